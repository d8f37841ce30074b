"""Room that every agent had at the last look at everything: while it lasts, a shield need not look again.

The idea is that of Verlet's neighbor lists (1967). At a look, agent i has room m_i: no obstacle and no other agent is nearer than
that, beyond the distance to keep. If since then i has moved by s_i and nobody by more than s, then it has m_i - s_i - s at least.
Obstacles are at rest; where they move, or messages are late, there is no look-out.
"""

import numpy as np

from marlbc_mj.core.cells import nearest, room
from marlbc_mj.core.laws import allocation_free

SKIN = 0.1
"""Share of the distances to keep that agents may move before everything is looked at again."""
ROOM_ERROR = 1e-9  # of what is computed here [m]
X, Y, FREE = 0, 1, 2
"""Columns of ``looked``: where the agent was, the room that it had [m]."""


@allocation_free
def forget(looked):
    """Have everything looked at again: between mission steps anybody may have moved obstacles. ``looked`` (N, 3), in place."""
    for i in range(looked.shape[0]):
        looked[i, X] = np.inf


@allocation_free
def displacement(view, i):
    """How far agent ``i`` is from where it was at the last look [m]."""
    x, y = view.p[i, 0] - view.looked[i, X], view.p[i, 1] - view.looked[i, Y]
    return np.sqrt(x * x + y * y)


@allocation_free
def most_moved(numbers, view):
    """The farthest that an agent has moved since the last look [m]; infinite where it is time for another."""
    farthest, skin = 0.0, SKIN * (numbers.clearance + numbers.agent_distance)
    for i in range(view.p.shape[0]):
        farthest = max(farthest, displacement(view, i))
    return farthest if farthest <= skin else np.inf


@allocation_free
def look(numbers, view):
    """Fill ``view.looked``; grids, where there are any, are those of this moment."""
    split = room(view.obstacles.shape[0])
    for i in range(view.p.shape[0]):
        view.looked[i, X], view.looked[i, Y], view.looked[i, FREE] = view.p[i, 0], view.p[i, 1], np.inf
        k = nearest(view.p[i], view.obstacles, view.grid[:split], -1)
        if k >= 0:
            see(view, i, view.obstacles[k], view.obstacles[k, 2] + numbers.clearance)
        j = nearest(view.p[i], view.p, view.grid[split:], i)
        if j >= 0:
            see(view, i, view.p[j], numbers.agent_distance)


@allocation_free
def see(view, i, place, kept):
    """Agent ``i`` has no more room than a thing at ``place`` leaves, from which ``kept`` [m] is to be kept."""
    x, y = view.p[i, 0] - place[0], view.p[i, 1] - place[1]
    view.looked[i, FREE] = min(view.looked[i, FREE], np.sqrt(x * x + y * y) - kept)


@allocation_free
def is_alone(view, i, longest, need, farthest):
    """Whether the last look says that nothing leaves agent ``i`` less room than ``need`` [m].

    Args:
        view: with what was seen.
        i: the agent.
        longest: the team's greatest stopping distance [m].
        need: at least the agent's own stopping distance [m].
        farthest: that an agent has moved since [m].
    """
    left = view.looked[i, FREE] - displacement(view, i) - farthest
    return left > 2.0 * need - view.stopping[i] + longest + ROOM_ERROR
