"""Assumptions of a shield, completed from a scenario and checked before anything runs."""

from dataclasses import replace
from statistics import NormalDist

import numpy as np

from marlbc_mj.controllers import PD, SORLC, Controller
from marlbc_mj.core.motion import obstacles_at
from marlbc_mj.core.shield import Shield
from marlbc_mj.core.stopping import ForceBound, ShieldNumbers, following_distance, retreat_drift, stopping_distance
from marlbc_mj.robots import Robot, RobotFleet
from marlbc_mj.scenarios import Draw, Scenario
from marlbc_mj.scenarios.layout import motion_array
from marlbc_mj.util.errors import ConfigurationError

GREATEST_SHARE = 0.25
"""Greatest share of the force limit that f may take at the speed |v| = h U / m, so that stopping within a substep and retreating
keep the state in S."""
GREATEST_ERROR = 0.5
"""Greatest share of the force limit that f and the robot's own error may take at that speed, so that a retreat makes up for what
a stop costs."""
CREEP = 2.0
"""Number of retreats at rest, each with its :func:`retreat_drift`, that the margin allows when several things are near."""
FASTEST = 1e3  # greatest default speed cap, for an f that does not grow with the speed [m/s]
LEAST_CREEP = 1e-5  # added for the drift at the end of a slow motion [m]
TUBE_SLACK = 1.05  # factor on a computed tube for the effect of the substep, which the continuous-time response leaves out


def resolve(shield: Shield, scenario: Scenario, limit: float, controller: Controller | None = None) -> ShieldNumbers:
    """The numbers of a shield for one scenario, a shield of forces or of references, see ``Shield.level``.

    Args:
        shield: the assumptions; None in a field takes the number of the scenario or the robot.
        scenario: the problem instance.
        limit: force limit of the actuators per axis [N]; infinite for an unlimited law.
        controller: the controller that tracks references; needed only for the tube around them.

    Raises:
        ConfigurationError: an assumption that does not hold, with the number that breaks it.
    """
    fleet = scenario.fleet
    robot = fleet.robots[0]
    known = robot.force_error is not None or shield.force_error is not None
    level = shield.level or ("reference" if shield.tube is not None or not known or fleet.mixed else "force")
    if level == "force" and fleet.mixed:
        raise ConfigurationError(
            f"shield: robots {fleet.words} brake differently, but a shield of forces assumes one mass, force limit and error for "
            "all; use a shield of references: Shield(level='reference')"
        )
    _check_sensors(shield, scenario)
    numbers = _of_forces(shield, scenario, robot, limit) if level == "force" else _of_references(shield, scenario, controller)
    starts = np.array(scenario.starts, dtype=np.float64)
    check_draw(numbers, Draw(starts, scenario.obstacle_array(), 1.0, motion_array(scenario.motions)))
    return numbers


def _of_forces(shield: Shield, scenario: Scenario, robot: Robot, limit: float) -> ShieldNumbers:
    """Numbers of a shield of forces."""
    if robot.force_error is None and shield.force_error is None:
        raise ConfigurationError(_missing(robot))
    force = scenario.force_limit if shield.force_limit is None else shield.force_limit
    if not 0.0 < force <= limit:
        raise ConfigurationError(
            f"shield: the force limit must be positive and at most the actuators' {limit:g} N, got {force:g} N"
        )
    bound = _disturbance_bound(shield, scenario)
    error = robot.force_error if shield.force_error is None else shield.force_error
    assert error is not None
    _check_bound(bound, error, force, scenario)
    bound = bound._replace(constant=bound.constant + error)
    cap = _speed_cap(bound, force) if shield.speed_cap is None else shield.speed_cap
    _check_braking(shield, scenario, bound, force, cap)
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
        velocity_error=float(shield.velocity_error + robot.slip),
        friction=float(robot.friction),
        obstacle_speed=float(shield.obstacle_speed) if scenario.moving else 0.0,
        obstacle_acceleration=float(shield.obstacle_acceleration) if scenario.moving else 0.0,
        **_messages(shield, scenario),
    )
    slipping = numbers._replace(constant=numbers.constant + scenario.mass * robot.slip / scenario.substep)
    creep = LEAST_CREEP + CREEP * retreat_drift(slipping, scenario.substep, 0.0)
    return numbers._replace(
        clearance=numbers.clearance + shield.margin + creep + shield.position_error,
        agent_distance=numbers.agent_distance + shield.margin + 2.0 * (creep + shield.position_error),
        slack=creep,
    )


def _of_references(shield: Shield, scenario: Scenario, controller: Controller | None) -> ShieldNumbers:
    """Numbers of a shield of references: references brake with the scenario's acceleration limit, and robots stay in a tube."""
    fleet = scenario.fleet
    if shield.mailed:
        raise ConfigurationError(
            "shield: messages may be late only in a shield of forces; in a shield of references every agent knows all references"
        )
    if scenario.moving:
        raise ConfigurationError(
            f"shield: obstacles of scenario {scenario.name!r} move; a shield of references supports only obstacles at rest"
        )
    if scenario.reference != "virtual" or not np.isfinite(scenario.acceleration_limit):
        raise ConfigurationError(
            f"shield: references of scenario {scenario.name!r} cannot be shielded: they must be virtual and of limited "
            f"acceleration, got {scenario.reference!r} and {scenario.acceleration_limit:g} m/s^2"
        )
    tube = _find_tube(shield, scenario, fleet, controller)
    kept = scenario.safe_distance if shield.clearance is None else shield.clearance
    between = 2.0 * fleet.radius if shield.agent_distance is None else shield.agent_distance
    return ShieldNumbers(
        force_limit=float(scenario.mass * scenario.acceleration_limit),
        box=np.inf,
        mass=float(scenario.mass),
        constant=0.0,
        linear=0.0,
        quadratic=0.0,
        speed_cap=float(scenario.speed_limit),
        clearance=float(kept + shield.margin + shield.position_error),
        agent_distance=float(between + shield.margin + 2.0 * shield.position_error),
        velocity_error=0.0,
        slack=LEAST_CREEP,
        tube=float(tube),
    )


def _messages(shield: Shield, scenario: Scenario) -> dict[str, float]:
    """Latency [substeps], loss quantile and silent agent, as fields of :class:`ShieldNumbers`."""
    substeps = shield.latency / scenario.substep
    if abs(substeps - round(substeps)) > 1e-9 * max(1.0, substeps):
        raise ConfigurationError(
            f"shield: the latency of {shield.latency:g} s must be a whole multiple of the substep {scenario.substep:g} s"
        )
    if not -1 <= shield.silent < scenario.agents:
        raise ConfigurationError(f"shield: silent must be -1 (none) or 0 to {scenario.agents - 1}, got {shield.silent}")
    loss = shield.message_loss
    quantile = -np.inf if loss == 0.0 else np.inf if loss == 1.0 else NormalDist().inv_cdf(loss)
    return {"latency": float(round(substeps)), "quantile": float(quantile), "silent": float(shield.silent)}


def _missing(robot: Robot) -> str:
    """Error message about what a robot lacks for a shield."""
    if robot.force_error is not None:
        return (
            f"shield: robot {robot.name!r} has no tube, the largest distance [m] from its reference, which a shield of "
            "references needs; give Shield(tube=...), or measure it: `python -m marlbc_mj.studies.shield_robots ROBOT`"
        )
    return (
        f"shield: robot {robot.name!r} has no braking identification: it lacks force_error, the bound [N] in every direction "
        "within one substep on forces other than the planar force and the disturbance, and tube, the largest distance [m] from "
        "its reference; `python -m marlbc_mj.studies.shield_robots ROBOT` measures both"
    )


def _find_tube(shield: Shield, scenario: Scenario, fleet: RobotFleet, controller: Controller | None) -> float:
    """Greatest distance of agents from their references [m]: given, computed for direct robots, or measured, in this order.

    In a mixed team the widest tube applies to all agents.
    """
    if shield.tube is not None:
        return shield.tube
    return max(_tube_of(robot, shield, scenario, controller) for robot in fleet.kinds)


def _tube_of(robot: Robot, shield: Shield, scenario: Scenario, controller: Controller | None) -> float:
    """Greatest distance of one robot from its reference [m]."""
    if robot.direct and not robot.contact and controller is not None:
        return tracking_tube(_with_one(scenario, robot), controller, _disturbance_bound(shield, scenario))
    if robot.tube is None:
        raise ConfigurationError(_missing(robot))
    gains = controller.linear_gains if isinstance(controller, PD | SORLC) else None
    if gains not in (robot.gains, PD().linear_gains):
        raise ConfigurationError(
            f"shield: robot {robot.name!r} stays within {robot.tube:g} m of its reference under PD and SORLC with the gains "
            f"{robot.gains} or {PD().linear_gains}, but {type(controller).__name__} has {gains}; give Shield(tube=...)"
        )
    return robot.tube


def _with_one(scenario: Scenario, robot: Robot) -> Scenario:
    """The scenario of a mixed team, with the mass and force limit of one of its robots for all agents."""
    if not scenario.robots:
        return scenario
    one = RobotFleet((robot,))
    (mass,), (unit,) = one.masses(scenario.mass).tolist(), one.masses(scenario.unit_force).tolist()
    limit = float(one.force_limits(scenario.force_limit)[0])
    return replace(scenario, robot=robot.name, robots=(), mass=mass, unit_force=unit, force_limit=limit)


def tracking_tube(scenario: Scenario, controller: Controller, bound: ForceBound) -> float:
    """Greatest distance of a point mass under PD, or SORLC without networks, from a reference of limited acceleration [m].

    The error obeys e'' + k_v e' + k_p e = f / m, and e' jumps by at most A T in every mission step. With k_v^2 >= 4 k_p the
    response g to a unit jump is positive, has one peak G and the integral 1 / k_p. So |e| <= (B / m + A) / k_p + A T G, as
    long as the force m (k_p e + k_v e') is below its limit, which is checked.

    Raises:
        ConfigurationError: another controller, underdamped gains, or a force beyond the limit.
    """
    if not (isinstance(controller, PD) or (isinstance(controller, SORLC) and controller.basis == "off")):
        raise ConfigurationError(
            f"shield: no tube is known for {type(controller).__name__}: only for PD and SORLC(basis='off'); give Shield(tube=...)"
        )
    k_p, k_v = (gain * scenario.unit_force / scenario.mass for gain in controller.linear_gains)
    if k_v**2 < 4.0 * k_p:
        raise ConfigurationError(f"shield: gains {k_p:g} and {k_v:g} overshoot; a tube needs k_v^2 >= 4 k_p")
    jump, brake = scenario.mission_step, scenario.acceleration_limit
    pull = bound.at(scenario.speed_limit) / scenario.mass + brake
    tube = TUBE_SLACK * (pull / k_p + brake * jump * _peak(k_p, k_v))
    error_rate = TUBE_SLACK * (2.0 * _peak(k_p, k_v) * pull + brake * jump)
    force = scenario.mass * (k_p * tube + k_v * error_rate)
    if not force <= scenario.force_limit:
        raise ConfigurationError(
            f"shield: following the references may need {force:.3g} N, more than the force limit of {scenario.force_limit:g} N; "
            "give Shield(tube=...)"
        )
    return float(tube)


def _peak(k_p: float, k_v: float) -> float:
    """Greatest value of the response g to a unit jump of e' [s], for k_v^2 >= 4 k_p."""
    root = np.sqrt(max(k_v**2 - 4.0 * k_p, 0.0))
    if root < 1e-6 * k_v:
        return float(2.0 / (np.e * k_v))
    fast, slow = 0.5 * (k_v + root), 0.5 * (k_v - root)
    at = np.log(fast / slow) / root
    return float((np.exp(-slow * at) - np.exp(-fast * at)) / root)


def _check_sensors(shield: Shield, scenario: Scenario) -> None:
    """Raise ConfigurationError if sensors have errors for which the shield gives no bound."""
    errors = scenario.imperfections
    blurred = (errors.position_noise > 0 or errors.delay > 0) and shield.position_error == 0
    if blurred or ((errors.velocity_noise > 0 or errors.delay > 0) and shield.velocity_error == 0):
        raise ConfigurationError(
            f"shield: sensors have noise of {errors.position_noise:g} m and {errors.velocity_noise:g} m/s and are "
            f"{errors.delay:g} s late; position_error and velocity_error must bound the resulting errors, got "
            f"{shield.position_error:g} m and {shield.velocity_error:g} m/s"
        )


def _disturbance_bound(shield: Shield, scenario: Scenario) -> ForceBound:
    """The shield's bound of the disturbance, or the disturbance's own at the greatest scale that is drawn."""
    if shield.disturbance is not None:
        return shield.disturbance
    offered = getattr(scenario.disturbance, "force_bound", None)
    if offered is None:
        raise ConfigurationError(
            f"shield: disturbance {type(scenario.disturbance).__name__} has no force_bound(); "
            "give Shield(disturbance=ForceBound(...))"
        )
    scale = max(map(abs, scenario.perturbation.drag_scale))
    return ForceBound(*(scale * number for number in offered()))


def _check_bound(bound: ForceBound, error: float, force: float, scenario: Scenario) -> None:
    """Raise ConfigurationError if a disturbance, alone or with the robot's own error, is too strong for the force limit."""
    speed = scenario.substep * force / scenario.mass
    for size, share, what in (
        (bound.at(speed), GREATEST_SHARE, "the disturbance"),
        (bound.at(speed) + error, GREATEST_ERROR, "the disturbance plus the robot's force error"),
    ):
        if size > share * force:
            raise ConfigurationError(
                f"shield: at {speed:.3g} m/s, which the force limit of {force:g} N reaches within a substep, {what} may be "
                f"{size:.3g} N; it must be at most {share * force:.3g} N, {share:g} of the limit"
            )


def _check_braking(shield: Shield, scenario: Scenario, bound: ForceBound, force: float, cap: float) -> None:
    """Raise ConfigurationError if no force is left to brake at the speed cap, or to follow a moving obstacle."""
    if not bound.at(cap) < force:
        raise ConfigurationError(
            f"shield: at the speed cap of {cap:g} m/s the disturbance may be {bound.at(cap):.3g} N, so a force limit of "
            f"{force:g} N leaves no force for braking; lower speed_cap"
        )
    if scenario.moving:
        fastest = cap + 2.0 * shield.obstacle_speed
        left = force - bound.at(fastest) - scenario.mass * shield.obstacle_acceleration
        if not left > 0.0:
            raise ConfigurationError(
                f"shield: near a moving obstacle agents may reach {fastest:g} m/s, where the disturbance and an obstacle "
                f"acceleration of {shield.obstacle_acceleration:g} m/s^2 leave {left:.3g} N of the force limit of {force:g} N"
            )


def _speed_cap(bound: ForceBound, force: float) -> float:
    """The speed at which half of the braking force at rest is left, at most FASTEST [m/s]."""
    half = 0.5 * (force - bound.constant)
    if bound.quadratic > 0.0:
        root = np.sqrt(bound.linear**2 + 4.0 * bound.quadratic * half)
        return min(float(2.0 * half / (bound.linear + root)), FASTEST)
    return min(half / bound.linear, FASTEST) if bound.linear > 0.0 else FASTEST


def check_draw(numbers: ShieldNumbers, draw: Draw) -> None:
    """Raise ConfigurationError unless agents at rest at a draw's starts are in the safe set and obstacles move as assumed."""
    speeds = _check_motions(numbers, draw.motions) if len(draw.motions) else np.zeros(len(draw.obstacles))
    starts, obstacles = draw.starts, obstacles_at(0.0, draw.obstacles, draw.motions)
    stop = stopping_distance(numbers, numbers.velocity_error)
    follow = np.array([max(stop, following_distance(numbers, speed + numbers.velocity_error)) for speed in speeds.tolist()])
    kept = numbers.clearance + numbers.tube + follow
    gaps = np.linalg.norm(starts[:, None] - obstacles[None, :, :2], axis=-1) - obstacles[:, 2]
    for i, k in np.argwhere(gaps < kept)[:1].tolist():
        raise ConfigurationError(
            f"shield: agent {i + 1} starts at a clearance of {gaps[i, k]:.3f} m from obstacle {k + 1}, but needs at least "
            f"{kept[k]:.3f} m"
        )
    least = numbers.agent_distance + 2.0 * (numbers.tube + stop)
    between = np.linalg.norm(starts[:, None] - starts[None], axis=-1) + np.diag(np.full(len(starts), np.inf))
    for i, j in np.argwhere(between < least)[:1].tolist():
        raise ConfigurationError(
            f"shield: agents {i + 1} and {j + 1} start {between[i, j]:.3f} m apart, but need at least {least:.3f} m"
        )


def _check_motions(numbers: ShieldNumbers, motions: np.ndarray) -> np.ndarray:
    """(K,) greatest speeds [m/s] of obstacles that move as ``motions`` (K, 6).

    Raises:
        ConfigurationError: an obstacle exceeds the assumed speed or acceleration.
    """
    swing = np.hypot(motions[:, 2], motions[:, 3]) * np.abs(motions[:, 4])
    speeds, accelerations = np.hypot(motions[:, 0], motions[:, 1]) + swing, swing * np.abs(motions[:, 4])
    for name, unit, values in (("obstacle_speed", "m/s", speeds), ("obstacle_acceleration", "m/s^2", accelerations)):
        k = int(values.argmax())
        if values[k] > getattr(numbers, name):
            raise ConfigurationError(
                f"shield: obstacle {k + 1} reaches {values[k]:.3g} {unit}, more than {name} = {getattr(numbers, name):g} {unit}"
            )
    return np.asarray(speeds)
