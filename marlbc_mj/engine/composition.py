"""From a priority order to a reference velocity: behaviors are evaluated in turn, composed and limited.

There are two compositions: null-space (12), :func:`compose`, to which erratum 5 and erratum 6 apply, and set-based,
:func:`compose_set_based`, in which avoidance is an inequality. The engine, the predictions of supervisors and the older
frameworks all use :func:`compose_team`.
"""

from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.barriers import Barrier, bound_neighbors, bound_obstacles
from marlbc_mj.core.behaviors import NEAREST_NEIGHBOR, NEAREST_OBSTACLE
from marlbc_mj.core.braking import restrain
from marlbc_mj.core.cells import fill, nearest, room
from marlbc_mj.core.compiling import allocation_free, on_both_paths
from marlbc_mj.core.halfplanes import closest
from marlbc_mj.core.nullspace import add_behavior
from marlbc_mj.engine.by_address import call
from marlbc_mj.engine.native import as_behavior

WORKSPACE = 9
"""Number of rows of two numbers from which a :class:`TeamView` is made."""
PLANE_ROWS = 2
"""Number of additional rows per half-plane of a set-based composition."""


class Behaviors(NamedTuple):
    """The behaviors of a scenario and how they become references: M behaviors, N agents, O orders, C commands."""

    laws: np.ndarray  # (M,) addresses; the laws themselves if numba is off
    params: np.ndarray  # (M, N, P) gains of each law for each agent
    sees: np.ndarray  # (M,) what each law looks at, see marlbc_mj.core.behaviors
    table: np.ndarray  # (O, M) behavior indices of every order, highest priority first
    command_of: np.ndarray  # (O,) index of the command that each order gives
    path: np.ndarray  # (2, 2) p_cd(0) [m] and its velocity [m/s]
    virtual: bool  # whether behaviors are evaluated at p_r; otherwise at the measured p
    speed_limit: float  # speed limit of references [m/s]
    acceleration_limit: float  # acceleration limit of references [m/s^2]
    compose: Any  # entry of the composition: null_space_team or set_based_team
    keeps: np.ndarray  # (M,) distance that an inequality task keeps [m]; 0 for an equality task
    rate: float  # from here on: the fields of Barrier, flat because threaded loops take no nested tuples
    margin: float
    reach: float
    speed: float
    braking: float
    duration: float
    obstacle_distance: float
    agent_distance: float


@allocation_free
def barrier_of(behaviors):
    """The :class:`Barrier` made of the flat fields of ``behaviors``."""
    return Barrier(
        rate=behaviors.rate,
        margin=behaviors.margin,
        reach=behaviors.reach,
        speed=behaviors.speed,
        braking=behaviors.braking,
        duration=behaviors.duration,
        obstacle_distance=behaviors.obstacle_distance,
        agent_distance=behaviors.agent_distance,
    )


class TeamView(NamedTuple):
    """What behaviors read of one team, and scratch for their evaluation."""

    at: np.ndarray  # (N, 2) positions at which behaviors are evaluated [m]
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]; (K, 5) with their velocity [m/s] if they move
    path: np.ndarray  # (2, 2) p_cd [m] and its velocity [m/s], now
    grid: np.ndarray  # room for a grid of the obstacles and one of the team; empty if trying all pairs costs less
    velocity: np.ndarray  # (2,) scratch: one behavior's desired velocity
    jacobian: np.ndarray  # (2, 2) scratch: its Jacobian
    basis: np.ndarray  # (2, 2) scratch: span of the Jacobians of higher priority
    pair: np.ndarray  # (2, 2) scratch: an agent and its nearest neighbor


@allocation_free
def path_at(t, path, out):
    """Desired centroid and its velocity at ``t`` [s]: ``out`` (2, 2) from ``path`` (2, 2) = origin [m], velocity [m/s]."""
    for axis in range(2):
        out[0, axis] = path[0, axis] + t * path[1, axis]
        out[1, axis] = path[1, axis]


@on_both_paths
def make_view(t, behaviors, at, obstacles, grid, workspace):
    """The :class:`TeamView` of a team at ``t`` [s]; ``workspace`` (WORKSPACE, 2). Grids are filled if there is room."""
    path = workspace[0:2]
    path_at(t, behaviors.path, path)
    if grid.shape[0] > 0:
        count = obstacles.shape[0]
        fill(obstacles, grid[: room(count)])
        fill(at, grid[room(count) :])
    return TeamView(at, obstacles, path, grid, workspace[2], workspace[3:5], workspace[5:7], workspace[7:9])


@on_both_paths
def desired_velocity(j, i, behaviors, view):
    """Write desired velocity (8) and Jacobian of behavior ``j`` for agent ``i`` into the view; returns the number of its rows.

    If the view has a grid, a law that needs only the nearest obstacle or neighbor receives only that one.
    """
    obstacles, team, own = view.obstacles, view.at, i
    if view.grid.shape[0] > 0:
        count = view.obstacles.shape[0]
        if behaviors.sees[j] == NEAREST_OBSTACLE:
            k = nearest(view.at[i], view.obstacles, view.grid[: room(count)], -1)
            if k >= 0:
                obstacles = view.obstacles[k : k + 1]
        elif behaviors.sees[j] == NEAREST_NEIGHBOR:
            k = nearest(view.at[i], view.at, view.grid[room(count) :], i)
            if k >= 0:
                own, team = 1 if i > k else 0, view.pair
                for axis in range(2):
                    team[own, axis], team[1 - own, axis] = view.at[i, axis], view.at[k, axis]
    law = as_behavior(behaviors.laws[j])
    return law(behaviors.params[j, i], view.at[i], view.path, obstacles, team, own, view.velocity, view.jacobian)


@on_both_paths
def compose(order, i, behaviors, view, v_r):
    """v_r = v^1 + sum_j N^{1..j-1} v^j, N = I - A^+ A (12), for agent ``i``, into ``v_r`` (2,) [m/s].

    ``order`` (M,) lists behavior indices, highest priority first. A stacks the Jacobians of all behaviors above j (erratum 5).
    A behavior is evaluated only if those above it leave a direction free.
    """
    v_r[0] = v_r[1] = 0.0
    rank = 0
    for j in order:
        if rank == 2:
            break
        rows = desired_velocity(j, i, behaviors, view)
        rank = add_behavior(view.velocity, view.jacobian, rows, view.basis, rank, v_r)


@allocation_free
def compose_set_based(order, i, behaviors, barrier, view, planes, v_r):
    """v_r = argmin |v - v_c|^2 over the v that inequality tasks allow, for agent ``i``, into ``v_r`` (2,) [m/s].

    v_c composes the other behaviors by (12): FM or FR, whichever comes first. |v| is at most ``barrier.speed``. OA and AA bound v
    whatever the order is, see :mod:`marlbc_mj.core.barriers`; if they contradict each other, the one that ``order`` (M,) lists
    first is violated least. ``planes`` (n, 4) is scratch.
    """
    v_r[0] = v_r[1] = 0.0
    rank, count = 0, 0
    for place in range(order.shape[0]):
        j = order[place]
        distance = behaviors.keeps[j]
        if distance > 0.0 and behaviors.sees[j] == NEAREST_OBSTACLE:
            count = bound_obstacles(view.at[i], view.obstacles, distance, place, barrier, planes, count)
        elif distance > 0.0:
            count = bound_neighbors(view.at, i, distance, place, barrier, planes, count)
        elif rank < 2:
            rows = desired_velocity(j, i, behaviors, view)
            rank = add_behavior(view.velocity, view.jacobian, rows, view.basis, rank, v_r)
    wish = view.velocity
    wish[0], wish[1] = v_r[0], v_r[1]
    closest(wish, barrier.speed, planes, count, v_r)


@allocation_free
def set_based_team(t, orders, behaviors, at, obstacles, grid, workspace, v_r):
    """Apply :func:`compose_set_based`, and :func:`restrain` if there is an acceleration limit, to every agent.

    Arguments as in :func:`compose_team`. Returns 0.
    """
    barrier = barrier_of(behaviors)
    view = make_view(t, behaviors, at, obstacles, grid[:0], workspace)
    planes = workspace[WORKSPACE:].reshape(((workspace.shape[0] - WORKSPACE) // PLANE_ROWS, 2 * PLANE_ROWS))
    for i in range(orders.shape[0]):
        before = view.pair[0]
        before[0], before[1] = v_r[i, 0], v_r[i, 1]
        compose_set_based(behaviors.table[orders[i]], i, behaviors, barrier, view, planes, v_r[i])
        if barrier.braking < np.inf:
            restrain(i, before, barrier, at, obstacles, v_r)
    return 0


@allocation_free
def null_space_team(t, orders, behaviors, at, obstacles, grid, workspace, v_r):
    """Apply :func:`compose` (12) to every agent; arguments as in :func:`compose_team`. Returns 0."""
    view = make_view(t, behaviors, at, obstacles, grid, workspace)
    for i in range(orders.shape[0]):
        compose(behaviors.table[orders[i]], i, behaviors, view, v_r[i])
    return 0


@allocation_free
def compose_team(t, orders, behaviors, at, obstacles, grid, workspace, v_r):
    """Compute the reference velocities ``v_r`` (N, 2) [m/s] of a team at ``t`` [s] by the composition of its scenario.

    Args:
        t: mission time [s].
        orders: (N,) int64, indices into ``behaviors.table``.
        behaviors: behaviors of the scenario.
        at: (N, 2) positions at which behaviors are evaluated [m].
        obstacles: (K, 3 or 5), see :class:`TeamView`.
        grid: room for a grid of the obstacles and one of the team; if it is empty, every law tries all of them.
        workspace: (WORKSPACE, 2) scratch; a set-based composition needs PLANE_ROWS more rows per half-plane.
        v_r: (N, 2), written in place. A set-based composition with an acceleration limit reads the previous velocities from it.
    """
    call(behaviors.compose, t, orders, behaviors, at, obstacles, grid, workspace, v_r)


@allocation_free
def keep(behaviors, v_r, previous):
    """Save v_r (N, 2) in ``previous`` (N, 2) before it is computed again, if references have limits."""
    if behaviors.speed_limit < np.inf or behaviors.acceleration_limit < np.inf:
        for i in range(v_r.shape[0]):
            for axis in range(2):
                previous[i, axis] = v_r[i, axis]


@allocation_free
def limit(behaviors, duration, previous, v_r):
    """Bound |v_r| (N, 2) by the speed limit, and its change since ``previous`` by the acceleration limit times ``duration`` [s].

    Both limit the length of a vector, so directions are kept. Infinite limits cost one comparison.
    """
    if not (behaviors.speed_limit < np.inf or behaviors.acceleration_limit < np.inf):
        return
    for i in range(v_r.shape[0]):
        speed = np.sqrt(v_r[i, 0] ** 2 + v_r[i, 1] ** 2)
        if speed > behaviors.speed_limit:
            v_r[i, 0] *= behaviors.speed_limit / speed
            v_r[i, 1] *= behaviors.speed_limit / speed
        x, y = v_r[i, 0] - previous[i, 0], v_r[i, 1] - previous[i, 1]
        change, most = np.sqrt(x * x + y * y), behaviors.acceleration_limit * duration
        if change > most:
            v_r[i, 0] = previous[i, 0] + x * (most / change)
            v_r[i, 1] = previous[i, 1] + y * (most / change)
