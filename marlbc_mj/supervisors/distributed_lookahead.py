"""Look-ahead without a center: every agent watches its own lane, tells the others, and decides from what it has heard.

The rule is that of :mod:`marlbc_mj.supervisors.lookahead`: the column while at least ``blocked`` lanes are blocked, else the
formation. An agent knows the plan and the obstacles along its own lane. Its message tells whether that lane is blocked and, under
the null-space composition, also whether its lane of the column is blocked and whether it is shut in. The scenario's communication
layer carries these votes (:mod:`marlbc_mj.supervisors.communication`). For each of them, an agent counts the agents that vote
yes, itself included. Votes older than ``hold`` do not count.

An agent that knows of fewer lanes than ``blocked`` forms the column only if all known lanes are blocked; without any message it
decides by its own lane. So each connected component of the team decides for itself, and with ideal communication all decisions
are those of the central rule.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.communication import Layer, make_layer
from marlbc_mj.supervisors.lookahead import Lanes, LookAhead
from marlbc_mj.supervisors.set_based_rule import IN_COLUMN, IN_FORMATION, rule_orders
from marlbc_mj.util.errors import ConfigurationError


class Votes(NamedTuple):
    """Memory of :class:`DistributedLookAhead`."""

    lanes: Lanes
    layer: Layer
    motion: np.ndarray  # (B, N) motion in force of each agent: IN_FORMATION or IN_COLUMN
    network: Any  # the layer's memory


@dataclass(frozen=True)
class DistributedLookAhead:
    """FR while at least ``blocked`` of the lanes that an agent knows of are blocked, else FM; see the module.

    Raises:
        ConfigurationError: a ``hold`` that is not positive.
    """

    rule: LookAhead = field(default_factory=LookAhead)  # defines when a lane is blocked and how many blocked lanes make a column
    hold: float = 2.0  # how long a vote counts [s]

    def __post_init__(self) -> None:
        if not self.hold > 0:
            raise ConfigurationError(f"DistributedLookAhead hold must be positive, got {self.hold}")

    def start(self, scenario: Scenario, teams: int) -> Votes:
        """Initial memory: all agents in formation, nothing has been heard.

        Raises:
            ConfigurationError: the scenario lacks an order.
        """
        lanes, layer = self.rule.start(scenario, teams), make_layer(scenario)
        motion = np.full((teams, scenario.agents), IN_FORMATION)
        return Votes(lanes, layer, motion, layer.start(teams, lanes.sights))

    def decide(self, observation: Observation, memory: Votes) -> tuple[np.ndarray, Votes]:
        """Decide motion and avoidance per agent."""
        lanes, now = memory.lanes, observation.time
        own = self.rule.watch(observation, lanes).astype(np.float64)
        (heard, stamp), network = memory.layer.exchange(now, observation.position, own, memory.network, observation.noise_seed)
        motion = self.agree(heard, now[:, None, None] - stamp, memory.motion)
        column, formation = (rule_orders(observation, np.full(len(now), each), lanes.rule) for each in (IN_COLUMN, IN_FORMATION))
        return np.where(motion == IN_COLUMN, column, formation), memory._replace(motion=motion, network=network)

    def agree(self, votes: np.ndarray, age: np.ndarray, last: np.ndarray) -> np.ndarray:
        """(B, N) motion of every agent.

        Args:
            votes: (B, N, N, M) 0 or 1, the last votes that each agent heard of each agent; M as in :meth:`LookAhead.watch`.
                Under consensus, all are the agent's estimate of the mean vote.
            age: (B, N, N) age of these votes [s].
            last: (B, N) motion in force.
        """
        known = age <= self.hold + 1e-9
        enough = np.minimum(self.rule.blocked, known.sum(axis=2))
        return self.rule.motion((votes * known[..., None]).sum(axis=2), enough, last)
