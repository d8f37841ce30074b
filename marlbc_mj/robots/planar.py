"""Where an MJCF's planar motion is and what pushes it, found by what joints and actuators do, not by their names or order.

A direct robot gets its planar force as control, and its p and v are its joints' own. :func:`straighten` brings any base on two
slides and any motors, whatever their gear, sense, reference and place, into this form without a change of the motion.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from marlbc_mj.util.errors import ConfigurationError

_SLIDE, _FREE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_FREE)
_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_PARALLEL = 1e-6


class Motor(NamedTuple):
    """An actuator that pushes a base along x or y and does nothing else."""

    name: str
    scale: float  # planar force per actuator force [N/N]
    low: float  # of the planar force, by every limit on the way [N]
    high: float


class Reason(NamedTuple):
    """An actuator along x or y whose force is not its control, and why."""

    name: str
    why: str


def posed(model: mujoco.MjModel, turn: float = 0.0) -> mujoco.MjData:
    """The model at its reference pose; with a ``turn`` [rad or m] every joint is moved by that much."""
    data = mujoco.MjData(model)
    if turn:
        mujoco.mj_integratePos(model, data.qpos, np.full(model.nv, turn), 1.0)
    mujoco.mj_forward(model, data)
    return data


def effects(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """(actuators, nv): generalized force of each actuator at force 1."""
    effect = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(effect, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return effect


# Bases -------------------------------------------------------------------------------------------------------------------------


class Base(NamedTuple):
    """What moves in the plane: the body that carries the rest, and its joints along x and y, or its free joint."""

    body: int
    joints: tuple[str, ...]
    dofs: tuple[int, int]


def find_base(model: mujoco.MjModel, root: int) -> Base:
    """The base of a model whose body ``root`` is the first that moves; slides may be on bodies that carry one another.

    Raises:
        ConfigurationError: there is neither a free joint nor a pair of slides along x and y.
    """
    first = model.body_jntadr[root]
    if model.jnt_type[first] == _FREE:
        dof = int(model.jnt_dofadr[first])
        return Base(root, (model.joint(first).name,), (dof, dof + 1))
    directions, found, body = posed(model).xaxis, dict[int, int](), root
    while True:
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            axis = _along(directions[j]) if model.jnt_type[j] == _SLIDE else None
            if axis is not None:
                found.setdefault(axis, j)
        children = [b for b in range(body + 1, model.nbody) if model.body_parentid[b] == body and model.body_jntnum[b] > 0]
        if len(found) == 2 or len(children) != 1:
            break
        body = children[0]
    if len(found) < 2:
        raise ConfigurationError(f"body {model.body(root).name!r} needs a free joint, or slide joints along x and y of the world")
    _refuse_turning_slides(model, tuple(found.values()))
    along_x, along_y = found[0], found[1]
    dofs = int(model.jnt_dofadr[along_x]), int(model.jnt_dofadr[along_y])
    return Base(body, (model.joint(along_x).name, model.joint(along_y).name), dofs)


def _along(direction: np.ndarray) -> int | None:
    """0 for the x axis, 1 for y, in either sense; None for any other direction."""
    at = int(np.argmax(np.abs(direction)))
    return at if at < 2 and abs(abs(direction[at]) - 1.0) < _PARALLEL else None


def _refuse_turning_slides(model: mujoco.MjModel, slides: Sequence[int]) -> None:
    """Raise ConfigurationError where a joint before the slides turns them."""
    last = max(slides)
    tree = model.body_rootid[model.jnt_bodyid]
    for j in range(last):
        if model.jnt_type[j] != _SLIDE and tree[j] == tree[last] and model.jnt_bodyid[j] <= model.jnt_bodyid[last]:
            raise ConfigurationError(
                f"joint {model.joint(j).name!r} turns the slide joints, so that they are not along x and y; put it after them"
            )


def slides_first(spec: mujoco.MjSpec) -> list[str]:
    """Move vertical hinges behind the slides of the same body, so that a base turns about itself; their names.

    In a file, a yaw hinge before the slides turns about the place where the base started, and the slides with it. In a team's
    world an agent starts anywhere.
    """
    moved: list[str] = []
    axes = posed(spec.copy().compile())
    model = axes.model
    for body in spec.bodies[1:]:
        joints = list(body.joints)
        late = [k for k, joint in enumerate(joints) if joint.type == mujoco.mjtJoint.mjJNT_HINGE and _before_slide(joints[k:])]
        if late and all(abs(axes.xaxis[model.joint(joints[k].name).id][2]) > 1.0 - _PARALLEL for k in late):
            order = [k for k in range(len(joints)) if k not in late] + late
            _reorder(joints, order)
            moved += [joints[place].name for place in range(len(joints) - len(late), len(joints))]
    return moved


def _before_slide(rest: Sequence[Any]) -> bool:
    return any(joint.type == mujoco.mjtJoint.mjJNT_SLIDE for joint in rest)


def _reorder(joints: Sequence[Any], order: Sequence[int]) -> None:
    """Joint k gets what joint ``order[k]`` was, its name included: actuators and others find it by that."""
    names = [name for name in dir(joints[0]) if not name.startswith("_") and name not in _FIXED]
    was = [{name: _copied(getattr(joint, name)) for name in names} for joint in joints]
    for k, joint in enumerate(joints):
        joint.name = f"{joint.name} is moved {k}"
    for joint, source in zip(joints, order, strict=True):
        for name, value in was[source].items():
            setattr(joint, name, value)


_FIXED = ("classname", "compiler", "frame", "id", "parent", "set_frame", "signature")


def _copied(value: Any) -> Any:
    return value.copy() if isinstance(value, np.ndarray) else value


def moved_masses(model: mujoco.MjModel, base: Base) -> tuple[float, float]:
    """What a force along x and one along y accelerate: all that the joint carries, and its own ``armature`` [kg]."""
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, posed(model), matrix)
    along_x, along_y = (float(matrix[dof, dof]) for dof in base.dofs)
    return along_x, along_y


# Motors ------------------------------------------------------------------------------------------------------------------------


def find_motors(model: mujoco.MjModel, base: Base) -> tuple[Motor, Motor] | Reason | None:
    """The motors of x and y, however the robot is turned.

    A reason where an axis has none but an actuator that is no plain motor, or one beside its motor that acts at control 0; None
    where nothing pushes along an axis.
    """
    upright, turned = effects(model, posed(model)), effects(model, posed(model, 0.4))
    found: list[Motor] = []
    for dof in base.dofs:
        pushing = [u for u in range(model.nu) if _pushes(upright[u], turned[u], dof)]
        plain = [u for u in pushing if no_motor(model, u) is None]
        if not pushing:
            return None
        acting = [
            u for u in pushing if u not in plain and (not plain or model.actuator_biastype[u] != mujoco.mjtBias.mjBIAS_NONE)
        ]
        if acting:
            return Reason(model.actuator(acting[0]).name, no_motor(model, acting[0]) or "")
        found.append(_motor(model, plain[0], dof, float(upright[plain[0], dof])))
    return found[0], found[1]


def _pushes(effect: np.ndarray, turned: np.ndarray, dof: int) -> bool:
    """Whether an actuator acts on one degree of freedom alone, and alike in both poses."""
    others = np.delete(effect, dof)
    return bool(
        abs(effect[dof]) > 1e-9 and np.allclose(others, 0.0, atol=1e-8 * abs(effect[dof])) and np.allclose(effect, turned)
    )


def no_motor(model: mujoco.MjModel, u: int) -> str | None:
    """Why an actuator's force is not its control times a constant; None for a motor."""
    if model.actuator_dyntype[u] != mujoco.mjtDyn.mjDYN_NONE:
        kind = mujoco.mjtDyn(int(model.actuator_dyntype[u])).name.removeprefix("mjDYN_").lower()
        return f"its force follows its control through dynamics of type {kind!r}"
    if model.actuator_gaintype[u] != mujoco.mjtGain.mjGAIN_FIXED:
        return "its gain depends on its position or velocity"
    if model.actuator_biastype[u] != mujoco.mjtBias.mjBIAS_NONE and model.actuator_biasprm[u].any():
        position, velocity = model.actuator_biasprm[u, 1:3]
        if position:
            return "it is a position servo: its force depends on where the joint is"
        if velocity:
            return "it is a velocity servo or a damper: its force depends on how fast the joint is"
        return "it pushes even at control 0"
    if model.actuator_gainprm[u, 0] == 0.0:
        return "its gain is zero"
    if np.any(getattr(model, "actuator_delay", np.zeros(model.nu))[u]):
        return "its control acts after a delay"
    if np.any(getattr(model, "actuator_damping", np.zeros(model.nu))[u]):
        return "it damps the joint that it drives"
    return None


def _motor(model: mujoco.MjModel, u: int, dof: int, effect: float) -> Motor:
    """Every limit between control and base: ctrlrange, forcerange, and actuatorfrcrange of tendon and joint."""
    gain = float(model.actuator_gainprm[u, 0])
    limits = np.array([-np.inf, np.inf])
    if model.actuator_ctrllimited[u]:
        limits = np.sort(gain * model.actuator_ctrlrange[u])
    if model.actuator_forcelimited[u]:
        limits = np.clip(limits, *model.actuator_forcerange[u])
    if _on_tendon(model, u) and model.tendon_actfrclimited[model.actuator_trnid[u, 0]]:
        limits = np.clip(limits, *model.tendon_actfrcrange[model.actuator_trnid[u, 0]])
    limits = np.sort(effect * limits)
    joint = int(model.dof_jntid[dof])
    if model.jnt_actfrclimited[joint]:
        limits = np.clip(limits, *model.jnt_actfrcrange[joint])
    return Motor(model.actuator(u).name, effect, float(limits[0]), float(limits[1]))


def _on_tendon(model: mujoco.MjModel, u: int) -> bool:
    return bool(model.actuator_trntype[u] == mujoco.mjtTrn.mjTRN_TENDON)


def largest_force(motors: tuple[Motor, Motor]) -> float:
    """What both motors can give in every direction [N].

    Raises:
        ConfigurationError: a motor without a limit, or one that cannot push both ways.
    """
    for motor in motors:
        if not np.isfinite((motor.low, motor.high)).all():
            raise ConfigurationError(f"motor {motor.name!r} has no limit; it needs a ctrlrange, or a forcerange")
        if not motor.low < 0.0 < motor.high:
            raise ConfigurationError(
                f"motor {motor.name!r} pushes from {motor.low:g} to {motor.high:g} N only; it must push both ways along its axis"
            )
    return min(min(-motor.low, motor.high) for motor in motors)


# One form for all direct robots ------------------------------------------------------------------------------------------------


def straighten(spec: mujoco.MjSpec, body: str, joints: tuple[str, ...], motors: tuple[str, ...]) -> None:
    """Slides along +x and +y that read where the body is in the world, and motors whose control is the planar force.

    Raises:
        ConfigurationError: joints or motors that are not what their place in the robot says.
    """
    model = spec.copy().compile()
    data = posed(model)
    if len(joints) == 2:
        _refuse_turning_slides(model, [model.joint(name).id for name in joints])
        for axis, name in enumerate(joints):
            _straighten_slide(spec, model, data, name, axis, float(data.body(body).xpos[axis]))
    model = spec.copy().compile()
    base = base_of(model, body, joints)
    for axis, found in enumerate(check_motors(model, base, motors)):
        actuator = spec.actuator(found.name)
        gain = float(model.actuator_gainprm[model.actuator(found.name).id, 0])
        if found.scale != 1.0 or gain != 1.0:
            actuator.gear = np.array(actuator.gear) / found.scale
            gains = np.array(actuator.gainprm)
            gains[0] = 1.0
            actuator.gainprm = gains
        if len(joints) == 2:
            spec.joint(joints[axis]).actfrclimited = 0
        if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON:
            spec.tendon(actuator.target).actfrclimited = 0
        _limit(actuator, found.low, found.high)


def check_slides(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Raise ConfigurationError unless two joints slide along +x and +y, however the robot turns: unknown dynamics push there."""
    model = spec.copy().compile()
    _refuse_turning_slides(model, [model.joint(name).id for name in joints])
    directions = posed(model).xaxis
    for axis, name in enumerate(joints):
        k = model.joint(name).id
        if model.jnt_type[k] != _SLIDE or directions[k][axis] < 1.0 - _PARALLEL:
            raise ConfigurationError(
                f"joints[{axis}] {name!r} moves along {np.round(directions[k], 3).tolist()}; it must slide along +{'xy'[axis]}"
            )


def _limit(actuator: Any, low: float, high: float) -> None:
    bounded = bool(np.isfinite((low, high)).all())
    actuator.ctrlrange = actuator.forcerange = (low, high) if bounded else (0.0, 0.0)
    actuator.ctrllimited = actuator.forcelimited = int(bounded)


def base_of(model: mujoco.MjModel, body: str, joints: Sequence[str]) -> Base:
    """The base that a robot names."""
    first = [int(model.jnt_dofadr[model.joint(name).id]) for name in joints]
    return Base(model.body(body).id, tuple(joints), (first[0], first[-1] if len(first) == 2 else first[0] + 1))


def check_motors(model: mujoco.MjModel, base: Base, motors: Sequence[str]) -> tuple[Motor, Motor]:
    """The motors that a direct robot names.

    Raises:
        ConfigurationError: one is no plain motor, or does not push along its axis alone.
    """
    upright, turned = effects(model, posed(model)), effects(model, posed(model, 0.4))
    found: list[Motor] = []
    for axis, (name, dof) in enumerate(zip(motors, base.dofs, strict=True)):
        u = model.actuator(name).id
        why = no_motor(model, u)
        if why is not None:
            raise ConfigurationError(f"actuator {name!r} is no motor: {why}")
        if not _pushes(upright[u], turned[u], dof):
            raise ConfigurationError(f"motors[{axis}] {name!r} does not push along {'xy'[axis]} alone; motors name those of x, y")
        found.append(_motor(model, u, dof, float(upright[u, dof])))
    return found[0], found[1]


def _straighten_slide(
    spec: mujoco.MjSpec, model: mujoco.MjModel, data: mujoco.MjData, name: str, axis: int, place: float
) -> None:
    """Let a slide point along +x or +y and read ``place`` where the body is there."""
    joint, k = spec.joint(name), model.joint(name).id
    direction = data.xaxis[k]
    if _along(direction) != axis or model.jnt_type[k] != _SLIDE:
        raise ConfigurationError(
            f"joints[{axis}] {name!r} moves along {np.round(direction, 3).tolist()}; joints name the slides along x, y"
        )
    sense, reference = float(np.sign(direction[axis])), float(model.qpos0[model.jnt_qposadr[k]])
    if sense > 0.0 and abs(reference - place) < 1e-12:
        return
    _refuse_followers(model, k, name)
    joint.axis = sense * np.array(joint.axis)
    joint.ref = place
    joint.springref = place + sense * (float(joint.springref) - reference)
    if model.jnt_limited[k]:
        joint.range = np.sort(place + sense * (np.array(joint.range) - reference))
    if model.jnt_actfrclimited[k]:
        joint.actfrcrange = np.sort(sense * np.array(joint.actfrcrange))
    for actuator in spec.actuators:
        if actuator.trntype in _JOINTS and actuator.target == name:
            gear = np.array(actuator.gear)
            gear[0] *= sense
            actuator.gear = gear


def _refuse_followers(model: mujoco.MjModel, k: int, name: str) -> None:
    """Raise ConfigurationError where something else counts by the coordinate of a joint that is to change."""
    wrapped = (model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT) & (model.wrap_objid == k)
    coupled = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & ((model.eq_obj1id == k) | (model.eq_obj2id == k))
    if wrapped.any() or coupled.any():
        raise ConfigurationError(
            f"joint {name!r} is in a tendon or an equality and is reversed or offset; let it point along +x or +y from 0"
        )
    for u in range(model.nu):
        if model.actuator_trntype[u] in _JOINTS and model.actuator_trnid[u, 0] == k and model.actuator_biasprm[u, 1]:
            raise ConfigurationError(
                f"joint {name!r} has the servo {model.actuator(u).name!r} and is reversed or offset; let it start at 0"
            )
