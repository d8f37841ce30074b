"""The general policy: one network for every agent of every team. Each agent decides between formation and column and, under the
null-space composition, where the composition does not avoid by itself, also whether avoidance is on top.

Its inputs are defined in :mod:`marlbc_mj.policies.general_inputs`. An agent sends one feature vector to the others. It computes
its action values from its own features and those heard so far, of any age and from any number of agents, even none.

Agents can decide by *consensus*: each sends its *lead*, the value of the column minus that of the formation, and takes the mean
of the leads that it knows in place of its own. Value decomposition learns the value of a team as the mean over its agents, so the
sign of the mean lead tells which of the two the team should take. Agents that hear each other then take the same.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.laws import compiled, inlined
from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.policies.general_inputs import (
    AGE_ENTRIES,
    COARSE,
    COARSEST,
    ENDING,
    INPUT_LAYOUT,
    INPUTS,
    SENT,
    WAYS,
    Sight,
    join_inputs,
)
from marlbc_mj.policies.greedy import Array, Policy, greedy
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import write_json

KIND = "general"
"""Entry of a checkpoint's header that identifies general policies."""
MOTIONS = FORMATION, COLUMN_ACTION = 0, 1
"""The actions: take the formation, or the column. Action ``len(MOTIONS) + k`` is action k with avoidance on top."""
ACTIONS_UNDER = {"set-based": len(MOTIONS), "null-space": 2 * len(MOTIONS)}
"""A, the number of actions of an agent, by composition."""
_NEEDS = {
    "set-based": "decides between formation and column alone and needs the composition that avoids by itself",
    "null-space": "decides about avoidance, too, and needs the composition that leaves avoidance to it",
}
"""Reasons why a policy requires its composition, for error messages."""
INTERVAL = 1.2
"""Time for which a decision holds, in settling times. Leads that are older do not count."""


class Sensed(NamedTuple):
    """Sensed features of B teams at a decision, and the actions in force."""

    features: np.ndarray  # (B, N, F) float32
    last: np.ndarray  # (B, N) actions in force
    fresh: np.ndarray  # (B,) bool, whether no action is in force yet


class GeneralPolicy(NamedTuple):
    """Dueling networks that all agents share, with a switching margin, a dwell time and a deadline.

    The values of the policy are the mean over the networks.
    """

    network: Policy  # one or more networks with INPUTS inputs and A action values
    dwell: int = 1  # least number of decisions for which an agent keeps a new order
    deadline: float = 0.0  # time reserved for the way back to the formation, per distance from the slot [T per d_OA]; 0: none
    consensus: bool = False  # whether agents decide by the mean of their leads

    @property
    def actions(self) -> int:
        """A, the number of actions of an agent."""
        return self.network.columns

    @property
    def composition(self) -> str:
        """The composition under which it was trained, derived from the number of actions."""
        return next(name for name, actions in ACTIONS_UNDER.items() if actions == self.actions)

    def messages(self, features: np.ndarray) -> np.ndarray:
        """(B, N, M) message of each agent to the others: the features that it sends."""
        return features[..., :SENT]

    def evaluate(self, features: np.ndarray, heard: np.ndarray, age: np.ndarray) -> np.ndarray:
        """(B, N, A) action values of each agent.

        Args:
            features: (B, N, F) float32, sensed features of each agent.
            heard: (B, N, N, M) or (B, 1, N, M), see :func:`join_inputs`; row i is what agent i has heard of each agent.
            age: (B, N, N) or (B, 1, N), age of these messages [T]; infinite where nothing was heard.
        """
        inputs = join_inputs(features, heard, age)
        return self.values(inputs.reshape(-1, INPUTS)).reshape(*inputs.shape[:2], self.actions)

    def decide(self, sensed: Sensed, values: np.ndarray) -> np.ndarray:
        """(B, N) actions: the best one if its value leads by more than the margin and the agent :func:`may_change`, else the
        action in force. An agent that :func:`must_return` takes the formation, with avoidance on top if the action had it.

        Args:
            sensed: features of each agent, and the actions in force.
            values: (B, N, A) from :meth:`evaluate`; for a policy with ``consensus``, after :func:`agree`.
        """
        chosen = greedy(values, sensed.last, sensed.fresh, self.network.margin)
        _keep_or_return(chosen, sensed, self.dwell, self.deadline)
        return chosen

    def values(self, inputs: np.ndarray) -> np.ndarray:
        """(M, A) action values for inputs (M, S), one row per agent."""
        each = self.network.values(inputs)
        return each[:, 0] if each.shape[1] == 1 else _mean_values(each)


def agree(values: np.ndarray, leads: np.ndarray, age: np.ndarray) -> np.ndarray:
    """Values (B, N, A), with the mean of the leads that an agent knows in place of its own.

    Args:
        values: (B, N, A) action values.
        leads: (B, N, N) or (B, 1, N), row i is the newest lead of each agent that agent i knows, its own included.
        age: age of these leads [T]; infinite where none is known.
    """
    agreed: np.ndarray = with_lead(values, mean_lead(np.ascontiguousarray(leads, dtype=np.float32), age))
    return agreed


@compiled
def lead_of_column(values):
    """(B, N) best value of an action that takes the column minus the best of one that takes the formation; values (B, N, A)."""
    lead = np.empty(values.shape[:2], dtype=values.dtype)
    for b in range(values.shape[0]):
        for i in range(values.shape[1]):
            lead[b, i] = best_value(values[b, i], COLUMN_ACTION) - best_value(values[b, i], FORMATION)
    return lead


@compiled
def best_value(values, motion):
    """Largest of the values (A,) of the actions that take a motion; NaN if one of them is."""
    return values[motion :: len(MOTIONS)].max()


@compiled
def mean_lead(leads, age):
    """(B, N) or (B, 1) mean of the leads (B, R, N) with an ``age`` (B, R, N) of at most one interval [T], for each receiver."""
    mean = np.zeros(leads.shape[:2], dtype=np.float32)
    for b in range(leads.shape[0]):
        for r in range(leads.shape[1]):
            count = 0
            for s in range(leads.shape[2]):
                if age[b, r, s] <= INTERVAL:
                    mean[b, r] += leads[b, r, s]
                    count += 1
            mean[b, r] /= np.float32(max(count, 1))
    return mean


@compiled
def with_lead(values, lead):
    """Values (B, N, A) relative to the formation's, shifted so that the column leads by ``lead`` (B, N or 1)."""
    shifted = values.copy()
    for b in range(values.shape[0]):
        for i in range(values.shape[1]):
            for motion in range(len(MOTIONS)):
                shifted[b, i, motion :: len(MOTIONS)] -= best_value(values[b, i], motion)
            shifted[b, i, COLUMN_ACTION :: len(MOTIONS)] += lead[b, min(i, lead.shape[1] - 1)]
    return shifted


@compiled
def _mean_values(values):
    """(M, A) mean of the values (M, N, A) of N networks, summed in the order of the networks."""
    mean = values[:, 0].copy()
    for i in range(1, values.shape[1]):
        mean += values[:, i]
    mean /= np.float32(values.shape[1])
    return mean


@compiled
def _keep_or_return(chosen, sensed, dwell, deadline):
    """Replace actions ``chosen`` (B, N) by those in force for agents that :func:`may_change` forbids to change, and by the
    formation for agents that :func:`must_return`.
    """
    for b in range(chosen.shape[0]):
        for i in range(chosen.shape[1]):
            own = sensed.features[b, i]
            if not may_change(own[AGE_ENTRIES], sensed.fresh[b], dwell):
                chosen[b, i] = sensed.last[b, i]
            if deadline > 0.0 and must_return(own[WAYS + 1], own[ENDING + 1], deadline):
                chosen[b, i] -= chosen[b, i] % len(MOTIONS)


@inlined
def may_change(age: Array, fresh: Array, dwell: int) -> Array:
    """Bool (...,): whether an agent may change its order.

    Without a dwell time, an agent can dither between two orders close to an obstacle; the references then jump, and the tracking
    error leads to a violation. A dwell time limits such changes (Hespanha and Morse 1999).

    Args:
        age: (...,) entry ``AGE_ENTRIES`` of the agents' features.
        fresh: (...,) bool, whether no order is in force yet.
        dwell: least age of an order, in decisions; half a decision less suffices, since decisions are rounded to mission steps.
    """
    least = -math.expm1(-(dwell - 0.5) * INTERVAL / COARSE) if dwell > 1 else 0.0
    result: Array = (age >= least) | fresh
    return result


@inlined
def must_return(distance: Array, ending: Array, deadline: float) -> Array:
    """Bool (...,): whether the time left is at most ``deadline`` times an agent's distance from its slot in the formation.

    Time is measured in settling times T, distance in d_OA; one T is longer than d_OA takes at full speed. Distances above 36
    count as 36.

    Args:
        distance: (...,) entry ``WAYS + 1`` of the agents' features, tanh(e / COARSE).
        ending: (...,) entry ``ENDING + 1``, exp(-t / COARSEST).
        deadline: see :class:`GeneralPolicy`; must be positive.
    """
    reach = (1.0 + distance) * ending ** (2.0 * COARSEST / (COARSE * deadline))
    result: Array = (1.0 - distance <= reach) & (reach >= 1e-6)
    return result


def decision_steps(scenario: Scenario, sight: Sight) -> int:
    """Mission steps for which a decision holds."""
    return max(1, round(INTERVAL * sight.time / scenario.mission_step))


def action_orders(scenario: Scenario) -> np.ndarray:
    """(A,) index into ``scenario.orders`` of each action under the scenario's composition.

    Raises:
        ConfigurationError: an order is missing.
    """
    motions = scenario.formation_names
    names = (*motions, *(f"OA>{motion}" for motion in motions))[: ACTIONS_UNDER[scenario.composition]]
    return np.array([scenario.orders.index(name) for name in names])


def orders_for(policy: GeneralPolicy, scenario: Scenario) -> np.ndarray:
    """:func:`action_orders` of a scenario, checked against the policy's composition.

    Raises:
        ConfigurationError: an order is missing, or the policy was trained for another composition.
    """
    if scenario.composition != policy.composition:
        raise ConfigurationError(
            f"scenario {scenario.name!r} has composition {scenario.composition!r}; the general policy "
            f"{_NEEDS[policy.composition]}: --composition {policy.composition}"
        )
    return action_orders(scenario)


def write_general(path: Path, policy: GeneralPolicy, description: dict[str, Any]) -> None:
    """Write a policy with its description, and the description again as a JSON file beside it for people to read."""
    network = policy.network
    arrays = {f"weight{k}": w for k, w in enumerate(network.weights)} | {f"bias{k}": b for k, b in enumerate(network.biases)}
    flown = {"margin": network.margin, "dwell": policy.dwell, "deadline": policy.deadline, "consensus": policy.consensus}
    said = {**description, "kind": KIND, "layout": INPUT_LAYOUT, "interval": INTERVAL, **flown}
    write_arrays(path, arrays, said)
    write_json(path.with_suffix(".json"), said)


def is_general(path: Path) -> bool:
    """Whether a checkpoint holds a general policy.

    Raises:
        ConfigurationError: as :func:`~marlbc_mj.policies.checkpoint.read_arrays`.
    """
    return read_arrays(path)[1].get("kind") == KIND


def read_general(path: Path) -> tuple[GeneralPolicy, dict[str, Any]]:
    """Read a general policy and its description.

    Raises:
        ConfigurationError: as :func:`~marlbc_mj.policies.checkpoint.read_arrays`; a checkpoint of another kind, with other
            inputs or another interval, or with arrays that do not form such a network.
    """
    arrays, description = read_arrays(path)
    if description.get("kind") != KIND:
        raise ConfigurationError(f"checkpoint {path} holds the policy of a single team, not a general policy")
    for name, wanted in (("layout", INPUT_LAYOUT), ("interval", INTERVAL)):
        if description.get(name) != wanted:
            raise ConfigurationError(
                f"checkpoint {path} was trained on other inputs: {name} is {description.get(name)}, but {wanted} in this version"
            )
    layers = sum(name.startswith("weight") for name in arrays)
    try:
        weights = tuple(arrays[f"weight{k}"] for k in range(layers))
        biases = tuple(arrays[f"bias{k}"] for k in range(layers))
        margin, dwell = float(description["margin"]), int(description.get("dwell", 1))
        deadline, consensus = float(description.get("deadline", 0.0)), bool(description.get("consensus", False))
    except (KeyError, TypeError, ValueError):
        raise ConfigurationError(f"checkpoint {path} does not hold the network of a general policy") from None
    policy = make_general(weights, biases, margin)._replace(dwell=dwell, deadline=deadline, consensus=consensus)
    fault = _fault(policy)
    if fault:
        raise ConfigurationError(f"checkpoint {path} does not hold the network of a general policy: {fault}")
    return policy, description


def make_general(weights: tuple[np.ndarray, ...], biases: tuple[np.ndarray, ...], margin: float) -> GeneralPolicy:
    """The policy of M dueling networks with weights (M, in, out) and biases (M, 1, out) per layer; the last has 1 + A outputs.

    It has no dwell time and no deadline, and agents decide by their own leads.
    """
    return GeneralPolicy(Policy(weights, biases, np.ones(INPUTS, dtype=np.float32), True, margin))


def mean_policy(policies: Sequence[GeneralPolicy], margin: float) -> GeneralPolicy:
    """A policy that averages the values of several policies; it has no dwell time and no deadline. It decides as they all do.

    Raises:
        ConfigurationError: no policies, networks of different sizes, or only some policies that decide by consensus.
    """
    networks = [policy.network for policy in policies]
    sizes = {tuple(weight.shape[1:] for weight in network.weights) for network in networks}
    if len(sizes) != 1:
        raise ConfigurationError(f"a mean needs at least one policy and networks of the same size, got sizes {sorted(sizes)}")
    if len({policy.consensus for policy in policies}) > 1:
        raise ConfigurationError("a mean needs policies that all decide by consensus, or policies that all do not")
    weights = (np.concatenate(layers) for layers in zip(*(network.weights for network in networks), strict=True))
    biases = (np.concatenate(layers) for layers in zip(*(network.biases for network in networks), strict=True))
    return make_general(tuple(weights), tuple(biases), margin)._replace(consensus=policies[0].consensus)


def _fault(policy: GeneralPolicy) -> str:
    """The reason why a policy is not a valid general policy; empty if it is one."""
    weights, biases, margin = policy.network.weights, policy.network.biases, policy.network.margin
    width, count = INPUTS, len(biases[0]) if biases and biases[0].ndim else 1
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if weight.dtype != np.float32 or bias.dtype != np.float32 or weight.ndim != 3:
            return f"layer {k} is not made of float32 matrices"
        if weight.shape[:2] != (count, width) or bias.shape != (count, 1, weight.shape[2]):
            return f"layer {k} has weights {weight.shape} and biases {bias.shape} for {width} inputs"
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            return f"layer {k} is not finite"
        width = weight.shape[2]
    if not weights or width - 1 not in ACTIONS_UNDER.values():
        return f"its {width} outputs are not a value and {' or '.join(map(str, ACTIONS_UNDER.values()))} advantages"
    if policy.dwell < 1 or not 0.0 <= policy.deadline < math.inf:
        return f"its dwell is {policy.dwell} decisions, its deadline {policy.deadline}"
    return "" if np.isfinite(margin) else f"its margin is {margin}"
