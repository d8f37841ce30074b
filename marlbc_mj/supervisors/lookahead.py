"""Look ahead: the column while the formation's own lanes are blocked, else the formation (project).

A *lane* is the way of an FM slot along the path. It is blocked while the slot, moved along the path from ``behind`` ago until
``ahead`` from now, comes within the safe distance of an obstacle; obstacles keep the velocity they have. The team forms the
column while at least ``blocked`` lanes are blocked: one agent can go around, several cannot at once.

It looks at the formation's lanes and not at the column: with the default ``behind`` the team opens up while its last agent may
still be between the walls of a long passage. Under the set-based composition that agent waits; under (12) it does not, and
``behind`` has to cover the length of formation and column (corridor: 0 of 40 layouts with 2 s).

The order in which an agent avoids comes from the local rule (:mod:`marlbc_mj.supervisors.set_based_rule`): under the published
composition FM and FR alone would run into whatever is in the way. Under the set-based composition it is FM or FR alone.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import compiled
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.set_based_rule import IN_COLUMN, IN_FORMATION, LocalRule, make_local_rule, rule_orders
from marlbc_mj.util.errors import ConfigurationError


class Lanes(NamedTuple):
    """Memory of :class:`LookAhead`: fixed for an episode."""

    slots: np.ndarray  # (N, 2) of FM around the desired centroid [m]
    path: np.ndarray  # (2, 2) p_cd(0) [m] and its velocity [m/s]
    safe_distance: float  # d_OA [m]
    rule: LocalRule


@dataclass(frozen=True)
class LookAhead:
    """FR while at least ``blocked`` lanes are blocked, else FM; see the module.

    Raises:
        ConfigurationError: a time or a margin that is negative or not finite, or a number of lanes below 1.
    """

    blocked: int = 2  # lanes that must be blocked for a column
    ahead: float = 8.0  # [s]
    behind: float = 2.0  # [s]
    margin: float = 0.6  # of the local rule [m]

    def __post_init__(self) -> None:
        if not isinstance(self.blocked, int) or self.blocked < 1:
            raise ConfigurationError(f"LookAhead blocked must be a whole number, at least 1, got {self.blocked}")
        for name in ("ahead", "behind"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"LookAhead {name} must be non-negative and finite, got {value}")

    def start(self, scenario: Scenario, teams: int) -> Lanes:
        """The lanes and the rule of a scenario; nothing is remembered.

        Raises:
            ConfigurationError: the scenario lacks an order, or the margin cannot be.
        """
        rule = make_local_rule(scenario, self.margin)
        slots = np.ascontiguousarray(scenario.formations[0])
        return Lanes(slots, rule.behaviors.path, float(scenario.safe_distance), rule)

    def decide(self, observation: Observation, memory: Lanes) -> tuple[np.ndarray, Lanes]:
        """One motion per team, avoidance per agent."""
        blocked = blocked_lanes(observation, memory, (-self.behind, self.ahead))
        motion = np.where(blocked.sum(axis=1) >= self.blocked, IN_COLUMN, IN_FORMATION)
        return rule_orders(observation, motion, memory.rule), memory


def blocked_lanes(observation: Observation, lanes: Lanes, span: tuple[float, float]) -> np.ndarray:
    """(B, N) bool: whose slot comes within the safe distance of an obstacle between ``span[0]`` and ``span[1]`` [s] from now."""
    blocked = np.zeros(observation.position.shape[:2], dtype=np.bool_)
    obstacles = np.ascontiguousarray(observation.obstacles)
    _fill_blocked(observation.time, lanes.slots, lanes.path, lanes.safe_distance, span, obstacles, blocked)
    return blocked


@compiled
def _fill_blocked(time, slots, path, safe_distance, span, obstacles, blocked):
    """:func:`blocked_lanes` into ``blocked`` (B, N).

    Slot and obstacle both move in straight lines, so the time at which they are nearest is known, and nothing is sampled.
    """
    for b in range(blocked.shape[0]):
        for i in range(blocked.shape[1]):
            for k in range(obstacles.shape[1]):
                x, y = slots[i, 0] + path[0, 0], slots[i, 1] + path[0, 1]
                x, y = x + time[b] * path[1, 0] - obstacles[b, k, 0], y + time[b] * path[1, 1] - obstacles[b, k, 1]
                u, w = path[1, 0], path[1, 1]
                if obstacles.shape[2] > 3:
                    u, w = u - obstacles[b, k, 3], w - obstacles[b, k, 4]
                speed = u * u + w * w
                when = -(x * u + y * w) / speed if speed > 0.0 else 0.0
                when = min(max(when, span[0]), span[1])
                distance = np.sqrt((x + when * u) ** 2 + (y + when * w) ** 2) - obstacles[b, k, 2]
                if violates(distance, safe_distance):
                    blocked[b, i] = True
                    break
