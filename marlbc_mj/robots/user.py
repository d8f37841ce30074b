"""Robots from a user's file: a Python file that defines one, or any MJCF whose actuators show how it is driven.

A Python file is run and defines ``ROBOT``, a :class:`~marlbc_mj.robots.base.Robot`, or a function ``robot()`` that returns one;
``file.py:NAME`` selects another name in it. An MJCF needs no additions: two slide joints or a free joint with motors along x and
y are driven directly, whatever their gears, senses and order; a free joint with rotors that lift and turn flies. A path that
starts with ``menagerie:`` is looked up in a checkout of MuJoCo Menagerie.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from marlbc_mj.robots.base import Robot
from marlbc_mj.robots.motors import Reason, check_motors, effects, find_motors, largest_force, no_motor, posed
from marlbc_mj.robots.multirotor import REPORT, rotor_drive, rotor_reading
from marlbc_mj.robots.planar import Base, base_of, find_base, moved_masses, slides_first
from marlbc_mj.robots.rotors import Attitude, agility, rotor_numbers
from marlbc_mj.robots.standard import standard_text
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.modules import USED_SUFFIXES, Beside, beside, guarded, load_module, made, split_name

MENAGERIE, MENAGERIE_ROOT = "menagerie:", "MENAGERIE_ROOT"
SUFFIXES = (".py", ".xml")
_WAY_OUT = "write a Python file with a drive and a reading"
_UNDRIVEN = "{}: its actuators neither push along x and y nor lift and turn; " + _WAY_OUT
_MOST_TILTING = 1.0  # acceleration limit of references for a rotorcraft that reaches FLIGHT's response [m/s^2]
FLIGHT = Attitude((250.0, 250.0, 230.0), (20.0, 20.0, 25.0), 0.08)
"""A fast attitude loop and thrust lag for rotorcraft without identified values: those of a small quadrotor, rounded."""


def is_file(name: str) -> bool:
    """Whether a robot's name is the path of a file."""
    return split_name(name)[0].endswith(SUFFIXES) or name.startswith(MENAGERIE)


def find(name: str) -> Path:
    """The path of the file that a name refers to.

    Raises:
        ConfigurationError: the file is missing or has no known suffix, or MENAGERIE_ROOT is needed and not set.
    """
    path = Path(split_name(name)[0])
    if name.startswith(MENAGERIE):
        root = os.environ.get(MENAGERIE_ROOT)
        if not root:
            raise ConfigurationError(f"{name} needs the environment variable {MENAGERIE_ROOT}: a checkout of MuJoCo Menagerie")
        path = Path(root) / name.removeprefix(MENAGERIE)
    if path.suffix not in SUFFIXES:
        raise ConfigurationError(f"a robot's file must end in {' or '.join(SUFFIXES)}, got {path}")
    if not path.is_file():
        raise ConfigurationError(f"robot file {path} is a folder" if path.is_dir() else f"no robot file {path}")
    return path


Stamp = tuple[Path, Beside]
"""Path of a robot's file, and name, modification time and size of the files in its folder and below."""


def stamp_of(name: str) -> Stamp:
    """The current stamp of a robot's file, which differs after an edit of the file or of others in its folder or below.

    Raises:
        ConfigurationError: as :func:`find`.
    """
    path = find(name).resolve()
    return path, beside(path, *USED_SUFFIXES)


def load(name: str) -> Robot:
    """The robot of a file; its name is the path, so that scenarios and logs find it again.

    Raises:
        ConfigurationError: the file cannot be used; the message gives the reason in one line.
    """
    path = find(name)
    return _from_python(path, name) if path.suffix == ".py" else from_mjcf(path, name)


def _from_python(path: Path, name: str) -> Robot:
    attribute = split_name(name)[1]
    robot = made(name, Robot) if attribute else _default_robot(path)
    if not isinstance(robot, Robot):
        raise ConfigurationError(f"robot file {path} defines neither ROBOT, a Robot, nor robot(), which returns one")
    robot = replace(robot, name=name)
    model = robot.spec().compile() if robot.shipped else check_mjcf(robot.mjcf)
    if robot.direct and robot.mass is not None and not robot.shipped:
        most = largest_force(check_motors(model, base_of(model, robot.body, robot.joints).dofs, robot.motors))
        if robot.force_limit > most * (1 + 1e-9):
            raise ConfigurationError(
                f"robot {name!r}: force_limit is {robot.force_limit:g} N, but {robot.mjcf.name} lets its motors give {most:g} N"
            )
    return robot


def _default_robot(path: Path) -> Any:
    """``robot()`` or ``ROBOT`` of a file."""
    module = load_module(path)
    make = getattr(module, "robot", None)
    return guarded(make, f"{path}: robot()") if callable(make) else getattr(module, "ROBOT", None)


def check_mjcf(path: Path) -> mujoco.MjModel:
    """Read and compile a user's MJCF by itself.

    Raises:
        ConfigurationError: it cannot be read, uses a file outside its folder, or fails :func:`check_model`.
    """
    return check_model(path, mujoco.MjSpec.from_string(standard_text(path)).compile())


def check_model(path: Path, model: mujoco.MjModel) -> mujoco.MjModel:
    """The model, if it has a mass and usable actuators.

    Raises:
        ConfigurationError: no mass, no actuator, or an actuator with several controls.
    """
    if model.nu == 0:
        raise ConfigurationError(f"{path} has no actuators; a robot needs at least two to be driven in the plane")
    if model.nbody < 2 or not model.body_subtreemass[0] > 0:
        raise ConfigurationError(f"{path} has no mass: {model.nbody - 1} bodies weigh {model.body_subtreemass[0]:g} kg")
    many = np.flatnonzero(getattr(model, "actuator_ctrlnum", np.ones(model.nu)) != 1)
    if len(many):
        raise ConfigurationError(f"{path}: actuator {model.actuator(many[0]).name!r} has several controls; use a motor")
    return model


def from_mjcf(path: Path, name: str) -> Robot:
    """A robot from its MJCF alone: its drive, mass and size are read from the compiled model.

    Raises:
        ConfigurationError: the file is invalid, or its actuators fit none of the kinds in the module's description.
    """
    spec = mujoco.MjSpec.from_string(standard_text(path))
    moved = slides_first(spec)
    model = check_model(path, spec.compile())
    data = posed(model)
    root = _moving_root(path, model)
    try:
        base = find_base(model, root)
        motors = find_motors(model, base.dofs)
        limit = largest_force(motors) if isinstance(motors, tuple) and not isinstance(motors, Reason) else np.inf
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    fields: dict[str, Any] = {
        "name": name,
        "mjcf": path,
        "body": model.body(base.body).name,
        "joints": base.joints,
        "prepare": _slides_first,
        **_size(model, data, root, base),
    }
    if isinstance(motors, Reason):
        raise ConfigurationError(f"{path}: actuator {motors.name!r} is not a motor: {motors.why}; {_WAY_OUT}")
    if motors is not None:
        turning = f"; {', '.join(moved)} moved after the slides, so that it turns about its own axis" if moved else ""
        return _direct({**fields, "description": f"two motors along x and y{turning}"}, (motors[0].name, motors[1].name), limit)
    _refuse_legs_and_wheels(path, model, base)
    if len(base.joints) == 1:
        return _flying(fields, path, spec)
    raise ConfigurationError(_UNDRIVEN.format(path))


def _refuse_legs_and_wheels(path: Path, model: mujoco.MjModel, base: Base) -> None:
    """Raise ConfigurationError, naming an actuator, if all actuators move parts on the base and none pushes the base itself."""
    own = np.flatnonzero(model.dof_bodyid == base.body)
    if np.abs(effects(model, posed(model))[:, own]).max(initial=0.0) > 0.0:
        return
    first, why = model.actuator(0).name, no_motor(model, 0)
    raise ConfigurationError(
        f"{path}: none of its {model.nu} actuators pushes its base {model.body(base.body).name!r}; they move what is on it, as "
        f"legs and wheels do: {first!r} for example{f' ({why})' if why else ''}; {_WAY_OUT}"
    )


def _moving_root(path: Path, model: mujoco.MjModel) -> int:
    """The one body that has a joint and no moving ancestor; raises ConfigurationError unless there is exactly one."""
    moves, roots = np.zeros(model.nbody, dtype=bool), []
    for b in range(1, model.nbody):
        carried = bool(moves[model.body_parentid[b]])
        moves[b] = carried or model.body_jntnum[b] > 0
        if moves[b] and not carried:
            roots.append(b)
    if len(roots) != 1:
        names = ", ".join(model.body(b).name for b in roots)
        still = ", ".join(repr(model.body(b).name) for b in range(1, model.nbody) if model.body_parentid[b] == 0)
        hint = f"it has {names}" if names else f"give one of its bodies a free joint: {still}"
        raise ConfigurationError(f"{path} must have exactly one base, a body with a joint and no moving parent; {hint}")
    return roots[0]


def _slides_first(spec: mujoco.MjSpec) -> None:
    """The ``prepare`` step of a robot that is given by its MJCF alone."""
    slides_first(spec)


def _size(model: mujoco.MjModel, data: mujoco.MjData, root: int, base: Base) -> dict[str, Any]:
    """Fields of a robot from the geometry of its moving bodies: radius from above, length unit, mass, substep and contact."""
    carried = {root}
    for b in range(root + 1, model.nbody):
        carried |= {b} if model.body_parentid[b] in carried else set()
    own = [g for g in range(model.ngeom) if model.geom_bodyid[g] in carried]
    reach = [np.linalg.norm(data.geom_xpos[g, :2] - data.xpos[root, :2]) + min(model.geom_rbound[g], 10.0) for g in own]
    radius = float(max(reach, default=0.1)) or 0.1
    touches = bool(model.geom_contype[own].any())
    floor = bool((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any())
    size = {"radius": radius, "length": 2.0 * radius, "mass": max(moved_masses(model, base)), "substep": 0.0025}
    return {**size, "contact": touches, "ground": touches and not floor}


def _direct(fields: dict[str, Any], motors: tuple[str, str], limit: float) -> Robot:
    fast = limit / fields["mass"]
    return Robot(
        **fields,
        motors=motors,
        force_limit=limit,
        speed_limit=min(2.0, np.sqrt(fast * fields["length"])),
        acceleration_limit=min(2.0, 0.4 * fast),
        gains=(64.0, 16.0),
    )


def _flying(fields: dict[str, Any], path: Path, spec: mujoco.MjSpec) -> Robot:
    """A rotorcraft; its attitude loop, limits and gains are scaled down to what its rotors' moments can achieve."""
    try:
        params, state, mass = rotor_numbers(spec, fields["body"], FLIGHT)
    except ConfigurationError as error:
        raise ConfigurationError(f"{_UNDRIVEN.format(path)} ({error})") from error
    able = agility(params) if params["gravity"] > 0.0 else 0.0  # angular acceleration [rad/s^2]
    if not able > 0.0:
        weight = f"its weight of {mass * params['gravity']:g} N"
        raise ConfigurationError(
            f"{path}: a rotorcraft flies by tilting against gravity, but its rotors cannot both hold {weight} and tilt it"
        )
    heading = (
        "" if any(turn for _, _, turn in params["moment_share"]) else "; none turns its heading alone, which is left to itself"
    )
    share = float(np.sqrt(min(1.0, able * params["gravity"] / (max(FLIGHT.stiffness) * _MOST_TILTING))))
    for name, power in (("stiffness", 1.0), ("damping", 0.5)):
        params[name] = tuple(share**power * gain for gain in params[name])
    return Robot(
        **{**fields, "mass": mass},
        drive=rotor_drive,
        reading=rotor_reading,
        params=params,
        state=state,
        report=REPORT,
        description=f"rotors that lift and turn{heading}",
        force_limit=0.3 * share * mass * params["gravity"],
        speed_limit=np.sqrt(share),
        acceleration_limit=share * _MOST_TILTING,
        gains=(9.0 * share, 6.0 * np.sqrt(share)),
        height=params["height"],
    )
