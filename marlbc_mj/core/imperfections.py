"""Imperfections of a plant: sensor noise, sensor delay and actuator loss. Off by default, and without cost when off."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.compiling import allocation_free, plain
from marlbc_mj.util.errors import ConfigurationError

_WORD = 0xFFFFFFFF


class Senses(NamedTuple):
    """The numbers of :class:`Imperfections` that :func:`sense` and :func:`weaken` read."""

    position_noise: float  # [m]
    velocity_noise: float  # [m/s]
    loss: float  # share of the force
    loss_agent: float  # index of the affected agent; -1: all agents
    loss_start: float  # time from which force is lost [s]


@dataclass(frozen=True)
class Imperfections:
    """Sensor noise, sensor delay and actuator loss of one scenario.

    Controllers and supervisors receive p and v that are ``delay`` old and have white Gaussian noise. It is drawn per world,
    agent, axis and substep from the world's seed, so it is the same for any batch size and number of threads. Clearances, the
    formation identifier, trajectories and metrics use the true positions. The loss removes a share of the planar force between
    the controller and the robot's drive.

    Raises:
        ConfigurationError: naming the invalid value.
    """

    position_noise: float = 0.0  # standard deviation per axis [m]
    velocity_noise: float = 0.0  # standard deviation per axis [m/s]
    delay: float = 0.0  # age of measurements; a whole number of substeps [s]
    loss: float = 0.0  # share of the force that is lost, from 0 to 1
    loss_agent: int = -1  # index of the agent that loses force; -1: all agents
    loss_start: float = 0.0  # time from which force is lost [s]

    def __post_init__(self) -> None:
        for name in ("position_noise", "velocity_noise", "delay", "loss_start"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"Imperfections.{name} must be non-negative and finite, got {value}")
        if not 0 <= self.loss <= 1:
            raise ConfigurationError(f"Imperfections.loss must be from 0 to 1, got {self.loss}")

    def check(self, agents: int, substep: float) -> None:
        """Raise ConfigurationError for an agent that does not exist or a delay that is no whole number of substeps."""
        if not -1 <= self.loss_agent < agents:
            raise ConfigurationError(f"Imperfections.loss_agent must be -1 (all) or 0 to {agents - 1}, got {self.loss_agent}")
        ratio = self.delay / substep
        if abs(ratio - round(ratio)) > 1e-9 * max(1.0, ratio):
            raise ConfigurationError(f"Imperfections.delay {self.delay} s must be a whole multiple of the substep {substep} s")

    @property
    def sensing(self) -> bool:
        """Whether measurements differ from the true state."""
        return self.position_noise > 0 or self.velocity_noise > 0 or self.delay > 0

    def depth(self, substep: float) -> int:
        """Number of rows of history that the delay needs; 0 without sensing errors."""
        return round(self.delay / substep) + 1 if self.sensing else 0

    def params(self) -> Senses:
        """Numbers for :func:`sense` and :func:`weaken`."""
        return Senses(self.position_noise, self.velocity_noise, self.loss, float(self.loss_agent), self.loss_start)


NO_IMPERFECTIONS = Imperfections()


@allocation_free
def _mixed(word):
    """A 32-bit integer hash (constants of the hash-prospector project): every input bit affects every output bit."""
    word = ((word ^ (word >> 16)) * 0x21F0AAAD) & _WORD
    word = ((word ^ (word >> 15)) * 0x735A2D97) & _WORD
    return word ^ (word >> 15)


@allocation_free
def normal(seed, count, stream):
    """A standard normal number as a function of three integers (Box-Muller on two hashes): stateless, so in any call order."""
    base = _mixed(_mixed(_mixed(seed & _WORD) ^ (count & _WORD)) ^ (2 * stream + 1))
    angle = _mixed(base ^ 0x9E3779B9)
    return np.sqrt(-2.0 * np.log((base + 1.0) / 4294967296.0)) * np.cos(2.0 * np.pi * angle / 4294967296.0)


_SALT = 0x9E3779B9  # makes uniform numbers independent of the normal ones of the same seed
_mixed_arrays = plain(_mixed)


def uniform(seed: np.ndarray, count: np.ndarray, streams: np.ndarray) -> np.ndarray:
    """Uniform numbers in [0, 1) as a function of three integers: stateless, so in any call order.

    Args:
        seed: (B,) int64.
        count: (B,) int64.
        streams: (...) int64, stream numbers.

    Returns:
        (B, ...).
    """
    base = _mixed_arrays(_mixed_arrays((seed ^ _SALT) & _WORD) ^ (count & _WORD))
    return np.asarray(_mixed_arrays(base.reshape(-1, *[1] * streams.ndim) ^ (2 * streams + 1)) / 4294967296.0)


@allocation_free
def sense(senses, seed, count, history, p, v, sensed):
    """Write the measurement at substep ``count`` into ``sensed`` (2, N, 2): true p, v (N, 2) of D - 1 substeps ago plus noise.

    ``history`` (D, 2, N, 2) is a ring buffer, to which this call adds the current state.
    """
    depth = history.shape[0]
    for i in range(p.shape[0]):
        for axis in range(2):
            history[count % depth, 0, i, axis] = p[i, axis]
            history[count % depth, 1, i, axis] = v[i, axis]
            for which in range(2):
                value = history[(count + 1) % depth, which, i, axis]
                noise = senses.position_noise if which == 0 else senses.velocity_noise
                if noise > 0.0:
                    value += noise * normal(seed, count, 4 * i + 2 * which + axis)
                sensed[which, i, axis] = value


@allocation_free
def weaken(senses, t, force):
    """Remove the lost share from the forces (N, 2) at ``t`` [s], in place."""
    if senses.loss > 0.0 and t >= senses.loss_start - 1e-9:
        for i in range(force.shape[0]):
            if senses.loss_agent < 0.0 or senses.loss_agent == i:
                for axis in range(2):
                    force[i, axis] *= 1.0 - senses.loss
