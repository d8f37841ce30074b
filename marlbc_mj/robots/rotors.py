"""Gains of a rotorcraft's laws from its MJCF; the rotors' shares are the pseudo-inverse of their effects."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from marlbc_mj.robots.motors import effects, no_motor
from marlbc_mj.robots.multirotor import MOST_ROTORS
from marlbc_mj.util.errors import ConfigurationError

HEIGHT_STIFFNESS, HEIGHT_DAMPING = 16.0, 8.0  # gains of the height loop [1/s^2, 1/s]


class Attitude(NamedTuple):
    """Closed-loop response of roll, pitch and yaw, and the thrust lag."""

    stiffness: tuple[float, float, float]  # a [1/s^2]
    damping: tuple[float, float, float]  # b [1/s]
    thrust_lag: float  # [s]


class RotorNumbers(NamedTuple):
    """Gains and state of the two laws, and the robot's mass."""

    params: dict[str, Any]
    state: dict[str, Any]
    mass: float  # [kg]


def rotor_numbers(spec: mujoco.MjSpec, body: str, attitude: Attitude) -> RotorNumbers:
    """Gains and state of the two laws for a robot at rest, and its mass.

    Raises:
        ConfigurationError: the rotors cannot give thrust and moments about x and y, are too many, or are not plain motors.
    """
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass, gravity = float(model.body(body).subtreemass[0]), -float(model.opt.gravity[2])
    params = {
        "mass": mass,
        "gravity": gravity,
        "height": float(data.body(body).xpos[2]),
        "height_stiffness": HEIGHT_STIFFNESS,
        "height_damping": HEIGHT_DAMPING,
        "inertia": tuple(model.body(body).inertia.tolist()),
        **attitude._asdict(),
        **_rotors(model, data, spec.modelname),
    }
    return RotorNumbers(params, {"axis": (0.0, 0.0, 1.0), "thrust": mass * gravity}, mass)


def agility(params: dict[str, Any]) -> float:
    """Angular acceleration about x and y that the rotors can give in either sense while hovering [rad/s^2]."""
    shares, least, most = (np.array(params[name]) for name in ("moment_share", "least", "most"))
    hover = params["mass"] * params["gravity"] * np.array(params["thrust_share"])
    room, turning = np.minimum(most - hover, hover - least), np.abs(shares[:, :2])
    moments = [float((room[used > 1e-12] / used[used > 1e-12]).min()) for used in turning.T]
    return max(float((np.array(moments) / params["inertia"][:2]).min()), 0.0)


def _rotors(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> dict[str, Any]:
    """The gains with one number or row per rotor, padded with zeros to MOST_ROTORS."""
    if model.nu > MOST_ROTORS:
        raise ConfigurationError(f"{name}: at most {MOST_ROTORS} rotors, got {model.nu}")
    for u in range(model.nu):
        why = no_motor(model, u)
        if why is not None:
            raise ConfigurationError(f"{name}: actuator {model.actuator(u).name!r} is not a motor: {why}")
    effect = effects(model, data)
    rotors = effect[:, 2:6].T * model.actuator_gainprm[:, 0]  # (4, rotors): lift and moments
    if np.linalg.matrix_rank(rotors[:3], tol=1e-9) < 3:
        raise ConfigurationError(f"{name}: {model.nu} actuators cannot give a thrust and moments about x and y")
    turning = np.linalg.matrix_rank(rotors, tol=1e-9) == 4  # if not, the heading is not controlled
    shares = np.linalg.pinv(rotors) if turning else np.pad(np.linalg.pinv(rotors[:3]), ((0, 0), (0, 1)))
    least, most = _control_limits(model)
    lift = rotors[0] / model.actuator_gainprm[:, 0]
    own = {"thrust_share": shares[:, 0], "moment_share": shares[:, 1:], "least": least, "most": most, "lift": lift}
    padding = MOST_ROTORS - model.nu
    return {key: [*rows.tolist(), *np.zeros((padding, *rows.shape[1:])).tolist()] for key, rows in own.items()}


def _control_limits(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """(rotors,) least and greatest controls within ``ctrlrange`` and ``forcerange``."""
    limits = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-np.inf, np.inf))
    by_force = np.sort(model.actuator_forcerange / model.actuator_gainprm[:, :1], axis=1)
    by_force = np.where(model.actuator_forcelimited[:, None], by_force, (-np.inf, np.inf))
    least, most = np.clip(limits, by_force[:, :1], by_force[:, 1:]).T
    return least, most
