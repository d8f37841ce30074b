"""Speed and acceleration limits of reference velocities: what a real robot can follow. Infinite ones cost a comparison."""

import numpy as np

from marlbc_mj.core.laws import allocation_free


@allocation_free
def keep(limits, v_r, previous):  # type: ignore[no-untyped-def]
    """Remember v_r (N, 2) in ``previous`` (N, 2) before it is computed anew, where there are limits."""
    if limits[0] < np.inf or limits[1] < np.inf:
        for i in range(v_r.shape[0]):
            for axis in range(2):
                previous[i, axis] = v_r[i, axis]


@allocation_free
def limit(limits, duration, previous, v_r):  # type: ignore[no-untyped-def]
    """Bound |v_r| (N, 2) by the speed limit, and its change since ``previous`` by the acceleration limit times ``duration`` [s].

    ``limits`` (2,): speed [m/s], acceleration [m/s^2]. Directions are kept: both are limits of vectors.
    """
    if not (limits[0] < np.inf or limits[1] < np.inf):
        return
    for i in range(v_r.shape[0]):
        speed = np.sqrt(v_r[i, 0] ** 2 + v_r[i, 1] ** 2)
        if speed > limits[0]:
            v_r[i, 0] *= limits[0] / speed
            v_r[i, 1] *= limits[0] / speed
        x, y = v_r[i, 0] - previous[i, 0], v_r[i, 1] - previous[i, 1]
        change, most = np.sqrt(x * x + y * y), limits[1] * duration
        if change > most:
            v_r[i, 0] = previous[i, 0] + x * (most / change)
            v_r[i, 1] = previous[i, 1] + y * (most / change)
