"""Unknown dynamics f(chi) of the plant (1): what the controllers do not know. One law and one dataclass each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError, unknown


@laws.disturbance
def paper_drag(params, t, p, v, force_out):  # type: ignore[no-untyped-def]
    """(43): f = scale [v1 sin^2(p2) + v2 cos^2(p1), v1 sin^2(p2) - v2 cos^2(p1)]; ``params`` = scale."""
    sine = np.sin(p[1])
    cosine = np.cos(p[0])
    first = v[0] * sine * sine
    second = v[1] * cosine * cosine
    force_out[0] = params[0] * (first + second)
    force_out[1] = params[0] * (first - second)


@laws.disturbance
def linear_drag(params, t, p, v, force_out):  # type: ignore[no-untyped-def]
    """f = -scale c v; ``params`` = scale, c [N s/m]."""
    force_out[0] = -params[0] * params[1] * v[0]
    force_out[1] = -params[0] * params[1] * v[1]


@laws.disturbance
def quadratic_drag(params, t, p, v, force_out):  # type: ignore[no-untyped-def]
    """f = -scale c |v| v; ``params`` = scale, c [N s^2/m^2]."""
    factor = params[0] * params[1] * np.sqrt(v[0] * v[0] + v[1] * v[1])
    force_out[0] = -factor * v[0]
    force_out[1] = -factor * v[1]


@laws.disturbance
def constant_wind(params, t, p, v, force_out):  # type: ignore[no-untyped-def]
    """f = scale w; ``params`` = scale, w_x, w_y [N]."""
    force_out[0] = params[0] * params[1]
    force_out[1] = params[0] * params[2]


@laws.disturbance
def wind_gusts(params, t, p, v, force_out):  # type: ignore[no-untyped-def]
    """f = scale (w + sum_k a_k sin(w_k t + phase_k)), alike for all agents; ``params`` = scale, w_x, w_y [N], then for each of
    the harmonics of x and then of y: a_k [N], w_k [rad/s], phase_k.
    """
    for axis in range(2):
        force_out[axis] = params[1 + axis]
    harmonics = (params.shape[0] - 3) // 6
    for k in range(2 * harmonics):
        axis = k // harmonics
        force_out[axis] += params[3 + 3 * k] * np.sin(params[4 + 3 * k] * t + params[5 + 3 * k])
    for axis in range(2):
        force_out[axis] *= params[0]


@runtime_checkable
class Disturbance(Protocol):
    """What the engine asks of a disturbance. ``params()[0]`` is its scale, which a perturbation draw multiplies."""

    @property
    def law(self) -> laws.Law: ...
    def params(self) -> Sequence[float]:
        """Numbers handed to the law as ``params``."""
        ...


HARMONICS = 12  # of wind gusts, on each axis


@dataclass(frozen=True)
class _Scaled:
    scale: float = 1.0  # multiplies the whole force; 0 switches the disturbance off

    def __post_init__(self) -> None:
        if not np.isfinite(self.params()).all():
            raise ConfigurationError(f"{type(self).__name__} needs finite numbers, got {tuple(self.params())}")

    def params(self) -> tuple[float, ...]:
        return (self.scale,)


@dataclass(frozen=True)
class PaperDrag(_Scaled):
    """The case study's unknown drag (43)."""

    law = staticmethod(paper_drag)


@dataclass(frozen=True)
class LinearDrag(_Scaled):
    """Viscous drag."""

    coefficient: float = 1.0  # c [N s/m]
    law = staticmethod(linear_drag)

    def params(self) -> tuple[float, ...]:
        return (self.scale, self.coefficient)


@dataclass(frozen=True)
class QuadraticDrag(_Scaled):
    """Drag of a body in fast air."""

    coefficient: float = 0.1  # c [N s^2/m^2]
    law = staticmethod(quadratic_drag)

    def params(self) -> tuple[float, ...]:
        return (self.scale, self.coefficient)


@dataclass(frozen=True)
class ConstantWind(_Scaled):
    """A constant force; unlike (1) asks, it does not vanish at rest."""

    force: tuple[float, float] = (5.0, 0.0)  # w [N]
    law = staticmethod(constant_wind)

    def params(self) -> tuple[float, ...]:
        return (self.scale, *self.force)


@dataclass(frozen=True)
class WindGusts(_Scaled):
    """Wind that comes and goes: a steady force and ``HARMONICS`` sines whose frequencies and phases ``seed`` draws.

    The same seed blows the same at the same mission time, whatever the agents do. Harmonic k has an amplitude that falls with its
    frequency as 1 / sqrt(1 + (w_k T)^2), as in a Dryden spectrum, and together they have the root mean square ``strength``.
    """

    steady: tuple[float, float] = (2.0, 0.0)  # [N]
    strength: float = 10.0  # RMS of the gusts on each axis [N]
    time: float = 4.0  # T, how long a gust lasts [s]
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

    def params(self) -> tuple[float, ...]:
        rng = np.random.default_rng(self.seed)
        place = (np.arange(HARMONICS) + rng.uniform(0.0, 1.0, (2, HARMONICS))) / HARMONICS  # one frequency in each band
        ratio = np.exp(np.log(0.2) + np.log(50.0) * place)  # w_k T, from 0.2 to 10
        amplitude = 1.0 / np.sqrt(1.0 + ratio**2)
        amplitude *= self.strength * np.sqrt(2.0 / (amplitude**2).sum(axis=1, keepdims=True))
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, HARMONICS))
        rows = np.stack([amplitude, ratio / self.time, phase], axis=-1)
        return (self.scale, *self.steady, *rows.ravel().tolist())


DISTURBANCES: dict[str, tuple[Callable[..., Disturbance], str]] = {
    "paper": (PaperDrag, "the case study's drag (43), periodic in the position"),
    "linear": (LinearDrag, "f = -c v"),
    "quadratic": (QuadraticDrag, "f = -c |v| v"),
    "wind": (ConstantWind, "a constant force"),
    "gusts": (WindGusts, "wind that comes and goes, drawn by its seed"),
}
"""Class and one line of description by name."""


def make_disturbance(name: str, scale: float = 1.0) -> Disturbance:
    """A disturbance by name, times ``scale``.

    Raises:
        ConfigurationError: unknown name, or a scale that is not finite.
    """
    if name not in DISTURBANCES:
        raise unknown("disturbance", name, DISTURBANCES)
    return DISTURBANCES[name][0](scale=scale)
