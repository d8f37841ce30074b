"""Disturbances: the unknown dynamics f(chi) of the plant (1), each with one law and one dataclass."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.core.stopping import ForceBound
from marlbc_mj.util.errors import ConfigurationError, unknown

HARMONICS = 12
"""Number of sines of wind gusts per axis."""


@laws.disturbance(gains="scale")
def paper_drag(gains, t, p, v, force_out):
    """(43): f = scale [v1 sin^2(p2) + v2 cos^2(p1), v1 sin^2(p2) - v2 cos^2(p1)]."""
    sine = np.sin(p[1])
    cosine = np.cos(p[0])
    first = v[0] * sine * sine
    second = v[1] * cosine * cosine
    force_out[0] = gains.scale * (first + second)
    force_out[1] = gains.scale * (first - second)


@laws.disturbance(gains=("scale", "coefficient"))
def linear_drag(gains, t, p, v, force_out):
    """f = -scale c v, c the coefficient [N s/m]."""
    for axis in range(2):
        force_out[axis] = -gains.scale * gains.coefficient * v[axis]


@laws.disturbance(gains=("scale", "coefficient"))
def quadratic_drag(gains, t, p, v, force_out):
    """f = -scale c |v| v, c the coefficient [N s^2/m^2]."""
    factor = gains.scale * gains.coefficient * np.sqrt(v[0] * v[0] + v[1] * v[1])
    for axis in range(2):
        force_out[axis] = -factor * v[axis]


@laws.disturbance(gains={"scale": (), "force": 2})
def constant_wind(gains, t, p, v, force_out):
    """f = scale w, w the force [N]."""
    for axis in range(2):
        force_out[axis] = gains.scale * gains.force[axis]


SINES = (2, HARMONICS)
GUSTS = {"scale": (), "steady": 2, "amplitude": SINES, "frequency": SINES, "phase": SINES}  # [1, N, N, rad/s, rad]


@laws.disturbance(gains=GUSTS)
def wind_gusts(gains, t, p, v, force_out):
    """f = scale (w + sum_k a_k sin(w_k t + phase_k)), the same for all agents; w is steady, each axis has its own sines."""
    for axis in range(2):
        force_out[axis] = gains.steady[axis]
        for k in range(HARMONICS):
            force_out[axis] += gains.amplitude[axis, k] * np.sin(gains.frequency[axis, k] * t + gains.phase[axis, k])
        force_out[axis] *= gains.scale


@runtime_checkable
class Disturbance(Protocol):
    """The interface of disturbances. The first gain is ``scale``, which the draw of a perturbation multiplies.

    A disturbance with a method ``force_bound() -> ForceBound`` needs no further settings for a shield.
    """

    @property
    def law(self) -> laws.Law: ...
    def params(self) -> laws.Numbers:
        """The law's gains by name."""
        ...


@dataclass(frozen=True)
class _Scaled:
    scale: float = 1.0  # multiplies the whole force; 0 switches the disturbance off
    law: ClassVar[laws.Law]

    def __post_init__(self) -> None:
        numbers = laws.pack_gains(self.law, self.params())
        if not np.isfinite(numbers).all():
            raise ConfigurationError(f"{type(self).__name__} needs finite numbers, got {tuple(numbers.tolist())}")

    def params(self) -> laws.Numbers:
        return laws.gains_of(self)


@dataclass(frozen=True)
class PaperDrag(_Scaled):
    """The case study's unknown drag (43)."""

    law = staticmethod(paper_drag)

    def force_bound(self) -> ForceBound:
        """|f| <= sqrt(2) scale |v|: f = scale [[s, k], [s, -k]] v with orthogonal columns, s and k from 0 to 1."""
        return ForceBound(linear=float(np.sqrt(2.0)) * abs(self.scale))


@dataclass(frozen=True)
class LinearDrag(_Scaled):
    """Viscous drag."""

    coefficient: float = 1.0  # c [N s/m]
    law = staticmethod(linear_drag)

    def force_bound(self) -> ForceBound:
        """|f| = scale c |v|."""
        return ForceBound(linear=abs(self.scale * self.coefficient))


@dataclass(frozen=True)
class QuadraticDrag(_Scaled):
    """Aerodynamic drag, quadratic in the speed."""

    coefficient: float = 0.1  # c [N s^2/m^2]
    law = staticmethod(quadratic_drag)

    def force_bound(self) -> ForceBound:
        """|f| = scale c |v|^2."""
        return ForceBound(quadratic=abs(self.scale * self.coefficient))


@dataclass(frozen=True)
class ConstantWind(_Scaled):
    """A constant force. Contrary to the assumption of (1), it does not vanish at rest."""

    force: tuple[float, float] = (5.0, 0.0)  # w [N]
    law = staticmethod(constant_wind)

    def force_bound(self) -> ForceBound:
        """|f| = scale |w|."""
        return ForceBound(abs(self.scale) * float(np.hypot(*self.force)))


@dataclass(frozen=True)
class WindGusts(_Scaled):
    """Gusty wind: a steady force plus ``HARMONICS`` sines per axis, with frequencies and phases drawn from ``seed``.

    For a given seed, the wind depends only on the mission time. The amplitude of harmonic k falls with its frequency as
    1 / sqrt(1 + (w_k T)^2), as in a Dryden spectrum, and all harmonics together have the root mean square ``strength``.
    """

    steady: tuple[float, float] = (2.0, 0.0)  # [N]
    strength: float = 10.0  # RMS of the gusts on each axis [N]
    time: float = 4.0  # T: typical duration of a gust [s]
    seed: int = 0
    law = staticmethod(wind_gusts)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.strength) and self.strength >= 0 and np.isfinite(self.time) and self.time > 0):
            raise ConfigurationError(
                f"WindGusts needs a non-negative strength and a positive time, got {self.strength} and {self.time}"
            )
        if self.seed < 0:
            raise ConfigurationError(f"WindGusts seed must not be negative, got {self.seed}")
        super().__post_init__()

    def params(self) -> laws.Numbers:
        return laws.gains_of(self, **self._harmonics())

    def _harmonics(self) -> dict[str, np.ndarray]:
        """Amplitude [N], frequency [rad/s] and phase [rad] of every sine, (2, HARMONICS) each."""
        rng = np.random.default_rng(self.seed)
        place = (np.arange(HARMONICS) + rng.uniform(0.0, 1.0, (2, HARMONICS))) / HARMONICS  # one frequency in each band
        ratio = np.exp(np.log(0.2) + np.log(50.0) * place)  # w_k T, from 0.2 to 10
        amplitude = 1.0 / np.sqrt(1.0 + ratio**2)
        amplitude *= self.strength * np.sqrt(2.0 / (amplitude**2).sum(axis=1, keepdims=True))
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, HARMONICS))
        return {"amplitude": amplitude, "frequency": ratio / self.time, "phase": phase}

    def force_bound(self) -> ForceBound:
        """|f_i| <= scale (|w_i| + sum_k a_k) on each axis, with all sines at their peaks."""
        peaks = np.abs(self.steady) + np.sum(self._harmonics()["amplitude"], axis=1)
        return ForceBound(abs(self.scale) * float(np.hypot(*peaks)))


DISTURBANCES: dict[str, tuple[Callable[..., Disturbance], str]] = {
    "paper": (PaperDrag, "the case study's drag (43), periodic in the position"),
    "linear": (LinearDrag, "f = -c v"),
    "quadratic": (QuadraticDrag, "f = -c |v| v"),
    "wind": (ConstantWind, "a constant force"),
    "gusts": (WindGusts, "wind that comes and goes, drawn by its seed"),
}
"""Class and one-line description of each disturbance, by name."""


def make_disturbance(name: str, scale: float = 1.0) -> Disturbance:
    """Make a disturbance by name, with its force multiplied by ``scale``.

    Raises:
        ConfigurationError: an unknown name, or a scale that is not finite.
    """
    if name not in DISTURBANCES:
        raise unknown("disturbance", name, DISTURBANCES)
    return DISTURBANCES[name][0](scale=scale)
