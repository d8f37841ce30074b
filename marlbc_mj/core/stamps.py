"""Separation of two agents whose messages are late or lost, by stamps: instants at which both states are known to both.

Of a *stamp* x agent i knows p_j and L_j from a message, and its own p_i and L_i from memory. With n the unit vector from j to i
at x, |p_i - p_j| is at least n.(p_i - p_j) ever after. So if each keeps

    n.p_i + c >= L_i,   c = gap(x) / 2 - n.p_i(x) + L_i(x),   gap(x) = |p_i(x) - p_j(x)| - D - L_i(x) - L_j(x),

a half-plane that is at rest (and j the same with -n), then |p_i - p_j| - D >= L_i + L_j now: each has used its half of the gap at
most. It holds as long as both keep the half-plane of one stamp that they share.

Agents keep the half-planes of their *live* stamps, one or two. A message says when it was sent, with the sender's state then, and
its newest stamp, with its state then. :func:`receive` says what becomes of it. They share a stamp at every moment, whatever is
late, lost or out of order: docs/shield.md has the proof, and tests/test_shield_messages.py tries all there is to a depth.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.imperfections import normal
from marlbc_mj.core.laws import allocation_free

NEVER_STAMPED = -1.0
"""Stands for a missing stamp."""
NEWEST, OLDER = 0, 1
STREAM = 1_000_003  # of random numbers: beyond those of sensors
REMEMBERED = 400  # substeps of the past that agents know their own states of, besides the latency


class Mail(NamedTuple):
    """Messages and stamps of one team."""

    now: int  # substeps since the mission began
    seed: int  # of what is lost
    latency: int  # [substeps]
    quantile: float  # a message is lost where a standard normal number is below
    silent: float  # agent whose messages are all lost; negative: none
    stamps: np.ndarray  # (N, N, 2) live stamps of i with j, the newest first [substeps]
    planes: np.ndarray  # (N, N, 2, 3) their half-planes: n, c [m]
    memory: np.ndarray  # (R, N, 3) p [m] and L [m] of everyone in the last R substeps, a ring
    said: np.ndarray  # (R, N, N) the newest stamps then


@allocation_free
def receive(stamps, planes, sent, newest, proposed, adopted, fits_sent, fits_newest):
    """Update of the live stamps with the sender of a message: confirm, adopt, propose.

    Args:
        stamps: (2,) live stamps, the newest first; NEVER_STAMPED where there is but one. In place.
        planes: (2, 3) their half-planes, in place; c is infinite where there is none.
        sent: when the message was sent.
        newest: the newest stamp that its sender kept then.
        proposed, adopted: (3,) half-planes of both instants.
        fits_sent, fits_newest: whether the agent is inside them, and remembers the instants.
    """
    if newest > stamps[NEWEST] and fits_newest:  # adopt: both keep it, so nothing older is needed
        stamps[NEWEST], stamps[OLDER] = newest, NEVER_STAMPED
        planes[OLDER, 2] = np.inf
        for m in range(3):
            planes[NEWEST, m] = adopted[m]
    elif newest == stamps[NEWEST]:  # confirmed: likewise
        stamps[OLDER] = NEVER_STAMPED
        planes[OLDER, 2] = np.inf
    if stamps[OLDER] == NEVER_STAMPED and sent > stamps[NEWEST] and fits_sent:  # propose, and keep what is shared
        stamps[OLDER] = stamps[NEWEST]
        stamps[NEWEST] = sent
        for m in range(3):
            planes[OLDER, m] = planes[NEWEST, m]
            planes[NEWEST, m] = proposed[m]


@allocation_free
def fill_plane(numbers, then, i, j, plane):
    """The half-plane (3,) that agent ``i`` keeps for ``j`` since an instant ``then`` (N, 3) of the memory."""
    x, y = then[i, 0] - then[j, 0], then[i, 1] - then[j, 1]
    distance = np.sqrt(x * x + y * y)
    if distance > 0.0:
        x, y = x / distance, y / distance
    else:
        x, y = 1.0 if i > j else -1.0, 0.0
    gap = distance - numbers.agent_distance - then[i, 2] - then[j, 2]
    plane[0], plane[1] = x, y
    plane[2] = 0.5 * gap - x * then[i, 0] - y * then[i, 1] + then[i, 2]


@allocation_free
def is_inside(view, plane, i):
    """Whether agent ``i`` can stop on its side of a half-plane (3,)."""
    return plane[0] * view.p[i, 0] + plane[1] * view.p[i, 1] + plane[2] >= view.stopping[i]


@allocation_free
def exchange(numbers, view, mail):
    """Messages of one substep of one team: everyone remembers, sends, and receives what arrives. ``view.stopping`` is filled.

    In a team's first substep all know all: a stamp that everyone shares.
    """
    agents, ring = view.p.shape[0], mail.memory.shape[0]
    now, count = mail.now % ring, float(mail.now)
    first = mail.stamps[0, 1, NEWEST] == NEVER_STAMPED
    for i in range(agents):
        mail.memory[now, i, 0], mail.memory[now, i, 1], mail.memory[now, i, 2] = view.p[i, 0], view.p[i, 1], view.stopping[i]
    if first:
        for i in range(agents):
            for j in range(agents):
                fill_plane(numbers, mail.memory[now], i, j, mail.planes[i, j, NEWEST])
                mail.stamps[i, j, NEWEST], mail.stamps[i, j, OLDER] = count, NEVER_STAMPED
                mail.planes[i, j, OLDER, 2] = np.inf
    for i in range(agents):
        for j in range(agents):
            mail.said[now, i, j] = mail.stamps[i, j, NEWEST]
    for i in range(agents):
        for j in range(agents):
            if i != j and not first and arrives(mail, i, j, agents):
                _take(numbers, view, mail, i, j)


@allocation_free
def arrives(mail, i, j, agents):
    """Whether the message that ``j`` sent to ``i`` one latency ago arrives now."""
    if mail.silent == j or mail.now - mail.latency < 0:
        return False
    return mail.quantile == -np.inf or normal(mail.seed, mail.now, STREAM + i * agents + j) >= mail.quantile


@allocation_free
def _take(numbers, view, mail, i, j):
    """Agent ``i`` receives the message that ``j`` sent one latency ago."""
    ring = mail.memory.shape[0]
    sent = mail.now - mail.latency
    newest = mail.said[sent % ring, j, i]
    proposed, adopted = mail.planes[i, i, 0], mail.planes[i, i, 1]  # scratch: no agent keeps apart from itself
    fits_newest = newest >= 0.0 and mail.now - newest < ring
    if fits_newest:
        fill_plane(numbers, mail.memory[int(newest) % ring], i, j, adopted)
        fits_newest = is_inside(view, adopted, i)
    fill_plane(numbers, mail.memory[sent % ring], i, j, proposed)
    fits_sent = is_inside(view, proposed, i)
    receive(mail.stamps[i, j], mail.planes[i, j], float(sent), newest, proposed, adopted, fits_sent, fits_newest)
