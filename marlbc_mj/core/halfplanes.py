"""The velocity nearest to a desired one within half-planes: an exact solution of a planar quadratic program, without a solver.

minimize |v - wish|^2  subject to  n_k . v >= b_k  and  |v| <= speed.

Half-planes are inserted one at a time: if one cuts off the optimum so far, the new optimum lies on its border, where the problem
has one dimension (M. de Berg et al., Computational Geometry, ch. 4; J. van den Berg et al., Reciprocal n-body collision
avoidance, 2011). If half-planes contradict each other, the more important levels win: the greatest violation of the first level
is minimized, then that of the second, and so on, and finally the distance from the desired velocity.

A half-plane is a row of four numbers: n_x, n_y (a unit normal), b [m/s], level. Rows are sorted by level, the most important
first.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free

PARALLEL = 1e-12  # sine below which two borders are parallel
ROUND_OFF = 1e-12  # violation up to which a half-plane counts as satisfied [m/s]
MEETING = 1e-10  # gap up to which borders count as meeting [m/s]
RELAXATION = 1e-9  # added to the least violation, so that rounding leaves a feasible point [m/s]


@allocation_free
def closest(wish, speed, planes, count, v):
    """Write into ``v`` (2,) the velocity closest to ``wish`` (2,) [m/s] that satisfies the half-planes or violates them least.

    Args:
        wish: (2,) desired velocity [m/s]; must not be the array ``v``.
        speed: greatest |v| [m/s].
        planes: (n, 4) half-planes; if they contradict each other, bounds are relaxed in place by the least violation.
        count: number of rows of ``planes`` in use.
        v: (2,) [m/s], written in place.

    Returns:
        Whether all half-planes can be satisfied.
    """
    if _insert(wish, planes, count, 0, -1, speed, v):
        return True
    _shorten(wish, speed, v)
    first = 0
    while first < count:
        end = first + 1
        while end < count and planes[end, 3] == planes[first, 3]:
            end += 1
        violation = _least_violation(planes, first, end, speed, v)
        if violation > 0.0:
            for k in range(first, end):
                planes[k, 2] -= violation + RELAXATION
        first = end
    x, y = v[0], v[1]
    if not _insert(wish, planes, count, 0, -1, speed, v):
        v[0], v[1] = x, y
    return False


@allocation_free
def _least_violation(planes, first, end, speed, v):
    """Minimize the greatest violation z >= 0 [m/s] of rows ``first`` to ``end`` - 1, subject to the rows before; returns z.

    ``v`` (2,) must satisfy the rows before ``first`` and is moved to the minimum. If row i is violated more than all rows before
    it, it is also the most violated of them at the optimum. Then z = b_i - n_i . v, and every row j before it requires
    (n_j - n_i) . v >= b_j - b_i: a linear program in v.
    """
    least = 0.0
    for i in range(first, end):
        violation = planes[i, 2] - planes[i, 0] * v[0] - planes[i, 1] * v[1]
        if violation <= least + ROUND_OFF:
            continue
        x, y = v[0], v[1]
        if not _insert(planes[i], planes, i, first, i, speed, v):
            v[0], v[1] = x, y
        least = max(0.0, planes[i, 2] - planes[i, 0] * v[0] - planes[i, 1] * v[1])
    return least


@allocation_free
def _insert(goal, planes, stop, first, most, speed, v):
    """Write the optimum over the first ``stop`` rows and the disc |v| <= ``speed`` into ``v``; False if there is none.

    If ``most`` < 0, the optimum is the point nearest to ``goal``. Otherwise it is the farthest point in the direction ``goal``,
    and rows from ``first`` on require row ``most`` to be violated at least as much as they are.
    """
    if most < 0:
        _shorten(goal, speed, v)
    else:
        v[0], v[1] = speed * goal[0], speed * goal[1]
    for k in range(stop):
        x, y, bound = _border(planes, k, first, most)
        if x * v[0] + y * v[1] < bound - ROUND_OFF and not _on_border(goal, planes, k, first, most, speed, v):
            return False
    return True


@allocation_free
def _border(planes, k, first, most):
    """Unit normal and bound of row ``k`` in the form that :func:`_insert` uses."""
    if most < 0 or k < first:
        return planes[k, 0], planes[k, 1], planes[k, 2]
    x, y, bound = planes[k, 0] - planes[most, 0], planes[k, 1] - planes[most, 1], planes[k, 2] - planes[most, 2]
    length = np.sqrt(x * x + y * y)
    if length < PARALLEL:
        return 0.0, 0.0, -1.0
    return x / length, y / length, bound / length


@allocation_free
def _on_border(goal, planes, k, first, most, speed, v):
    """Write the optimum on the border of row ``k``, subject to the rows before it, into ``v``; False if there is none."""
    x, y, bound = _border(planes, k, first, most)
    if abs(bound) > speed + MEETING:
        return False
    high = np.sqrt(max(0.0, speed * speed - bound * bound))
    low = -high
    for j in range(k):
        other_x, other_y, least = _border(planes, j, first, most)
        along = y * other_x - x * other_y  # the border's direction is (y, -x)
        rest = least - bound * (x * other_x + y * other_y)
        if abs(along) < PARALLEL:
            if rest > MEETING:
                return False
        elif along > 0.0:
            low = max(low, rest / along)
        else:
            high = min(high, rest / along)
    if low > high + MEETING:
        return False
    wanted = y * goal[0] - x * goal[1]
    if most >= 0:
        wanted = high if wanted > 0.0 else low
    place = min(max(wanted, low), high)
    v[0], v[1] = bound * x + place * y, bound * y - place * x
    return True


@allocation_free
def _shorten(vector, length, out):
    """Write ``vector`` (2,), shortened to at most ``length``, into ``out`` (2,)."""
    size = np.sqrt(vector[0] ** 2 + vector[1] ** 2)
    factor = length / size if size > length else 1.0
    out[0], out[1] = factor * vector[0], factor * vector[1]
