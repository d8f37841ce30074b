"""Saturated PD: SORLC without networks and compensator; the baseline of every comparison."""

from dataclasses import dataclass

from marlbc_mj.controllers.base import require_gains
from marlbc_mj.controllers.lqr import state_feedback
from marlbc_mj.core import laws


@dataclass(frozen=True)
class PD:
    """Proportional-derivative law with the gains of Table 2: state feedback without a drag model."""

    position_gain: float = 100.0  # k_p [1/s^2]
    velocity_gain: float = 100.0  # k_v [1/s]
    limited: bool = True
    law = staticmethod(state_feedback)

    def __post_init__(self) -> None:
        require_gains(self, ("position_gain", "velocity_gain"))

    @property
    def linear_gains(self) -> tuple[float, float]:
        return self.position_gain, self.velocity_gain

    def params(self, agent: int, limit: float) -> laws.Numbers:
        return laws.gains_of(self, limit=limit, model_weight=0.0)

    def initial_state(self, agent: int) -> laws.Numbers:
        return {}
