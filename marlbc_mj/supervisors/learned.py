"""Learned supervisors: a checkpoint's greedy policy, evaluated every few mission steps without torch."""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.policies.actions import order_of
from marlbc_mj.policies.checkpoint import check_policy, check_signature, read_policy
from marlbc_mj.policies.greedy import Policy, greedy
from marlbc_mj.policies.shipped import called
from marlbc_mj.policies.states import State, make_state
from marlbc_mj.scenarios import Scenario


class LearnedMemory(NamedTuple):
    """Memory of :class:`Learned` for B teams."""

    read: State
    order_of: np.ndarray  # (A,) index into scenario.orders of each action
    actions: np.ndarray  # (B, N) actions in force
    solver_ms: float = 0.0  # computing time of state and networks in the last mission step [ms]


@dataclass(frozen=True)
class Learned:
    """A trained policy as a supervisor; build it with :meth:`load`.

    A decision holds for ``interval`` of each team's own mission steps; nothing is computed in between.
    """

    policy: Policy
    signature: dict[str, Any]
    path: Path

    @classmethod
    def load(cls, path: Path) -> "Learned":
        """Load a policy from a checkpoint.

        Raises:
            ConfigurationError: the file is missing, incomplete or altered, or not a checkpoint of a policy.
        """
        policy, description = read_policy(path)
        return cls(policy, description["signature"], path)

    @property
    def interval(self) -> int:
        """Mission steps for which a decision holds."""
        return int(self.signature["interval"])

    def start(self, scenario: Scenario, teams: int) -> LearnedMemory:
        """Initial memory; checks that the policy was trained for this scenario.

        Raises:
            ConfigurationError: a different team, or different behaviors, slots, mission step or path, see
                :func:`~marlbc_mj.policies.checkpoint.signature`; or networks that do not fit them.
        """
        path = called(self.path)
        check_signature(path, self.signature, scenario)
        read = make_state(self.signature["state"], scenario)
        orders = order_of(scenario, self.signature["actions"])
        check_policy(path, self.policy, scenario.agents, len(orders), read.size)
        return LearnedMemory(read, orders, np.zeros((teams, scenario.agents), dtype=np.int64))

    def decide(self, observation: Observation, memory: LearnedMemory) -> tuple[np.ndarray, LearnedMemory]:
        """The greedy action of every agent; the action in force unless another is better by more than the margin."""
        actions, began = memory.actions, perf_counter()
        due = observation.step % self.interval == 0
        if due.any():
            seen = Observation(*(field[due] for field in observation))
            values = self.policy.values(memory.read(seen))
            actions = actions.copy()
            actions[due] = greedy(values, actions[due], seen.step == 0, self.policy.margin)
        solver_ms = 1e3 * (perf_counter() - began)
        return memory.order_of[actions], memory._replace(actions=actions, solver_ms=solver_ms)
