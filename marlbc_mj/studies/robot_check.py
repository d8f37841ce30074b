"""The checklist for a robot: every requirement of a mission, tested on the robot itself."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from marlbc_mj.controllers import PD
from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.engine.assembly import OPTIONS
from marlbc_mj.engine.world import World
from marlbc_mj.robots import Robot, make_robot
from marlbc_mj.robots.planar import base_of, moved_masses
from marlbc_mj.scenarios import Scenario, standard_behaviors
from marlbc_mj.studies.robot_truth import Truth, compare, try_laws
from marlbc_mj.util.errors import MarlbcError
from marlbc_mj.util.text import one_line

DURATION = 8.0  # duration of the step test [s]
SETTLED, OVERSHOOT = 0.1, 0.35  # largest final error and overshoot allowed, in the robot's length unit
MASSES = 0.01  # largest relative difference between the masses moved along x and y
_HEIGHT, TILT = 0.05, 35.0  # largest change of height [m] and largest tilt [deg] allowed


_KINDS = {
    "integrator": mujoco.mjtIntegrator,
    "cone": mujoco.mjtCone,
    "jacobian": mujoco.mjtJacobian,
    "solver": mujoco.mjtSolver,
}
"""Options with named values, and their enumerations."""


class Item(NamedTuple):
    """One line of the checklist."""

    name: str
    passed: bool
    detail: str


def checklist(name: str) -> Iterator[Item]:
    """Check a robot by name or path; stops at a failure that makes the remaining checks meaningless."""
    try:
        robot = make_robot(name)
        robot.spec()
    except MarlbcError as error:
        yield Item("file", False, str(error))
        return
    yield Item("file", True, f"{robot.mjcf.name}: {robot.description}")
    for check in (_mass, _actuators, _limits, _options, _frame, _joint, _laws, _attached):
        item = _guarded(check, robot)
        yield item
        if not item.passed and check in (_joint, _laws, _attached):
            return
    yield from _step_test(robot)


def _guarded(check: Callable[[Robot], Item], robot: Robot) -> Item:
    try:
        return check(robot)
    except (MarlbcError, ValueError, KeyError, TypeError, IndexError) as error:
        return Item(check.__name__.strip("_"), False, one_line(error))


def _compiled(robot: Robot) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def _mass(robot: Robot) -> Item:
    model, _ = _compiled(robot)
    weighed = float(model.body(robot.body).subtreemass[0])
    if robot.mass is None:
        return Item("mass", weighed > 0, f"{weighed:g} kg, scaled to the scenario's mass")
    if robot.direct and len(robot.joints) == 2:
        along_x, along_y = moved_masses(model, base_of(model, robot.body, robot.joints))
        if not np.isclose(along_x, along_y, rtol=MASSES):
            said = f"{along_x:g} kg move along x, {along_y:g} kg along y; both masses must be equal"
            return Item("mass", False, said)
    rotating = robot.mass - weighed
    good = weighed > 0 and -1e-6 <= rotating <= weighed
    return Item("mass", good, f"{weighed:g} kg in the MJCF, {robot.mass:g} kg with rotating parts")


def _actuators(robot: Robot) -> Item:
    model, _ = _compiled(robot)
    names = ", ".join(model.actuator(u).name or f"#{u}" for u in range(model.nu))
    return Item("actuators", model.nu > 0, f"{model.nu}: {names}")


def _limits(robot: Robot) -> Item:
    model, _ = _compiled(robot)
    limited = model.actuator_ctrllimited | model.actuator_forcelimited
    open_ = [model.actuator(u).name or f"#{u}" for u in range(model.nu) if not limited[u]]
    if open_:
        return Item("limits", False, f"no ctrlrange: {', '.join(open_)}")
    ranges = {tuple(map(float, r)) for r in model.actuator_ctrlrange}
    return Item("limits", True, ", ".join(f"{low:g} to {high:g}" for low, high in sorted(ranges)))


def _options(robot: Robot) -> Item:
    """The MJCF options that the team's world keeps, and those that it cannot keep."""
    given, usual = robot.spec().option, mujoco.MjSpec().option
    kept = [
        f"{name} {_shown(name, getattr(given, name))}"
        for name in OPTIONS
        if not np.array_equal(getattr(given, name), getattr(usual, name))
    ]
    lost = [f"timestep {given.timestep:g} s (the scenario's substep counts)"] if given.timestep != usual.timestep else []
    said = "; ".join(f"{word}: {', '.join(names)}" for word, names in (("kept", kept), ("not kept", lost)) if names)
    return Item("options", True, said or "MuJoCo's defaults")


def _shown(name: str, value: Any) -> str:
    """The value of an option as written in MJCF, by name if it has one."""
    if name in _KINDS:
        return str(_KINDS[name](int(value)).name).split("_")[1].lower()
    return " ".join(f"{float(x):g}" for x in np.ravel(value))


def _frame(robot: Robot) -> Item:
    model, data = _compiled(robot)
    body = model.body(robot.body).id
    upright = float(data.xmat[body][8])
    offset = data.subtree_com[body][:2] - data.xpos[body][:2]
    heading = float(np.degrees(np.arctan2(data.xmat[body][3], data.xmat[body][0])))
    ahead = robot.direct or abs(heading) < 1.0  # motors push along the world's axes at any heading
    good = upright > 0.999 and ahead and float(np.hypot(*offset)) < robot.radius
    said = f"z up: {upright:.3f}, x along the world's: {heading:.1f} deg off, centre of mass {1e3 * np.hypot(*offset):.1f} mm off"
    return Item("frame", good, said)


def _joint(robot: Robot) -> Item:
    model, data = _compiled(robot)
    kinds = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_SLIDE): "slide"}
    found = [kinds.get(int(model.joint(name).type[0]), "other") for name in robot.joints]
    good = found in (["free"], ["slide", "slide"])
    said = ", ".join(f"{name} ({kind})" for name, kind in zip(robot.joints, found, strict=True))
    if found == ["slide", "slide"]:
        directions = [data.xaxis[model.joint(name).id] for name in robot.joints]
        for axis, (name, direction) in enumerate(zip(robot.joints, directions, strict=True)):
            if not np.allclose(direction, np.eye(3)[axis], atol=1e-6):
                return Item("joint", False, f"{name} slides along {np.round(direction, 3).tolist()}, not along {'xy'[axis]}")
    elif found == ["free"] and model.joint(robot.joints[0]).bodyid[0] != model.body(robot.body).rootid[0]:
        return Item("joint", False, f"{said} does not move body {robot.body!r}")
    return Item("joint", good, said)


def _laws(robot: Robot) -> Item:
    wrong = try_laws(robot)
    return Item("laws", wrong is None, wrong or ("none: motors push along x and y" if robot.direct else "within their arrays"))


def _attached(robot: Robot) -> Item:
    scenario = step_scenario(robot)
    model = World(scenario, PD(*robot.gains)).plan.model
    return Item("attached", True, f"two of it in one world: {model.nq} positions, {model.nu} actuators")


def step_scenario(robot: Robot, **changes: Any) -> Scenario:
    """Two copies of the robot, far apart; references step by two length units along x and one along y, within its limits."""
    unit = robot.length
    slots = ((2.0 * unit, -20.0 * unit), (2.0 * unit, 20.0 * unit))
    brake, top = robot.acceleration_limit, robot.speed_limit
    gain = 0.8 * brake / top if np.isfinite((brake, top)).all() else 8.0
    fields: dict[str, Any] = {
        "name": "step",
        "starts": ((0.0, -21.0 * unit), (0.0, 19.0 * unit)),
        "behaviors": standard_behaviors(slots, ((unit, 0.0), (-unit, 0.0)), formation_gain=gain),
        "disturbance": LinearDrag(coefficient=0.0),
        "duration": DURATION,
        **robot.scale(),
    }
    return Scenario(**{**fields, **changes})


def _step_test(robot: Robot) -> Iterator[Item]:
    scenario = step_scenario(robot)
    world = World(scenario, PD(*robot.gains), record=True)
    orders = np.full((1, 2), scenario.orders.index("FM"))
    records, truths = [], [compare(world)]
    try:
        for _ in range(scenario.mission_steps):
            records.append(world.step(orders).record)
            truths.append(compare(world))
    except MarlbcError as error:
        yield Item("step", False, f"diverges: {error}")
        return
    p, target = (np.concatenate([getattr(r, which)[0] for r in records]) for which in ("position", "reference"))
    force = np.concatenate([r.force[0] for r in records if r is not None])
    off = float(np.abs(p[-1] - target[-1]).max()) / robot.length
    beyond = float((p - scenario.formations[0]).max()) / robot.length
    good = off < SETTLED and beyond < OVERSHOOT
    cause = "" if good else _cause(scenario, force, np.concatenate([r.velocity[0] for r in records if r is not None]))
    yield Item("step", good, f"{off:.3f} length units off after {DURATION:g} s, {max(beyond, 0.0):.3f} beyond the goal{cause}")
    yield _measured(world, truths, force)
    yield _saturation(robot, world, force)
    yield from _flight(robot, world, truths)


def _cause(scenario: Scenario, force: np.ndarray, v: np.ndarray) -> str:
    """The likely cause of a failed step test, from forces and velocities (T, N, 2)."""
    if float((force * v).sum()) < 0.0:
        return ": it moves against its force; are axes exchanged or reversed in its drive or its reading?"
    share = float((np.abs(force) > 0.99 * scenario.force_limit).any(axis=-1).mean())
    if share > 0.2:
        return f": its force is at the limit of {scenario.force_limit:g} N for {100 * share:.0f} % of the time; what brakes it?"
    return ": its mass, gains or limits do not match its weight and its friction"


def _measured(world: World, truths: Sequence[Truth], force: np.ndarray) -> Item:
    """Check that p is a point fixed to the body, v the velocity of that point, and the force that of MuJoCo's actuators."""
    robot = world.plan.robot
    offset = np.stack([truth.offset for truth in truths])
    astray = float(np.linalg.norm(offset - offset[0], axis=-1).max())
    away = float(np.linalg.norm(offset[0], axis=-1).max())
    slip = float(max(truth.velocity_error.max() for truth in truths))
    said = f"p within {1e3 * astray:.3g} mm of a fixed point of {robot.body!r}, v within {1e3 * slip:.3g} mm/s of its velocity"
    good = astray < 1e-3 * robot.length and away < max(robot.radius, robot.length) and slip < 1e-3 * robot.length
    gaps = [float(truth.force_error.max()) for truth in truths[1:] if truth.force_error is not None]
    if gaps:
        most = max(float(np.abs(force).max()), 1e-9)
        stages = world.plan.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4  # data has the forces of its last stage
        within = float(np.abs(np.diff(force, axis=0)).max()) if stages else 0.0
        good = good and max(gaps) < 1e-3 * most + within
        said += f", force within {max(gaps):.3g} N of MuJoCo's actuators"
    if away >= max(robot.radius, robot.length):
        said = f"p is {away:.3g} m from MuJoCo's position of body {robot.body!r} (xpos): is it in world coordinates?"
    return Item("measured", good, said)


def _saturation(robot: Robot, world: World, force: np.ndarray) -> Item:
    """Check the limits of forces in the step test, and of actuators at its end and after one step at a hundredfold gain."""
    most = float(np.abs(force).max())
    hard = World(step_scenario(robot), replace(PD(*robot.gains), position_gain=100 * robot.gains[0], limited=False))
    orders = np.full((1, 2), hard.scenario.orders.index("FM"))
    try:
        hard.step(orders)
    except MarlbcError as error:
        return Item("saturation", False, f"with a hundredfold gain: {error}")
    model = world.plan.model
    limited = model.actuator_ctrllimited.astype(bool)
    forces = np.abs([each.data[0].actuator_force[limited] for each in (world, hard)])
    inside = bool((forces <= np.abs(model.actuator_ctrlrange[limited]).max(axis=1) + 1e-9).all())
    bound = world.scenario.force_limit * (1 + 1e-9)
    good = inside and (most <= bound if robot.direct else np.isfinite(most))
    return Item("saturation", good, f"largest force {most:.3g} N of {world.scenario.force_limit:.3g} N per axis")


def _flight(robot: Robot, world: World, truths: Sequence[Truth]) -> Iterator[Item]:
    heights = np.stack([truth.height for truth in truths])
    moved = float(np.abs(heights - heights[0]).max())
    found = {name: float(np.abs(world.state.robot[0, :, k]).max()) for name, k in robot.diagnostics.items()}
    if "height_error" in found:
        error = max(found["height_error"], moved)
        yield Item("height", error < _HEIGHT, f"held within {1e3 * error:.1f} mm")
    else:
        why = "" if moved < _HEIGHT else ": nothing supports it; give it ground to stand on, slides, or no gravity"
        yield Item("height", moved < _HEIGHT, f"body {robot.body!r} stays within {1e3 * moved:.3g} mm{why}")
    if "tilt" in found:
        degrees = float(np.degrees(found["tilt"]))
        yield Item("tilt", degrees < TILT, f"at most {degrees:.1f} deg")
