"""SORLC, the second-order reinforcement learning controller: equations (30) and (36)-(41), errata 1, 2, 13 and 14.

Identifier, critic and actor are linear in 12 Gaussians whose centres lie on the diagonal, c_k = (c_k, ..., c_k). Then
|z - c_k|^2 = |z|^2 - 2 c_k sum(z) + n c_k^2, and the ratio of neighbouring values is itself geometric in k. So two
exponentials give all twelve values, which agree with the textbook form to 1e-13.
"""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from marlbc_mj.controllers.base import require_gains
from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError, unknown

NEURONS = 12
GAINS = laws.Names.of(
    (
        "position_error_gain",  # xi_p [1/s^2]
        "velocity_error_gain",  # xi_v [1/s]
        "compensator_gain",  # xi_tau [1/s]
        "identifier_rate",  # Gamma_f = rate * I [1/s]
        "identifier_leak",  # nu_f
        "critic_rate",  # gamma_c [1/s]
        "actor_rate",  # gamma_a [1/s]
        "control_weight",  # beta_V
        "tau_sign",  # sign of tau in (40)
        "limit",  # [N]
        "learns",  # 0: no networks
        "relative",  # 1: the basis receives errors divided by the scales below instead of p and v
        "position_scale",  # [m]
        "velocity_scale",  # [m/s]
        "tau_scale",  # [N]
        "first_centre",
        "centre_distance",
        "precision",  # 1 / width^2
        "chi_factor",  # ``factor`` of diagonal_gaussians for the 4 components of chi
        "tau_factor",  # the same for the 2 components of tau
    )
)
STATE = laws.Names.of(
    {
        "w_f": (2, NEURONS),  # omega_f / scale [N], per axis
        "w_a": (2, NEURONS),  # omega_a [N]
        "w_c": (2, NEURONS),  # omega_c [N]
        "psi_f": NEURONS,  # Psi_f(chi) of this substep
        "psi_v": NEURONS,  # Psi_V(chi, tau)
        "scale": (),  # omega_f = scale * w_f, so that leaking all weights takes one multiplication
        "tau": 2,  # compensator [N], per axis
    }
)

BASES = ("published", "scaled", "off")
NEGLIGIBLE = 45.0  # exp(-45) = 3e-20 counts as zero


class Weights(NamedTuple):
    """One agent's adaptive state in the paper's shapes."""

    identifier: np.ndarray  # omega_f (12, 2)
    actor: np.ndarray  # omega_a (12, 2)
    critic: np.ndarray  # omega_c (12, 2)
    tau: np.ndarray  # (2,) compensator of (30)


@laws.controller(gains=GAINS, state=STATE)
def sorlc(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """One substep of SORLC: force (40) from the current weights, then explicit Euler updates of weights and tau."""
    learning = gains.learns != 0.0 and fill_basis(gains, state, p, v, p_r, v_r)
    xi_p, xi_v, xi_tau = gains.position_error_gain, gains.velocity_error_gain, gains.compensator_gain
    gamma_f, gamma_c, gamma_a = gains.identifier_rate, gains.critic_rate, gains.actor_rate
    half, sign = 0.5 / gains.control_weight, gains.tau_sign
    leak = 1.0 - h * gamma_f * gains.identifier_leak
    if gains.learns != 0.0 and not learning:
        state.scale *= leak  # with Psi_f = 0, only the leak of (37) is left
    elif state.scale != 1.0:
        unscale(state)
    psi_f, psi_v, tau = state.psi_f, state.psi_v, state.tau
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]  # (18), (19)
        w_f, w_a, w_c = state.w_f[axis], state.w_a[axis], state.w_c[axis]
        f_hat = dot(w_f, psi_f) if learning else 0.0  # (36)
        actor = dot(w_a, psi_v) if learning else 0.0  # omega_a^T Psi_V of (40), (41)
        critic = dot(w_c, psi_v) if learning else 0.0  # (38)
        u_0 = -xi_p * e_p - xi_v * e_v + sign * tau[axis] + (-f_hat - half * actor)  # (40)
        u = laws.clip(u_0, gains.limit)  # (2)
        tau[axis] += h * (u - u_0 - xi_tau * tau[axis])  # (30)
        force_out[axis] = u
        if not learning:
            continue
        for k in range(NEURONS):
            w_f[k] = leak * w_f[k] + h * gamma_f * (e_p + e_v) * psi_f[k]  # (37)
            w_c[k] -= h * gamma_c * critic * psi_v[k]  # (39)
            w_a[k] -= h * (gamma_a * (actor - critic) + gamma_c * critic) * psi_v[k]  # (41)


@laws.allocation_free
def dot(weights, psi):
    """Scalar product of the weights of one axis with a basis."""
    total = 0.0
    for k in range(NEURONS):
        total += weights[k] * psi[k]
    return total


@laws.inlined
def unscale(state):
    """Multiply the stored identifier weights by their scale, so that they equal omega_f."""
    for axis in range(2):
        for k in range(NEURONS):
            state.w_f[axis, k] *= state.scale
    state.scale = 1.0


@laws.inlined
def fill_basis(gains, state, p, v, p_r, v_r):
    """Write Psi_f(chi) and Psi_V(chi, tau) into the state; if both vanish, write nothing and return False."""
    if gains.relative != 0.0:
        z0, z1 = (p[0] - p_r[0]) / gains.position_scale, (p[1] - p_r[1]) / gains.position_scale
        z2, z3 = (v[0] - v_r[0]) / gains.velocity_scale, (v[1] - v_r[1]) / gains.velocity_scale
    else:
        z0, z1, z2, z3 = p[0], p[1], v[0], v[1]
    square, total = z0 * z0 + z1 * z1 + z2 * z2 + z3 * z3, z0 + z1 + z2 + z3
    if not diagonal_gaussians(gains, square, total, 4.0, gains.chi_factor, state.psi_f):
        return False
    t0, t1 = state.tau[0] / gains.tau_scale, state.tau[1] / gains.tau_scale
    tau_felt = diagonal_gaussians(gains, t0 * t0 + t1 * t1, t0 + t1, 2.0, gains.tau_factor, state.psi_v)
    for k in range(NEURONS):  # a Gaussian of (chi, tau) is a Gaussian of chi times one of tau
        state.psi_v[k] = (state.psi_v[k] if tau_felt else 0.0) * state.psi_f[k]
    return True


@laws.allocation_free
def diagonal_gaussians(gains, square, total, n, factor, psi):
    """exp(-precision |z - c_k 1|^2) for the centres c_k on the diagonal, from |z|^2, sum(z) and the dimension n of z.

    The ratio of neighbouring values falls by ``factor`` = exp(-2 n distance^2 precision) from one to the next. Values are written
    to ``psi`` (12,). If all are below 3e-20, too small to affect a force, nothing is written and the result is False.
    """
    first, step, precision = gains.first_centre, gains.centre_distance, gains.precision
    last = first + (NEURONS - 1) * step
    closest = min(max(total, n * first), n * last)  # n times the centre nearest to z
    if precision * (square * n - closest * (2.0 * total - closest)) > NEGLIGIBLE * n:
        return False
    value = np.exp(-precision * (square - first * (2.0 * total - n * first)))
    ratio = np.exp(precision * step * (2.0 * total - n * (2.0 * first + step)))
    for k in range(NEURONS):
        psi[k] = value
        value *= ratio
        ratio *= factor
    return True


def weights(state: np.ndarray) -> Weights:
    """Read one agent's state (S,), or a stack of them (..., S), as weight matrices (..., 12, 2)."""
    read = STATE.view(state)
    w_f, w_a, w_c = (matrix.swapaxes(-1, -2) for matrix in (read.w_f, read.w_a, read.w_c))
    return Weights(w_f * np.asarray(read.scale)[..., None, None], w_a, w_c, read.tau)


@dataclass(frozen=True)
class SORLC:
    """SORLC with the gains of Table 2, and a choice of basis.

    ``published`` follows the paper: once positions leave [-6, 6], within 10 s, the basis vanishes and SORLC is a saturated PD
    law with compensator. ``scaled`` feeds the basis the tracking errors divided by ``position_scale`` and ``velocity_scale``
    instead, so its inputs stay within its range for the whole run. ``off`` has no networks. With the published Gamma_f and
    nu_f, the leak keeps the identifier below a fifth of the PD terms; :meth:`scaled` therefore sets other values.
    """

    basis: Literal["published", "scaled", "off"] = "published"
    position_error_gain: float = 100.0  # xi_p [1/s^2]
    velocity_error_gain: float = 100.0  # xi_v [1/s]
    compensator_gain: float = 50.0  # xi_tau [1/s]
    identifier_rate: float = 0.4  # Gamma_f = rate * I
    identifier_leak: float = 0.6  # nu_f
    critic_rate: float = 4.0  # gamma_c
    actor_rate: float = 6.0  # gamma_a
    control_weight: float = 1.0  # beta_V
    tau_sign: Literal[-1, 1] = -1  # sign of tau in (40); -1 as published, +1 corrects erratum 2
    identifier_weights: tuple[float, ...] = (1.0, 0.98, 0.96, 0.94)  # initial value of every entry of omega_f, one per agent
    actor_weights: tuple[float, ...] = (0.5, 0.48, 0.46, 0.44)  # the same for omega_a
    critic_weights: tuple[float, ...] = (1.0, 0.96, 0.92, 0.88)  # the same for omega_c
    centre_range: float = 6.0  # centres evenly spaced on [-6, 6]
    width: float = 2.0
    position_scale: float = 1.0  # [m], scaled basis only
    velocity_scale: float = 1.0  # [m/s], scaled basis only
    tau_scale: float = 1.0  # [N], scaled basis only
    limited: bool = True
    law = staticmethod(sorlc)

    def __post_init__(self) -> None:
        if self.basis not in BASES:
            raise unknown("basis", self.basis, BASES)
        if self.tau_sign not in (-1, 1):
            raise ConfigurationError(f"SORLC.tau_sign must be -1 or 1, got {self.tau_sign}")
        positive = ("identifier_rate", "critic_rate", "control_weight", "centre_range", "width")
        scales = ("position_scale", "velocity_scale", "tau_scale")
        require_gains(self, (*positive, *scales))
        require_gains(self, ("identifier_leak",), allow_zero=True)
        if self.width < self.centre_range / 6.0:
            raise ConfigurationError(
                f"SORLC.width must be at least a sixth of centre_range, {self.centre_range / 6.0:g}, got {self.width}; narrower "
                "Gaussians fall below what the recurrence over neurons can represent"
            )
        self._require_weights()
        self._require_theorem_1()

    def _require_weights(self) -> None:
        for name in ("identifier_weights", "actor_weights", "critic_weights"):
            fills = getattr(self, name)
            if not fills or not np.isfinite(fills).all():
                raise ConfigurationError(f"SORLC.{name} must be finite numbers, at least one, got {fills}")

    def _require_theorem_1(self) -> None:
        """Check the gain conditions (42), except the one on xi_e, which the paper does not define (erratum 14)."""
        conditions = {
            "xi_p > 2": self.position_error_gain > 2,
            "xi_v > 3": self.velocity_error_gain > 3,
            "xi_tau > 3/2": self.compensator_gain > 1.5,
            "gamma_a > 1/(2 beta_V^2)": self.actor_rate > 0.5 / self.control_weight**2,
            "gamma_a > gamma_c > gamma_a/2": self.actor_rate > self.critic_rate > self.actor_rate / 2,
        }
        broken = [name for name, holds in conditions.items() if not holds]
        finite = np.isfinite([self.position_error_gain, self.velocity_error_gain, self.compensator_gain])
        if broken or not finite.all():
            raise ConfigurationError(f"SORLC gains break condition (42): {', '.join(broken) or 'not finite'} ({self})")

    @classmethod
    def scaled(cls, **changes: Any) -> "SORLC":
        """SORLC with the scaled basis and its own learning gains, chosen from the sweep that ``marlbc ablation`` prints.

        The identifier's bandwidth is Gamma_f Psi^T Psi / 100. A rate of 1000 and a width of 6 make it about 90 rad/s, a factor
        of 8 below the bandwidth at which the loop starts to oscillate with a substep of 5 ms.
        """
        return cls(**{"basis": "scaled", "identifier_rate": 1000.0, "identifier_leak": 1e-3, "width": 6.0, **changes})

    @property
    def linear_gains(self) -> tuple[float, float]:
        return self.position_error_gain, self.velocity_error_gain

    @property
    def decay_rates(self) -> tuple[float, ...]:
        """Decay rates of the compensator (30) and of the identifier through its leak (37) [1/s]."""
        return self.compensator_gain, self.identifier_rate * self.identifier_leak

    def params(self, agent: int, limit: float) -> dict[str, Any]:
        relative = self.basis == "scaled"
        distance = 2.0 * self.centre_range / (NEURONS - 1)
        return laws.gains_of(
            self,
            limit=limit,
            learns=self.basis != "off",
            relative=relative,
            tau_scale=self.tau_scale if relative else 1.0,
            first_centre=-self.centre_range,
            centre_distance=distance,
            precision=1.0 / self.width**2,
            chi_factor=np.exp(-8.0 * (distance / self.width) ** 2),
            tau_factor=np.exp(-4.0 * (distance / self.width) ** 2),
        )

    def initial_state(self, agent: int) -> dict[str, Any]:
        fills = {"w_f": self.identifier_weights, "w_a": self.actor_weights, "w_c": self.critic_weights}
        return {"scale": 1.0, **{name: values[agent % len(values)] for name, values in fills.items()}}
