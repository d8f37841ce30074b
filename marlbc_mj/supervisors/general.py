"""``marlms-general``: one learned policy for every agent of every team, distributed (project).

Every agent senses its own lanes, sends these features to the others, and computes the values of formation and column from its own
features and those it has heard; see :mod:`marlbc_mj.policies.general`. If the policy decides by consensus, the agent also sends
its lead and decides by the mean of the leads that it knows. The shipped policy leaves avoidance to the composition, which must be
the set-based one. A policy that was trained under the null-space composition also decides about avoidance, and its agents give
way to each other as under other supervisors.

The scenario's communication layer carries the messages at every mission step, in two rounds if there are leads: features first.
With ideal communication, all agents hear each other at once, and messages are computed only at decisions. An agent that is cut
off continues with its own features and those heard before; their age and the number of agents heard are among its inputs. Leads
of others count for one interval only. So each connected component decides for itself.
"""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.communication import IDEAL
from marlbc_mj.engine.observation import Observation
from marlbc_mj.policies.general import (
    FORMATION,
    GeneralPolicy,
    Sensed,
    agree,
    decision_steps,
    lead_of_column,
    orders_for,
    read_general,
)
from marlbc_mj.policies.general_inputs import SENT, Sight, make_sight, sense_features
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.communication import Layer, make_layer
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift, no_way
from marlbc_mj.supervisors.set_based_rule import composition_avoids


class GeneralMemory(NamedTuple):
    """Memory of :class:`General` for B teams."""

    sight: Sight
    orders: np.ndarray  # (A,) index into scenario.orders of each action
    interval: int  # mission steps for which a decision holds
    actions: np.ndarray  # (B, N) actions in force
    way: GiveWay  # data for giving way to other agents; none if the composition does it
    layer: Layer | None = None  # None: communication is ideal
    network: Any = None  # the layer's memory of features
    leads: Any = None  # the layer's memory of leads
    solver_ms: float = 0.0  # computing time of inputs and network in the last mission step [ms]


@dataclass(frozen=True)
class General:
    """The general policy as a supervisor; build it with :meth:`load`.

    A decision holds for 1.2 settling times, counted in each team's own mission steps.
    """

    policy: GeneralPolicy

    @classmethod
    def load(cls, path: Path) -> "General":
        """Load a policy from a checkpoint.

        Raises:
            ConfigurationError: the file is missing, incomplete or altered, of other inputs, or not of a general policy.
        """
        return cls(read_general(path)[0])

    def start(self, scenario: Scenario, teams: int) -> GeneralMemory:
        """Initial memory: all teams in formation, nothing has been heard.

        Raises:
            ConfigurationError: a composition other than the one of training, no column, or a path at rest.
        """
        orders, sight = orders_for(self.policy, scenario), make_sight(scenario)
        actions = np.full((teams, scenario.agents), FORMATION, dtype=np.int64)
        way = no_way(scenario) if composition_avoids(scenario) else give_way(scenario)
        memory = GeneralMemory(sight, orders, decision_steps(scenario, sight), actions, way)
        if scenario.communication == IDEAL:
            return memory
        layer = make_layer(scenario)
        return memory._replace(layer=layer, network=layer.start(teams, SENT), leads=layer.start(teams, 1))

    def decide(self, observation: Observation, memory: GeneralMemory) -> tuple[np.ndarray, GeneralMemory]:
        """Orders of the actions in force, which teams with a due decision choose anew; see :meth:`GeneralPolicy.decide`."""
        began, due = perf_counter(), observation.step % memory.interval == 0
        if memory.layer is None:
            memory = self._decide_due(observation, memory, due) if np.count_nonzero(due) else memory
        else:
            memory = self._exchange_and_decide(observation, memory, due)
        orders = lift(memory.orders[memory.actions], observation, memory.way)
        return orders, memory._replace(solver_ms=1e3 * (perf_counter() - began))

    def _decide_due(self, observation: Observation, memory: GeneralMemory, due: np.ndarray) -> GeneralMemory:
        """The memory with new actions of the teams ``due`` (B,), with ideal communication."""
        seen = observation if np.count_nonzero(due) == len(due) else Observation(*(field[due] for field in observation))
        features = sense_features(seen, memory.sight)
        sent = self.policy.messages(features)
        age = np.zeros((len(sent), 1, sent.shape[1]))
        values = self.policy.evaluate(features, sent[:, None], age)
        if self.policy.consensus:
            values = agree(values, lead_of_column(values)[:, None], age)
        return self._with_actions(features, seen.step == 0, values, memory, due)

    def _exchange_and_decide(self, observation: Observation, memory: GeneralMemory, due: np.ndarray) -> GeneralMemory:
        """The memory after one mission step of communication, with new actions of the teams ``due`` (B,)."""
        assert memory.layer is not None
        features, time = sense_features(observation, memory.sight), observation.time
        layer, where, seed = memory.layer, (time, observation.position), observation.noise_seed
        (heard, stamp), network = layer.exchange(*where, self.policy.messages(features), memory.network, seed)
        memory = memory._replace(network=network)
        if not (self.policy.consensus or due.any()):
            return memory
        values = self.policy.evaluate(features, heard, (time[:, None, None] - stamp) / memory.sight.time)
        if self.policy.consensus:
            (told, stamp), leads = layer.exchange(*where, lead_of_column(values)[..., None], memory.leads, seed)
            values = agree(values, told[..., 0], (time[:, None, None] - stamp) / memory.sight.time)
            memory = memory._replace(leads=leads)
        return self._with_actions(features[due], observation.step[due] == 0, values[due], memory, due) if due.any() else memory

    def _with_actions(
        self,
        features: np.ndarray,
        fresh: np.ndarray,
        values: np.ndarray,
        memory: GeneralMemory,
        due: np.ndarray,
    ) -> GeneralMemory:
        """The memory with new actions of the teams ``due`` (B,); features, fresh and values have one row per due team."""
        actions = memory.actions.copy()
        actions[due] = self.policy.decide(Sensed(features, actions[due], fresh), values)
        return memory._replace(actions=actions)
