"""Communication between the agents of a team: the settings of a scenario, and the graph that follows from them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlbc_mj.util.errors import ConfigurationError, unknown

PROTOCOLS = ("flooding", "consensus")


@dataclass(frozen=True)
class Communication:
    """How the agents of one scenario communicate. The default is ideal: every message reaches every agent at once.

    Every ``period`` an agent broadcasts. Agents within ``range`` at that time receive the message ``delay`` later, unless it is
    lost. Each direction of each link loses messages independently, by random numbers from the world's seed that are the same for
    any batch size and number of threads. Silent agents receive, but do not send. Distances are those of measured positions.

    Raises:
        ConfigurationError: naming the invalid value.
    """

    protocol: Literal["flooding", "consensus"] = "flooding"  # pass on the newest entries, or dynamic average consensus
    range: float = np.inf  # how far a message reaches [m]
    period: float = 0.0  # time between two broadcasts of an agent, a multiple of the mission step; 0: every mission step [s]
    delay: float = 0.0  # time from sending to receiving, a multiple of the mission step [s]
    loss: float = 0.0  # probability that a one-way message is lost, at least 0 and below 1
    silent: tuple[int, ...] = ()  # indices of the agents that stop sending, counted from 0
    silent_from: float = 0.0  # when they stop [s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "silent", tuple(self.silent))
        if self.protocol not in PROTOCOLS:
            raise unknown("communication.protocol", self.protocol, PROTOCOLS)
        if not self.range > 0:
            raise ConfigurationError(f"communication.range must be positive, got {self.range}")
        for name in ("period", "delay", "silent_from"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"communication.{name} must be non-negative and finite, got {value}")
        if not 0 <= self.loss < 1:
            raise ConfigurationError(f"communication.loss must be at least 0 and below 1, got {self.loss}")

    def check(self, starts: np.ndarray, mission_step: float) -> None:
        """Check the settings for a team that starts at ``starts`` (N, 2) [m].

        Raises:
            ConfigurationError: a silent agent that does not exist, a time that is no whole number of mission steps, or a range
                that leaves the team disconnected at the start.
        """
        agents = len(starts)
        for agent in self.silent:
            if not 0 <= agent < agents:
                raise ConfigurationError(f"communication.silent must name agents from 0 to {agents - 1}, got {agent}")
        for name in ("period", "delay"):
            ratio = getattr(self, name) / mission_step
            if abs(ratio - round(ratio)) > 1e-9 * max(1.0, ratio):
                raise ConfigurationError(
                    f"communication.{name} {getattr(self, name)} s must be a whole multiple of the mission step {mission_step} s"
                )
        part = components(within_range(starts[None], self.range))[0]
        if part.any():
            names = [", ".join(str(i + 1) for i in np.flatnonzero(part == k)) for k in np.unique(part)]
            raise ConfigurationError(
                f"communication.range {self.range:g} m splits the team into {len(names)} parts at the start: agents "
                + " | ".join(names)
            )


IDEAL = Communication()
"""Ideal communication: every message reaches every agent at once."""


def within_range(position: np.ndarray, reach: float) -> np.ndarray:
    """(B, N, N) bool: whether two agents at positions (B, N, 2) [m] are at most ``reach`` [m] apart; no agent with itself."""
    agents = position.shape[1]
    apart = ~np.eye(agents, dtype=np.bool_)
    if reach == np.inf:
        return np.broadcast_to(apart, (len(position), agents, agents))
    gap = position[:, :, None] - position[:, None]
    return np.asarray((np.einsum("bija,bija->bij", gap, gap) <= reach * reach) & apart)


def components(link: np.ndarray) -> np.ndarray:
    """(B, N) int64: the connected component of each agent, as its lowest agent index, in graphs (B, N, N) of two-way links."""
    agents = link.shape[1]
    part = np.tile(np.arange(agents), (len(link), 1))
    near = link | np.eye(agents, dtype=np.bool_)
    while True:
        least = np.where(near, part[:, None, :], agents).min(axis=2)
        if (least == part).all():
            return part
        part = least
