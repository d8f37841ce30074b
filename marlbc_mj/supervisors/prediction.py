"""What candidate order sequences lead to: the kinematic reference or MuJoCo worlds over a horizon, and the cost of the outcome.

Both predictions fill the same *trails* (C, H, N, 2): the position of every agent at the end of every predicted mission step, for
each of C candidates. One cost judges them. Candidates are shared out over threads; results do not depend on how many. Obstacles
that move are predicted to keep the velocity they have.
"""

import numba
import numpy as np

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.core.laws import allocation_free, compiled
from marlbc_mj.core.motion import drift
from marlbc_mj.engine.composition import WORKSPACE, compose_team, keep, limit, path_at
from marlbc_mj.engine.plan import Plan
from marlbc_mj.engine.world import World
from marlbc_mj.supervisors.base import Situation

SCRATCH = WORKSPACE + 3
"""Rows of two that one candidate needs: what composing asks for, the desired path and a normal."""


@allocation_free
def predict(start, moving, first, mission_step, orders, behaviors, obstacles, drifted, grid, scratch, v_r, before_v, trail):
    """Reference trail of one candidate: p_r += dt v_r, with v_r of (12) evaluated at p_r as in the ``virtual`` reference.

    Args:
        start: (N, 2) [m] at mission step ``first``; moving: (N, 2) its velocity [m/s], from which limited references go on.
        before_v: (N, 2), scratch.
        orders: (H, N) int64, indices into the behaviors' table.
        obstacles: (K, 3), or (K, 5) now; drifted: the same, scratch.
        grid, scratch, v_r: of the candidate, scratch.
        trail: (H, N, 2) [m], written in place.
    """
    before = start
    for i in range(start.shape[0]):
        for axis in range(2):
            v_r[i, axis] = moving[i, axis]
    for k in range(orders.shape[0]):
        keep(behaviors, v_r, before_v)
        seen = _after(k * mission_step, obstacles, drifted)
        compose_team((first + k) * mission_step, orders[k], behaviors, before, seen, grid, scratch[3:], v_r)
        limit(behaviors, mission_step, before_v, v_r)
        for i in range(start.shape[0]):
            for axis in range(2):
                trail[k, i, axis] = before[i, axis] + mission_step * v_r[i, axis]
        before = trail[k]


@allocation_free
def _after(t, obstacles, drifted):
    """Obstacles after ``t`` [s]: themselves where they are at rest."""
    if obstacles.shape[1] == 3:
        return obstacles
    drift(t, obstacles, drifted)
    return drifted


@allocation_free
def trail_cost(trail, first, mission_step, path, formations, obstacles, drifted, weights, scratch):
    """Sum over predicted steps and agents of w_F E_FM + w_R E_FR + w_slack max(0, d_min - d), E = min(1, |p - slot| / scale).

    Slots are those of the desired centroid. ``weights`` (5,): w_F, w_R, w_slack [1/m], d_min [m], scale [m];
    ``formations`` (2, N, 2) [m]; ``scratch`` (SCRATCH, 2).
    """
    now, normal = scratch[:2], scratch[2]
    cost = 0.0
    for k in range(trail.shape[0]):
        path_at((first + k + 1) * mission_step, path, now)
        seen = _after((k + 1) * mission_step, obstacles, drifted)
        for i in range(trail.shape[1]):
            for which in range(2):
                x = trail[k, i, 0] - now[0, 0] - formations[which, i, 0]
                y = trail[k, i, 1] - now[0, 1] - formations[which, i, 1]
                cost += weights[which] * min(1.0, np.sqrt(x * x + y * y) / weights[4])
            cost += weights[2] * max(0.0, weights[3] - nearest_obstacle(trail[k, i], seen, normal))
    return cost


@allocation_free
def judge_candidate(
    c, kinematic, start, moving, first, mission_step, orders, behaviors, formations, obstacles, drifted, grid, weights,
    scratch, v_r, before_v, trails, costs,
):  # fmt: skip
    """Cost of candidate ``c``, after rolling out its reference unless its trail was filled by other means."""
    if kinematic:
        predict(
            start, moving, first, mission_step, orders[c], behaviors, obstacles, drifted[c], grid[c], scratch[c], v_r[c],
            before_v[c], trails[c],
        )  # fmt: skip
    costs[c] = trail_cost(trails[c], first, mission_step, behaviors.path, formations, obstacles, drifted[c], weights, scratch[c])


@compiled
def judge_serial(candidates, *args):
    """:func:`judge_candidate` of every candidate, one after the other."""
    for c in range(candidates):
        judge_candidate(c, *args)


@numba.njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def judge_parallel(
    candidates, kinematic, start, moving, first, mission_step, orders, behaviors, formations, obstacles, drifted, grid, weights,
    scratch, v_r, before_v, trails, costs,
):  # fmt: skip
    """:func:`judge_candidate` of every candidate, shared out over numba's threads; the same numbers as in series."""
    for c in numba.prange(candidates):
        judge_candidate(
            c, kinematic, start, moving, first, mission_step, orders, behaviors, formations, obstacles, drifted, grid, weights,
    scratch, v_r, before_v, trails, costs,
        )  # fmt: skip


def judge(
    plan: Plan, start: np.ndarray, first: int, orders: np.ndarray, obstacles: np.ndarray, weights: np.ndarray, *,
    moving: np.ndarray | None = None, threads: int = 1, trails: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Costs (C,) and trails (C, H, N, 2) of candidate ``orders`` (C, H, N) from positions ``start`` (N, 2) at step ``first``.

    ``moving`` (N, 2) [m/s], zero by default, is the velocity that references of limited acceleration go on from.
    ``weights`` as in :func:`trail_cost`; ``trails`` given are judged as they are, else the kinematic reference is rolled out.
    """
    candidates, scenario = len(orders), plan.scenario
    kinematic = trails is None
    if trails is None:
        trails = np.empty((*orders.shape, 2))
    costs = np.empty(candidates)
    arguments = (
        kinematic, np.ascontiguousarray(start), np.ascontiguousarray(np.zeros_like(start) if moving is None else moving), first,
        scenario.mission_step, orders, plan.behaviors, scenario.formations, np.ascontiguousarray(obstacles),
        np.zeros((candidates, *obstacles.shape)),
        np.zeros((candidates, plan.grid_room)), weights, np.zeros((candidates, SCRATCH, 2)),
        *np.zeros((2, candidates, scenario.agents, 2)), trails, costs,
    )  # fmt: skip
    if threads == 1 or candidates == 1:
        judge_serial(candidates, *arguments)
    else:
        numba.set_num_threads(threads)
        judge_parallel(candidates, *arguments)
    return costs, trails


def follow(twin: World, situation: Situation) -> None:
    """Put a twin (a world of its own) where the measured team is; references and controllers stay what the twin made them."""
    team = twin.state
    team.position[0], team.velocity[0], team.obstacles[0] = situation.position, situation.velocity, situation.obstacles
    if team.motions.shape[1]:  # a twin's obstacles go straight on from where they are seen
        place, velocity = situation.obstacles[:, :3], situation.obstacles[:, 3:]
        team.motions[0, :, :2], team.motions[0, :, 2:] = velocity, 0.0
        team.anchors[0] = place
        team.anchors[0, :, :2] -= velocity * situation.time
    twin.put(0, situation.position, situation.velocity)


def simulate(twin: World, worlds: World, orders: np.ndarray) -> np.ndarray:
    """Trails (C, H, N, 2) of candidate ``orders`` (C, H, N) through MuJoCo: measured positions, from the twin's state on.

    ``worlds`` holds at least C worlds; those left over repeat the first candidate. A world that diverges stays where it did.
    """
    candidates, horizon = orders.shape[:2]
    every = np.concatenate([orders, np.repeat(orders[:1], worlds.worlds - candidates, axis=0)])
    for c in range(worlds.worlds):
        worlds.copy_world(twin, 0, c)
    trails = np.empty((*orders.shape, 2))
    for k in range(horizon):
        worlds.advance(np.ascontiguousarray(every[:, k]))
        trails[:, k] = worlds.state.position[:candidates]
    return trails
