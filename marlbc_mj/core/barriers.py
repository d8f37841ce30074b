"""Avoidance as inequalities on a reference velocity: OA and AA as half-planes for :mod:`marlbc_mj.core.halfplanes`.

The bound on the approach speed is that of a set-based task (S. Moe et al., Set-based tasks within the singularity-robust
multiple task-priority inverse kinematics framework, Frontiers in Robotics and AI, 2016). It is the velocity damper of B. Faverjon
and P. Tournassoud (1987) and, since a reference is a single integrator, a control barrier function (A. D. Ames et al., Control
barrier functions: theory and applications, 2019). Each of two agents takes half of it (L. Wang, A. D. Ames, M. Egerstedt, Safety
barrier certificates for collisions-free multirobot systems, 2017).
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import allocation_free


class Barrier(NamedTuple):
    """Parameters with which inequality tasks bound reference velocities."""

    rate: float  # alpha: greatest approach speed per remaining room [1/s]
    margin: float  # m: distance kept in addition to d_OA and d_AA, for tracking errors [m]
    reach: float  # obstacles and agents farther away than this are ignored [m]
    speed: float  # greatest reference speed [m/s]
    braking: float  # A: acceleration limit of references [m/s^2]; infinite if they may jump
    duration: float  # T: time for which a reference velocity is held, one mission step [s]
    obstacle_distance: float  # greatest d_OA of the inequality tasks [m]; 0 without one
    agent_distance: float  # greatest d_AA of the inequality tasks [m]; 0 without one


@allocation_free
def bound_obstacles(p, obstacles, distance, level, barrier, planes, count):
    """OA as half-planes: n_k . v >= n_k . v_k - alpha (d_k - d_OA - m) for every obstacle k within reach.

    A step of duration T leaves at least (1 - alpha T) of the room d_k - d_OA - m, since the distance to a disc is convex along
    a line. So with alpha T <= 1, the room to an obstacle at rest never becomes negative.

    Args:
        p: (2,) position of the agent [m].
        obstacles: (K, 3) x, y, radius [m]; (K, 5) with their velocity v_k [m/s] if they move.
        distance: d_OA [m].
        level: level of these half-planes, see :mod:`marlbc_mj.core.halfplanes`.
        barrier: provides alpha, m and the reach.
        planes: (n, 4), written in place from row ``count`` on.
        count: number of rows written before.

    Returns:
        The new number of rows.
    """
    for k in range(obstacles.shape[0]):
        x, y = p[0] - obstacles[k, 0], p[1] - obstacles[k, 1]
        farthest = barrier.reach + obstacles[k, 2]
        square = x * x + y * y
        if square > farthest * farthest:
            continue
        between = np.sqrt(square)
        _normal(x, y, between, 1.0, planes[count])
        planes[count, 2] = -barrier.rate * (between - obstacles[k, 2] - distance - barrier.margin)
        if obstacles.shape[1] > 3:
            planes[count, 2] += planes[count, 0] * obstacles[k, 3] + planes[count, 1] * obstacles[k, 4]
        planes[count, 3] = level
        count += 1
    return count


@allocation_free
def bound_neighbors(team, i, distance, level, barrier, planes, count):
    """AA as half-planes: n_ij . v >= -alpha / 2 (d_ij - d_AA - m) for every agent j within reach of agent ``i``.

    ``team`` (N, 2) holds the positions [m]; the other arguments are those of :func:`bound_obstacles`. Two agents at the same
    place separate along x.
    """
    for j in range(team.shape[0]):
        x, y = team[i, 0] - team[j, 0], team[i, 1] - team[j, 1]
        square = x * x + y * y
        if j == i or square > barrier.reach * barrier.reach:
            continue
        between = np.sqrt(square)
        _normal(x, y, between, 1.0 if i > j else -1.0, planes[count])
        planes[count, 2] = -0.5 * barrier.rate * (between - distance - barrier.margin)
        planes[count, 3] = level
        count += 1
    return count


@allocation_free
def _normal(x, y, length, otherwise, plane):
    """Write the unit vector along (x, y) into the first two entries of ``plane``; (``otherwise``, 0) if its length is zero."""
    plane[0] = x / length if length > 0.0 else otherwise
    plane[1] = y / length if length > 0.0 else 0.0
