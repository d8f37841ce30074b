"""Admissible references of limited acceleration: those from which braking in a straight line keeps all distances.

An agent's *braking path* is the straight line that it travels until it rests, if it brakes from the next mission step on. A
velocity is admissible if its braking path keeps d_OA + m from every obstacle at rest and d_AA + m from every point of the braking
paths of all other agents. One mission step later, the remaining braking path lies within the old one. So an agent that brakes
stays admissible: from an admissible state there is always an admissible velocity, whatever the desired velocities are.

For one obstacle and T -> 0, |v| max(0, -n . v) <= 2 A (d - d_OA - m) is sufficient: the distance to a convex body is convex along
a line, so on an approach it is at least d + n . v |v| / (2 A) everywhere on the braking path.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free

BISECTIONS = 8
"""Number of bisections of the change of velocity, if the full change is not admissible."""


@allocation_free
def restrain(i, before, barrier, at, obstacles, v_r):
    """Replace the desired velocity ``v_r[i]`` of agent ``i`` by an admissible one within the acceleration limit, in place.

    The result lies between the braking velocity and the desired velocity, which is first cut to the acceleration limit. Bisection
    brings it close to the latter. Agents choose one after the other: agent i knows the choices of the agents before it, and the
    agents after it can still brake from their present velocities. Moving obstacles bound only the desired velocity
    (:mod:`marlbc_mj.core.barriers`); there is no guarantee for them.

    Args:
        i: index of the agent.
        before: (2,) its velocity in the previous mission step [m/s].
        barrier: see :class:`marlbc_mj.core.barriers.Barrier`, with a finite ``braking``.
        at: (N, 2) positions of the agents [m].
        obstacles: (K, 3) x, y, radius [m]; (K, 5) if they move.
        v_r: (N, 2) [m/s], already chosen for the agents before i, and of the previous mission step for the agents after i.
    """
    brake_x, brake_y = brake(before[0], before[1], barrier)
    x, y = v_r[i, 0] - before[0], v_r[i, 1] - before[1]
    change, most = np.sqrt(x * x + y * y), barrier.braking * barrier.duration
    part = most / change if change > most else 1.0
    x, y = before[0] + part * x - brake_x, before[1] + part * y - brake_y
    share, step, found = 1.0, 0.5, 0.0
    for _ in range(1 + BISECTIONS):
        if stays_clear(i, brake_x + share * x, brake_y + share * y, brake_x, brake_y, barrier, at, obstacles, v_r):
            found = share
            if share == 1.0:
                break
            share += step
        else:
            share -= step
        step *= 0.5
    v_r[i, 0], v_r[i, 1] = brake_x + found * x, brake_y + found * y


@allocation_free
def stays_clear(i, x, y, brake_x, brake_y, barrier, at, obstacles, v_r):
    """Whether the braking path of agent ``i`` from velocity (x, y) keeps all distances, or comes no closer than braking now does.

    (``brake_x``, ``brake_y``) [m/s] is its velocity if it brakes now; the other arguments are those of :func:`restrain`.
    """
    time, brake_time = path_time(x, y, barrier), path_time(brake_x, brake_y, barrier)
    a, b, c, d = time * x, time * y, brake_time * brake_x, brake_time * brake_y
    length = np.sqrt(a * a + b * b)
    if barrier.obstacle_distance > 0.0 and obstacles.shape[1] == 3:
        for k in range(obstacles.shape[0]):
            r_x, r_y = at[i, 0] - obstacles[k, 0], at[i, 1] - obstacles[k, 1]
            least = barrier.obstacle_distance + barrier.margin + obstacles[k, 2]
            if r_x * r_x + r_y * r_y < (least + length) ** 2:
                gap = least_distance(r_x, r_y, a, b, 0.0, 0.0)
                if gap < least and gap < least_distance(r_x, r_y, c, d, 0.0, 0.0):
                    return False
    if barrier.agent_distance > 0.0:
        least = barrier.agent_distance + barrier.margin
        for j in range(at.shape[0]):
            if j == i:
                continue
            v_x, v_y = (v_r[j, 0], v_r[j, 1]) if j < i else brake(v_r[j, 0], v_r[j, 1], barrier)
            other_time = path_time(v_x, v_y, barrier)
            e, f = other_time * v_x, other_time * v_y
            r_x, r_y = at[i, 0] - at[j, 0], at[i, 1] - at[j, 1]
            if r_x * r_x + r_y * r_y < (least + length + np.sqrt(e * e + f * f)) ** 2:
                gap = least_distance(r_x, r_y, a, b, e, f)
                if gap < least and gap < least_distance(r_x, r_y, c, d, e, f):
                    return False
    return True


@allocation_free
def path_time(x, y, barrier):
    """L(s) / s [s], where L(s) = (s + A T / 2)^2 / (2 A) is the length of the braking path from a velocity (x, y) of speed s.

    The reference holds s for a mission step T and then loses A T in every step. L(s) - s T >= L(s - A T), so paths are nested.
    For T -> 0, L is s^2 / (2 A).
    """
    speed, half = np.sqrt(x * x + y * y), 0.5 * barrier.braking * barrier.duration
    return (speed + half) ** 2 / (2.0 * barrier.braking * speed) if speed > 0.0 else 0.0


@allocation_free
def brake(x, y, barrier):
    """The velocity one mission step after (x, y) [m/s] when braking in a straight line."""
    speed, loss = np.sqrt(x * x + y * y), barrier.braking * barrier.duration
    factor = 1.0 - loss / speed if speed > loss else 0.0
    return factor * x, factor * y


@allocation_free
def least_distance(x, y, a, b, c, d):
    """Least |(x, y) + s (a, b) - t (c, d)| over s and t in [0, 1]: the distance between two line segments.

    (x, y) points from the start of the second segment to that of the first, (a, b) and (c, d) are the segments as vectors [m].
    """
    cross = a * d - b * c
    if cross != 0.0 and 0.0 <= (c * y - d * x) / cross <= 1.0 and 0.0 <= (a * y - b * x) / cross <= 1.0:
        return 0.0
    along_first = min(_from_origin(x, y, a, b), _from_origin(x - c, y - d, a, b))
    return min(along_first, _from_origin(x, y, -c, -d), _from_origin(x + a, y + b, -c, -d))


@allocation_free
def _from_origin(x, y, a, b):
    """Distance from the origin to the segment between (x, y) and (x + a, y + b)."""
    square = a * a + b * b
    s = min(max(-(x * a + y * b) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return np.sqrt((x + s * a) ** 2 + (y + s * b) ** 2)
