"""Saturated PD: what SORLC becomes once its networks have nothing to say; the baseline of every comparison."""

from dataclasses import dataclass

import numpy as np

from marlbc_mj.controllers.base import require_gains
from marlbc_mj.core import laws


@laws.controller
def pd(params, state, p, v, p_r, v_r, drag, h, force_out):  # type: ignore[no-untyped-def]
    """u = clip(-k_p e_p - k_v e_v, +-limit); ``params`` = k_p, k_v, limit; no state."""
    for axis in range(2):
        wish = -params[0] * (p[axis] - p_r[axis]) - params[1] * (v[axis] - v_r[axis])
        force_out[axis] = laws.clip(wish, params[2])


@dataclass(frozen=True)
class PD:
    """Proportional-derivative law with the gains of Table 2."""

    position_gain: float = 100.0  # k_p [1/s^2]
    velocity_gain: float = 100.0  # k_v [1/s]
    limited: bool = True
    law = staticmethod(pd)

    def __post_init__(self) -> None:
        require_gains(self, ("position_gain", "velocity_gain"))

    @property
    def linear_gains(self) -> tuple[float, float]:
        return self.position_gain, self.velocity_gain

    def params(self, agent: int, limit: float) -> tuple[float, ...]:
        return self.position_gain, self.velocity_gain, limit

    def initial_state(self, agent: int) -> np.ndarray:
        return np.zeros(0)
