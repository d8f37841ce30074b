"""Places and motions of obstacles, which a seed may draw as a whole."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from marlbc_mj.core.motion import NUMBERS
from marlbc_mj.util.errors import ConfigurationError, unknown

SPLITS = ("train", "test")
"""Layout splits to draw from. A layout has a number: even ones are for training, odd ones are held out."""


class Motion(NamedTuple):
    """How an obstacle moves from its place: o(t) = (x, y) + v t + a sin(2 pi t / period + phase)."""

    vx: float = 0.0  # [m/s]
    vy: float = 0.0  # [m/s]
    ax: float = 0.0  # amplitude [m]
    ay: float = 0.0  # [m]
    period: float = 1.0  # [s]
    phase: float = 0.0  # [rad]

    @property
    def numbers(self) -> tuple[float, ...]:
        """One row of the motions that :func:`marlbc_mj.core.motion.move` takes."""
        return (self.vx, self.vy, self.ax, self.ay, 2.0 * np.pi / self.period, self.phase)


class Sample(NamedTuple):
    """One layout."""

    obstacles: np.ndarray  # (K, 3) x, y, radius [m]; of one that moves, its place without motion
    motions: np.ndarray  # (K, 6) as marlbc_mj.core.motion has them, or (0, 6): all at rest


@runtime_checkable
class Layout(Protocol):
    """A frozen dataclass that draws layouts with one and the same number of obstacles."""

    def sample(self, rng: np.random.Generator) -> Sample:
        """One layout.

        Raises:
            ConfigurationError: none was found, and why.
        """
        ...


def layout_number(rng: np.random.Generator, split: str) -> int:
    """Number of the layout that ``rng`` chooses: even for training and odd for testing, so that no seed is in both.

    Raises:
        ConfigurationError: an unknown split.
    """
    if split not in SPLITS:
        raise unknown("split", split, SPLITS)
    return 2 * int(rng.integers(2**62)) + SPLITS.index(split)


def motion_array(motions: tuple[Motion, ...]) -> np.ndarray:
    """(K, 6) rows of :func:`marlbc_mj.core.motion.move`."""
    return np.array([motion.numbers for motion in motions], dtype=np.float64).reshape(-1, NUMBERS)


def motions_of(rows: np.ndarray) -> tuple[Motion, ...]:
    """The reverse of :func:`motion_array`."""
    return tuple(Motion(vx, vy, ax, ay, 2.0 * np.pi / w if w else 1.0, phase) for vx, vy, ax, ay, w, phase in rows.tolist())


def check_motions(motions: tuple[Motion, ...], obstacles: int) -> None:
    """Raise ConfigurationError for motions that are not one an obstacle, not finite, or have no positive period."""
    if motions and len(motions) != obstacles:
        raise ConfigurationError(f"{len(motions)} motions for {obstacles} obstacles; give one each, or none")
    for k, motion in enumerate(motions):
        if not (np.isfinite(motion).all() and motion.period > 0):
            raise ConfigurationError(f"motion {k} must be finite with a positive period, got {tuple(motion)}")
