"""``marlms-general``: one learned policy for every agent of every team, distributed (project).

Every agent senses its own lanes, sends what it sensed and decides by itself between formation and column, from what it sensed
and what it heard of the others; see :mod:`marlbc_mj.policies.general`. Avoidance is the composition's business: only the
set-based one will do. Without a communication layer in the scenario everybody hears everybody at once.
"""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.policies.general import FORMATION, GeneralPolicy, Sensed, decision_steps, motion_orders, read_general
from marlbc_mj.policies.general_inputs import Sight, make_sight, sense_features
from marlbc_mj.scenarios import Scenario


class GeneralMemory(NamedTuple):
    """B teams between two mission steps."""

    sight: Sight
    orders: np.ndarray  # (2,) index into scenario.orders of every action
    interval: int  # mission steps that a decision holds for
    actions: np.ndarray  # (B, N) in force
    solver_ms: float = 0.0  # what inputs and network took in the last mission step [ms]


@dataclass(frozen=True)
class General:
    """The general policy as a supervisor; build it with :meth:`load`.

    A decision holds for 1.2 settling times, counted by each team's own steps; in between, nothing is computed.
    """

    policy: GeneralPolicy

    @classmethod
    def load(cls, path: Path) -> "General":
        """From a checkpoint.

        Raises:
            ConfigurationError: the file is missing, torn, changed, of other inputs, or not a checkpoint of a general policy.
        """
        return cls(read_general(path)[0])

    def start(self, scenario: Scenario, teams: int) -> GeneralMemory:
        """All teams in formation.

        Raises:
            ConfigurationError: another composition than the set-based one, no column, or a path at rest.
        """
        orders, sight = motion_orders(scenario), make_sight(scenario)
        actions = np.full((teams, scenario.agents), FORMATION, dtype=np.int64)
        return GeneralMemory(sight, orders, decision_steps(scenario, sight), actions)

    def decide(self, observation: Observation, memory: GeneralMemory) -> tuple[np.ndarray, GeneralMemory]:
        """Formation or column for every agent; the one in force unless the other is better by more than the margin."""
        actions, began = memory.actions, perf_counter()
        due = observation.step % memory.interval == 0
        if due.any():
            seen = observation if due.all() else Observation(*(field[due] for field in observation))
            features = sense_features(seen, memory.sight)
            sent = self.policy.messages(features)
            heard, age = sent[:, None], np.zeros((len(sent), 1, sent.shape[1]))
            actions = actions.copy()
            actions[due] = self.policy.decide(Sensed(features, actions[due], seen.step == 0), heard, age)
        return memory.orders[actions], memory._replace(actions=actions, solver_ms=1e3 * (perf_counter() - began))
