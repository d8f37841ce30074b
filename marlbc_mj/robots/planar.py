"""Finds the planar motion of an MJCF and the actuators that push it by their effect, not by names or order.

The controls of a direct robot are its planar force, and its p and v are its joints' coordinates and velocities.
:func:`straighten` converts motors and a base on two slides to this form, whatever their gear, sense, reference and place, without
changing the motion.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from marlbc_mj.robots.motors import check_motors, posed
from marlbc_mj.util.errors import ConfigurationError

_SLIDE, _FREE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_FREE)
_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_PARALLEL = 1e-6


# Bases -------------------------------------------------------------------------------------------------------------------------


class Base(NamedTuple):
    """The body that moves in the plane and carries the rest, and its joints along x and y or its free joint."""

    body: int
    joints: tuple[str, ...]
    dofs: tuple[int, int]


def find_base(model: mujoco.MjModel, root: int) -> Base:
    """The base of a model with ``root`` as its first moving body; the two slides may be on nested bodies.

    Raises:
        ConfigurationError: there is neither a free joint nor a pair of slides along x and y, or a joint turns the slides.
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
    """0 for a direction along +x or -x, 1 for +y or -y, None for any other."""
    at = int(np.argmax(np.abs(direction)))
    return at if at < 2 and abs(abs(direction[at]) - 1.0) < _PARALLEL else None


def _refuse_turning_slides(model: mujoco.MjModel, slides: Sequence[int]) -> None:
    """Raise ConfigurationError if a joint before the slides turns them."""
    last = max(slides)
    tree = model.body_rootid[model.jnt_bodyid]
    for j in range(last):
        if model.jnt_type[j] != _SLIDE and tree[j] == tree[last] and model.jnt_bodyid[j] <= model.jnt_bodyid[last]:
            raise ConfigurationError(
                f"joint {model.joint(j).name!r} comes before the slide joints and turns them away from x and y; put it after them"
            )


def slides_first(spec: mujoco.MjSpec) -> list[str]:
    """Move vertical hinges behind the slides of the same body, so that the base turns about itself; returns their names.

    A yaw hinge before the slides turns them too, about the place where the base starts in its file. In a team's world an agent
    may start anywhere.
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
    """Give joint k all attributes of joint ``order[k]``, including the name by which actuators and others refer to it."""
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
    """Effective masses along x and y [kg]: everything that the joint carries, plus its ``armature``."""
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, posed(model), matrix)
    along_x, along_y = (float(matrix[dof, dof]) for dof in base.dofs)
    return along_x, along_y


# One form for all direct robots ------------------------------------------------------------------------------------------------


def straighten(spec: mujoco.MjSpec, body: str, joints: tuple[str, ...], motors: tuple[str, ...]) -> None:
    """Change slides to point along +x and +y and to read the body's world position, and motors to take the planar force.

    Raises:
        ConfigurationError: a joint or motor that is not along its axis, or that cannot be converted.
    """
    model = spec.copy().compile()
    data = posed(model)
    if len(joints) == 2:
        _refuse_turning_slides(model, [model.joint(name).id for name in joints])
        for axis, name in enumerate(joints):
            _straighten_slide(spec, model, data, name, axis, float(data.body(body).xpos[axis]))
    model = spec.copy().compile()
    base = base_of(model, body, joints)
    for axis, found in enumerate(check_motors(model, base.dofs, motors)):
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
    """Raise ConfigurationError unless two joints always slide along +x and +y, where unknown dynamics act on them."""
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
    """The base given by the names of a body and its joints."""
    first = [int(model.jnt_dofadr[model.joint(name).id]) for name in joints]
    return Base(model.body(body).id, tuple(joints), (first[0], first[-1] if len(first) == 2 else first[0] + 1))


def _straighten_slide(
    spec: mujoco.MjSpec, model: mujoco.MjModel, data: mujoco.MjData, name: str, axis: int, place: float
) -> None:
    """Make a slide point along +x or +y and read ``place`` at the reference pose."""
    joint, k = spec.joint(name), model.joint(name).id
    direction = data.xaxis[k]
    if _along(direction) != axis or model.jnt_type[k] != _SLIDE:
        raise ConfigurationError(
            f"joints[{axis}] {name!r} moves along {np.round(direction, 3).tolist()}; joints must name the slides along x and y"
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
    """Raise ConfigurationError if a tendon, equality or servo depends on the coordinate of a joint that must change."""
    wrapped = (model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT) & (model.wrap_objid == k)
    coupled = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & ((model.eq_obj1id == k) | (model.eq_obj2id == k))
    if wrapped.any() or coupled.any():
        raise ConfigurationError(
            f"joint {name!r} is used by a tendon or an equality, so it must not be reversed or offset; "
            "let it point along +x or +y from 0"
        )
    for u in range(model.nu):
        if model.actuator_trntype[u] in _JOINTS and model.actuator_trnid[u, 0] == k and model.actuator_biasprm[u, 1]:
            raise ConfigurationError(
                f"joint {name!r} has the servo {model.actuator(u).name!r} and must not be reversed or offset; let it start at 0"
            )
