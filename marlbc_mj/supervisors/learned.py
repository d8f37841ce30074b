"""Learned supervisors: a checkpoint's greedy policy, evaluated without torch every few mission steps."""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.policies.actions import order_of
from marlbc_mj.policies.checkpoint import check_policy, check_signature, read_policy
from marlbc_mj.policies.greedy import Policy, greedy
from marlbc_mj.policies.states import OLD, State, make_state
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Situation


class LearnedMemory(NamedTuple):
    """One team between two mission steps."""

    read: State
    order_of: np.ndarray  # (A,) index into scenario.orders of every action
    command_of: np.ndarray  # (A,) index into scenario.orders.commands of every action
    hold: float  # how long a decision holds [s]
    actions: np.ndarray  # (1, N) in force
    age: np.ndarray  # (1, N) how long their commands have been in force [s]
    solver_ms: float = 0.0  # what state and networks took in the last mission step [ms]


@dataclass(frozen=True)
class Learned:
    """A trained policy as a supervisor; build it with :meth:`load`.

    A decision holds for ``interval`` mission steps; in between, nothing is computed.
    """

    policy: Policy
    signature: dict[str, Any]
    path: Path

    @classmethod
    def load(cls, path: Path) -> "Learned":
        """From a checkpoint.

        Raises:
            ConfigurationError: the file is missing, torn, changed, or not a checkpoint of a policy.
        """
        policy, description = read_policy(path)
        return cls(policy, description["signature"], path)

    @property
    def interval(self) -> int:
        """Mission steps that a decision holds for."""
        return int(self.signature["interval"])

    def start(self, scenario: Scenario) -> LearnedMemory:
        """Check the scenario against what the policy was trained for.

        Raises:
            ConfigurationError: another team, other behaviors, slots, mission step or path, see
                :func:`~marlbc_mj.policies.checkpoint.signature`; or networks that do not fit them.
        """
        check_signature(self.path, self.signature, scenario)
        read = make_state(self.signature["state"], scenario)
        orders = order_of(scenario, self.signature["actions"])
        check_policy(self.path, self.policy, scenario.agents, len(orders), read.size)
        none = np.zeros((1, scenario.agents), dtype=np.int64)
        hold = self.interval * scenario.mission_step
        return LearnedMemory(read, orders, scenario.orders.command_of[orders], hold, none, np.full(none.shape, OLD))

    def decide(self, situation: Situation, memory: LearnedMemory) -> tuple[np.ndarray, LearnedMemory]:
        """The greedy action of every agent; the one in force unless another is better by more than the margin."""
        actions, age, began = memory.actions, memory.age, perf_counter()
        if situation.step % self.interval == 0:
            state = memory.read(_batch(situation), situation.obstacles[None], age)
            fresh = situation.step == 0
            actions = greedy(self.policy.values(state), actions, np.array([fresh]), self.policy.margin)
            kept = age if fresh else np.where(memory.command_of[actions] == situation.command, age, 0.0)
            age = kept + memory.hold
        solver_ms = 1e3 * (perf_counter() - began)
        return memory.order_of[actions[0]], memory._replace(actions=actions, age=age, solver_ms=solver_ms)


def _batch(situation: Situation) -> Observation:
    """A batch observation of one world."""
    return Observation(
        np.array([situation.step]),
        np.array([situation.time]),
        situation.position[None],
        situation.velocity[None],
        situation.clearance[None],
        np.array([situation.formation]),
        situation.command[None],
        np.full(situation.command[None].shape, np.inf),
        situation.reference[None],
        situation.obstacles[None],
    )
