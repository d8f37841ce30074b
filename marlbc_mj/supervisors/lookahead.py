"""Look-ahead: the column while lanes of the formation are blocked, else the formation (project).

A *lane* is the track of a slot along the path. It is blocked if the slot comes within the safe distance of an obstacle on the
stretch from ``behind`` before now to ``ahead`` after now; obstacles are assumed to keep their velocity. The team forms the column
while at least ``blocked`` lanes of the formation are blocked: one agent can go around an obstacle, several at once cannot.

This rule considers neither the column's own lanes nor the way back from it. Beside the walls of a passage and behind its end, the
formation's lanes are free while agents are still between the walls. Under the set-based composition these agents wait there.
Under (12) they cross the walls, which is a violation (corridor: 0 of 40 layouts without one). So under (12) there are two more
conditions. A column with a blocked lane is not formed, since it does not help. And the column is kept while any agent is *shut
in*: the straight way from its place in the column to its slot comes within the safe distance of an obstacle, now or within
``change``.

Orders with avoidance come from the local rule (:mod:`marlbc_mj.supervisors.set_based_rule`): under the published composition, FM
and FR alone would run into obstacles. Under the set-based composition, the order is FM or FR alone.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import compiled
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.set_based_rule import (
    IN_COLUMN,
    IN_FORMATION,
    LocalRule,
    composition_avoids,
    make_local_rule,
    rule_orders,
)
from marlbc_mj.util.errors import ConfigurationError


class Lanes(NamedTuple):
    """Memory of :class:`LookAhead`; everything but the motion is fixed for an episode."""

    motion: np.ndarray  # (B,) motion in force: IN_FORMATION or IN_COLUMN
    slots: np.ndarray  # (N, 2) slots of FM around the desired centroid [m]
    column: np.ndarray  # (N, 2) slots of FR [m]
    path: np.ndarray  # (2, 2) p_cd(0) [m] and its velocity [m/s]
    safe_distance: float  # d_OA [m]
    rule: LocalRule
    exposed: bool  # whether the composition does not avoid by itself, so that orders can lead into obstacles

    @property
    def sights(self) -> int:
        """M, the number of conditions that :meth:`LookAhead.watch` checks."""
        return 3 if self.exposed else 1


@dataclass(frozen=True)
class LookAhead:
    """FR while at least ``blocked`` lanes are blocked, else FM; see the module.

    Raises:
        ConfigurationError: a time or a margin that is negative or not finite, or a number of lanes below 1.
    """

    blocked: int = 2  # lanes that must be blocked for a column
    ahead: float = 8.0  # how far ahead lanes are checked [s]
    behind: float = 2.0  # how far behind lanes are checked [s]
    change: float = 1.0  # time to get from the column into the formation [s]
    margin: float = 0.6  # margin of the local rule [m]

    def __post_init__(self) -> None:
        if not isinstance(self.blocked, int) or self.blocked < 1:
            raise ConfigurationError(f"LookAhead blocked must be a whole number, at least 1, got {self.blocked}")
        for name in ("ahead", "behind", "change"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"LookAhead {name} must be non-negative and finite, got {value}")

    def start(self, scenario: Scenario, teams: int) -> Lanes:
        """Initial memory: all teams in formation.

        Raises:
            ConfigurationError: the scenario lacks an order, or the margin is invalid.
        """
        rule = make_local_rule(scenario, self.margin)
        slots, column = map(np.ascontiguousarray, scenario.formations)
        fixed = (slots, column, rule.behaviors.path, float(scenario.safe_distance), rule, not composition_avoids(scenario))
        return Lanes(np.full(teams, IN_FORMATION), *fixed)

    def decide(self, observation: Observation, memory: Lanes) -> tuple[np.ndarray, Lanes]:
        """Decide one motion per team, and avoidance per agent."""
        agents = self.watch(observation, memory).sum(axis=1)
        motion = self.motion(agents, self.blocked, memory.motion)
        return rule_orders(observation, motion, memory.rule), memory._replace(motion=motion)

    def watch(self, observation: Observation, lanes: Lanes) -> np.ndarray:
        """(B, N, M) bool, conditions that each agent checks by itself: whether its lane of the formation is blocked (M = 1).

        If ``lanes.exposed``, also whether its lane of the column is blocked, and whether it is shut in (M = 3).
        """
        sights = [blocked_lanes(observation, lanes, (-self.behind, self.ahead))]
        if lanes.exposed:
            sights.append(blocked_lanes(observation, lanes._replace(slots=lanes.column), (0.0, self.ahead)))
            sights.append(shut_in(observation, lanes, self.change))
        return np.stack(sights, axis=-1)

    def motion(self, agents: np.ndarray, enough: np.ndarray | int, last: np.ndarray) -> np.ndarray:
        """IN_COLUMN or IN_FORMATION, from the number of ``agents`` (..., M) for which each condition of :meth:`watch` holds.

        ``enough`` (...,) is the number of blocked lanes that makes a column, and ``last`` (...,) the motion in force. Numbers of
        agents may be estimates, so thresholds lie half an agent below.
        """
        column = agents[..., 0] >= enough - 0.5
        if agents.shape[-1] > 1:
            narrow, shut = np.moveaxis(agents[..., 1:] >= 0.5, -1, 0)
            column = (column & ~narrow) | ((last == IN_COLUMN) & shut)
        return np.where(column, IN_COLUMN, IN_FORMATION)


def blocked_lanes(observation: Observation, lanes: Lanes, span: tuple[float, float]) -> np.ndarray:
    """(B, N) bool: whether an agent's slot comes within d_OA of an obstacle between ``span[0]`` and ``span[1]`` [s] from now."""
    blocked = np.zeros(observation.position.shape[:2], dtype=np.bool_)
    obstacles = np.ascontiguousarray(observation.obstacles)
    _fill_blocked(observation.time, lanes.slots, lanes.path, lanes.safe_distance, span, obstacles, blocked)
    return blocked


def shut_in(observation: Observation, lanes: Lanes, change: float) -> np.ndarray:
    """(B, N) bool: whether an agent's straight way from column to slot is blocked now, in ``change`` [s] or half-way between."""
    shut = np.zeros(observation.position.shape[:2], dtype=np.bool_)
    obstacles = np.ascontiguousarray(observation.obstacles)
    for ahead in (0.0, 0.5 * change, change):
        _add_shut(observation.time, ahead, lanes.slots, lanes.column, lanes.path, lanes.safe_distance, obstacles, shut)
    return shut


@compiled
def _fill_blocked(time, slots, path, safe_distance, span, obstacles, blocked):
    """Fill ``blocked`` (B, N) for :func:`blocked_lanes`.

    Slot and obstacle both move in straight lines, so the time of closest approach is computed exactly, without sampling.
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


@compiled
def _add_shut(time, ahead, slots, column, path, safe_distance, obstacles, shut):
    """Set ``shut`` (B, N) where an obstacle is within d_OA of the segment from column to slot, ``ahead`` [s] from now.

    Slots and column move along the path, obstacles with their velocity.
    """
    for b in range(shut.shape[0]):
        t = time[b] + ahead
        for k in range(obstacles.shape[1]):
            x, y = obstacles[b, k, 0] - path[0, 0] - t * path[1, 0], obstacles[b, k, 1] - path[0, 1] - t * path[1, 1]
            if obstacles.shape[2] > 3:
                x, y = x + ahead * obstacles[b, k, 3], y + ahead * obstacles[b, k, 4]
            for i in range(shut.shape[1]):
                u, w = slots[i, 0] - column[i, 0], slots[i, 1] - column[i, 1]
                to_x, to_y = x - column[i, 0], y - column[i, 1]
                square = u * u + w * w
                share = min(max((to_x * u + to_y * w) / square, 0.0), 1.0) if square > 0.0 else 0.0
                distance = np.sqrt((to_x - share * u) ** 2 + (to_y - share * w) ** 2) - obstacles[b, k, 2]
                if violates(distance, safe_distance):
                    shut[b, i] = True
