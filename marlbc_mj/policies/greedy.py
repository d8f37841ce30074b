"""The greedy policy of a trained team without torch: maps states to actions.

It consists of three laws: :func:`dueling_value`, :func:`admissible` and :func:`takes_best`. They work element by element on
numbers in compiled code, on NumPy arrays and on torch tensors, so that training, inference and export share them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

import numpy as np

from marlbc_mj.core.laws import compiled, inlined

if TYPE_CHECKING:
    from torch import Tensor


class Policy(NamedTuple):
    """Greedy policy of N dueling (or plain) networks with a switching margin, as stored in a checkpoint."""

    weights: tuple[np.ndarray, ...]  # (N, in, out) float32 per layer
    biases: tuple[np.ndarray, ...]  # (N, 1, out) float32 per layer
    scale: np.ndarray  # (S,) divisor of the state
    dueling: bool
    margin: float  # lead of the best action's value over that of the last action needed for a change
    risk: float = 0.0  # largest admissible risk; 0 if the networks have no risk outputs

    @property
    def columns(self) -> int:
        """Number of action values that a network computes for a state."""
        return int((self.biases[-1].shape[-1] - self.dueling) // (2 if self.risk else 1))

    def width(self, columns: int) -> int:
        """Number of outputs that the last layer needs for this many action values."""
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
FEW_OUTPUTS = 8
"""Layers with fewer outputs are computed one output at a time."""
RISK_SLACK = cast(float, np.float32(0.05))  # float32 in compiled code, as it is in torch
"""If every action is too risky, those that exceed the least risk by no more than this remain admissible."""


@inlined
def dueling_value(value: Array, advantage: Array, mean: Array) -> Array:
    """Q(s, a) = V(s) + B(s, a) - mean_b B(s, b) (Wang et al. 2016).

    Args:
        value: (..., 1) V.
        advantage: (..., A) B.
        mean: (..., 1) mean of the advantages.
    """
    result: Array = value + advantage - mean
    return result


@inlined
def admissible(risks: Array, least: Array, limit: float) -> Array:
    """Bool (..., A): whether each action may be taken; at least one always may.

    Args:
        risks: (..., A) risks of the actions.
        least: (..., 1) the smallest of these.
        limit: largest acceptable risk.
    """
    return (risks <= limit) | (risks <= least + RISK_SLACK)


@inlined
def takes_best(lead: Array, fresh: Array, margin: float) -> Array:
    """Bool: whether the best action replaces the last one.

    Args:
        lead: value of the best action minus that of the last one.
        fresh: whether there is no last action.
        margin: lead needed for a change.
    """
    result: Array = (lead > margin) | fresh
    return result


def greedy(values: np.ndarray, last: np.ndarray, fresh: np.ndarray, margin: float) -> np.ndarray:
    """(B, N) actions: the best one if :func:`takes_best` holds, else the last one.

    Args:
        values: (B, N, A) action values, or (B, 1, A^N) of joint actions in C order, chosen jointly.
        last: (B, N) last actions.
        fresh: (B,) bool, whether there is no last action.
        margin: lead in action values needed for a change.

    Raises:
        IndexError: a last action that is not one of the A.
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
    """(B, N) actions as :func:`greedy` chooses them, for values (B, N, A)."""
    best = np.empty(last.shape, dtype=np.int64)
    for b in range(last.shape[0]):
        for i in range(last.shape[1]):
            if not 0 <= last[b, i] < values.shape[2]:
                raise IndexError("a last action is not an index into the action values")
            action = values[b, i].argmax()
            lead = values[b, i, action] - values[b, i, last[b, i]]
            best[b, i] = action if takes_best(lead, fresh[b], margin) else last[b, i]
    return best


@compiled
def action_values(state, scale, weights, biases, dueling, actions, limit):
    """(B, N, A) action values of a ``Policy``'s networks in states (B, S), all float32; -inf where an action is too risky.

    ``limit`` is the largest admissible risk, 0 for networks without risk outputs. For one team, loops are faster than one BLAS
    call per layer and one NumPy call per operation.
    """
    networks, last, widest = len(weights[0]), len(weights) - 1, 0
    for bias in biases:
        widest = max(widest, bias.shape[2])
    values = np.empty((len(state), networks, actions), dtype=np.float32)
    layers, risks = np.empty((2, widest), dtype=np.float32), np.empty(actions, dtype=np.float32)
    scaled = state / scale
    for i in range(networks):
        for b in range(len(state)):
            y = scaled[b]
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
                    q[a] = dueling_value(y[0], q[a], mean)
            if limit > 0.0:
                exclude_risky(q, y[dueling + actions :], limit, risks)
    return values


@compiled
def exclude_risky(values, logits, limit, risks):
    """Set ``values`` (A,) of actions that are too risky to -inf; writes the sigmoid of ``logits`` (A,) to ``risks`` (A,)."""
    one = np.float32(1.0)
    for a in range(len(values)):
        risks[a] = one / (one + np.exp(-logits[a]))
    least = risks.min()
    for a in range(len(values)):
        if not admissible(risks[a], least, limit):
            values[a] = -np.inf


@compiled
def dense(x, weight, bias, out):
    """Write ``x @ weight + bias`` to ``out``, summed in the order of the inputs.

    Large layers take four inputs at a time and skip them if all four are zero; layers with few outputs take one output at a time.
    Both results are identical to the last bit; each method is the faster one for its layers.
    """
    if len(out) < FEW_OUTPUTS:
        for o in range(len(out)):
            total = bias[o]
            for j in range(len(x)):
                total += x[j] * weight[j, o]
            out[o] = total
        return
    out[:] = bias
    whole = len(x) - len(x) % 4
    for j in range(0, whole, 4):
        a, b, c, d = x[j], x[j + 1], x[j + 2], x[j + 3]
        if a != 0.0 or b != 0.0 or c != 0.0 or d != 0.0:
            for o in range(len(out)):
                out[o] = (((out[o] + a * weight[j, o]) + b * weight[j + 1, o]) + c * weight[j + 2, o]) + d * weight[j + 3, o]
    for j in range(whole, len(x)):
        for o in range(len(out)):
            out[o] += x[j] * weight[j, o]


@compiled
def rectify(x):
    """Replace ``x`` by max(x, 0), in place; NaN passes through."""
    for j in range(len(x)):
        if x[j] < 0.0:
            x[j] = 0.0
