"""The checklist for a robot: what a mission will ask of it, tried one by one on the robot itself."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from marlbc_mj.controllers import PD
from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.engine.world import World
from marlbc_mj.robots import Robot, make_robot
from marlbc_mj.robots.user import check_mjcf
from marlbc_mj.scenarios import Scenario, standard_behaviors
from marlbc_mj.util.errors import MarlbcError
from marlbc_mj.util.text import one_line

DURATION = 8.0  # of the step test [s]
SETTLED, OVERSHOOT = 0.1, 0.35  # of the robot's length unit: error at the end, excursion beyond the reference
HEIGHT, TILT = 0.05, 35.0  # that a flying robot keeps [m], [deg]


class Item(NamedTuple):
    """One line of the checklist."""

    name: str
    passed: bool
    said: str


def checklist(name: str) -> Iterator[Item]:
    """Check a robot by name or path; stops at what makes the rest meaningless."""
    try:
        robot = make_robot(name)
    except MarlbcError as error:
        yield Item("file", False, str(error))
        return
    yield Item("file", True, f"{robot.mjcf.name}: {robot.description}")
    for check in (_mass, _actuators, _limits, _frame, _joint, _attached):
        item = _guarded(check, robot)
        yield item
        if not item.passed and check in (_joint, _attached):
            return
    yield from _step_test(robot)


def _guarded(check: Callable[[Robot], Item], robot: Robot) -> Item:
    try:
        return check(robot)
    except (MarlbcError, ValueError, KeyError) as error:
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
        return Item("mass", weighed > 0, f"{weighed:g} kg, scaled to the scenario's")
    rotating = robot.mass - weighed
    good = weighed > 0 and -1e-6 <= rotating <= weighed
    return Item("mass", good, f"{weighed:g} kg in the MJCF, {robot.mass:g} kg with what turns along")


def _actuators(robot: Robot) -> Item:
    model = check_mjcf(robot.mjcf)
    names = ", ".join(model.actuator(u).name or f"#{u}" for u in range(model.nu))
    return Item("actuators", model.nu > 0, f"{model.nu}: {names}")


def _limits(robot: Robot) -> Item:
    model, _ = _compiled(robot)
    open_ = [model.actuator(u).name or f"#{u}" for u in range(model.nu) if not model.actuator_ctrllimited[u]]
    if open_:
        return Item("limits", False, f"no ctrlrange: {', '.join(open_)}")
    ranges = {tuple(map(float, r)) for r in model.actuator_ctrlrange}
    return Item("limits", True, ", ".join(f"{low:g} to {high:g}" for low, high in sorted(ranges)))


def _frame(robot: Robot) -> Item:
    model, data = _compiled(robot)
    body = model.body(robot.body).id
    upright = float(data.xmat[body][8])
    offset = data.subtree_com[body][:2] - data.xpos[body][:2]
    heading = float(np.degrees(np.arctan2(data.xmat[body][3], data.xmat[body][0])))
    good = upright > 0.999 and abs(heading) < 1.0 and float(np.hypot(*offset)) < robot.radius
    said = f"z up: {upright:.3f}, x along the world's: {heading:.1f} deg off, centre of mass {1e3 * np.hypot(*offset):.1f} mm off"
    return Item("frame", good, said)


def _joint(robot: Robot) -> Item:
    model, _ = _compiled(robot)
    kinds = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_SLIDE): "slide"}
    found = [kinds.get(int(model.joint(name).type[0]), "other") for name in robot.joints]
    good = found in (["free"], ["slide", "slide"])
    return Item("joint", good, ", ".join(f"{name} ({kind})" for name, kind in zip(robot.joints, found, strict=True)))


def _attached(robot: Robot) -> Item:
    scenario = step_scenario(robot)
    model = World(scenario, PD(*robot.gains)).plan.model
    return Item("attached", True, f"two of it in one world: {model.nq} positions, {model.nu} actuators")


def step_scenario(robot: Robot, **changes: Any) -> Scenario:
    """Two of the robot, far apart, with references that step by two length units along x and one along y, within its limits."""
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
    try:
        records = [world.step(orders).record for _ in range(scenario.mission_steps)]
    except MarlbcError as error:
        yield Item("step", False, f"diverges: {error}")
        return
    p, target = (np.concatenate([getattr(r, which)[0] for r in records]) for which in ("position", "reference"))
    force = np.concatenate([r.force[0] for r in records if r is not None])
    off = float(np.abs(p[-1] - target[-1]).max()) / robot.length
    beyond = float((p - scenario.formations[0]).max()) / robot.length
    good = off < SETTLED and beyond < OVERSHOOT
    yield Item("step", good, f"{off:.3f} length units off after {DURATION:g} s, {max(beyond, 0.0):.3f} beyond the goal")
    yield _saturation(robot, world, force)
    yield from _flight(robot, world)


def _saturation(robot: Robot, world: World, force: np.ndarray) -> Item:
    """The forces of the step stay within limits, and so do the controls when the law asks for a hundred times as much."""
    most = float(np.abs(force).max())
    hard = World(step_scenario(robot), replace(PD(*robot.gains), position_gain=100 * robot.gains[0], limited=False))
    orders = np.full((1, 2), hard.scenario.orders.index("FM"))
    try:
        hard.step(orders)
    except MarlbcError as error:
        return Item("saturation", False, f"a hundredfold gain: {error}")
    model, data = world.plan.model, world.data[0]
    limited = model.actuator_ctrllimited.astype(bool)
    inside = bool((np.abs(data.actuator_force[limited]) <= np.abs(model.actuator_ctrlrange[limited]).max(axis=1) + 1e-9).all())
    bound = world.scenario.force_limit * (1 + 1e-9)
    good = inside and (most <= bound if robot.direct else np.isfinite(most))
    return Item("saturation", good, f"largest force {most:.3g} N of {world.scenario.force_limit:.3g} N per axis")


def _flight(robot: Robot, world: World) -> Iterator[Item]:
    found = {name: float(np.abs(world.state.robot[0, :, k]).max()) for name, k in robot.diagnostics.items()}
    if "height_error" in found:
        yield Item("height", found["height_error"] < HEIGHT, f"held within {1e3 * found['height_error']:.1f} mm")
    if "tilt" in found:
        degrees = float(np.degrees(found["tilt"]))
        yield Item("tilt", degrees < TILT, f"at most {degrees:.1f} deg")
