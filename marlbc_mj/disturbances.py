"""Unknown dynamics f(chi) of the plant (1): what the controllers do not know. One law and one dataclass each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from marlbc_mj import laws
from marlbc_mj.errors import ConfigurationError, unknown


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


@runtime_checkable
class Disturbance(Protocol):
    """What the engine asks of a disturbance. ``params()[0]`` is its scale, which a perturbation draw multiplies."""

    @property
    def law(self) -> laws.Law: ...
    def params(self) -> Sequence[float]:
        """Numbers handed to the law as ``params``."""
        ...


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


DISTURBANCES: dict[str, tuple[Callable[..., Disturbance], str]] = {
    "paper": (PaperDrag, "the case study's drag (43), periodic in the position"),
    "linear": (LinearDrag, "f = -c v"),
    "quadratic": (QuadraticDrag, "f = -c |v| v"),
    "wind": (ConstantWind, "a constant force"),
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
