"""The communication layer: the messages that every agent of B teams has heard from every other, step by step.

At every mission step, a supervisor that decides per agent provides a short *message* of M numbers from each agent. The layer of
the scenario (:class:`~marlbc_mj.core.communication.Communication`) carries it by one of two protocols:

- **Flooding.** Every agent keeps the newest message of every agent, with the time at which its author sent it, and broadcasts
  this whole table every period; of two entries the newer one wins. After as many hops as the graph's diameter, every agent knows
  all others in its connected component. One hop takes one period, or the delay rounded up to whole periods if that is longer.
- **Consensus.** First-order dynamic average consensus (Kia et al. 2019): every agent keeps an estimate x of the mean message m,
  x_i <- x_i - eps sum_j a_ij (x_i - x_j) + dm_i, with eps = 1 and Metropolis weights a_ij = 1 / (1 + max(d_i, d_j)). A pair
  exchanges only if both the message and its acknowledgment arrive, and both estimates then move by the same amount. So the sum
  of all x remains the sum of all m, whatever is lost. A round takes two delays, or the period if that is longer. The entry of
  every agent j holds the same number, agent i's own estimate. So means and sums can be computed from it, but no minima or maxima.

While a team is disconnected, each part has the messages of its own members and those heard from the others before; time stamps
give their age. The supervisor decides how to use them.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from marlbc_mj.core.communication import IDEAL, Communication, within_range
from marlbc_mj.core.imperfections import uniform
from marlbc_mj.scenarios import Scenario

NEVER_HEARD = -np.inf
"""Time stamp of a message that was never heard [s]."""
_NOT_YET = -1
"""Last mission step of a team that has not exchanged any message yet."""


class Knowledge(NamedTuple):
    """Messages that agents have heard from each other, and their time stamps."""

    heard: np.ndarray  # (B, N, N, M) row i: newest message of each agent that agent i knows, its own included; zeros if none
    stamp: np.ndarray  # (B, N, N) when the author sent it [s]; NEVER_HEARD if none


class Hearing(NamedTuple):
    """Which agents of B teams hear each other at one moment, for logs."""

    link: np.ndarray  # (B, N, N) bool: agent i is in range of agent j, and j is not silent
    age: np.ndarray  # (B, N, N) age of what agent i knows of j, rounded to 1e-6 [s]; infinite if it knows nothing

    def team(self, b: int) -> "Hearing":
        """The entries of team ``b``, (N, N) each."""
        return Hearing(self.link[b], self.age[b])


def hearing(memory: Any, time: np.ndarray) -> Hearing | None:
    """The :class:`Hearing` at times (B,) [s] from a supervisor's memory; None if it has no layer's memory as ``network``."""
    network = getattr(memory, "network", None)
    if network is None:
        return None
    return Hearing(network.link.copy(), np.round(time[:, None, None] - network.stamp, 6))


class Layer(Protocol):
    """Carries messages; made by :func:`make_layer`. It holds no state: messages under way are part of the memory."""

    def start(self, teams: int, size: int) -> Any:
        """Initial memory of B ``teams`` with messages of M = ``size`` numbers; nothing has been heard.

        It has the fields ``link``, (B, N, N) bool, whether agent i was in range of j and j was not silent at the last exchange,
        and ``stamp`` as in :class:`Knowledge`.
        """
        ...

    def exchange(
        self, time: np.ndarray, position: np.ndarray, message: np.ndarray, memory: Any, seed: np.ndarray | None = None
    ) -> tuple[Knowledge, Any]:
        """Deliver arriving messages and broadcast those that are due. Call it once per mission step.

        If a team's time is not later than at its last exchange, its memory is reset.

        Args:
            time: (B,) [s].
            position: (B, N, 2) [m].
            message: (B, N, M) current message of each agent.
            memory: from :meth:`start` or the last exchange.
            seed: (B,) seeds of the message losses, ``observation.noise_seed``; zeros by default.

        Returns:
            The knowledge of every agent now, and the memory for the next exchange.
        """
        ...

    def forget(self, memory: Any, teams: np.ndarray) -> Any:
        """The memory with ``teams`` (B,) bool reset to their initial state."""
        ...


def make_layer(scenario: Scenario) -> Layer:
    """The communication layer of a scenario."""
    radio = Radio(scenario.communication, scenario.agents, scenario.mission_step)
    return Consensus(radio) if scenario.communication.protocol == "consensus" else Flooding(radio)


@dataclass(frozen=True)
class Radio:
    """The common part of both protocols: links and message losses."""

    communication: Communication
    agents: int
    mission_step: float  # [s]

    def steps(self, seconds: float) -> int:
        """A time rounded to whole mission steps."""
        return round(seconds / self.mission_step)

    def count(self, time: np.ndarray) -> np.ndarray:
        """(B,) int64, number of the mission step at times (B,) [s]."""
        return np.rint(time / self.mission_step).astype(np.int64)

    def link(self, time: np.ndarray, position: np.ndarray) -> np.ndarray:
        """(B, N, N) bool: whether agent i is in range of j and j is not silent."""
        settings = self.communication
        near = within_range(position, settings.range)
        if not settings.silent:
            return near
        mute = np.zeros((len(time), self.agents), dtype=np.bool_)
        mute[:, list(settings.silent)] = (time >= settings.silent_from - 1e-9)[:, None]
        return np.asarray(near & ~mute[:, None, :])

    def arrives(self, count: np.ndarray, seed: np.ndarray | None) -> np.ndarray:
        """(B, N, N) bool: whether a message from j to i, sent at mission steps ``count`` (B,), is not lost."""
        if self.communication.loss == 0.0:
            return np.ones((len(count), self.agents, self.agents), dtype=np.bool_)
        seeds = np.zeros(len(count), dtype=np.int64) if seed is None else seed
        streams = np.arange(self.agents * self.agents).reshape(self.agents, self.agents)
        return np.asarray(uniform(seeds, count, streams) >= self.communication.loss)


# Flooding -----------------------------------------------------------------------------------------------------------------------


class Broadcast(NamedTuple):
    """The tables that the agents of B teams broadcast at one mission step."""

    arrival: np.ndarray  # (B,) int64, mission step at which they arrive
    hears: np.ndarray  # (B, N, N) bool: whether agent i receives the table of j
    knowledge: Knowledge  # contents of the tables when sent


class Flood(NamedTuple):
    """Memory of :class:`Flooding`. Its arrays are never modified, so that broadcasts under way can share them."""

    step: np.ndarray  # (B,) int64, mission step of the last exchange
    due: np.ndarray  # (B,) int64, mission step of the next broadcast
    heard: np.ndarray  # (B, N, N, M) as in Knowledge
    stamp: np.ndarray  # (B, N, N) as in Knowledge [s]
    link: np.ndarray  # (B, N, N) bool, see Layer.start
    under_way: tuple[Broadcast, ...] = ()


@dataclass(frozen=True)
class Flooding:
    """The protocol of time-stamped flooding; see the module."""

    radio: Radio

    def start(self, teams: int, size: int) -> Flood:
        agents = self.radio.agents
        pairs = (teams, agents, agents)
        never = np.full(pairs, NEVER_HEARD)
        count = np.full(teams, _NOT_YET)
        return Flood(count, np.zeros(teams, dtype=np.int64), np.zeros((*pairs, size)), never, np.zeros(pairs, dtype=np.bool_))

    def exchange(
        self, time: np.ndarray, position: np.ndarray, message: np.ndarray, memory: Flood, seed: np.ndarray | None = None
    ) -> tuple[Knowledge, Flood]:
        radio, settings = self.radio, self.radio.communication
        if settings == IDEAL:
            return self._ideal(time, position, message)
        count = radio.count(time)
        memory = self.forget(memory, count <= memory.step)
        knowledge, under_way = _deliver(_with_own(memory, time, message), count, memory.under_way)
        link, due = radio.link(time, position), count >= memory.due
        if due.any():
            hears = link & radio.arrives(count, seed) & due[:, None, None]
            under_way = (*under_way, Broadcast(count + radio.steps(settings.delay), hears, knowledge))
            knowledge, under_way = _deliver(knowledge, count, under_way)
        next_due = np.where(due, count + max(1, radio.steps(settings.period)), memory.due)
        return knowledge, Flood(count, next_due, *knowledge, link, under_way)

    def _ideal(self, time: np.ndarray, position: np.ndarray, message: np.ndarray) -> tuple[Knowledge, Flood]:
        """The exchange for infinite range, no delay and no loss."""
        pairs = (len(time), self.radio.agents, self.radio.agents)
        heard = np.broadcast_to(message[:, None], (*pairs, message.shape[2]))
        knowledge = Knowledge(heard, np.broadcast_to(time[:, None, None], pairs))
        count = self.radio.count(time)
        return knowledge, Flood(count, count + 1, *knowledge, self.radio.link(time, position))

    def forget(self, memory: Flood, teams: np.ndarray) -> Flood:
        if not teams.any():
            return memory
        fresh = self.start(len(teams), memory.heard.shape[3])
        under_way = tuple(sent._replace(hears=sent.hears & ~teams[:, None, None]) for sent in memory.under_way)
        return memory._replace(under_way=under_way, **_forgotten(teams, fresh, memory))


def _with_own(memory: Flood, time: np.ndarray, message: np.ndarray) -> Knowledge:
    """The knowledge in ``memory``, with the agents' own entries replaced by their messages at ``time`` (B,) [s]."""
    heard, stamp = memory.heard.copy(), memory.stamp.copy()
    own = np.arange(message.shape[1])
    heard[:, own, own], stamp[:, own, own] = message, time[:, None]
    return Knowledge(heard, stamp)


def _deliver(
    knowledge: Knowledge, count: np.ndarray, under_way: tuple[Broadcast, ...]
) -> tuple[Knowledge, tuple[Broadcast, ...]]:
    """The knowledge after all broadcasts that arrive by mission steps ``count`` (B,), and the broadcasts still under way."""
    later = []
    for sent in under_way:
        arrived = sent.arrival <= count
        if arrived.all():
            knowledge = _newest(knowledge, sent.knowledge, sent.hears)
        elif arrived.any():
            knowledge = _newest(knowledge, sent.knowledge, sent.hears & arrived[:, None, None])
            later.append(sent._replace(hears=sent.hears & ~arrived[:, None, None]))
        else:
            later.append(sent)
    return knowledge, tuple(later)


def _newest(knowledge: Knowledge, sent: Knowledge, hears: np.ndarray) -> Knowledge:
    """The newest entries among each agent's own table and the tables in ``sent`` that it ``hears`` (B, N, N)."""
    if not hears.any():
        return knowledge
    offered = np.where(hears[..., None], sent.stamp[:, None], NEVER_HEARD)  # (B, i, j, k): stamp of what j tells i about k
    newer = offered.max(axis=2) > knowledge.stamp
    teams, _, authors = np.nonzero(newer)
    senders = offered.argmax(axis=2)[newer]
    heard, stamp = knowledge.heard.copy(), knowledge.stamp.copy()
    stamp[newer] = sent.stamp[teams, senders, authors]
    heard[newer] = sent.heard[teams, senders, authors]
    return Knowledge(heard, stamp)


# Consensus ----------------------------------------------------------------------------------------------------------------------


class Handshakes(NamedTuple):
    """The round of B teams that is under way; once it has ended, ``met`` is False and ``change`` 0."""

    arrival: np.ndarray  # (B,) int64, mission step at which the acknowledgments arrive
    met: np.ndarray  # (B, N) bool: agents with at least one successful handshake
    change: np.ndarray  # (B, N, M) change of the estimates


class Estimates(NamedTuple):
    """Memory of :class:`Consensus`."""

    step: np.ndarray  # (B,) int64, mission step of the last exchange
    due: np.ndarray  # (B,) int64, mission step of the next round
    estimate: np.ndarray  # (B, N, M) estimate x of the mean message
    message: np.ndarray  # (B, N, M) message m at the last exchange
    stamp: np.ndarray  # (B, N, N) own entry: time of the last exchange; others: the agent's last handshake [s]
    link: np.ndarray  # (B, N, N) bool, see Layer.start
    under_way: Handshakes


@dataclass(frozen=True)
class Consensus:
    """The protocol of dynamic average consensus; see the module."""

    radio: Radio

    def start(self, teams: int, size: int) -> Estimates:
        agents = self.radio.agents
        zeros, none, pairs = np.zeros((teams, agents, size)), np.zeros(teams, dtype=np.int64), (teams, agents, agents)
        nothing = Handshakes(none, np.zeros((teams, agents), dtype=np.bool_), zeros)
        never, apart = np.full(pairs, NEVER_HEARD), np.zeros(pairs, dtype=np.bool_)
        return Estimates(np.full(teams, _NOT_YET), none, zeros, zeros, never, apart, nothing)

    def exchange(
        self, time: np.ndarray, position: np.ndarray, message: np.ndarray, memory: Estimates, seed: np.ndarray | None = None
    ) -> tuple[Knowledge, Estimates]:
        radio, settings = self.radio, self.radio.communication
        count = radio.count(time)
        memory = self.forget(memory, count <= memory.step)
        shared = memory._replace(step=count, estimate=memory.estimate + message - memory.message, message=message)
        shared = _shake(shared._replace(link=radio.link(time, position)), time)
        due, duration = count >= memory.due, 2 * radio.steps(settings.delay)
        if due.any():
            begun = _begin(shared, radio.arrives(count, seed) & due[:, None, None], duration)
            under_way = Handshakes(*(_where(due, new, old) for new, old in zip(begun, shared.under_way, strict=True)))
            next_due = np.where(due, count + max(1, duration, radio.steps(settings.period)), memory.due)
            shared = _shake(shared._replace(due=next_due, under_way=under_way), time)
        own = np.arange(radio.agents)
        shared.stamp[:, own, own] = time[:, None]
        heard = np.broadcast_to(shared.estimate[:, :, None], (*shared.stamp.shape, message.shape[2]))
        return Knowledge(heard, shared.stamp), shared

    def forget(self, memory: Estimates, teams: np.ndarray) -> Estimates:
        if not teams.any():
            return memory
        fresh = self.start(len(teams), memory.message.shape[2])
        under_way = Handshakes(*(_where(teams, new, old) for new, old in zip(fresh.under_way, memory.under_way, strict=True)))
        return memory._replace(under_way=under_way, **_forgotten(teams, fresh, memory))


def _begin(shared: Estimates, arrives: np.ndarray, duration: int) -> Handshakes:
    """A round of handshakes, ``duration`` mission steps long; ``arrives`` (B, N, N) tells which one-way messages are not lost."""
    link = shared.link & shared.link.transpose(0, 2, 1)
    degree = link.sum(axis=2)
    weight = 1.0 / (1.0 + np.maximum(degree[:, :, None], degree[:, None]))
    met = link & arrives & arrives.transpose(0, 2, 1)
    weight = weight * met
    change = weight @ shared.estimate - weight.sum(axis=2)[..., None] * shared.estimate
    return Handshakes(shared.step + duration, met.any(axis=2), change)


def _shake(shared: Estimates, time: np.ndarray) -> Estimates:
    """The estimates of B teams, with the round under way applied where it has ended by ``time`` (B,) [s]."""
    arrival, met, change = shared.under_way
    ended = arrival <= shared.step
    estimate = shared.estimate + change * ended[:, None, None]
    stamp = np.where((met & ended[:, None])[:, :, None], time[:, None, None], shared.stamp)
    left = Handshakes(arrival, met & ~ended[:, None], change * ~ended[:, None, None])
    return shared._replace(estimate=estimate, stamp=stamp, under_way=left)


def _forgotten(teams: np.ndarray, fresh: Flood | Estimates, memory: Flood | Estimates) -> dict[str, Any]:
    """The arrays of a memory by name, with the rows of ``teams`` (B,) taken from a ``fresh`` memory."""
    names = [name for name in memory._fields if name != "under_way"]
    return {name: _where(teams, getattr(fresh, name), getattr(memory, name)) for name in names}


def _where(teams: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Rows of ``new`` for ``teams`` (B,) bool, rows of ``old`` for the others."""
    return np.asarray(np.where(teams.reshape(-1, *[1] * (new.ndim - 1)), new, old))
