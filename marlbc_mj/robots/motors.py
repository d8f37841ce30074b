"""Finds the motors that push a base along x and y by their effect, with all limits between control and base."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from marlbc_mj.util.errors import ConfigurationError


class Motor(NamedTuple):
    """An actuator that pushes a base along x or y and does nothing else."""

    name: str
    scale: float  # planar force per actuator force [N/N]
    low: float  # least planar force that all limits allow [N]
    high: float  # greatest planar force that all limits allow [N]


class Reason(NamedTuple):
    """An actuator along x or y that is not a plain motor, and why."""

    name: str
    why: str


def posed(model: mujoco.MjModel, turn: float = 0.0) -> mujoco.MjData:
    """Data of the model at its reference pose, with every joint moved by ``turn`` [rad or m]."""
    data = mujoco.MjData(model)
    if turn:
        mujoco.mj_integratePos(model, data.qpos, np.full(model.nv, turn), 1.0)
    mujoco.mj_forward(model, data)
    return data


def effects(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """(actuators, nv) generalized forces of each actuator at unit force."""
    effect = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(effect, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return effect


def find_motors(model: mujoco.MjModel, dofs: tuple[int, int]) -> tuple[Motor, Motor] | Reason | None:
    """The motors that push along x and y in every pose of the robot.

    Returns:
        The two motors; a reason if none of the actuators of an axis is a plain motor, or if one beside the motor acts at control
        0; None if no actuator pushes along an axis.
    """
    upright, turned = effects(model, posed(model)), effects(model, posed(model, 0.4))
    found: list[Motor] = []
    for dof in dofs:
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
    """Whether an actuator acts on one degree of freedom only, with the same effect in both poses."""
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
    if any(np.any(getattr(model, name, np.zeros(model.nu))[u]) for name in ("actuator_damping", "actuator_dampingpoly")):
        return "it damps the joint that it drives"
    return None


def _motor(model: mujoco.MjModel, u: int, dof: int, effect: float) -> Motor:
    """A motor with all limits between control and base: ctrlrange, forcerange, and actuatorfrcrange of tendon and joint."""
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
    """The largest force that both motors can apply in both directions along their axes [N].

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


def check_motors(model: mujoco.MjModel, dofs: tuple[int, int], motors: Sequence[str]) -> tuple[Motor, Motor]:
    """The motors that a direct robot names.

    Raises:
        ConfigurationError: an actuator is not a plain motor, or does not push along its axis only.
    """
    upright, turned = effects(model, posed(model)), effects(model, posed(model, 0.4))
    found: list[Motor] = []
    for axis, (name, dof) in enumerate(zip(motors, dofs, strict=True)):
        u = model.actuator(name).id
        why = no_motor(model, u)
        if why is not None:
            raise ConfigurationError(f"actuator {name!r} is not a motor: {why}")
        if not _pushes(upright[u], turned[u], dof):
            raise ConfigurationError(
                f"motors[{axis}] {name!r} does not push along {'xy'[axis]} alone; motors must name those of x and y"
            )
        found.append(_motor(model, u, dof, float(upright[u, dof])))
    return found[0], found[1]
