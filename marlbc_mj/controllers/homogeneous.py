"""Finite-time and fixed-time rivals (Huang et al. 2019; Zhou et al. 2022), reconstructed: sums of powers of the errors.

sig(x)^a = sign(x) |x|^a and phi_a(x) = sign(x) min(|x|, 1)^a, axis by axis. Their velocity gains are calibrated: at a switch
between FM and FR v_r jumps by Lambda |dy| = 48 or 96 m/s, and Table 6's maxima are 8 times (finite-time) and 20 times
(fixed-time) that, but for one agent's under fixed-time; ``marlbc calibrate`` repeats it. Totals are not fitted, and no
convergence theorem is claimed. f^ is the true f by default, which is generous to them.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlbc_mj.controllers.base import model_weight, require_gains
from marlbc_mj.core import laws


@laws.inlined
def sig(x, power):  # type: ignore[no-untyped-def]
    """sign(x) |x|^power."""
    return np.sign(x) * abs(x) ** power


@laws.controller
def homogeneous(params, state, p, v, p_r, v_r, drag, h, force_out):  # type: ignore[no-untyped-def]
    """u = -f^ - a e_v - b sig(e_p)^q - c sig(e_p)^r - phi_s(e_v) - d sig(e_v)^t, then the limit; no state.

    ``params`` = weight of f^, a, b, q, c, r, s, d, t, limit [N].
    """
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        bounded = np.sign(e_v) * (abs(e_v) if abs(e_v) < 1.0 else 1.0) ** params[6]
        wish = -params[0] * drag[axis] - params[1] * e_v - params[2] * sig(e_p, params[3]) - bounded
        if params[4] != 0.0:
            wish -= params[4] * sig(e_p, params[5])
        if params[7] != 0.0:
            wish -= params[7] * sig(e_v, params[8])
        force_out[axis] = laws.clip(wish, params[9])


@dataclass(frozen=True)
class _Homogeneous:
    model: Literal["exact", "none"] = "exact"  # f^: the true f, or nothing
    limited: bool = False
    law = staticmethod(homogeneous)

    def __post_init__(self) -> None:
        model_weight(self.model)
        require_gains(self, ("velocity_gain", "position_gain"))

    @property
    def linear_gains(self) -> None:
        """Unbounded near zero: powers below 1 have no largest gain."""
        return

    def initial_state(self, agent: int) -> np.ndarray:
        return np.zeros(0)


@dataclass(frozen=True)
class FiniteTime(_Homogeneous):
    """u = -f^ - 8 e_v - 4 sig(e_p)^0.6 - phi_0.75(e_v), with the default gains.

    Source: Huang et al. 2019 for the form; ``velocity_gain`` from Table 6's maxima (:mod:`marlbc_mj.studies.calibration`);
    ``position_gain`` and the powers are chosen here.
    """

    velocity_gain: float = 8.0  # [1/s]
    position_gain: float = 4.0

    def params(self, agent: int, limit: float) -> tuple[float, ...]:
        weight = model_weight(self.model)
        return weight, self.velocity_gain, self.position_gain, 0.6, 0.0, 1.0, 0.75, 0.0, 1.0, limit


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

    def params(self, agent: int, limit: float) -> tuple[float, ...]:
        outer = self.outer_position_gain, 1.4, 0.75, self.outer_velocity_gain, 7.0 / 6.0, limit
        return model_weight(self.model), self.velocity_gain, self.position_gain, 0.6, *outer
