"""SORLC, the second-order reinforcement learning controller: equations (30) and (36)-(41), errata 1, 2, 13 and 14.

Identifier, critic and actor are linear in 12 Gaussians whose centres lie on the diagonal, c_k = (c_k, ..., c_k). Then
|z - c_k|^2 = |z|^2 - 2 c_k sum(z) + n c_k^2, and neighbours differ by a factor that is itself geometric in k: two
exponentials give all twelve values, equal to the textbook form to 1e-13.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from marlbc_mj.controllers.base import require_gains
from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError, unknown

NEURONS = 12
_F, _A, _C, _PSI_F, _PSI_V, _SCALE = (row * NEURONS for row in (0, 2, 4, 6, 7, 8))  # offsets in the state; weights axis by axis
_TAU = _SCALE + 1  # omega_f is the stored numbers times state[_SCALE]: a leak of them all is one multiplication
STATE_SIZE = _TAU + 2

BASES = ("printed", "scaled", "off")
NEGLIGIBLE = 45.0  # exp(-45) = 3e-20 is taken as zero


class Weights(NamedTuple):
    """One agent's adaptive state in the paper's shapes."""

    identifier: np.ndarray  # omega_f (12, 2)
    actor: np.ndarray  # omega_a (12, 2)
    critic: np.ndarray  # omega_c (12, 2)
    tau: np.ndarray  # (2,) compensator of (30)


@laws.allocation_free
def diagonal_gaussians(square, total, n, first, step, precision, factor, out, at):  # type: ignore[no-untyped-def]
    """exp(-precision |z - c_k 1|^2) for c_k = first + k step, from |z|^2, sum(z) and the dimension n of z.

    ``precision`` = 1 / width^2, ``factor`` = exp(-2 n step^2 precision). Written to ``out[at : at + 12]``; returns False
    and leaves it
    alone where every value is below 3e-20, which no force can feel.
    """
    last = first + (NEURONS - 1) * step
    closest = min(max(total, n * first), n * last)  # n times the centre nearest to z
    if precision * (square * n - closest * (2.0 * total - closest)) > NEGLIGIBLE * n:
        return False
    value = np.exp(-precision * (square - first * (2.0 * total - n * first)))
    ratio = np.exp(precision * step * (2.0 * total - n * (2.0 * first + step)))
    for k in range(NEURONS):
        out[at + k] = value
        value *= ratio
        ratio *= factor
    return True


@laws.controller
def sorlc(params, state, p, v, p_r, v_r, drag, h, force_out):  # type: ignore[no-untyped-def]
    """One substep of SORLC: force (40) from the current weights, then weights and tau by explicit Euler.

    ``params`` = xi_p, xi_v, xi_tau, Gamma_f, nu_f, gamma_c, gamma_a, 1 / (2 beta_V), sign of tau, limit [N], networks on
    (0 or 1), basis relative to the reference (0 or 1), scale of p [m], of v [m/s], of tau [N], first centre, distance of
    centres, 1 / width^2, and the factors of :func:`diagonal_gaussians` for n = 4 and n = 2.
    """
    active = params[10] != 0.0 and _basis(params, state, p, v, p_r, v_r)
    leak = 1.0 - h * params[3] * params[4]
    if params[10] != 0.0 and not active:
        state[_SCALE] *= leak  # with Psi_f = 0 (37) only leaks
    elif state[_SCALE] != 1.0:
        for k in range(2 * NEURONS):
            state[_F + k] *= state[_SCALE]
        state[_SCALE] = 1.0
    for axis in range(2):
        position_error = p[axis] - p_r[axis]
        velocity_error = v[axis] - v_r[axis]
        nominal = -params[0] * position_error - params[1] * velocity_error + params[8] * state[_TAU + axis]
        if active:
            nominal += _actor_critic(params, state, axis, h)
            gain = h * params[3] * (position_error + velocity_error)
            for k in range(NEURONS):
                state[_F + axis * NEURONS + k] = leak * state[_F + axis * NEURONS + k] + gain * state[_PSI_F + k]
        force = laws.clip(nominal, params[9])
        force_out[axis] = force
        state[_TAU + axis] += h * (force - nominal - params[2] * state[_TAU + axis])


@laws.inlined
def _actor_critic(params, state, axis, h):  # type: ignore[no-untyped-def]
    """-f^ - actor / (2 beta_V) of (40) for one axis, then one Euler step of critic (39) and actor (41)."""
    f_hat, actor, critic = 0.0, 0.0, 0.0
    for k in range(NEURONS):
        f_hat += state[_F + axis * NEURONS + k] * state[_PSI_F + k]
        actor += state[_A + axis * NEURONS + k] * state[_PSI_V + k]
        critic += state[_C + axis * NEURONS + k] * state[_PSI_V + k]
    d_actor = h * (params[6] * (actor - critic) + params[5] * critic)
    d_critic = h * params[5] * critic
    for k in range(NEURONS):
        state[_A + axis * NEURONS + k] -= d_actor * state[_PSI_V + k]
        state[_C + axis * NEURONS + k] -= d_critic * state[_PSI_V + k]
    return -f_hat - params[7] * actor


@laws.inlined
def _basis(params, state, p, v, p_r, v_r):  # type: ignore[no-untyped-def]
    """Fill Psi_f(chi) and Psi_V(chi, tau) in the state; False, and nothing filled, where both vanish."""
    if params[11] != 0.0:
        z0, z1 = (p[0] - p_r[0]) / params[12], (p[1] - p_r[1]) / params[12]
        z2, z3 = (v[0] - v_r[0]) / params[13], (v[1] - v_r[1]) / params[13]
    else:
        z0, z1, z2, z3 = p[0], p[1], v[0], v[1]
    first, step, precision = params[15], params[16], params[17]
    square = z0 * z0 + z1 * z1 + z2 * z2 + z3 * z3
    if not diagonal_gaussians(square, z0 + z1 + z2 + z3, 4.0, first, step, precision, params[18], state, _PSI_F):
        return False
    t0, t1 = state[_TAU] / params[14], state[_TAU + 1] / params[14]
    if not diagonal_gaussians(t0 * t0 + t1 * t1, t0 + t1, 2.0, first, step, precision, params[19], state, _PSI_V):
        for k in range(NEURONS):
            state[_PSI_V + k] = 0.0
    for k in range(NEURONS):
        state[_PSI_V + k] *= state[_PSI_F + k]
    return True


def weights(state: np.ndarray) -> Weights:
    """Read one agent's state (S,), or a stack of them (..., S), as weight matrices (..., 12, 2)."""
    shape = (*state.shape[:-1], 2, NEURONS)
    identifier, actor, critic = (state[..., at : at + 2 * NEURONS].reshape(shape).swapaxes(-1, -2) for at in (_F, _A, _C))
    return Weights(identifier * state[..., _SCALE, None, None], actor, critic, state[..., _TAU:])


@dataclass(frozen=True)
class SORLC:
    """Gains of Table 2, and the readings of the basis.

    ``printed`` follows the paper: positions leave [-6, 6] within 10 s, the basis vanishes and SORLC is a saturated PD law.
    ``scaled``
    feeds the basis the tracking errors over ``position_scale`` and ``velocity_scale`` instead, so the identifier sees
    signals inside its range along the whole run; ``off`` has no networks. With the printed Gamma_f and nu_f the leak
    holds the identifier below a fifth of the PD terms, so ``scaled`` has its own: see :meth:`scaled`.
    """

    basis: Literal["printed", "scaled", "off"] = "printed"
    position_error_gain: float = 100.0  # xi_p [1/s^2]
    velocity_error_gain: float = 100.0  # xi_v [1/s]
    compensator_gain: float = 50.0  # xi_tau [1/s]
    identifier_rate: float = 0.4  # Gamma_f = rate * I
    identifier_leak: float = 0.6  # nu_f
    critic_rate: float = 4.0  # gamma_c
    actor_rate: float = 6.0  # gamma_a
    control_weight: float = 1.0  # beta_V
    tau_sign: Literal[-1, 1] = -1  # sign of tau in (40); +1 is the reading of erratum 2
    identifier_weights: tuple[float, ...] = (1.0, 0.98, 0.96, 0.94)  # constant fill of omega_f(0), one per agent
    actor_weights: tuple[float, ...] = (0.5, 0.48, 0.46, 0.44)
    critic_weights: tuple[float, ...] = (1.0, 0.96, 0.92, 0.88)
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
        """Gain conditions (42), without the one on xi_e, which the paper does not define (erratum 14)."""
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
    def scaled(cls, **changes: object) -> "SORLC":
        """The scaled basis with learning gains of its own, chosen from the sweep that ``marlbc ablation`` prints.

        Gamma_f Psi^T Psi / 100 is the identifier's bandwidth: 1000 and width 6 make it about 90 rad/s, a factor 8 below
        where a substep of
        5 ms starts to oscillate.
        """
        gains: dict[str, object] = {"identifier_rate": 1000.0, "identifier_leak": 1e-3, "width": 6.0}
        return cls(basis="scaled", **{**gains, **changes})  # type: ignore[arg-type]

    @property
    def linear_gains(self) -> tuple[float, float]:
        return self.position_error_gain, self.velocity_error_gain

    @property
    def decay_rates(self) -> tuple[float, ...]:
        """Of the compensator (30) and of the identifier's leak (37) [1/s]."""
        return self.compensator_gain, self.identifier_rate * self.identifier_leak

    def params(self, agent: int, limit: float) -> tuple[float, ...]:
        relative = self.basis == "scaled"
        step = 2.0 * self.centre_range / (NEURONS - 1)
        return (
            self.position_error_gain,
            self.velocity_error_gain,
            self.compensator_gain,
            self.identifier_rate,
            self.identifier_leak,
            self.critic_rate,
            self.actor_rate,
            0.5 / self.control_weight,
            float(self.tau_sign),
            limit,
            float(self.basis != "off"),
            float(relative),
            self.position_scale,
            self.velocity_scale,
            self.tau_scale if relative else 1.0,
            -self.centre_range,
            step,
            1.0 / self.width**2,
            float(np.exp(-8.0 * (step / self.width) ** 2)),
            float(np.exp(-4.0 * (step / self.width) ** 2)),
        )

    def initial_state(self, agent: int) -> np.ndarray:
        state = np.zeros(STATE_SIZE)
        state[_SCALE] = 1.0
        for at, fills in (
            (_F, self.identifier_weights),
            (_A, self.actor_weights),
            (_C, self.critic_weights),
        ):
            state[at : at + 2 * NEURONS] = fills[agent % len(fills)]
        return state
