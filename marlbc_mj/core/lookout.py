"""The look-out of a shield: lists of what was near every agent when it last looked. Until agents move far, the rest is ignored.

The idea is that of Verlet's neighbor lists (1967), except that each agent renews its own list, so that one fast agent does not
make all others look. Let x_i be the place from which agent i last looked. Its list holds the things k, obstacles and agents, to
which it had at most the room R there: |x_i - x_k| - kept <= R. An agent that looks also enters itself into the lists of others.
If agent i has moved by s_i since, and no agent by more than s, then its room to unlisted things is more than R - s_i - s, and its
room to listed things is at least the least room at that time minus s_i + s. The look-out is used only if obstacles are at rest
and no messages are late.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free, inlined
from marlbc_mj.core.stopping import anything_near, concerns, near, thing_count

SKIN = 0.1
"""Distance that an agent may move before it looks again, as a share of R."""
LISTED = 24
"""Greatest length of the list of an agent; if more things are near, all things are checked."""
ROOM_ERROR = 1e-9  # rounding error of the rooms computed here [m]
X, Y, FREE = 0, 1, 2
"""Columns of ``looked``: where the agent last looked, and the least room that it had there, at most R [m]."""


@allocation_free
def forget_moved(obstacles, looked, seen):
    """Make all agents look again if ``obstacles`` (K, 3) are not those of the last look.

    Callers may move them between mission steps. ``looked`` (N, 3) and ``seen`` (K, 3) are changed in place.
    """
    same = True
    for k in range(seen.shape[0]):
        for column in range(3):
            if obstacles[k, column] != seen[k, column]:
                same = False
                seen[k, column] = obstacles[k, column]
    if not same:
        for i in range(looked.shape[0]):
            looked[i, X] = np.inf


@inlined
def vicinity(numbers):
    """R [m]: the sum of the distances kept from obstacles and from agents."""
    return numbers.clearance + numbers.agent_distance


@inlined
def displacement(view, i):
    """Distance of agent ``i`` from where it last looked [m]."""
    x, y = view.p[i, 0] - view.looked[i, X], view.p[i, 1] - view.looked[i, Y]
    return np.sqrt(x * x + y * y)


@allocation_free
def look_out(numbers, view):
    """Make agents that have moved far look again; returns the greatest displacement of the other agents [m]."""
    farthest, skin = 0.0, SKIN * vicinity(numbers)
    for i in range(view.p.shape[0]):
        moved = displacement(view, i)
        if moved <= skin:
            farthest = max(farthest, moved)
        else:
            look(numbers, view, i)
    return farthest


@allocation_free
def look(numbers, view, i):
    """Renew the list of agent ``i`` and its row of ``view.looked`` from where it is, and enter it into the lists of others."""
    count, around = view.obstacles.shape[0], vicinity(numbers)
    view.looked[i, X], view.looked[i, Y], view.looked[i, FREE] = view.p[i, 0], view.p[i, 1], around
    view.around[i, 0] = 0
    for k in range(count + view.p.shape[0]):
        j = k - count
        if j < 0:
            x, y, kept = view.obstacles[k, 0], view.obstacles[k, 1], view.obstacles[k, 2] + numbers.clearance
        else:
            x, y, kept = view.looked[j, X], view.looked[j, Y], numbers.agent_distance
        x, y = view.p[i, 0] - x, view.p[i, 1] - y
        if x * x + y * y <= (kept + around) ** 2 and j != i:
            free = np.sqrt(x * x + y * y) - kept
            view.looked[i, FREE] = min(view.looked[i, FREE], free)
            enter(view.around[i], k)
            if j >= 0:
                view.looked[j, FREE] = min(view.looked[j, FREE], free)
                enter(view.around[j], count + i)


@allocation_free
def enter(listed, k):
    """Insert thing ``k`` into a list (1 + LISTED,): its length, or -1 after an overflow, then the things in ascending order."""
    length = listed[0]
    if length < 0:
        return
    place = length
    while place > 0 and listed[place] > k:
        place -= 1
    if place > 0 and listed[place] == k:
        return
    if length == LISTED:
        listed[0] = -1
        return
    for n in range(length, place, -1):
        listed[n + 1] = listed[n]
    listed[place + 1] = k
    listed[0] = length + 1


@inlined
def most_room(view, i, longest, need):
    """Distance [m] beyond the kept one above which no obstacle or agent leaves agent ``i`` less room than ``need`` [m]."""
    return 2.0 * need - view.stopping[i] + longest + ROOM_ERROR


@inlined
def is_alone(view, i, longest, need, farthest):
    """Whether the least room at the last look shows that nothing leaves agent ``i`` less room than ``need`` [m].

    Args:
        view: contains the results of the last look.
        i: the agent.
        longest: the team's greatest stopping distance [m].
        need: at least the agent's own stopping distance [m].
        farthest: the result of :func:`look_out` [m].
    """
    return view.looked[i, FREE] - displacement(view, i) - farthest > most_room(view, i, longest, need)


@inlined
def is_listed(numbers, view, i, longest, need, farthest):
    """Whether the list has everything that may leave agent ``i`` less room than ``need`` [m]; arguments of :func:`is_alone`."""
    left = vicinity(numbers) - displacement(view, i) - farthest
    return view.around[i, 0] >= 0 and left > most_room(view, i, longest, need)


@allocation_free
def gather(numbers, view, i, longest, need, farthest):
    """Fill ``view.near`` with all things that leave agent ``i`` less room than ``need`` [m], in ascending order.

    Args:
        numbers: numbers of the shield.
        view: filled in place; without a look-out, its grids must be up to date.
        i: the agent.
        longest: the team's greatest stopping distance [m].
        need: room below which things are gathered [m].
        farthest: the result of :func:`look_out` [m].
    """
    found, watched = 0, view.looked.shape[0] > 0
    if watched and is_listed(numbers, view, i, longest, need, farthest):
        for n in range(view.around[i, 0]):
            k = view.around[i, 1 + n]
            if near(numbers, view, i, k, need):
                found += 1
                view.near[found] = k
    elif watched or anything_near(numbers, view, i, longest, need):
        for k in range(thing_count(view)):
            if concerns(view, i, k) and near(numbers, view, i, k, need):
                found += 1
                view.near[found] = k
    view.near[0] = found
