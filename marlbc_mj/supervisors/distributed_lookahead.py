"""Look ahead without a center: every agent watches its own lane, tells the others, and decides from what it has heard.

The rule is that of :mod:`marlbc_mj.supervisors.lookahead`: the column while at least ``blocked`` lanes are blocked, else the
formation. An agent knows the plan and the obstacles along its own lane. What it says is whether that lane is blocked; the
communication layer of the scenario carries it (:mod:`marlbc_mj.supervisors.communication`). Each agent counts the lanes that it
knows to be blocked, its own among them. What was said more than ``hold`` ago does not count.

An agent that knows of fewer lanes than ``blocked`` asks for all of these: one that has heard of nobody goes by its own lane
alone. So each connected component of the team decides for itself, and with ideal communication all decisions are those of the
central rule under the set-based composition. What that rule adds under the null-space one is not here.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.communication import Layer, make_layer
from marlbc_mj.supervisors.lookahead import Lanes, LookAhead, blocked_lanes
from marlbc_mj.supervisors.set_based_rule import IN_COLUMN, IN_FORMATION, rule_orders
from marlbc_mj.util.errors import ConfigurationError


class Votes(NamedTuple):
    """Memory of :class:`DistributedLookAhead`."""

    lanes: Lanes
    layer: Layer
    network: Any  # the layer's memory


@dataclass(frozen=True)
class DistributedLookAhead:
    """FR while at least ``blocked`` of the lanes that an agent knows of are blocked, else FM; see the module.

    Raises:
        ConfigurationError: a ``hold`` that is not positive.
    """

    rule: LookAhead = field(default_factory=LookAhead)  # when a lane is blocked, and how many make a column
    hold: float = 2.0  # how long a vote counts [s]

    def __post_init__(self) -> None:
        if not self.hold > 0:
            raise ConfigurationError(f"DistributedLookAhead hold must be positive, got {self.hold}")

    def start(self, scenario: Scenario, teams: int) -> Votes:
        """Lanes, rule and layer of a scenario; nothing has been heard.

        Raises:
            ConfigurationError: the scenario lacks an order.
        """
        layer = make_layer(scenario)
        return Votes(self.rule.start(scenario, teams), layer, layer.start(teams, 1))

    def decide(self, observation: Observation, memory: Votes) -> tuple[np.ndarray, Votes]:
        """Motion and avoidance per agent."""
        lanes, now = memory.lanes, observation.time
        own = blocked_lanes(observation, lanes, (-self.rule.behind, self.rule.ahead))[..., None].astype(np.float64)
        (heard, stamp), network = memory.layer.exchange(now, observation.position, own, memory.network, observation.noise_seed)
        column = self.agree(heard[..., 0], now[:, None, None] - stamp)
        either = (rule_orders(observation, np.full(len(now), motion), lanes.rule) for motion in (IN_COLUMN, IN_FORMATION))
        return np.where(column, *either), memory._replace(network=network)

    def agree(self, votes: np.ndarray, age: np.ndarray) -> np.ndarray:
        """(B, N) bool: who goes for the column, from the votes that each agent heard and their ages [s], (B, N, N) each.

        Votes are 0 or 1; under consensus each is the agent's estimate of their mean, so half a vote decides.
        """
        known = age <= self.hold + 1e-9
        most = np.minimum(self.rule.blocked, known.sum(axis=2))
        return np.asarray((votes * known).sum(axis=2) >= most - 0.5)
