"""A trained team without torch: states in, actions out."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from marlbc_mj.laws import compiled

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
        y = outputs((state / self.scale).astype(np.float32), self.weights, self.biases)
        actions = self.columns
        values, logits = y[..., self.dueling : self.dueling + actions], y[..., self.dueling + actions :]
        if self.dueling:
            values = y[..., :1] + values - values.mean(axis=-1, keepdims=True)
        if self.risk:
            risks = 1.0 / (1.0 + np.exp(-logits))
            values = np.where(admissible(risks, risks.min(axis=-1, keepdims=True), self.risk), values, -np.inf)
        return np.asarray(values)


@compiled
def outputs(x, weights, biases):  # type: ignore[no-untyped-def]
    """(B, N, O) of the last layers for inputs (B, in), all float32, summed in the order of the inputs for any B.

    For one team a loop takes less time than a BLAS call a layer; for many, it costs no more than their simulation by far.
    """
    networks, last = len(weights[0]), len(weights) - 1
    widest = 0
    for bias in biases:
        widest = max(widest, bias.shape[2])
    out = np.empty((len(x), networks, biases[last].shape[2]), dtype=np.float32)
    layers = np.empty((2, widest), dtype=np.float32)
    for b in range(len(x)):
        for i in range(networks):
            y = x[b]
            for k in range(last + 1):
                weight = weights[k][i]
                z = layers[k % 2, : weight.shape[1]]
                z[:] = biases[k][i, 0]
                for j in range(weight.shape[0]):
                    factor = y[j]
                    if factor != 0.0:
                        for o in range(len(z)):
                            z[o] += factor * weight[j, o]
                if k < last:
                    for o in range(len(z)):
                        if z[o] < 0.0:  # NaN passes through
                            z[o] = 0.0
                y = z
            out[b, i] = y
    return out


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
    world, agent = np.arange(len(last))[:, None], np.arange(agents)
    lead = values[world, agent, best] - values[world, agent, last]
    return np.where((lead > margin) | fresh[:, None], best, last)
