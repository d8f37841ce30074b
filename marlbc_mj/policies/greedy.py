"""A trained team without torch: states in, actions out."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from marlbc_mj.core.laws import compiled, inlined

if TYPE_CHECKING:
    from torch import Tensor

SLACK: float = np.float32(0.05)  # type: ignore[assignment]  # float32 in compiled code, as it is in torch
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
        state = np.ascontiguousarray(state, dtype=np.float32)
        scale = np.asarray(self.scale, dtype=np.float32)
        weights, biases = self.weights, self.biases
        if not all(array.flags.carray for array in (*weights, *biases)):  # compiled code takes arrays of one kind
            weights, biases = (
                tuple(np.require(array, np.float32, ("C", "W")) for array in arrays) for arrays in (weights, biases)
            )
        values: np.ndarray = action_values(state, scale, weights, biases, self.dueling, self.columns, np.float32(self.risk))
        return values


Array = TypeVar("Array", np.ndarray, "Tensor")


@inlined
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

    Raises:
        IndexError: a last action that is none.
    """
    agents = last.shape[1]
    if values.shape[1] != agents:
        each = (round(values.shape[2] ** (1 / agents)),) * agents
        joint = greedy(values, np.ravel_multi_index(tuple(last.T), each)[:, None], fresh, margin)
        return np.stack(np.unravel_index(joint[:, 0], each), axis=-1)
    best: np.ndarray = best_actions(values, last, fresh, np.result_type(values, np.float32).type(margin))
    return best


@compiled
def best_actions(values, last, fresh, margin):
    """:func:`greedy` for values (B, N, A)."""
    best = np.empty(last.shape, dtype=np.int64)
    for b in range(last.shape[0]):
        for i in range(last.shape[1]):
            if not 0 <= last[b, i] < values.shape[2]:
                raise IndexError("a last action is no index into the action values")
            action = values[b, i].argmax()
            leads = values[b, i, action] - values[b, i, last[b, i]] > margin
            best[b, i] = action if leads or fresh[b] else last[b, i]
    return best


@compiled
def action_values(state, scale, weights, biases, dueling, actions, limit):
    """(B, N, A) values of ``Policy``'s networks for states (B, S), all float32; ``limit`` is the largest admissible risk, or 0.

    For one team, loops take less time than a BLAS call a layer and a NumPy call an operation.
    """
    networks, last, widest = len(weights[0]), len(weights) - 1, 0
    for bias in biases:
        widest = max(widest, bias.shape[2])
    values = np.empty((len(state), networks, actions), dtype=np.float32)
    layers, risks, one = np.empty((2, widest), dtype=np.float32), np.empty(actions, dtype=np.float32), np.float32(1.0)
    for b in range(len(state)):
        x = state[b] / scale
        for i in range(networks):
            y = x
            for k in range(last + 1):
                z = layers[k % 2, : weights[k].shape[2]]
                dense(y, weights[k][i], biases[k][i, 0], z)
                if k < last:
                    rectify(z)
                y = z
            q = values[b, i]
            q[:] = y[dueling : dueling + actions]
            if dueling:
                mean = q.sum() / np.float32(actions)
                for a in range(actions):
                    q[a] = y[0] + q[a] - mean
            if limit > 0.0:
                for a in range(actions):
                    risks[a] = one / (one + np.exp(-y[dueling + actions + a]))
                least = risks.min()
                for a in range(actions):
                    if not admissible(risks[a], least, limit):
                        q[a] = -np.inf
    return values


@compiled
def dense(x, weight, bias, out):
    """``x @ weight + bias`` into ``out``, summed in the order of the inputs, those that are 0 left out."""
    out[:] = bias
    for j in range(len(x)):
        factor = x[j]
        if factor != 0.0:
            for o in range(len(out)):
                out[o] += factor * weight[j, o]


@compiled
def rectify(x):
    """The larger of ``x`` and 0, in place; NaN passes through."""
    for j in range(len(x)):
        if x[j] < 0.0:
            x[j] = 0.0
