"""Finite-time and fixed-time baselines (Huang et al. 2019; Zhou et al. 2022), reconstructed as sums of powers of the errors.

sig(x)^a = sign(x) |x|^a and phi_a(x) = sign(x) min(|x|, 1)^a, per axis. The velocity gains are calibrated: at a switch between
FM and FR, v_r jumps by Lambda |dy| = 48 or 96 m/s, and the maxima in Table 6 are 8 times (finite-time) and 20 times
(fixed-time) this jump, except for one agent under fixed-time. ``marlbc calibrate`` repeats the calibration. The published
totals are not fitted, and no convergence theorem is claimed. By default f^ is the true f, which favors these baselines.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlbc_mj.controllers.base import model_weight, require_gains
from marlbc_mj.core import laws

_GAINS = (
    "model_weight",  # weight of f^
    "velocity_gain",  # a
    "position_gain",  # b
    "position_power",  # q, below 1
    "outer_position_gain",  # c
    "outer_position_power",  # r, above 1
    "bounded_power",  # s
    "outer_velocity_gain",  # d
    "outer_velocity_power",  # t, above 1
    "limit",  # [N]
)


@laws.inlined
def sig(x, power):
    """sign(x) |x|^power."""
    return np.sign(x) * abs(x) ** power


@laws.inlined
def phi(x, power):
    """sign(x) min(|x|, 1)^power."""
    return np.sign(x) * (abs(x) if abs(x) < 1.0 else 1.0) ** power


@laws.controller(gains=_GAINS)
def homogeneous(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """u = -f^ - a e_v - b sig(e_p)^q - phi_s(e_v) - c sig(e_p)^r - d sig(e_v)^t, clipped to the limit; stateless."""
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        wish = -gains.model_weight * drag[axis] - gains.velocity_gain * e_v
        wish -= gains.position_gain * sig(e_p, gains.position_power)
        wish -= phi(e_v, gains.bounded_power)
        if gains.outer_position_gain != 0.0:
            wish -= gains.outer_position_gain * sig(e_p, gains.outer_position_power)
        if gains.outer_velocity_gain != 0.0:
            wish -= gains.outer_velocity_gain * sig(e_v, gains.outer_velocity_power)
        force_out[axis] = laws.clip(wish, gains.limit)


@dataclass(frozen=True)
class _Homogeneous:
    model: Literal["exact", "none"] = "exact"  # f^: the true drag f, or zero
    limited: bool = False
    law = staticmethod(homogeneous)

    def __post_init__(self) -> None:
        model_weight(self.model)
        require_gains(self, ("velocity_gain", "position_gain"))

    @property
    def linear_gains(self) -> None:
        """None: the gain of a power below 1 is unbounded near zero."""
        return

    def initial_state(self, agent: int) -> laws.Numbers:
        return {}


@dataclass(frozen=True)
class FiniteTime(_Homogeneous):
    """u = -f^ - 8 e_v - 4 sig(e_p)^0.6 - phi_0.75(e_v), with the default gains.

    Source: Huang et al. 2019 for the form; ``velocity_gain`` from Table 6's maxima (:mod:`marlbc_mj.studies.calibration`);
    ``position_gain`` and the powers are chosen here.
    """

    velocity_gain: float = 8.0  # [1/s]
    position_gain: float = 4.0

    def params(self, agent: int, limit: float) -> laws.Numbers:
        outer = {"outer_position_gain": 0.0, "outer_position_power": 1.0, "outer_velocity_gain": 0.0, "outer_velocity_power": 1.0}
        powers = {"position_power": 0.6, "bounded_power": 0.75, **outer}
        return laws.gains_of(self, limit=limit, model_weight=model_weight(self.model), **powers)


@dataclass(frozen=True)
class FixedTime(_Homogeneous):
    """u = -f^ - 20 e_v - 10 sig(e_p)^0.6 - sig(e_p)^1.4 - phi_0.75(e_v) - 0.02 sig(e_v)^(7/6), with the default gains.

    Source: Zhou et al. 2022 for the form; ``velocity_gain`` from Table 6's maxima (:mod:`marlbc_mj.studies.calibration`); the
    other gains and the powers are chosen here.
    """

    velocity_gain: float = 20.0  # [1/s]
    position_gain: float = 10.0
    outer_position_gain: float = 1.0
    outer_velocity_gain: float = 0.02

    def params(self, agent: int, limit: float) -> laws.Numbers:
        outer = {"outer_position_power": 1.4, "outer_velocity_power": 7.0 / 6.0}
        powers = {"position_power": 0.6, "bounded_power": 0.75, **outer}
        return laws.gains_of(self, limit=limit, model_weight=model_weight(self.model), **powers)
