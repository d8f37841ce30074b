"""Checks of a robot's laws: reported p, v and force against MuJoCo's own values, and no access outside their arrays."""

from collections.abc import Callable
from types import CellType, FunctionType
from typing import Any, NamedTuple

import mujoco
import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.engine.assembly import agent_prefix
from marlbc_mj.engine.world import World
from marlbc_mj.robots import Robot
from marlbc_mj.robots.motors import effects, posed


class Truth(NamedTuple):
    """Differences between what MuJoCo computes and what robots report, for the agents of one world at one instant."""

    offset: np.ndarray  # (N, 2) p relative to the body's origin, in the body's frame [m]
    velocity_error: np.ndarray  # (N,) of v against the body's velocity at p [m/s]
    force_error: np.ndarray | None  # (N,) against the actuators' force in MuJoCo [N]; None with wheels or legs in between
    height: np.ndarray  # (N,) height of the body [m]


def compare(world: World) -> Truth:
    """Compare the current state of world 0 with ``xpos``, ``cvel`` and ``qfrc_actuator``."""
    model, data = world.plan.model, world.data[0]
    now = mujoco.MjData(model)  # mj_step leaves xpos and cvel at the previous state
    now.qpos[:], now.qvel[:] = data.qpos, data.qvel
    mujoco.mj_kinematics(model, now)
    mujoco.mj_comPos(model, now)
    mujoco.mj_comVel(model, now)
    p, v, force = world.state.position[0], world.state.velocity[0], world.state.force[0]
    offset, velocity_error, height = np.zeros_like(p), np.zeros(len(p)), np.zeros(len(p))
    for i, robot in enumerate(world.plan.fleet.robots):
        body = model.body(agent_prefix(i) + robot.body).id
        ahead = np.append(p[i] - now.xpos[body, :2], 0.0)
        offset[i] = (now.xmat[body].reshape(3, 3).T @ ahead)[:2]
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(model, now, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        velocity_error[i] = np.hypot(*(v[i] - (twist[3:] + np.cross(twist[:3], ahead))[:2]))
        height[i] = now.xpos[body, 2]
    error = np.hypot(*(force - data.qfrc_actuator[world.plan.plant.qvel_index]).T) if _pushes_base_only(world) else None
    return Truth(offset, velocity_error, error, height)


def _pushes_base_only(world: World) -> bool:
    """Whether every actuator acts only on the base's own joints, so that its planar force can be read there."""
    model, first = world.plan.model, world.plan.plant.qvel_index
    own = set(model.dof_bodyid[first.ravel()].tolist())
    inside = np.isin(model.dof_bodyid, list(own))
    return not np.abs(effects(model, posed(model))[:, ~inside]).max(initial=0.0) > 0.0


# Laws --------------------------------------------------------------------------------------------------------------------------


def try_laws(robot: Robot) -> str | None:
    """Run drive and reading as plain Python, which checks every index; returns a description of the error, or None.

    Compiled code does not check indices: it would read and write outside the law's arrays.
    """
    if robot.drive is None or robot.reading is None:
        return None
    model = robot.spec().compile()
    data = posed(model)
    drive, reading = all_plain(robot.drive), all_plain(robot.reading)
    gains, state = laws.as_gains(robot.drive, robot.params), laws.as_state(robot.drive, robot.state)
    ctrl, p, v, force = np.zeros(model.nu), np.zeros(2), np.zeros(2), np.zeros(2)
    most = min(robot.force_limit, 100.0)
    for wish in (np.zeros(2), np.array([most, -most])):
        for law, arguments in (
            (drive, (gains, state, data.qpos, data.qvel, wish, model.opt.timestep, ctrl)),
            (reading, (gains, state, data.qpos, data.qvel, data.actuator_force, p, v, force)),
        ):
            try:
                with np.errstate(all="ignore"):
                    law(*arguments)
            except Exception as error:
                return f"{law.__name__} fails as plain Python: {type(error).__name__}: {error}"
    return None


def all_plain(law: Callable[..., Any], seen: dict[int, laws.Law] | None = None) -> laws.Law:
    """A law as plain Python, including every compiled helper that it calls."""
    seen = {} if seen is None else seen
    function = laws.plain(law)
    if not isinstance(function, FunctionType):
        return law
    if id(function) in seen:
        return seen[id(function)]
    bound: dict[str, Any] = dict(function.__globals__)
    cells = tuple(CellType(cell.cell_contents) for cell in function.__closure__ or ())
    plain = FunctionType(function.__code__, bound, function.__name__, function.__defaults__, cells or None)
    seen[id(function)] = plain
    for name in function.__code__.co_names:
        value: Any = bound.get(name)
        if laws.is_compiled(value):
            bound[name] = all_plain(value, seen)
    for cell in cells:
        if laws.is_compiled(cell.cell_contents):
            cell.cell_contents = all_plain(cell.cell_contents, seen)
    return plain
