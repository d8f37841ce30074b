"""``marlms-general``: one learned policy for every agent of every team, distributed (project).

Every agent senses its own lanes, sends what it sensed and decides by itself between formation and column, from what it sensed
and what it heard of the others; see :mod:`marlbc_mj.policies.general`. The shipped policy leaves avoidance to the composition,
which must be the set-based one; a policy that was trained under the null-space composition decides about avoidance, too, and
its agents give way to each other as under other supervisors.

The communication layer of the scenario carries what is sent, at every mission step. With ideal communication everybody hears
everybody at once, and nothing is exchanged between decisions. An agent that is cut off goes on by what it senses and by what it
heard before; how old that is, and how many it has heard of, are among its inputs. So each connected component decides for itself.
"""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.communication import IDEAL
from marlbc_mj.engine.observation import Observation
from marlbc_mj.policies.general import FORMATION, GeneralPolicy, Sensed, decision_steps, orders_for, read_general
from marlbc_mj.policies.general_inputs import SENT, Sight, make_sight, sense_features
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.communication import Layer, make_layer
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift, no_way
from marlbc_mj.supervisors.set_based_rule import avoids_by_itself


class GeneralMemory(NamedTuple):
    """B teams between two mission steps."""

    sight: Sight
    orders: np.ndarray  # (A,) index into scenario.orders of every action
    interval: int  # mission steps that a decision holds for
    actions: np.ndarray  # (B, N) in force
    way: GiveWay  # to other agents; none where the composition keeps them apart
    layer: Layer | None = None  # None: communication is ideal
    network: Any = None  # the layer's memory
    solver_ms: float = 0.0  # what inputs and network took in the last mission step [ms]


@dataclass(frozen=True)
class General:
    """The general policy as a supervisor; build it with :meth:`load`.

    A decision holds for 1.2 settling times, counted by each team's own steps.
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
        """All teams in formation; nothing has been heard.

        Raises:
            ConfigurationError: another composition than the one it was trained under, no column, or a path at rest.
        """
        orders, sight = orders_for(self.policy, scenario), make_sight(scenario)
        actions = np.full((teams, scenario.agents), FORMATION, dtype=np.int64)
        way = no_way(scenario) if avoids_by_itself(scenario) else give_way(scenario)
        memory = GeneralMemory(sight, orders, decision_steps(scenario, sight), actions, way)
        if scenario.communication == IDEAL:
            return memory
        layer = make_layer(scenario)
        return memory._replace(layer=layer, network=layer.start(teams, SENT))

    def decide(self, observation: Observation, memory: GeneralMemory) -> tuple[np.ndarray, GeneralMemory]:
        """An action for every agent: the one in force unless another is better by more than the margin."""
        began, due = perf_counter(), observation.step % memory.interval == 0
        if memory.layer is None:
            memory = self._decide_due(observation, memory, due) if np.count_nonzero(due) else memory
        else:
            memory = self._exchange_and_decide(observation, memory, due)
        orders = lift(memory.orders[memory.actions], observation, memory.way)
        return orders, memory._replace(solver_ms=1e3 * (perf_counter() - began))

    def _decide_due(self, observation: Observation, memory: GeneralMemory, due: np.ndarray) -> GeneralMemory:
        """The memory with new actions of the teams ``due`` (B,), everybody heard at once."""
        seen = observation if np.count_nonzero(due) == len(due) else Observation(*(field[due] for field in observation))
        features = sense_features(seen, memory.sight)
        sent = self.policy.messages(features)
        heard, age = sent[:, None], np.zeros((len(sent), 1, sent.shape[1]))
        return self._with_actions(features, seen.step == 0, (heard, age), memory, due)

    def _exchange_and_decide(self, observation: Observation, memory: GeneralMemory, due: np.ndarray) -> GeneralMemory:
        """The memory after one mission step of communication, with new actions of the teams ``due`` (B,)."""
        assert memory.layer is not None
        features, time = sense_features(observation, memory.sight), observation.time
        sent = self.policy.messages(features)
        (heard, stamp), network = memory.layer.exchange(time, observation.position, sent, memory.network, observation.noise_seed)
        memory = memory._replace(network=network)
        if not due.any():
            return memory
        age = (time[:, None, None] - stamp) / memory.sight.time
        return self._with_actions(features[due], observation.step[due] == 0, (heard[due], age[due]), memory, due)

    def _with_actions(
        self,
        features: np.ndarray,
        fresh: np.ndarray,
        knowledge: tuple[np.ndarray, np.ndarray],
        memory: GeneralMemory,
        due: np.ndarray,
    ) -> GeneralMemory:
        """The memory with the decisions of the teams ``due`` (B,), of which the rest of the arguments are."""
        actions = memory.actions.copy()
        actions[due] = self.policy.decide(Sensed(features, actions[due], fresh), *knowledge)
        return memory._replace(actions=actions)
