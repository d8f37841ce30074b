"""Predefined-time control: J. D. Sanchez-Torres, E. N. Sanchez, A. G. Loukianov, American Control Conference 2015, 5842-5846,
and J. D. Sanchez-Torres et al., IMA Journal of Mathematical Control and Information 35, i1-i29, 2018.

x' = -Phi(x; m, T), Phi = exp(|x|^m) sig(x)^(1 - m) / (m T), 0 < m <= 1, reaches zero within T from anywhere: its settling time
T (1 - exp(-|x(0)|^m)) is bounded by T. For a second-order system two such terms are nested: the velocity error should follow
-Phi(e_p; m, T_p), so sigma = e_v + Phi(e_p; m, T_p), and u = -f^ - Phi(sigma; m, T_s).

Three departures from the source keep force and gain bounded. When an order switches, v_r jumps by up to 96 m/s, and exp(|x|^m)
would become huge: so errors are measured in units of ``position_scale`` and ``velocity_scale``, and the exponent is limited to
``exponent_limit``. Near zero the gain of sig(x)^(1 - m) is unbounded: so Phi is linear below ``layer`` (in the same units). The
derivative of the inner term, which is singular at zero, is omitted. The source's bound T therefore applies only between the
layer and the exponent limit, and no theorem is claimed here.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlbc_mj.controllers.base import model_weight, require_gains
from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError


@laws.allocation_free
def predefined(x, power, time, exponent_limit, layer):
    """Phi(x) = exp(min(|x|^m, limit)) sig(x)^(1 - m) / (m T), but linear for |x| below the layer."""
    size = abs(x) if abs(x) > layer else layer
    exponent = size**power
    if exponent > exponent_limit:
        exponent = exponent_limit
    return np.exp(exponent) * size ** (-power) * x / (power * time)


@laws.controller(
    gains=(
        "model_weight",  # w
        "position_time",  # T_p [s]
        "velocity_time",  # T_s [s]
        "power",  # m
        "position_scale",  # a [m]
        "velocity_scale",  # b [m/s]
        "exponent_limit",
        "layer",
        "limit",  # [N]
    )
)
def predefined_time(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """u = -w f - b Phi(sigma / b; m, T_s), sigma = e_v + a Phi(e_p / a; m, T_p), clipped to the limit; stateless."""
    power, top, layer = gains.power, gains.exponent_limit, gains.layer
    a, b = gains.position_scale, gains.velocity_scale
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        sigma = e_v + a * predefined(e_p / a, power, gains.position_time, top, layer)
        wish = -gains.model_weight * drag[axis] - b * predefined(sigma / b, power, gains.velocity_time, top, layer)
        force_out[axis] = laws.clip(wish, gains.limit)


@dataclass(frozen=True)
class PredefinedTime:
    """Nested predefined-time terms; gains chosen on the case study, not taken from a source."""

    position_time: float = 2.0  # T_p [s]
    velocity_time: float = 0.5  # T_s [s]
    power: float = 0.3  # m of both terms
    position_scale: float = 12.0  # a [m]: the greatest distance between two slots
    velocity_scale: float = 96.0  # b [m/s]: the largest jump of v_r
    exponent_limit: float = 1.5  # beyond it Phi grows as sig(x)^(1 - m)
    layer: float = 1e-3  # relative error below which Phi is linear
    model: Literal["exact", "none"] = "exact"  # f^: the true drag f, or zero
    limited: bool = False
    law = staticmethod(predefined_time)

    def __post_init__(self) -> None:
        model_weight(self.model)
        positive = ("position_time", "velocity_time", "position_scale", "velocity_scale", "exponent_limit", "layer")
        require_gains(self, positive)
        if not 0.0 < self.power <= 1.0:
            raise ConfigurationError(f"PredefinedTime.power must be above 0 and at most 1, got {self.power}")

    @property
    def linear_gains(self) -> tuple[float, float]:
        """Upper bounds: slope of the nested terms for the position, slope of the outer term for the velocity."""
        outer, inner = self._slope(self.velocity_time), self._slope(self.position_time)
        return outer * inner, outer

    def _slope(self, time: float) -> float:
        """Maximum of Phi(x) / x: exp(x^m) / (m T x^m) falls until x^m = 1, then rises until the exponent limit."""
        at = self.layer**self.power
        end = max(self.exponent_limit, at)
        return float(max(np.exp(min(at, end)) / at, np.exp(end) / end) / (self.power * time))

    def params(self, agent: int, limit: float) -> laws.Numbers:
        return laws.gains_of(self, limit=limit, model_weight=model_weight(self.model))

    def initial_state(self, agent: int) -> laws.Numbers:
        return {}
