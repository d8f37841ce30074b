"""RLC, the single-agent reinforcement learning controller that SORLC is compared with (Zhang et al. 2022), reconstructed.

u = -xi_p e_p - f^ - omega_a^T Psi_V / 2 - c e_v: SORLC's law without compensator and limit, and with almost no damping.
The cited law has no velocity error term, which leaves the loop undamped; c = 2.35 reproduces the published 3.4 s in which the
velocity error converges. No convergence theorem is claimed.
"""

from dataclasses import dataclass, field

from marlbc_mj.controllers.base import require_gains
from marlbc_mj.controllers.sorlc import SORLC, sorlc
from marlbc_mj.core import laws


@dataclass(frozen=True)
class RLC:
    """RLC with the identifier, actor and critic of SORLC with the basis ``published``.

    Source: ``position_gain`` and the networks from Table 2; ``damping`` is fitted to the published convergence time.
    """

    position_gain: float = 100.0  # xi_p [1/s^2]
    damping: float = 2.35  # c [1/s]
    networks: SORLC = field(default_factory=SORLC)
    limited: bool = False
    law = staticmethod(sorlc)

    def __post_init__(self) -> None:
        require_gains(self, ("position_gain",))
        require_gains(self, ("damping",), allow_zero=True)

    @property
    def linear_gains(self) -> tuple[float, float]:
        return self.position_gain, self.damping

    @property
    def decay_rates(self) -> tuple[float, ...]:
        """Decay rates of the networks [1/s]."""
        return self.networks.decay_rates

    def params(self, agent: int, limit: float) -> laws.Numbers:
        gains = self.networks.params(agent, limit)
        return {**gains, "position_error_gain": self.position_gain, "velocity_error_gain": self.damping}

    def initial_state(self, agent: int) -> laws.Numbers:
        return self.networks.initial_state(agent)
