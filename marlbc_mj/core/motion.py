"""Obstacles that move with the mission time: in a straight line, or back and forth.

This extends the paper, whose Assumption 2 has obstacles at rest. The engine, metrics and drawings use the same law, so that an
obstacle has one position at any time.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free, compiled

NUMBERS = 6
"""Number of columns of a motion: velocity x, y [m/s], amplitude x, y [m], angular frequency [rad/s], phase [rad]."""
MOVING = 5
"""Number of columns of a moving obstacle: x, y, radius [m], velocity x, y [m/s]."""


@allocation_free
def move(t, anchors, motions, out):
    """o(t) = anchor + v t + a sin(w t + phase), and its velocity.

    Args:
        t: mission time [s].
        anchors: (K, 3) x, y, radius [m].
        motions: (K, 6), columns as in :data:`NUMBERS`.
        out: (K, 5) x, y, radius [m], velocity x, y [m/s], written in place.
    """
    for k in range(anchors.shape[0]):
        sine = np.sin(motions[k, 4] * t + motions[k, 5])
        rate = motions[k, 4] * np.cos(motions[k, 4] * t + motions[k, 5])
        for axis in range(2):
            out[k, axis] = anchors[k, axis] + motions[k, axis] * t + motions[k, 2 + axis] * sine
            out[k, 3 + axis] = motions[k, axis] + motions[k, 2 + axis] * rate
        out[k, 2] = anchors[k, 2]


@allocation_free
def drift(t, obstacles, out):
    """Predict obstacles (K, 5) after ``t`` [s] at constant velocity, as a tracker does, into ``out`` (K, 5)."""
    for k in range(obstacles.shape[0]):
        for axis in range(2):
            out[k, axis] = obstacles[k, axis] + obstacles[k, 3 + axis] * t
            out[k, 3 + axis] = obstacles[k, 3 + axis]
        out[k, 2] = obstacles[k, 2]


@compiled
def _fill_moved(times, anchors, motions, out):
    for m in range(times.shape[0]):
        move(times[m], anchors, motions, out[m])


def moved(times: np.ndarray, anchors: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """The obstacles (M, K, 5) that :func:`move` gives at each of the ``times`` (M,) [s]."""
    times = np.ascontiguousarray(times, dtype=np.float64)
    out = np.empty((len(times), len(anchors), MOVING))
    _fill_moved(times, np.ascontiguousarray(anchors, dtype=np.float64), np.ascontiguousarray(motions, dtype=np.float64), out)
    return out


def obstacles_at(time: float, anchors: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """(K, 3) x, y, radius [m] of obstacles at ``time`` [s]; with ``motions`` (0, 6) these are the anchors (K, 3)."""
    if len(motions) == 0:
        return anchors
    return np.ascontiguousarray(moved(np.array([time]), anchors, motions)[0, :, :3])  # compiled functions expect this


def nearest_places(times: np.ndarray, positions: np.ndarray, anchors: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """(K, 3) obstacles, each at its closest approach to an agent in an episode: where a still picture draws it.

    ``positions`` (M, N, 2) [m] are those at ``times`` (M,) [s].
    """
    if len(motions) == 0:
        return anchors
    tracks = moved(times, anchors, motions)[..., :3]  # (M, K, 3)
    gaps = [np.linalg.norm(positions - tracks[:, None, k, :2], axis=-1).min(axis=1).argmin() for k in range(len(anchors))]
    return np.asarray(tracks[gaps, np.arange(len(anchors))])
