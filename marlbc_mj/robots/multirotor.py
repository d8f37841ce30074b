"""A rotorcraft at a held height: planar force -> tilt and thrust -> rotors, with the attitude loop inside.

The attitude follows the closed-loop response phi'' = -a phi - b phi' + a phi_wanted of each axis, as far as the rotors' limits
allow. Rotors are allotted by the pseudo-inverse of what they do to thrust and moments, read from the MJCF, so any arrangement
works.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError

FIXED, EACH = 15, 7  # numbers in front, and for each rotor
MOST_TILT = np.radians(32.0)  # that is asked for
STATE = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)  # b_x, b_y, b_z, thrust, saturated substeps, worst height error, worst tilt
DIAGNOSTICS = {"saturated": 4, "height_error": 5, "tilt": 6}


class Attitude(NamedTuple):
    """Closed-loop response of roll, pitch and yaw, and the lag of the thrust."""

    stiffness: tuple[float, float, float]  # a [1/s^2]
    damping: tuple[float, float, float]  # b [1/s]
    thrust_lag: float  # [s]


@laws.drive
def rotor_drive(params, state, qpos, qvel, force, h, ctrl_out):  # type: ignore[no-untyped-def]
    """``params`` = mass, gravity, height, stiffness and damping of the height, inertia (3), a (3), b (3), thrust lag; then for
    each rotor its share of thrust and moments (4), least and largest control, and what it lifts.
    """
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    state[0], state[1], state[2] = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    error = params[2] - qpos[2]
    lift = params[0] * max(params[1] + params[3] * error - params[4] * qvel[2], 0.3 * params[1])
    ahead, left = np.cos(yaw) * force[0] + np.sin(yaw) * force[1], np.cos(yaw) * force[1] - np.sin(yaw) * force[0]
    pitch = laws.clip(np.arctan2(ahead, lift), MOST_TILT)
    roll = laws.clip(-np.arctan2(left * np.cos(pitch), lift), MOST_TILT)
    state[3] += (1.0 - np.exp(-h / params[14])) * (lift / max(state[2], 0.5) - state[3])
    roll -= np.arctan2(2.0 * (y * z + w * x), state[2])
    pitch -= np.arcsin(laws.clip(2.0 * (w * y - x * z), 1.0))
    moment_x = params[5] * (params[8] * roll - params[11] * qvel[3])
    moment_y = params[6] * (params[9] * pitch - params[12] * qvel[4])
    moment_z = params[7] * (-params[10] * yaw - params[13] * qvel[5])
    saturated = 0.0
    for k in range(ctrl_out.shape[0]):
        at = FIXED + EACH * k
        wish = params[at] * state[3] + params[at + 1] * moment_x + params[at + 2] * moment_y + params[at + 3] * moment_z
        ctrl_out[k] = wish
        if wish < params[at + 4] or wish > params[at + 5]:
            ctrl_out[k] = params[at + 4] if wish < params[at + 4] else params[at + 5]
            saturated = 1.0
    state[4] += saturated
    state[5] = max(state[5], abs(error))
    state[6] = max(state[6], np.arccos(laws.clip(state[2], 1.0)))


@laws.reading
def rotor_reading(params, state, qpos, qvel, actuator_force, p_out, v_out, force_out):  # type: ignore[no-untyped-def]
    """p, v of the body; the planar part of the rotors' thrust along the axis that the drive saw."""
    thrust = 0.0
    for k in range(actuator_force.shape[0]):
        thrust += params[FIXED + EACH * k + 6] * actuator_force[k]
    for axis in range(2):
        p_out[axis] = qpos[axis]
        v_out[axis] = qvel[axis]
        force_out[axis] = thrust * state[axis]


def rotor_numbers(spec: mujoco.MjSpec, body: str, attitude: Attitude) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Params and state of the two laws for a robot at rest, and its mass [kg].

    Raises:
        ConfigurationError: the rotors cannot give thrust and three moments.
    """
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    effect = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(effect, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    rotors = effect[:, 2:6].T * model.actuator_gainprm[:, 0]  # (4, rotors): lift and moments
    if np.linalg.matrix_rank(rotors, tol=1e-9) < 4:
        raise ConfigurationError(f"{spec.modelname}: {model.nu} actuators cannot give a thrust and three moments")
    shares = np.linalg.pinv(rotors)
    limits = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-np.inf, np.inf))
    mass, inertia = float(model.body(body).subtreemass[0]), model.body(body).inertia
    gravity, height = -float(model.opt.gravity[2]), float(data.body(body).xpos[2])
    numbers = [mass, gravity, height, 16.0, 8.0, *inertia, *attitude.stiffness, *attitude.damping, attitude.thrust_lag]
    rows = np.column_stack([shares, limits, rotors[0] / model.actuator_gainprm[:, 0]])
    params = (*map(float, numbers), *map(float, rows.ravel()))
    return params, (*STATE[:3], mass * gravity, *STATE[4:]), mass
