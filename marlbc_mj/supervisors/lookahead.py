"""Look ahead: the column while the formation's own lanes are blocked, else the formation (project).

A *lane* is the way of an FM slot along the path. It is blocked while the slot, moved along the path, comes within the safe
distance of an obstacle; obstacles keep the velocity they have. It is watched from ``ahead`` from now back to where the last agent
of the column is, or to the slot if that is farther back, and ``behind`` further: an obstacle counts until the whole column has
passed it. The team forms the column while at least ``blocked`` lanes are blocked: one agent can go around, several cannot at
once.

Without the look back to the end of the column the team opens up while its last agent is still between the walls of a long
passage. Under the set-based composition that agent waits there; under (12) it does not, and violates.

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
    passing: np.ndarray  # (N,) from a slot's passage of a place to that of the column's last agent; 0 where that comes first [s]
    rule: LocalRule


@dataclass(frozen=True)
class LookAhead:
    """FR while at least ``blocked`` lanes are blocked, else FM; see the module.

    Raises:
        ConfigurationError: a time or a margin that is negative or not finite, or a number of lanes below 1.
    """

    blocked: int = 2  # lanes that must be blocked for a column
    ahead: float = 8.0  # [s]
    behind: float = 0.5  # [s]
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
        slots, column = map(np.ascontiguousarray, scenario.formations)
        path = rule.behaviors.path
        return Lanes(slots, path, float(scenario.safe_distance), passing_times(slots, column, path[1]), rule)

    def decide(self, observation: Observation, memory: Lanes) -> tuple[np.ndarray, Lanes]:
        """One motion per team, avoidance per agent."""
        span = np.column_stack([-self.behind - memory.passing, np.full(len(memory.passing), self.ahead)])
        blocked = blocked_lanes(observation, memory, span)
        motion = np.where(blocked.sum(axis=1) >= self.blocked, IN_COLUMN, IN_FORMATION)
        return rule_orders(observation, motion, memory.rule), memory


def passing_times(slots: np.ndarray, column: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(N,) from when a slot of the formation passes a place on the path until the last agent of the column does, or 0 [s].

    Args:
        slots, column: (N, 2) around the desired centroid [m].
        velocity: (2,) of the desired centroid [m/s]; where it rests nobody passes anything, and the times are 0.
    """
    speed = float(np.linalg.norm(velocity))
    if speed == 0.0:
        return np.zeros(len(slots))
    along = velocity / speed
    return np.asarray(np.maximum(slots @ along - (column @ along).min(), 0.0) / speed)


def blocked_lanes(observation: Observation, lanes: Lanes, span: np.ndarray | tuple[float, float]) -> np.ndarray:
    """(B, N) bool: whose slot comes within the safe distance of an obstacle within ``span``, first and last [s] from now.

    ``span`` is (N, 2), or (2,) for all lanes alike.
    """
    blocked = np.zeros(observation.position.shape[:2], dtype=np.bool_)
    obstacles = np.ascontiguousarray(observation.obstacles)
    spans = np.ascontiguousarray(np.broadcast_to(np.asarray(span, dtype=np.float64), (len(lanes.slots), 2)))
    _fill_blocked(observation.time, lanes.slots, lanes.path, lanes.safe_distance, spans, obstacles, blocked)
    return blocked


@compiled
def _fill_blocked(time, slots, path, safe_distance, spans, obstacles, blocked):
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
                when = min(max(when, spans[i, 0]), spans[i, 1])
                distance = np.sqrt((x + when * u) ** 2 + (y + when * w) ** 2) - obstacles[b, k, 2]
                if violates(distance, safe_distance):
                    blocked[b, i] = True
                    break
