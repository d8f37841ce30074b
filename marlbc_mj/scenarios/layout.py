"""Layouts: places and motions of all obstacles of a scenario, which a seed may draw."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from marlbc_mj.core.motion import NUMBERS
from marlbc_mj.util.errors import ConfigurationError, unknown

SPLITS = ("train", "test")
"""Splits that layouts are drawn from. Layouts with even numbers are for training, those with odd numbers are held out."""


class Motion(NamedTuple):
    """How an obstacle moves from its place: o(t) = (x, y) + v t + a sin(2 pi t / period + phase)."""

    vx: float = 0.0  # [m/s]
    vy: float = 0.0  # [m/s]
    ax: float = 0.0  # amplitude along x [m]
    ay: float = 0.0  # amplitude along y [m]
    period: float = 1.0  # [s]
    phase: float = 0.0  # [rad]

    @property
    def numbers(self) -> tuple[float, ...]:
        """The motion as a row for :func:`marlbc_mj.core.motion.move`."""
        return (self.vx, self.vy, self.ax, self.ay, 2.0 * np.pi / self.period, self.phase)


class Sample(NamedTuple):
    """One drawn layout."""

    obstacles: np.ndarray  # (K, 3) x, y, radius [m]; for a moving obstacle, its place without motion
    motions: np.ndarray  # (K, 6) with the columns of marlbc_mj.core.motion, or (0, 6) if all are at rest


@runtime_checkable
class Layout(Protocol):
    """A frozen dataclass that draws layouts, all with the same number of obstacles."""

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw one layout.

        Raises:
            ConfigurationError: no layout was found; the message gives the reason.
        """
        ...


def layout_number(rng: np.random.Generator, split: str) -> int:
    """A layout number drawn from ``rng``: even for training and odd for testing, so that no layout is in both splits.

    Raises:
        ConfigurationError: the split is unknown.
    """
    if split not in SPLITS:
        raise unknown("split", split, SPLITS)
    return 2 * int(rng.integers(2**62)) + SPLITS.index(split)


def motion_array(motions: tuple[Motion, ...]) -> np.ndarray:
    """(K, 6) rows for :func:`marlbc_mj.core.motion.move`."""
    return np.array([motion.numbers for motion in motions], dtype=np.float64).reshape(-1, NUMBERS)


def motions_of(rows: np.ndarray) -> tuple[Motion, ...]:
    """The inverse of :func:`motion_array`."""
    return tuple(Motion(vx, vy, ax, ay, 2.0 * np.pi / w if w else 1.0, phase) for vx, vy, ax, ay, w, phase in rows.tolist())


def check_motions(motions: tuple[Motion, ...], obstacles: int) -> None:
    """Raise ConfigurationError unless there is one motion per obstacle or none, all finite with positive periods."""
    if motions and len(motions) != obstacles:
        raise ConfigurationError(f"{len(motions)} motions for {obstacles} obstacles; give one each, or none")
    for k, motion in enumerate(motions):
        if not (np.isfinite(motion).all() and motion.period > 0):
            raise ConfigurationError(f"motion {k} must be finite with a positive period, got {tuple(motion)}")
