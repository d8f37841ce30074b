"""The planar program that ORCA and the barrier function need: the admissible velocity nearest to a wish.

Half-planes are inserted one at a time (de Berg et al., Computational Geometry, chapter 4; van den Berg et al. 2011): while the
point found so far satisfies the next one it stays, else the new point lies on that half-plane's line. Where no point satisfies
all of them, the greatest violation is made as small as it can be. Both are exact, up to rounding.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free

PARALLEL = 1e-12
"""Two lines whose directions have a smaller sine are parallel."""
ROUNDING = 1e-9
"""A half-plane is satisfied within this."""


@allocation_free
def nearest_velocity(wish, speed, planes, count, out):
    """argmin |v - wish| over |v| <= speed and n_k^T v >= c_k for all k; the least greatest violation where there is no such v.

    Args:
        wish: (2,).
        speed: bound of the length of v.
        planes: (2 K or more, 3 or more) rows n_x, n_y, c: unit normal and offset of each half-plane; rows from K on are scratch.
        count: K.
        out: (2,) v, written in place.

    Returns:
        Whether all half-planes hold.
    """
    failed = _insert_all(planes[:count], wish[0], wish[1], speed, False, out)
    if failed == count:
        return True
    _least_violation(planes[:count], failed, speed, planes[count:], out)
    return False


@allocation_free
def _insert_all(planes, x, y, speed, outward, out):
    """The point nearest to (x, y), or farthest along the unit vector (x, y) if ``outward``, into ``out`` (2,).

    Returns how many half-planes it satisfies, counted up to the first at which there is no point any more.
    """
    length = np.sqrt(x * x + y * y)
    scale = speed if outward else speed / length if length > speed else 1.0
    out[0], out[1] = scale * x, scale * y
    for i in range(planes.shape[0]):
        if planes[i, 0] * out[0] + planes[i, 1] * out[1] < planes[i, 2] - ROUNDING and not _on_line(
            i, planes, x, y, speed, outward, out
        ):
            return i
    return planes.shape[0]


@allocation_free
def _on_line(i, planes, x, y, speed, outward, out):
    """The best point of line ``i`` within the disc and the half-planes before it, into ``out``; False where there is none."""
    n_x, n_y, offset = planes[i, 0], planes[i, 1], planes[i, 2]
    square = speed * speed - offset * offset
    if square < 0.0:
        return False
    high = np.sqrt(square)
    low = -high
    for j in range(i):
        slope = planes[j, 1] * n_x - planes[j, 0] * n_y
        need = planes[j, 2] - offset * (planes[j, 0] * n_x + planes[j, 1] * n_y)
        if abs(slope) <= PARALLEL:
            if need > ROUNDING:
                return False
        elif slope > 0.0:
            low = max(low, need / slope)
        else:
            high = min(high, need / slope)
    if low > high + ROUNDING:
        return False
    along = n_x * y - n_y * x
    farthest = high if along > 0.0 else low
    place = farthest if outward else min(max(along, low), high)
    out[0], out[1] = offset * n_x - place * n_y, offset * n_y + place * n_x
    return True


@allocation_free
def _least_violation(planes, first, speed, room, out):
    """The point of the disc with the least greatest violation, from half-plane ``first`` on, into ``out``.

    Where half-plane i is violated most, no other may be violated more: (n_j - n_i)^T v >= c_j - c_i for all j before it, and v
    goes along n_i as far as those let it.
    """
    worst = 0.0
    for i in range(first, planes.shape[0]):
        if planes[i, 2] - planes[i, 0] * out[0] - planes[i, 1] * out[1] <= worst + ROUNDING:
            continue
        count = 0
        for j in range(i):
            x, y = planes[j, 0] - planes[i, 0], planes[j, 1] - planes[i, 1]
            length = np.sqrt(x * x + y * y)
            if length > PARALLEL:
                room[count, 0], room[count, 1] = x / length, y / length
                room[count, 2] = (planes[j, 2] - planes[i, 2]) / length
                count += 1
        x, y = out[0], out[1]
        if _insert_all(room[:count], planes[i, 0], planes[i, 1], speed, True, out) < count:
            out[0], out[1] = x, y  # there is a point; only rounding hides it
        worst = planes[i, 2] - planes[i, 0] * out[0] - planes[i, 1] * out[1]
