"""Non-singular terminal sliding-mode control: Y. Feng, X. Yu, Z. Man, Automatica 38(12), 2159-2167, 2002, equations (8), (9).

Axis by axis s = e_p + (1/beta) sig(e_v)^gamma with 1 < gamma = p/q < 2, and u = -f^ - (beta/gamma) sig(e_v)^(2 - gamma)
- k sat(s/phi). On s = 0 the error reaches zero in finite time. No exponent in the law is negative, so it has no singularity. As
usual, a saturation with boundary layer phi replaces the sign function of the original, which would chatter in sampled time.

Since gamma > 1, s hardly depends on small velocity errors: inside the layer the only damping is (beta/gamma) |e_v|^(1 - gamma),
which grows without bound near zero, so a sampled loop ends in a small limit cycle instead of at zero.
"""

from dataclasses import dataclass
from typing import Literal

from marlbc_mj.controllers.base import model_weight, require_gains
from marlbc_mj.controllers.homogeneous import sig
from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError


@laws.controller(gains=("model_weight", "surface_gain", "power", "reaching_gain", "boundary_layer", "limit"))
def terminal_sliding(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """u = -w f - (beta/gamma) sig(e_v)^(2 - gamma) - k sat(s/phi), s = e_p + sig(e_v)^gamma / beta, clipped; stateless."""
    beta, gamma, k, phi = gains.surface_gain, gains.power, gains.reaching_gain, gains.boundary_layer
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        s = e_p + sig(e_v, gamma) / beta
        wish = -gains.model_weight * drag[axis] - beta / gamma * sig(e_v, 2.0 - gamma) - k * laws.clip(s / phi, 1.0)
        force_out[axis] = laws.clip(wish, gains.limit)


@dataclass(frozen=True)
class TerminalSliding:
    """The textbook law with a boundary layer. The gains are chosen on the case study, not taken from a source."""

    surface_gain: float = 4.0  # beta
    power: float = 1.25  # gamma = p/q
    reaching_gain: float = 150.0  # k [N]
    boundary_layer: float = 1.0  # phi [m]
    model: Literal["exact", "none"] = "exact"  # f^: the true drag f, or zero
    limited: bool = False
    law = staticmethod(terminal_sliding)

    def __post_init__(self) -> None:
        model_weight(self.model)
        require_gains(self, ("surface_gain", "reaching_gain", "boundary_layer"))
        if not 1.0 < self.power < 2.0:
            raise ConfigurationError(f"TerminalSliding.power must be between 1 and 2, both excluded, got {self.power}")

    @property
    def linear_gains(self) -> None:
        """None: the gain of a power below 1 is unbounded near zero."""
        return

    def params(self, agent: int, limit: float) -> laws.Numbers:
        return laws.gains_of(self, limit=limit, model_weight=model_weight(self.model))

    def initial_state(self, agent: int) -> laws.Numbers:
        return {}
