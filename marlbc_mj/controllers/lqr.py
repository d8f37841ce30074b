"""LQR: the regulator that minimises the paper's own cost for a double integrator: least control cost, soft tracking."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlbc_mj.controllers.base import model_weight, require_gains
from marlbc_mj.core import laws


@laws.controller(gains=("model_weight", "position_gain", "velocity_gain", "limit"))
def state_feedback(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """u = clip(-w f - k_p e_p - k_v e_v, +-limit), where w is the model weight; stateless."""
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        wish = -gains.model_weight * drag[axis] - gains.position_gain * e_p - gains.velocity_gain * e_v
        force_out[axis] = laws.clip(wish, gains.limit)


def riccati_gains(state_weight: float, control_weight: float) -> tuple[float, float]:
    """(k_p, k_v) that minimise the integral of alpha |e|^2 + beta |u|^2 for e_p' = e_v, e_v' = u.

    The algebraic Riccati equation has the closed-form solution k_p = sqrt(alpha/beta), k_v = sqrt(alpha/beta + 2 k_p). The
    paper's weights give (1, sqrt 3).
    """
    k_p = float(np.sqrt(state_weight / control_weight))
    return k_p, float(np.sqrt(state_weight / control_weight + 2.0 * k_p))


@dataclass(frozen=True)
class LQR:
    """State feedback with :func:`riccati_gains` of the weights alpha_V and beta_V of the cost (24); nothing is fitted."""

    state_weight: float = 1.0  # alpha_V
    control_weight: float = 1.0  # beta_V
    model: Literal["exact", "none"] = "exact"  # f^: the true drag f, or zero
    limited: bool = False
    law = staticmethod(state_feedback)

    def __post_init__(self) -> None:
        require_gains(self, ("state_weight", "control_weight"))
        model_weight(self.model)

    @property
    def linear_gains(self) -> tuple[float, float]:
        return riccati_gains(self.state_weight, self.control_weight)

    def params(self, agent: int, limit: float) -> laws.Numbers:
        k_p, k_v = self.linear_gains
        return {"model_weight": model_weight(self.model), "position_gain": k_p, "velocity_gain": k_v, "limit": limit}

    def initial_state(self, agent: int) -> laws.Numbers:
        return {}
