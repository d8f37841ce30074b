"""Separation of two agents whose messages are late or lost, by stamps: instants at which both states are known to both.

For a *stamp* x, agent i knows p_j and L_j from a message, and its own p_i and L_i from memory. Let n be the unit vector from j to
i at x. At any later time, |p_i - p_j| >= n.(p_i - p_j). So if agent i keeps

    n.p_i + c >= L_i,   c = gap(x) / 2 - n.p_i(x) + L_i(x),   gap(x) = |p_i(x) - p_j(x)| - D - L_i(x) - L_j(x),

a half-plane at rest, and j its own with -n, then |p_i - p_j| - D >= L_i + L_j holds now: each has used at most its half of the
gap. This holds as long as both keep the half-plane of one stamp that they share.

Agents keep the half-planes of their *live* stamps, one or two. A message contains the time at which it was sent and the newest
stamp of its sender, each with the sender's state at that time. :func:`receive` updates the live stamps with it. Two agents share
a stamp at every moment, whatever is late, lost or out of order: docs/shield.md has the proof, and tests/test_shield_messages.py
checks all sequences of messages up to a fixed depth.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.imperfections import normal
from marlbc_mj.core.laws import allocation_free

NEVER_STAMPED = -1.0
"""Value of a missing stamp."""
NEWEST, OLDER = 0, 1
STREAM = 1_000_003  # first random number stream of messages, above those of sensors
REMEMBERED = 400  # past substeps, besides the latency, of which agents remember their own states


class Mail(NamedTuple):
    """Messages and stamps of one team."""

    now: int  # substeps since the mission began
    seed: int  # seed of the message losses
    latency: int  # latency of messages [substeps]
    quantile: float  # a message is lost if its standard normal number is below this
    silent: float  # agent whose messages are all lost; negative: none
    stamps: np.ndarray  # (N, N, 2) live stamps of i with j, the newest first [substeps]
    planes: np.ndarray  # (N, N, 2, 3) their half-planes: n, c [m]
    memory: np.ndarray  # (R, N, 3) p [m] and L [m] of all agents in the last R substeps, a ring buffer
    sent_stamps: np.ndarray  # (R, N, N) the newest stamps of i with j in those substeps


@allocation_free
def receive(stamps, planes, sent, newest, proposed, adopted, fits_sent, fits_newest):
    """Update the live stamps shared with the sender of a message: confirm, adopt, propose.

    Args:
        stamps: (2,) live stamps, the newest first; NEVER_STAMPED in place of a missing second one. In place.
        planes: (2, 3) their half-planes, in place; c is infinite if there is none.
        sent: when the message was sent.
        newest: the newest stamp that its sender kept then.
        proposed, adopted: (3,) half-planes of the instants ``sent`` and ``newest``.
        fits_sent, fits_newest: whether the agent is inside these half-planes and remembers the instants.
    """
    if newest > stamps[NEWEST] and fits_newest:  # adopt: both keep it, so nothing older is needed
        stamps[NEWEST], stamps[OLDER] = newest, NEVER_STAMPED
        planes[OLDER, 2] = np.inf
        for m in range(3):
            planes[NEWEST, m] = adopted[m]
    elif newest == stamps[NEWEST]:  # confirmed: likewise
        stamps[OLDER] = NEVER_STAMPED
        planes[OLDER, 2] = np.inf
    if stamps[OLDER] == NEVER_STAMPED and sent > stamps[NEWEST] and fits_sent:  # propose, and keep the shared stamp
        stamps[OLDER] = stamps[NEWEST]
        stamps[NEWEST] = sent
        for m in range(3):
            planes[OLDER, m] = planes[NEWEST, m]
            planes[NEWEST, m] = proposed[m]


@allocation_free
def fill_plane(numbers, then, i, j, plane):
    """Write into ``plane`` (3,) the half-plane that agent ``i`` keeps for ``j``, from the remembered states ``then`` (N, 3)."""
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
    """Exchange the messages of one team in one substep: every agent stores its state, sends, and receives what arrives.

    ``view.stopping`` must be filled. In a team's first substep all agents know all states, which makes the first shared stamp.
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
            mail.sent_stamps[now, i, j] = mail.stamps[i, j, NEWEST]
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
    newest = mail.sent_stamps[sent % ring, j, i]
    proposed, adopted = mail.planes[i, i, 0], mail.planes[i, i, 1]  # scratch: no agent has half-planes with itself
    fits_newest = newest >= 0.0 and mail.now - newest < ring
    if fits_newest:
        fill_plane(numbers, mail.memory[int(newest) % ring], i, j, adopted)
        fits_newest = is_inside(view, adopted, i)
    fill_plane(numbers, mail.memory[sent % ring], i, j, proposed)
    fits_sent = is_inside(view, proposed, i)
    receive(mail.stamps[i, j], mail.planes[i, j], float(sent), newest, proposed, adopted, fits_sent, fits_newest)
