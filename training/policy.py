"""A trained team as plain NumPy: states in, actions out, without torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

SLACK = 0.05
"""Where every action is risky, those that exceed the least risk by no more than this stay admissible."""


class Policy(NamedTuple):
    """Greedy policy of N dueling (or plain) networks with a switching margin; what a checkpoint holds."""

    weights: tuple[np.ndarray, ...]  # (N, in, out) float32 each
    biases: tuple[np.ndarray, ...]  # (N, 1, out)
    scale: np.ndarray  # (S,)
    dueling: bool
    margin: float
    risk: float = 0.0  # largest admissible risk; 0 where the networks have no risks

    @property
    def columns(self) -> int:
        """Values that a network gives for a state."""
        return int((self.biases[-1].shape[-1] - self.dueling) // (2 if self.risk else 1))

    def width(self, columns: int) -> int:
        """Outputs that the last layer needs for so many values."""
        return int(self.dueling) + columns * (2 if self.risk else 1)

    def values(self, state: np.ndarray) -> np.ndarray:
        """(B, N, A) action values of states (B, S); -inf for actions that are too risky."""
        first = self.weights[0]
        networks, inputs, width = first.shape
        y = (state / self.scale).astype(np.float32) @ first.transpose(1, 0, 2).reshape(inputs, networks * width)
        y = y.reshape(len(state), networks, width).transpose(1, 0, 2) + self.biases[0]
        for weight, bias in zip(self.weights[1:], self.biases[1:], strict=True):
            y = np.matmul(np.maximum(y, 0.0), weight) + bias
        y = y.transpose(1, 0, 2)
        actions = self.columns
        values, logits = y[..., self.dueling : self.dueling + actions], y[..., self.dueling + actions :]
        if self.dueling:
            values = y[..., :1] + values - values.mean(axis=-1, keepdims=True)
        if self.risk:
            risks = 1.0 / (1.0 + np.exp(-logits))
            values = np.where(admissible(risks, risks.min(axis=-1, keepdims=True), self.risk), values, -np.inf)
        return np.asarray(values)


Array = TypeVar("Array", np.ndarray, "Tensor")


def admissible(risks: Array, least: Array, limit: float) -> Array:
    """Bool (..., A): which actions may be taken, by their risks (..., A) and the least of these (..., 1)."""
    return (risks <= limit) | (risks <= least + SLACK)


def greedy(values: np.ndarray, last: np.ndarray, fresh: np.ndarray, margin: float) -> np.ndarray:
    """(B, N) actions: the best one, but the last one unless the best is better by more than ``margin``.

    Args:
        values: (B, N, A), or (B, 1, A^N) of joint actions in C order, of which the best as a whole is taken.
        last: (B, N) actions before.
        fresh: (B,) bool, no action has been taken yet, so there is nothing to keep.
        margin: of the action values.
    """
    agents = last.shape[1]
    if values.shape[1] != agents:
        each = (round(values.shape[2] ** (1 / agents)),) * agents
        joint = greedy(values, np.ravel_multi_index(tuple(last.T), each)[:, None], fresh, margin)
        return np.stack(np.unravel_index(joint[:, 0], each), axis=-1)
    best = values.argmax(axis=-1)
    lead = np.take_along_axis(values, best[..., None], axis=-1) - np.take_along_axis(values, last[..., None], axis=-1)
    return np.where((lead[..., 0] > margin) | fresh[:, None], best, last)
