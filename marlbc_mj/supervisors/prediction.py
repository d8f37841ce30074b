"""Predictions of candidate order sequences over a horizon, by the kinematic reference or by MuJoCo worlds, and their cost.

A *pair* is a team and one of its candidates; C is the number of pairs of all B teams. Both predictions produce *trails*
(C, H, N, 2), the position of every agent at the end of every predicted mission step for each pair, which the same cost function
evaluates. Pairs are distributed over threads; results do not depend on their number. Moving obstacles are predicted to keep
their velocity.
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

CERTAIN = 1.0 - 1e-9
"""Factor that reduces a lower bound by far more than rounding errors."""


class CostWeights(NamedTuple):
    """The parameters of the cost."""

    formation: float  # w_F, per agent and step
    reconstruction: float  # w_R, per agent and step
    slack: float  # w_slack, weight of missing clearance [1/m]
    clearance: float  # d_min, clearance wanted [m]
    scale: float  # distance from a slot that counts as an error of 1 [m]


class Problem(NamedTuple):
    """The numbers of mission and cost for a prediction; flat, for compiled code."""

    mission_step: float  # [s]
    formations: np.ndarray  # (2, N, 2) slots of FM, then of FR [m]
    w_formation: float  # this and the next four as in :class:`CostWeights`
    w_reconstruction: float
    w_slack: float
    least: float
    scale: float
    floor: float  # lower bound of the team's cost per step, since no agent can be at both of its slots


class Teams(NamedTuple):
    """Initial states of predictions for B teams."""

    first: np.ndarray  # (B,) int64, number of mission steps so far
    start: np.ndarray  # (B, N, 2) initial positions [m]
    moving: np.ndarray  # (B, N, 2) initial velocity, for references of limited acceleration [m/s]
    obstacles: np.ndarray  # (B, K, 3), or (B, K, 5) where they move


class Pairs(NamedTuple):
    """The candidates of every team, one team after the other; several pairs may share a sequence of orders.

    A team's other sequences begin with the same orders as its first one.
    """

    team: np.ndarray  # (C,) int64, below B
    sequence: np.ndarray  # (C,) int64, below S
    orders: np.ndarray  # (S, H, N) int64, indices into scenario.orders
    branch: np.ndarray  # (S,) int64, predicted step from which a sequence differs from the first of its team
    extra: np.ndarray  # (S,) cost of a sequence besides its trail, relative to the first sequence of its team


class Scratch(NamedTuple):
    """Scratch arrays for C pairs of B teams."""

    lead: np.ndarray  # (C,) int64, the first pair of the same team
    rows: np.ndarray  # (C, W, 2), see marlbc_mj.engine.inequalities.workspace_rows
    velocity: np.ndarray  # (C, 2, N, 2) v_r of this step and of the previous one
    obstacles: np.ndarray  # (C, K, 3 or 5)
    grid: np.ndarray  # (C, grid_room)
    held: np.ndarray  # (B, H + 1) cost of the team's first pair before every step
    held_velocity: np.ndarray  # (B, H + 1, N, 2) v_r of that pair before every step


def problem(scenario: Scenario, weights: CostWeights) -> Problem:
    """The numbers of a scenario that a prediction needs, under the weights of a cost."""
    apart = np.linalg.norm(scenario.formations[0] - scenario.formations[1], axis=-1)  # (N,) distance between an agent's two slots
    floor = min(weights.formation, weights.reconstruction) * np.minimum(1.0, apart / weights.scale).sum()
    return Problem(scenario.mission_step, scenario.formations, *weights, floor=float(floor))


@allocation_free
def predict_pair(c, behaviors, problem, teams, pairs, scratch, trails, costs):
    """Reference trail and cost of pair ``c``: p_r += dt v_r, with v_r composed at p_r as in the ``virtual`` reference.

    The prediction starts at the step where the pair's orders first differ from those of its team's first pair, which must have
    been predicted before. It stops, with an infinite cost, as soon as the pair cannot become cheaper than the first one.
    """
    b, lead, orders = pairs.team[c], scratch.lead[c], pairs.orders[pairs.sequence[c]]
    begin, horizon = np.int64(0), orders.shape[0]
    trail, v_r = trails[c], scratch.velocity[c, 0]
    held, held_v = scratch.held[b], scratch.held_velocity[b]
    if c == lead:
        held[0] = 0.0
        copy_points(teams.moving[b], held_v[0])
    else:
        begin = pairs.branch[pairs.sequence[c]]
        for k in range(begin):
            copy_points(trails[lead, k], trail[k])
    cost = held[begin]
    copy_points(held_v[begin], v_r)
    for k in range(begin, horizon):
        if c != lead and cannot_win(cost, horizon - k, problem, pairs.extra[pairs.sequence[c]], held[horizon]):
            costs[c] = np.inf
            return
        before = teams.start[b] if k == 0 else trail[k - 1]
        advance_reference((c, k), before, orders[k], behaviors, problem, teams, pairs, scratch, trail[k])
        cost = add_step_cost(cost, k, trail[k], c, behaviors, problem, teams, pairs, scratch)
        if c == lead:
            held[k + 1] = cost
            copy_points(v_r, held_v[k + 1])
    costs[c] = cost


@allocation_free
def advance_reference(moment, before, orders, behaviors, problem, teams, pairs, scratch, after):
    """Predict step k of pair c, ``moment`` = (c, k), from p_r ``before`` to ``after`` (N, 2) [m] under ``orders`` (N,); update
    the pair's v_r.
    """
    c, k = moment
    b, duration = pairs.team[c], problem.mission_step
    v_r, before_v = scratch.velocity[c, 0], scratch.velocity[c, 1]
    keep(behaviors, v_r, before_v)
    seen = extrapolate(k * duration, teams.obstacles[b], scratch.obstacles[c])
    compose_team((teams.first[b] + k) * duration, orders, behaviors, before, seen, scratch.grid[c], scratch.rows[c], v_r)
    limit(behaviors, duration, before_v, v_r)
    for i in range(before.shape[0]):
        for axis in range(2):
            after[i, axis] = before[i, axis] + duration * v_r[i, axis]


@allocation_free
def cannot_win(cost, steps, problem, extra, best):
    """Whether a candidate with ``cost`` so far, a fixed ``extra`` cost and ``steps`` to go must end above ``best``."""
    return (cost + steps * problem.floor + extra) * CERTAIN > best


@allocation_free
def copy_points(points, into):
    """Copy ``points`` (N, 2) to ``into`` (N, 2)."""
    for i in range(points.shape[0]):
        for axis in range(2):
            into[i, axis] = points[i, axis]


@allocation_free
def extrapolate(t, obstacles, drifted):
    """Predicted obstacles after ``t`` [s], in ``drifted`` if they move; obstacles at rest are returned unchanged."""
    if obstacles.shape[1] == 3:
        return obstacles
    drift(t, obstacles, drifted)
    return drifted


@allocation_free
def trail_cost(c, behaviors, problem, teams, pairs, scratch, trail):
    """Cost of the trail (H, N, 2) [m] of pair ``c``: :func:`add_step_cost` summed over all predicted steps."""
    cost = 0.0
    for k in range(trail.shape[0]):
        cost = add_step_cost(cost, k, trail[k], c, behaviors, problem, teams, pairs, scratch)
    return cost


@allocation_free
def add_step_cost(cost, k, at, c, behaviors, problem, teams, pairs, scratch):
    """``cost`` plus the cost of predicted step ``k`` of pair ``c``, at whose end the team is ``at`` (N, 2) [m].

    It is the sum over agents of w_F E_FM + w_R E_FR + w_slack max(0, d_min - d), E = min(1, |p - slot| / scale). Slots are placed
    around the desired centroid.
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


@compiled
def _predict_serial(behaviors, problem, teams, pairs, scratch, trails, costs):
    """Run :func:`predict_pair` for all pairs in order; the first pair of a team precedes its others."""
    for c in range(costs.shape[0]):
        predict_pair(c, behaviors, problem, teams, pairs, scratch, trails, costs)


@threaded
def _predict_parallel(behaviors, problem, teams, pairs, scratch, trails, costs):
    """Run :func:`predict_pair` for all pairs on numba's threads; results are identical to those in series."""
    for c in numba.prange(costs.shape[0]):
        if scratch.lead[c] == c:
            predict_pair(np.int64(c), behaviors, problem, teams, pairs, scratch, trails, costs)
    for c in numba.prange(costs.shape[0]):
        if scratch.lead[c] != c:
            predict_pair(np.int64(c), behaviors, problem, teams, pairs, scratch, trails, costs)


@compiled
def _judge(behaviors, problem, teams, pairs, scratch, trails, costs):
    """Compute :func:`trail_cost` for all pairs from given trails."""
    for c in range(costs.shape[0]):
        costs[c] = trail_cost(c, behaviors, problem, teams, pairs, scratch, trails[c])


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

    Without ``trails``, the kinematic reference is predicted; the prediction of a pair that cannot become cheaper than the first
    one of its team stops early, which leaves its cost infinite and the rest of its trail NaN. Costs exclude ``pairs.extra``.
    """
    kinematic, (count, teams_count, horizon) = trails is None, (len(pairs.team), len(teams.first), pairs.orders.shape[1])
    if trails is None:
        trails = np.full((count, *pairs.orders.shape[1:], 2), np.nan)
    costs = np.empty(count)
    scratch = Scratch(
        lead=np.searchsorted(pairs.team, pairs.team),
        rows=np.zeros((count, workspace_rows(scenario), 2)),
        velocity=np.zeros((count, 2, scenario.agents, 2)),
        obstacles=np.zeros((count, *teams.obstacles.shape[1:])),
        grid=np.zeros((count, grid_room(scenario))),
        held=np.zeros((teams_count, horizon + 1)),
        held_velocity=np.zeros((teams_count, horizon + 1, scenario.agents, 2)),
    )
    arguments = behaviors, problem(scenario, weights), teams, pairs, scratch, trails, costs
    if not kinematic:
        _judge(*arguments)
    elif count > 1 and threads_usable(threads):
        _predict_parallel(*arguments)
    else:
        _predict_serial(*arguments)
    return costs, trails


def follow(twins: World, observation: Observation) -> None:
    """Move twins, one world per team, to the teams' measured states; their references and controllers keep their own states."""
    state = twins.state
    state.position[:], state.velocity[:], state.obstacles[:] = observation.position, observation.velocity, observation.obstacles
    if state.motions.shape[1]:  # obstacles of a twin move in straight lines from their observed places
        place, velocity = observation.obstacles[..., :3], observation.obstacles[..., 3:]
        state.motions[..., :2], state.motions[..., 2:] = velocity, 0.0
        state.anchors[:] = place
        state.anchors[..., :2] -= velocity * observation.time[:, None, None]
    for b in range(twins.worlds):
        twins.put(b, observation.position[b], observation.velocity[b])


def simulate(twins: World, team: int, worlds: World, orders: np.ndarray) -> np.ndarray:
    """Trails (C, H, N, 2) of one team under candidate ``orders`` (C, H, N), simulated by MuJoCo from the state of its twin.

    ``worlds`` must have at least C worlds; the surplus ones repeat the first candidate. A world that diverges stops there.
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
