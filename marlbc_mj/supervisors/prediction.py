"""Predictions of candidate order sequences: the kinematic reference or MuJoCo worlds over a horizon, and the cost of the outcome.

A *pair* is a team and one of its candidates; C counts the pairs of all B teams. Both predictions fill the same *trails*
(C, H, N, 2): the position of every agent at the end of every predicted mission step, for each pair. One cost judges them. Pairs
are shared out over threads; results do not depend on how many. Obstacles that move are predicted to keep the velocity they have.
"""

from typing import NamedTuple

import numba
import numpy as np

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.core.compiling import threads_usable
from marlbc_mj.core.laws import allocation_free, compiled, threaded
from marlbc_mj.core.motion import drift
from marlbc_mj.engine.composition import Behaviors, compose_team, keep, limit, path_at
from marlbc_mj.engine.inequalities import workspace_rows
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import grid_room
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Scenario


class CostWeights(NamedTuple):
    """The numbers of the cost."""

    formation: float  # w_F, per agent and step
    reconstruction: float  # w_R, per agent and step
    slack: float  # of missing clearance [1/m]
    clearance: float  # wanted [m]
    scale: float  # of distances to slots [m]


class Problem(NamedTuple):
    """The mission's numbers for a prediction; flat, for compiled code."""

    mission_step: float  # [s]
    formations: np.ndarray  # (2, N, 2) slots of FM, then of FR [m]
    w_formation: float  # the rest as in :class:`CostWeights`
    w_reconstruction: float
    w_slack: float
    least: float
    scale: float


class Teams(NamedTuple):
    """Where predictions for B teams begin."""

    first: np.ndarray  # (B,) int64, mission steps made
    start: np.ndarray  # (B, N, 2) [m]
    moving: np.ndarray  # (B, N, 2) velocity that references of limited acceleration go on from [m/s]
    obstacles: np.ndarray  # (B, K, 3), or (B, K, 5) where they move


class Pairs(NamedTuple):
    """The candidates of every team, one team after the other; many pairs may share a sequence of orders."""

    team: np.ndarray  # (C,) int64, below B
    sequence: np.ndarray  # (C,) int64, below S
    orders: np.ndarray  # (S, H, N) int64, indices into scenario.orders


class Scratch(NamedTuple):
    """Scratch arrays of a pair."""

    rows: np.ndarray  # (C, W, 2), see marlbc_mj.engine.plan.workspace_rows
    velocity: np.ndarray  # (C, 2, N, 2) v_r now and before
    obstacles: np.ndarray  # (C, K, 3 or 5)
    grid: np.ndarray  # (C, room)


def problem(scenario: Scenario, weights: CostWeights) -> Problem:
    """The numbers of a scenario that a prediction needs, under the weights of a cost."""
    return Problem(scenario.mission_step, scenario.formations, *weights)


@allocation_free
def predict_reference(c, behaviors, problem, teams, pairs, scratch, trail):
    """Reference trail (H, N, 2) [m] of pair ``c``: p_r += dt v_r, with v_r of (12) evaluated at p_r as in the ``virtual``
    reference.
    """
    b, orders, duration = pairs.team[c], pairs.orders[pairs.sequence[c]], problem.mission_step
    v_r, before_v = scratch.velocity[c, 0], scratch.velocity[c, 1]
    before = teams.start[b]
    for i in range(before.shape[0]):
        for axis in range(2):
            v_r[i, axis] = teams.moving[b, i, axis]
    for k in range(orders.shape[0]):
        keep(behaviors, v_r, before_v)
        seen = extrapolate(k * duration, teams.obstacles[b], scratch.obstacles[c])
        t = (teams.first[b] + k) * duration
        compose_team(t, orders[k], behaviors, before, seen, scratch.grid[c], scratch.rows[c], v_r)
        limit(behaviors, duration, before_v, v_r)
        for i in range(before.shape[0]):
            for axis in range(2):
                trail[k, i, axis] = before[i, axis] + duration * v_r[i, axis]
        before = trail[k]


@allocation_free
def extrapolate(t, obstacles, drifted):
    """Obstacles after ``t`` [s]: themselves where they are at rest."""
    if obstacles.shape[1] == 3:
        return obstacles
    drift(t, obstacles, drifted)
    return drifted


@allocation_free
def trail_cost(c, behaviors, problem, teams, pairs, scratch, trail):
    """Cost of the trail (H, N, 2) [m] of pair ``c``: the sum of :func:`add_step_cost` over all predicted steps."""
    cost = 0.0
    for k in range(trail.shape[0]):
        cost = add_step_cost(cost, k, trail[k], c, behaviors, problem, teams, pairs, scratch)
    return cost


@allocation_free
def add_step_cost(cost, k, at, c, behaviors, problem, teams, pairs, scratch):
    """``cost`` and what predicted step ``k`` of pair ``c`` adds to it, the team being ``at`` (N, 2) [m] at its end.

    The sum over agents of w_F E_FM + w_R E_FR + w_slack max(0, d_min - d), E = min(1, |p - slot| / scale). Slots are those of the
    desired centroid.
    """
    b, duration, formations = pairs.team[c], problem.mission_step, problem.formations
    now, normal = scratch.rows[c, :2], scratch.rows[c, 2]
    path_at((teams.first[b] + k + 1) * duration, behaviors.path, now)
    seen = extrapolate((k + 1) * duration, teams.obstacles[b], scratch.obstacles[c])
    for i in range(at.shape[0]):
        for which in range(2):
            x = at[i, 0] - now[0, 0] - formations[which, i, 0]
            y = at[i, 1] - now[0, 1] - formations[which, i, 1]
            weight = problem.w_formation if which == 0 else problem.w_reconstruction
            cost += weight * min(1.0, np.sqrt(x * x + y * y) / problem.scale)
        cost += problem.w_slack * max(0.0, problem.least - nearest_obstacle(at[i], seen, normal))
    return cost


@allocation_free
def judge_pair(c, kinematic, behaviors, problem, teams, pairs, scratch, trails, costs):
    """Cost of pair ``c``, after its reference is predicted unless its trail was filled by other means."""
    if kinematic:
        predict_reference(c, behaviors, problem, teams, pairs, scratch, trails[c])
    costs[c] = trail_cost(c, behaviors, problem, teams, pairs, scratch, trails[c])


@compiled
def _judge_serial(kinematic, behaviors, problem, teams, pairs, scratch, trails, costs):
    """:func:`judge_pair` of every pair, one after the other."""
    for c in range(costs.shape[0]):
        judge_pair(c, kinematic, behaviors, problem, teams, pairs, scratch, trails, costs)


@threaded
def _judge_parallel(kinematic, behaviors, problem, teams, pairs, scratch, trails, costs):
    """:func:`judge_pair` of every pair, shared out over numba's threads; the same numbers as in series."""
    for c in numba.prange(costs.shape[0]):
        judge_pair(np.int64(c), kinematic, behaviors, problem, teams, pairs, scratch, trails, costs)


def judge_pairs(
    scenario: Scenario,
    behaviors: Behaviors,
    weights: CostWeights,
    teams: Teams,
    pairs: Pairs,
    *,
    threads: int = 1,
    trails: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Costs (C,) and trails (C, H, N, 2) of all pairs of teams and candidates.

    ``trails`` given are judged as they are, else the kinematic reference is predicted.
    """
    kinematic, count = trails is None, len(pairs.team)
    if trails is None:
        trails = np.empty((count, *pairs.orders.shape[1:], 2))
    costs = np.empty(count)
    scratch = Scratch(
        np.zeros((count, workspace_rows(scenario), 2)),
        np.zeros((count, 2, scenario.agents, 2)),
        np.zeros((count, *teams.obstacles.shape[1:])),
        np.zeros((count, grid_room(scenario))),
    )
    arguments = kinematic, behaviors, problem(scenario, weights), teams, pairs, scratch, trails, costs
    if count > 1 and threads_usable(threads):
        _judge_parallel(*arguments)
    else:
        _judge_serial(*arguments)
    return costs, trails


def follow(twins: World, observation: Observation) -> None:
    """Put twins (worlds of their own, one per team) where the measured teams are; references and controllers stay theirs."""
    state = twins.state
    state.position[:], state.velocity[:], state.obstacles[:] = observation.position, observation.velocity, observation.obstacles
    if state.motions.shape[1]:  # a twin's obstacles go straight on from where they are seen
        place, velocity = observation.obstacles[..., :3], observation.obstacles[..., 3:]
        state.motions[..., :2], state.motions[..., 2:] = velocity, 0.0
        state.anchors[:] = place
        state.anchors[..., :2] -= velocity * observation.time[:, None, None]
    for b in range(twins.worlds):
        twins.put(b, observation.position[b], observation.velocity[b])


def simulate(twins: World, team: int, worlds: World, orders: np.ndarray) -> np.ndarray:
    """Trails (C, H, N, 2) of candidate ``orders`` (C, H, N) of one team through MuJoCo: positions, from its twin's state on.

    ``worlds`` holds at least C worlds; those left over repeat the first candidate. A world that diverges stays where it did.
    """
    candidates, horizon = orders.shape[:2]
    every = np.concatenate([orders, np.repeat(orders[:1], worlds.worlds - candidates, axis=0)])
    for c in range(worlds.worlds):
        worlds.copy_world(twins, team, c)
    trails = np.empty((*orders.shape, 2))
    for k in range(horizon):
        worlds.advance(np.ascontiguousarray(every[:, k]))
        trails[:, k] = worlds.state.position[:candidates]
    return trails
