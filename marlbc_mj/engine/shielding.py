"""A shield's assumptions, taken from a scenario where they are left open, and checked before anything runs."""

import numpy as np

from marlbc_mj.core.shield import ForceBound, Shield, ShieldNumbers, retreat_drift, stopping_distance
from marlbc_mj.robots import Robot, make_robot
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError

GREATEST_SHARE = 0.25
"""Of the force limit, that f may take at the speed |v| = h U / m, so that stopping within a substep and retreating keep S."""
CREEP = 2.0
"""Retreats at rest, each with its :func:`drift`, that the margin has room for where several things press at once."""
FASTEST = 1e3  # speed cap where f does not grow with the speed [m/s]
LEAST_CREEP = 1e-5  # more, for the drift of a slow motion that ends [m]


def resolve(shield: Shield, scenario: Scenario, limit: float) -> ShieldNumbers:
    """The assumptions of a shield for one scenario, as numbers.

    Args:
        shield: what is assumed; None in a field takes the scenario's.
        scenario: the problem instance.
        limit: of the actuators per axis [N]; infinite for an unlimited law.

    Raises:
        ConfigurationError: an assumption that does not hold, with the number that breaks it.
    """
    robot = make_robot(scenario.robot)
    _check_plant(shield, scenario, robot)
    force = scenario.force_limit if shield.force_limit is None else shield.force_limit
    if not 0.0 < force <= limit:
        raise ConfigurationError(
            f"shield: the force limit must be positive and at most the actuators' {limit:g} N, got {force:g} N"
        )
    bound = _force_bound(shield, scenario, robot)
    _check_bound(bound, force, scenario)
    cap = _speed_cap(bound, force) if shield.speed_cap is None else shield.speed_cap
    if not bound.at(cap) < force:
        raise ConfigurationError(
            f"shield: at the speed cap of {cap:g} m/s the disturbance may be {bound.at(cap):.3g} N, so a force limit of "
            f"{force:g} N leaves nothing to brake with; lower speed_cap"
        )
    kept = scenario.safe_distance if shield.clearance is None else shield.clearance
    between = 2.0 * robot.radius if shield.agent_distance is None else shield.agent_distance
    numbers = ShieldNumbers(
        force_limit=float(force),
        box=float(limit),
        mass=float(scenario.mass),
        **{name: float(value) for name, value in bound._asdict().items()},
        speed_cap=float(cap),
        clearance=float(kept),
        agent_distance=float(between),
        velocity_error=float(shield.velocity_error),
    )
    creep = LEAST_CREEP + CREEP * retreat_drift(numbers, scenario.substep, 0.0)
    numbers = numbers._replace(
        clearance=numbers.clearance + shield.margin + creep + shield.position_error,
        agent_distance=numbers.agent_distance + shield.margin + 2.0 * (creep + shield.position_error),
        slack=creep,
    )
    check_start(numbers, np.array(scenario.starts, dtype=np.float64), scenario.obstacle_array())
    return numbers


def _check_plant(shield: Shield, scenario: Scenario, robot: Robot) -> None:
    """Raise ConfigurationError for a plant that the stopping ball does not describe."""
    if robot.force_error is None and shield.force_error is None:
        raise ConfigurationError(
            f"shield: robot {robot.name!r} has no braking identification: its force_error is missing, a bound [N] of what moves "
            "it within one substep, in every direction, besides the planar force and the disturbance"
        )
    if scenario.moving:
        raise ConfigurationError(
            f"shield: obstacles of scenario {scenario.name!r} move; only obstacles at rest are kept clear of"
        )
    errors = scenario.imperfections
    blurred = (errors.position_noise > 0 or errors.delay > 0) and shield.position_error == 0
    if blurred or ((errors.velocity_noise > 0 or errors.delay > 0) and shield.velocity_error == 0):
        raise ConfigurationError(
            f"shield: sensors have noise of {errors.position_noise:g} m and {errors.velocity_noise:g} m/s and are "
            f"{errors.delay:g} s late; position_error and velocity_error must bound what that makes, got "
            f"{shield.position_error:g} m and {shield.velocity_error:g} m/s"
        )


def _force_bound(shield: Shield, scenario: Scenario, robot: Robot) -> ForceBound:
    """Bound of all that is not u: the disturbance at the greatest scale that is drawn, and the robot's own error."""
    error = robot.force_error if shield.force_error is None else shield.force_error
    assert error is not None
    bound = shield.disturbance
    if bound is None:
        offered = getattr(scenario.disturbance, "force_bound", None)
        if offered is None:
            raise ConfigurationError(
                f"shield: disturbance {type(scenario.disturbance).__name__} has no force_bound(); "
                "give Shield(disturbance=ForceBound(...))"
            )
        scale = max(map(abs, scenario.perturbation.drag_scale))
        bound = ForceBound(*(scale * number for number in offered()))
    return bound._replace(constant=bound.constant + error)


def _check_bound(bound: ForceBound, force: float, scenario: Scenario) -> None:
    """Raise ConfigurationError for a disturbance too strong for the force limit."""
    speed = scenario.substep * force / scenario.mass
    if bound.at(speed) > GREATEST_SHARE * force:
        raise ConfigurationError(
            f"shield: at {speed:.3g} m/s, which the force limit of {force:g} N reaches within a substep, the disturbance may be "
            f"{bound.at(speed):.3g} N; it must be at most {GREATEST_SHARE * force:.3g} N, {GREATEST_SHARE:g} of the limit"
        )


def _speed_cap(bound: ForceBound, force: float) -> float:
    """The speed at which f takes half of what it leaves of the force limit at rest, at most FASTEST [m/s]."""
    half = 0.5 * (force - bound.constant)
    if bound.quadratic > 0.0:
        root = np.sqrt(bound.linear**2 + 4.0 * bound.quadratic * half)
        return min(float(2.0 * half / (bound.linear + root)), FASTEST)
    return min(half / bound.linear, FASTEST) if bound.linear > 0.0 else FASTEST


def check_start(numbers: ShieldNumbers, starts: np.ndarray, obstacles: np.ndarray) -> None:
    """Raise ConfigurationError unless agents at rest at ``starts`` (N, 2) [m] among ``obstacles`` (K, 3) are in the safe set."""
    stop = stopping_distance(numbers, numbers.velocity_error)
    gaps = np.linalg.norm(starts[:, None] - obstacles[None, :, :2], axis=-1) - obstacles[:, 2]
    for i, k in np.argwhere(gaps < numbers.clearance + stop)[:1].tolist():
        raise ConfigurationError(
            f"shield: agent {i + 1} starts at a clearance of {gaps[i, k]:.3f} m from obstacle {k + 1}, where at least "
            f"{numbers.clearance + stop:.3f} m is kept"
        )
    between = np.linalg.norm(starts[:, None] - starts[None], axis=-1) + np.diag(np.full(len(starts), np.inf))
    for i, j in np.argwhere(between < numbers.agent_distance + 2.0 * stop)[:1].tolist():
        raise ConfigurationError(
            f"shield: agents {i + 1} and {j + 1} start {between[i, j]:.3f} m apart, where at least "
            f"{numbers.agent_distance + 2.0 * stop:.3f} m is kept"
        )
