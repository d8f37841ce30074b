"""The set-based rule: avoidance goes on top only while the formation's velocity would break the safe distance (project).

It expresses the idea of set-based tasks (Moe et al. 2016), an inequality that is active only where it is about to be broken, by
priority orders, and so works under the published composition (12). Each agent decides for itself, at its own reference p_r,
without further prediction. With v the velocity of its formation behavior alone,

    OA on top   if   min(d(p_r), d(p_r + dt v)) < d_OA + margin   and   n^T (v - o') < 0,

where d is the clearance from the nearest obstacle, n its normal at p_r, o' the velocity of that obstacle and dt the mission step.
Under (12), OA on top keeps the part of v along the obstacle, so the agent slides around it. The rule can separate two obstacles
only if the gap between them is wider than 2 (d_OA + margin).

Under the set-based composition avoidance is a constraint of every order, so the rule then returns the formation's order alone.
"""

from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.core.cells import nearest, room
from marlbc_mj.core.laws import allocation_free, compiled
from marlbc_mj.engine.by_address import point_to
from marlbc_mj.engine.composition import WORKSPACE, Behaviors, compose_team
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import grid_room, make_behaviors
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift, no_way
from marlbc_mj.util.errors import ConfigurationError

IN_FORMATION, IN_COLUMN = 0, 1
"""Motions of a team: the first of ``scenario.formation_names``, or the second."""


class LocalRule(NamedTuple):
    """The scenario's data for the rule, fixed for an episode."""

    behaviors: Behaviors
    free: np.ndarray  # (2,) order of each motion without avoidance
    avoiding: np.ndarray  # (2,) order with avoidance on top; equal to ``free`` if the composition avoids by itself
    least: float  # clearance below which the rule acts, d_OA + margin [m]; -inf if the composition avoids by itself
    step: float  # dt [s]
    way: GiveWay  # data for giving way to other agents
    grid: np.ndarray  # scratch for grids of obstacles and team


def make_local_rule(scenario: Scenario, margin: float) -> LocalRule:
    """The rule's data for a scenario and its composition, passed by reference for fast compiled code.

    Raises:
        ConfigurationError: the scenario lacks an order, or the margin is negative or not finite.
    """
    if not (np.isfinite(margin) and margin >= 0):
        raise ConfigurationError(f"margin of the set-based rule must be non-negative and finite, got {margin}")
    free = np.array([scenario.orders.index(name) for name in scenario.formation_names])
    behaviors, step, grid = make_behaviors(scenario), float(scenario.mission_step), np.zeros(grid_room(scenario))
    if composition_avoids(scenario):
        avoiding, least, way = free, -np.inf, no_way(scenario)
    else:
        avoiding = np.array([scenario.orders.index(f"OA>{name}") for name in scenario.formation_names])
        least, way = float(scenario.safe_distance + margin), give_way(scenario)
    return cast(LocalRule, point_to(LocalRule(behaviors, free, avoiding, least, step, way, grid)))


def composition_avoids(scenario: Scenario) -> bool:
    """Whether the composition keeps the safe distance under every order."""
    return scenario.composition == "set-based"


@allocation_free
def follow_rule(t, motion, rule, at, obstacles, workspace, velocity, orders):
    """Apply the rule to one team, without agent avoidance.

    Args:
        t: mission time [s].
        motion: the team's motion, IN_FORMATION or IN_COLUMN.
        rule: the scenario's data.
        at: (N, 2) positions at which behaviors are evaluated [m].
        obstacles: (K, 3) x, y, radius [m]; (K, 5) with their velocity [m/s] where they move.
        workspace: (WORKSPACE, 2) scratch.
        velocity: (N, 2) [m/s], written in place: v_r of the motion alone.
        orders: (N,) int64, written in place.

    Returns:
        The number of agents with avoidance on top.
    """
    for i in range(at.shape[0]):
        orders[i] = rule.free[motion]
    compose_team(t, orders, rule.behaviors, at, obstacles, rule.grid, workspace, velocity)
    count = 0
    for i in range(at.shape[0]):
        if closes_in(at[i], velocity[i], rule, obstacles, workspace):
            orders[i] = rule.avoiding[motion]
            count += 1
    return count


@allocation_free
def closes_in(p, v, rule, obstacles, rows):
    """Whether velocity ``v`` (2,) [m/s] takes an agent at ``p`` (2,) [m] closer to an obstacle than the rule allows.

    If ``rule.grid`` is not empty, it must be filled with these obstacles; ``rows`` (2 or more, 2) is scratch.
    """
    count = obstacles.shape[0]
    if count == 0 or rule.least == -np.inf:
        return False
    grid = rule.grid[: room(count)] if rule.grid.shape[0] > 0 else rule.grid
    normal, ahead = rows[0], rows[1]
    for axis in range(2):
        ahead[axis] = p[axis] + rule.step * v[axis]
    k = nearest(ahead, obstacles, grid, -1)
    soon = nearest_obstacle(ahead, obstacles[k : k + 1], normal)
    k = nearest(p, obstacles, grid, -1)
    now = nearest_obstacle(p, obstacles[k : k + 1], normal)
    rate = normal[0] * v[0] + normal[1] * v[1]
    if obstacles.shape[1] > 3:
        rate -= normal[0] * obstacles[k, 3] + normal[1] * obstacles[k, 4]
    return min(now, soon) < rule.least and rate < 0.0


@compiled
def _fill_orders(time, motion, rule, at, obstacles, orders):
    """:func:`follow_rule` for every team: orders (B, N) at ``time`` (B,) [s], positions (B, N, 2) [m], motions (B,)."""
    workspace, velocity = np.empty((WORKSPACE, 2)), np.empty(at.shape[1:])
    for b in range(at.shape[0]):
        follow_rule(time[b], motion[b], rule, at[b], obstacles[b], workspace, velocity, orders[b])


def rule_orders(observation: Observation, motion: np.ndarray, rule: LocalRule) -> np.ndarray:
    """(B, N) orders of B teams with motions ``motion`` (B,); agent avoidance on top where a neighbor is too close."""
    at = observation.reference if rule.behaviors.virtual else observation.position
    orders = np.repeat(rule.free[motion][:, None], at.shape[1], axis=1)
    if rule.least == -np.inf:  # the composition avoids by itself, whatever the order
        return orders
    _fill_orders(observation.time, motion, rule, *map(np.ascontiguousarray, (at, observation.obstacles)), orders)
    return lift(orders, observation, rule.way)


class Ruled(NamedTuple):
    """Memory of :class:`SetBasedRule`."""

    motion: np.ndarray  # (B,) motion of every team
    rule: LocalRule


@dataclass(frozen=True)
class SetBasedRule:
    """The rule with one motion for the whole mission, FM by default; see the module."""

    margin: float = 0.6  # clearance beyond d_OA below which the rule acts [m]
    column: bool = False  # FR instead of FM

    def start(self, scenario: Scenario, teams: int) -> Ruled:
        """The rule's data for this scenario, constant over the episode.

        Raises:
            ConfigurationError: the scenario lacks an order, or the margin is invalid.
        """
        return Ruled(np.full(teams, IN_COLUMN if self.column else IN_FORMATION), make_local_rule(scenario, self.margin))

    def decide(self, observation: Observation, memory: Ruled) -> tuple[np.ndarray, Ruled]:
        """Decide for every agent by itself."""
        return rule_orders(observation, memory.motion, memory.rule), memory
