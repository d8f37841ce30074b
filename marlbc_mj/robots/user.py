"""Robots from a user's file: a Python file that makes one, or any MJCF whose way of driving can be told from its actuators.

A Python file is run and defines ``ROBOT``, a :class:`~marlbc_mj.robots.base.Robot`, or a function ``robot()`` that returns one.
An MJCF is taken as it is: two slide joints or a free joint with motors along x and y are driven directly, a free joint with
rotors that lift and turn flies. A path that starts with ``menagerie:`` is looked up in a checkout of MuJoCo Menagerie.
"""

import os
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from marlbc_mj.robots.assets import embed
from marlbc_mj.robots.base import Robot
from marlbc_mj.robots.multirotor import REPORT, rotor_drive, rotor_reading
from marlbc_mj.robots.rotors import Attitude, rotor_numbers
from marlbc_mj.util.errors import ConfigurationError, MarlbcError
from marlbc_mj.util.text import one_line

MENAGERIE, MENAGERIE_ROOT = "menagerie:", "MENAGERIE_ROOT"
SUFFIXES = (".py", ".xml")
_UNDRIVEN = "{}: its actuators neither push along x and y nor lift and turn; write a Python file with a drive and a reading"
FREE = "base_free"  # name of a free joint that has none
FLIGHT = Attitude((250.0, 250.0, 230.0), (20.0, 20.0, 25.0), 0.08)
"""A brisk attitude loop and thrust lag for rotorcraft that no one has identified: a small quadrotor's, rounded."""


def is_file(name: str) -> bool:
    """Whether a robot's name is a path rather than a name."""
    return name.endswith(SUFFIXES) or name.startswith(MENAGERIE)


def find(name: str) -> Path:
    """The file that a name means.

    Raises:
        ConfigurationError: it is not there, has no known suffix, or Menagerie is asked for and MENAGERIE_ROOT is not set.
    """
    path = Path(name)
    if name.startswith(MENAGERIE):
        root = os.environ.get(MENAGERIE_ROOT)
        if not root:
            raise ConfigurationError(f"{name} needs the environment variable {MENAGERIE_ROOT}: a checkout of MuJoCo Menagerie")
        path = Path(root) / name.removeprefix(MENAGERIE)
    if path.suffix not in SUFFIXES:
        raise ConfigurationError(f"a robot's file must end in {' or '.join(SUFFIXES)}, got {path}")
    if not path.is_file():
        raise ConfigurationError(f"no robot file {path}")
    return path


def load(name: str) -> Robot:
    """The robot of a file; its name is the path, so that scenarios and logs find it again.

    Raises:
        ConfigurationError: what is wrong with the file, in one line.
    """
    path = find(name)
    return _from_python(path, name) if path.suffix == ".py" else from_mjcf(path, name)


def _from_python(path: Path, name: str) -> Robot:
    try:
        found = runpy.run_path(str(path))
    except MarlbcError:
        raise
    except Exception as error:
        raise ConfigurationError(f"robot file {path} fails: {type(error).__name__}: {error}") from error
    make: Any = found.get("robot")
    robot = make() if callable(make) else found.get("ROBOT")
    if not isinstance(robot, Robot):
        raise ConfigurationError(f"robot file {path} defines neither ROBOT, a Robot, nor robot(), which returns one")
    check_mjcf(robot.mjcf)
    return replace(robot, name=name)


def check_mjcf(path: Path) -> mujoco.MjModel:
    """Read and compile an MJCF by itself.

    Raises:
        ConfigurationError: it cannot be read, uses a file outside its folder, or has no mass or no actuator.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, FileNotFoundError) as error:
        raise ConfigurationError(f"{path} is no MJCF that MuJoCo reads: {one_line(error)}") from error
    _check_files(path, spec)
    try:
        model = spec.compile()
    except ValueError as error:
        raise ConfigurationError(f"{path} does not compile: {one_line(error)}") from error
    if model.nu == 0:
        raise ConfigurationError(f"{path} has no actuators; a robot needs at least two to be driven in the plane")
    if model.nbody < 2 or not model.body_subtreemass[0] > 0:
        raise ConfigurationError(f"{path} has no mass: {model.nbody - 1} bodies weigh {model.body_subtreemass[0]:g} kg")
    return model


def _check_files(path: Path, spec: mujoco.MjSpec) -> None:
    """Raise ConfigurationError for a mesh, texture or height field outside the MJCF's folder, or missing."""
    folder = path.resolve().parent
    named = [(spec.meshdir, m.file) for m in spec.meshes] + [(spec.meshdir, h.file) for h in spec.hfields]
    named += [(spec.texturedir, t.file) for t in spec.textures]
    for directory, file in named:
        if not file:
            continue
        target = (folder / directory / file).resolve()
        if not target.is_relative_to(folder):
            raise ConfigurationError(f"{path} uses a file outside its folder: {file}")
        if not target.is_file():
            raise ConfigurationError(f"{path} uses a file that is not there: {file}")


def from_mjcf(path: Path, name: str) -> Robot:
    """A robot from its MJCF alone: how it is driven, its mass and its size are read from the compiled model.

    Raises:
        ConfigurationError: the file is broken, or its actuators fit none of the ways above.
    """
    model = check_mjcf(path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and model.body_jntnum[b] > 0]
    if len(roots) != 1 or not model.body(roots[0]).name:
        names = ", ".join(model.body(b).name or "(unnamed)" for b in roots)
        still = ", ".join(repr(model.body(b).name) for b in range(1, model.nbody) if model.body_parentid[b] == 0)
        hint = f"it has {names}" if names else f"give one of its bodies a free joint: {still}"
        raise ConfigurationError(f"{path} must have one named body that moves by a joint of its own; {hint}")
    body = model.body(roots[0])
    joints = [model.joint(j) for j in range(body.jntadr[0], body.jntadr[0] + body.jntnum[0])]
    free = [j.name for j in joints if j.type[0] == mujoco.mjtJoint.mjJNT_FREE]
    slides = _slides(joints)
    fields: dict[str, Any] = {"name": name, "mjcf": path, "body": body.name, "prepare": _complete, **_size(model, data, roots[0])}
    if not free and slides is None:
        raise ConfigurationError(f"{path}: body {body.name!r} needs a free joint, or slide joints along x and y")
    motors = _direct_motors(model, data, roots[0])
    if motors is not None:
        limit = float(np.min(np.abs(model.actuator_ctrlrange[list(motors)])))
        along_x, along_y = (model.actuator(m).name for m in motors)
        return _direct(fields, (free[0] or FREE,) if free else slides, (along_x, along_y), limit)
    if free:
        return _flying(fields, free[0] or FREE, path)
    raise ConfigurationError(_UNDRIVEN.format(path))


def _complete(spec: mujoco.MjSpec) -> None:
    """Name a free joint that has no name, leave lights to the arena, and take external files into the text."""
    for light in list(spec.lights):
        spec.delete(light)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE and not joint.name:
            joint.name = FREE
    embed(spec)


def _slides(joints: list[Any]) -> tuple[str, str] | None:
    """Names of the slide joints along x and y."""
    found = []
    for axis in np.eye(3)[:2]:
        along = [j.name for j in joints if j.type[0] == mujoco.mjtJoint.mjJNT_SLIDE and np.allclose(np.abs(j.axis), axis)]
        if not along:
            return None
        found.append(along[0])
    return found[0], found[1]


def _effects(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """(actuators, nv): generalized force of each actuator at force 1."""
    effect = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(effect, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return effect


def _direct_motors(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> tuple[int, int] | None:
    """Actuators that push the base along x and along y with force = control, and do nothing else, however it is turned."""
    turned = mujoco.MjData(model)
    mujoco.mj_integratePos(model, turned.qpos, np.full(model.nv, 0.4), 1.0)
    mujoco.mj_forward(model, turned)
    effects = _effects(model, data), _effects(model, turned)
    found = []
    for axis in range(2):
        pure = np.zeros(model.nv)
        pure[model.body_dofadr[body] + axis] = 1.0
        same = [
            u for u in range(model.nu) if all(np.allclose(e[u], pure) for e in effects) and model.actuator_gainprm[u, 0] == 1.0
        ]
        if not same:
            return None
        found.append(same[0])
    return found[0], found[1]


def _size(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> dict[str, Any]:
    """Radius seen from above and mass of the moving body and all below it, and what it touches."""
    own = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == root]
    reach = [np.linalg.norm(data.geom_xpos[g, :2] - data.xpos[root, :2]) + min(model.geom_rbound[g], 10.0) for g in own]
    radius = float(max(reach, default=0.1)) or 0.1
    touches = bool(model.geom_contype[own].any())
    floor = bool((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any())
    size = {"radius": radius, "length": 2.0 * radius, "mass": float(model.body_subtreemass[root]), "substep": 0.0025}
    return {**size, "contact": touches, "ground": touches and not floor}


def _direct(fields: dict[str, Any], joints: Any, motors: tuple[str, str], limit: float) -> Robot:
    if not limit > 0:
        raise ConfigurationError(f"{fields['mjcf']}: motors {motors[0]!r} and {motors[1]!r} need a ctrlrange")
    fast = limit / fields["mass"]
    return Robot(
        **fields,
        joints=joints,
        motors=motors,
        description="two motors along x and y",
        force_limit=limit,
        speed_limit=min(2.0, np.sqrt(fast * fields["length"])),
        acceleration_limit=min(2.0, 0.4 * fast),
        gains=(64.0, 16.0),
    )


def _flying(fields: dict[str, Any], joint: str, path: Path) -> Robot:
    try:
        params, state, mass = rotor_numbers(mujoco.MjSpec.from_file(str(path)), fields["body"], FLIGHT)
    except ConfigurationError as error:
        raise ConfigurationError(f"{_UNDRIVEN.format(path)} ({error})") from error
    return Robot(
        **{**fields, "mass": mass},
        joints=(joint,),
        drive=rotor_drive,
        reading=rotor_reading,
        params=params,
        state=state,
        report=REPORT,
        description="rotors that lift and turn",
        force_limit=0.3 * mass * 9.81,
        speed_limit=1.0,
        acceleration_limit=1.0,
        gains=(9.0, 6.0),
        height=params["height"],
    )
