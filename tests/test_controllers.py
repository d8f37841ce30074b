"""Controllers against (30), (36)-(41) written out in NumPy and against closed forms; checks of gains and substeps."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.controllers import CONTROLLERS, PD, SORLC, Controller, largest_stable_substep, make_controller
from marlbc_mj.controllers.sorlc import NEURONS, STATE, weights
from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError

H = 0.005  # [s]
ZERO = np.zeros(2)
BASIS_TOLERANCE = 2e-13


def call(controller: Controller, state, p, v, p_r, v_r, *, limit=200.0, h=H, agent=0) -> np.ndarray:
    """Force of one substep; ``state`` is the row of the law's state, changed in place."""
    law, force = controller.law, np.full(2, np.nan)
    law(
        laws.as_gains(law, controller.params(agent, limit)), laws.interface(law).state.view(state), p, v, p_r, v_r, ZERO, h, force
    )
    return force


def start(controller: Controller, agent: int = 0) -> np.ndarray:
    """The row of a law's state at t = 0."""
    return laws.pack_state(controller.law, controller.initial_state(agent))


class Textbook:
    """One agent's SORLC as published: (12, 2) weight matrices, one exponential for every Gaussian, explicit Euler."""

    def __init__(self, gains: SORLC, agent: int) -> None:
        self.gains = gains
        self.w_f = np.full((12, 2), gains.identifier_weights[agent])
        self.w_a = np.full((12, 2), gains.actor_weights[agent])
        self.w_c = np.full((12, 2), gains.critic_weights[agent])
        self.tau = np.zeros(2)
        self.centres = np.linspace(-gains.centre_range, gains.centre_range, 12)

    def gaussians(self, z) -> np.ndarray:
        """Psi_k(z) = exp(-|z - c_k|^2 / width^2), every coordinate of c_k the same."""
        return np.exp(-((z - self.centres[:, None]) ** 2).sum(axis=1) / self.gains.width**2)

    def step(self, p, v, p_r, v_r, limit, h) -> np.ndarray:
        g = self.gains
        e_p, e_v = p - p_r, v - v_r
        chi, tau = np.concatenate([p, v]), self.tau
        if g.basis == "scaled":
            chi = np.concatenate([e_p / g.position_scale, e_v / g.velocity_scale])
            tau = self.tau / g.tau_scale
        learns = g.basis != "off"
        psi_f = learns * self.gaussians(chi)
        psi_v = learns * self.gaussians(np.concatenate([chi, tau]))
        f_hat = self.w_f.T @ psi_f  # (36)
        u_0 = (  # (40), the nominal input (erratum 1), with the sign of tau open (erratum 2)
            -g.position_error_gain * e_p
            - g.velocity_error_gain * e_v
            - f_hat
            + g.tau_sign * self.tau
            - self.w_a.T @ psi_v / (2 * g.control_weight)
        )
        u = np.clip(u_0, -limit, limit)  # (2)
        d_tau = -g.compensator_gain * self.tau + (u - u_0)  # (30), (4)
        d_f = g.identifier_rate * (np.outer(psi_f, e_p + e_v) - g.identifier_leak * self.w_f)  # (37)
        outer = np.outer(psi_v, psi_v)
        d_c = -g.critic_rate * outer @ self.w_c  # (39)
        d_a = -outer @ (g.actor_rate * (self.w_a - self.w_c) + g.critic_rate * self.w_c)  # (41)
        self.tau = self.tau + h * d_tau
        if learns:
            self.w_f, self.w_c, self.w_a = self.w_f + h * d_f, self.w_c + h * d_c, self.w_a + h * d_a
        return u


def assert_close(actual, expected, relative=1e-12):
    """Compare with a tolerance relative to the largest entry, or to 1 if that is larger."""
    np.testing.assert_allclose(actual, expected, rtol=0, atol=relative * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("tau_sign", [-1, 1])
@pytest.mark.parametrize("basis", ["published", "scaled", "own scales", "off"])
def test_sorlc_is_the_textbook_law(basis, tau_sign):
    """Force, weights and tau equal (30), (36)-(41) over 2000 substeps of random states, some of them saturated."""
    if basis == "own scales":
        changes = {"position_scale": 0.5, "velocity_scale": 3.0, "tau_scale": 7.0, "control_weight": 1.3}
        gains = SORLC.scaled(tau_sign=tau_sign, **changes)
    else:
        gains = SORLC.scaled(tau_sign=tau_sign) if basis == "scaled" else SORLC(basis=basis, tau_sign=tau_sign)
    rng = np.random.default_rng(0)
    agent, limit = 2, 150.0
    textbook, state = Textbook(gains, agent), start(gains, agent)
    numbers, record = laws.as_gains(gains.law, gains.params(agent, limit)), laws.interface(gains.law).state.view(state)
    saturated, force = 0, np.full(2, np.nan)
    for _ in range(2000):
        p, v = rng.uniform(-4, 4, 2), rng.uniform(-4, 4, 2)
        p_r, v_r = p + rng.uniform(-1, 1, 2), v + rng.uniform(-1, 1, 2)
        expected = textbook.step(p, v, p_r, v_r, limit, H)
        gains.law(numbers, record, p, v, p_r, v_r, ZERO, H, force)
        saturated += np.abs(force).max() == limit
        assert_close(force, expected)
    assert 100 < saturated < 1900
    w_f, w_a, w_c, tau = weights(state)
    for actual, reference in ((w_f, textbook.w_f), (w_a, textbook.w_a), (w_c, textbook.w_c), (tau, textbook.tau)):
        assert_close(actual, reference)
    if basis != "off":
        assert not np.allclose(w_a, gains.actor_weights[agent])  # so the comparison includes learning


def test_sorlc_off_is_pd_with_the_compensator():
    """Without networks u = clip(-100 e_p - 100 e_v - tau), which is PD as long as nothing saturates."""
    rng = np.random.default_rng(1)
    off, pd = SORLC(basis="off"), PD()
    state = start(off)
    for _ in range(200):
        p, v, p_r, v_r = rng.uniform(-0.4, 0.4, (4, 2))
        np.testing.assert_allclose(call(off, state, p, v, p_r, v_r), call(pd, np.zeros(0), p, v, p_r, v_r), rtol=1e-14)
    assert not weights(state).tau.any()


def test_far_from_its_centres_the_published_basis_is_silent():
    """At positions beyond [-6, 6], Psi = 0: actor and critic do not change, and the identifier only leaks (erratum 13)."""
    gains = SORLC()
    state = start(gains)
    p = np.array([100.0, 6.0])
    force = call(gains, state, p, ZERO, p - 0.1, ZERO)
    np.testing.assert_allclose(force, [-10.0, -10.0], rtol=1e-12)
    w_f, w_a, w_c, tau = weights(state)
    np.testing.assert_allclose(w_f, 1.0 - H * 0.4 * 0.6, rtol=1e-14)
    assert (w_a == 0.5).all() and (w_c == 1.0).all() and not tau.any()


def gaussians_of(gains: SORLC, p, v) -> np.ndarray:
    """Psi_f(chi): the identifier weights (37) after one step from zero without leak, with h Gamma_f (e_p + e_v) = 1."""
    gains = replace(gains, identifier_weights=(0.0,), identifier_leak=0.0, identifier_rate=1.0 / H)
    state = start(gains)
    call(gains, state, p, v, p - 0.5, v - 0.5)
    return weights(state).identifier


def basis_error(middle, offsets, width) -> float:
    """Largest difference between the law's basis and twelve separate exponentials; the largest Psi possible is 1."""
    z = middle + np.array(offsets)
    expected = np.exp(-((z - np.linspace(-6.0, 6.0, NEURONS)[:, None]) ** 2).sum(axis=1) / width**2)
    actual = gaussians_of(SORLC(width=width), z[:2], z[2:])
    return float(np.abs(actual - expected[:, None]).max())


@given(st.floats(-8, 8), st.floats(0.0, 20.0), st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.floats(2.0, 8.0))
def test_two_exponentials_are_twelve_gaussians(middle, spread, offsets, width):
    """Psi_k = exp(-|chi - c_k 1|^2 / width^2), c_k evenly spaced on [-6, 6], on and off the diagonal, for the widths in use."""
    assert basis_error(middle, spread * np.array(offsets), width) < BASIS_TOLERANCE


@pytest.mark.parametrize("width", [0.5, 0.2])
def test_narrow_gaussians_are_right_or_refused(width):
    """A width so small that exp(-|c_12 - c_1|^2 / width^2) underflows must not set the far Gaussians to 0."""
    try:
        gains = SORLC(width=width)
    except ConfigurationError:
        return  # a refusal is also right
    assert basis_error(6.0, np.zeros(4), gains.width) < BASIS_TOLERANCE


@pytest.mark.parametrize("tau_sign", [-1, 1])
def test_compensator_under_constant_saturation(tau_sign):
    """At the limit L: tau_k = (L - w) (1 - (1 - h (xi_tau + s))^k) / (xi_tau + s), s the sign of tau in (40), w = u_0 - s tau."""
    gains = SORLC(basis="off", tau_sign=tau_sign)
    state = start(gains)
    p = np.array([-5.0, 7.0])
    wish, limit = -100.0 * p, np.array([200.0, -200.0])
    rate = gains.compensator_gain + tau_sign
    for k in range(1, 400):
        force = call(gains, state, p, ZERO, ZERO, ZERO)
        assert (force == limit).all()
        expected = (limit - wish) / rate * (1.0 - (1.0 - H * rate) ** k)
        np.testing.assert_allclose(weights(state).tau, expected, rtol=1e-12)


def test_tau_decays_once_the_input_is_free():
    """tau_{k+1} = (1 - h xi_tau) tau_k without saturation (30)."""
    gains = SORLC(basis="off")
    state = start(gains)
    STATE.view(state).tau[:] = (1.0, -2.0)
    for k in range(1, 50):
        call(gains, state, ZERO, ZERO, ZERO, ZERO)
        np.testing.assert_allclose(weights(state).tau, np.array([1.0, -2.0]) * (1.0 - 50.0 * H) ** k, rtol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1e3), st.floats(0.1, 1e3), st.floats(0.1, 1e3))
def test_pd_closed_form(seed, k_p, k_v, limit):
    """u = clip(-k_p e_p - k_v e_v, +-limit) per axis."""
    p, v, p_r, v_r = np.random.default_rng(seed).normal(size=(4, 2))
    force = call(PD(k_p, k_v), np.zeros(0), p, v, p_r, v_r, limit=limit)
    np.testing.assert_allclose(force, np.clip(-k_p * (p - p_r) - k_v * (v - v_r), -limit, limit), rtol=1e-13, atol=1e-12)


@given(st.floats(1e-2, 1e4), st.floats(1e-2, 1e3))
def test_largest_stable_substep_is_where_the_spectral_radius_is_one(k_p, k_v):
    """v += h (-k_p e - k_v v), e += h v is stable just below this substep, and unstable just above it."""

    def spectral_radius(h):
        step = np.array([[1.0 - h * h * k_p, h * (1.0 - h * k_v)], [-h * k_p, 1.0 - h * k_v]])
        return np.abs(np.linalg.eigvals(step)).max()

    limit = largest_stable_substep(k_p, k_v)
    assert spectral_radius(limit * (1 - 1e-3)) < 1.0 < spectral_radius(limit * (1 + 1e-3))


def test_the_papers_gains_need_substeps_below_19_8_ms():
    """For gains 100 and 100, h < 19.8 ms; without a position gain the limit is 20 ms, without both gains infinite."""
    assert largest_stable_substep(100.0, 100.0) == pytest.approx(0.0198, abs=5e-5)
    assert largest_stable_substep(0.0, 100.0) == pytest.approx(0.02)
    assert largest_stable_substep(0.0, 0.0) == np.inf
    assert largest_stable_substep(1e-14, 100.0) == pytest.approx(0.02)


@pytest.mark.parametrize(
    "broken",
    [
        {"position_error_gain": 2.0},
        {"velocity_error_gain": 3.0},
        {"compensator_gain": 1.5},
        {"actor_rate": 4.0},
        {"critic_rate": 3.0},
        {"critic_rate": 6.0},
        {"control_weight": 0.2},
        {"position_error_gain": np.inf},
        {"velocity_error_gain": np.nan},
    ],
    ids=str,
)
def test_gains_that_break_condition_42_are_refused(broken):
    """xi_p > 2, xi_v > 3, xi_tau > 3/2, gamma_a > 1/(2 beta_V^2), gamma_a > gamma_c > gamma_a/2, strict; the value is shown."""
    with pytest.raises(ConfigurationError, match=r"condition \(42\)") as error:
        SORLC(**broken)
    for name, value in broken.items():
        assert f"{name}={value}" in str(error.value)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 0.0])
@pytest.mark.parametrize("name", ["identifier_rate", "centre_range", "width", "position_scale", "velocity_scale", "tau_scale"])
def test_sorlc_settings_must_be_positive_and_finite(name, value):
    """The message names the setting and the value."""
    with pytest.raises(ConfigurationError, match=f"{name} .* {value}"):
        SORLC(**{name: value})


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["position_gain", "velocity_gain"])
def test_pd_gains_must_be_positive_and_finite(name, value):
    """The message names the gain and the value."""
    with pytest.raises(ConfigurationError, match=f"{name} .* {value}"):
        PD(**{name: value})


def test_unknown_names_are_refused_with_the_valid_ones():
    """This holds for controllers, bases and the sign of tau."""
    with pytest.raises(ConfigurationError, match="'nonsense'; choose from: sorlc"):
        make_controller("nonsense")
    with pytest.raises(ConfigurationError, match="'nonsense'; choose from: published, scaled, off"):
        SORLC(basis="nonsense")
    with pytest.raises(ConfigurationError, match="tau_sign .* 0"):
        SORLC(tau_sign=0)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_named_controller_keeps_the_protocol(name):
    """It has a factory, a law, finite gains for any agent, a new state per call, and obeys its force limit."""
    controller = make_controller(name)
    assert isinstance(controller, Controller)
    assert np.isfinite(laws.pack_gains(controller.law, controller.params(7, 200.0))).all()
    first, second = start(controller), start(controller)
    assert first is not second and (first == second).all()
    force = call(controller, first, np.ones(2), ZERO, ZERO, ZERO)
    assert (force < 0).all() and (np.abs(force).max() <= 200.0 or not controller.limited)


def test_weights_start_as_the_paper_fills_them():
    """They are constant matrices, with the values of section 4.1 for each agent; tau(0) = 0."""
    for agent, (f, a, c) in enumerate([(1, 0.5, 1), (0.98, 0.48, 0.96), (0.96, 0.46, 0.92), (0.94, 0.44, 0.88)]):
        w_f, w_a, w_c, tau = weights(start(SORLC(), agent))
        assert w_f.shape == w_a.shape == w_c.shape == (12, 2)
        assert (w_f == f).all() and (w_a == a).all() and (w_c == c).all() and not tau.any()
