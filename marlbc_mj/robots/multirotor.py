"""A rotorcraft at a held height: planar force -> tilt and thrust -> rotors, with the attitude loop inside.

The attitude of each axis follows the closed-loop response phi'' = -a phi - b phi' + a phi_wanted within the rotors' limits. Each
rotor has a share of thrust and moments, so any arrangement works; :mod:`marlbc_mj.robots.rotors` computes the shares.
"""

import numpy as np

from marlbc_mj.core import laws

MOST_ROTORS = 32
MOST_TILT = np.radians(32.0)  # largest commanded roll and pitch [rad]
_GAINS = {
    "mass": (),  # [kg]
    "gravity": (),  # [m/s^2]
    "height": (),  # [m]
    "height_stiffness": (),  # [1/s^2]
    "height_damping": (),  # [1/s]
    "inertia": 3,  # about the body's x, y and z [kg m^2]
    "stiffness": 3,  # a of roll, pitch and yaw [1/s^2]
    "damping": 3,  # b of roll, pitch and yaw [1/s]
    "thrust_lag": (),  # [s]
    "thrust_share": MOST_ROTORS,  # control of each rotor per unit of thrust [1/N]
    "moment_share": (MOST_ROTORS, 3),  # control of each rotor per unit of moment about x, y and z [1/(N m)]
    "least": MOST_ROTORS,  # least control of each rotor
    "most": MOST_ROTORS,  # greatest control of each rotor
    "lift": MOST_ROTORS,  # thrust of each rotor per unit of actuator force
}
_STATE = {
    "axis": 3,  # b, the body's z axis in the world
    "thrust": (),  # [N]
    "saturated": (),  # number of substeps with a rotor at its limit
    "height_error": (),  # largest so far [m]
    "tilt": (),  # largest so far [rad]
}
REPORT = ("saturated", "height_error", "tilt")


@laws.drive(gains=_GAINS, state=_STATE)
def rotor_drive(gains, state, qpos, qvel, force, h, ctrl_out):
    """Tilt and thrust that produce the planar force and hold the height, then each rotor's share of thrust and moments."""
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    b = state.axis
    b[0], b[1], b[2] = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    error = gains.height - qpos[2]
    rise = gains.gravity + gains.height_stiffness * error - gains.height_damping * qvel[2]
    lift = gains.mass * max(rise, 0.3 * gains.gravity)
    ahead, left = np.cos(yaw) * force[0] + np.sin(yaw) * force[1], np.cos(yaw) * force[1] - np.sin(yaw) * force[0]
    pitch = laws.clip(np.arctan2(ahead, lift), MOST_TILT)
    roll = laws.clip(-np.arctan2(left * np.cos(pitch), lift), MOST_TILT)
    state.thrust += (1.0 - np.exp(-h / gains.thrust_lag)) * (lift / max(b[2], 0.5) - state.thrust)
    roll -= np.arctan2(2.0 * (y * z + w * x), b[2])
    pitch -= np.arcsin(laws.clip(2.0 * (w * y - x * z), 1.0))
    state.saturated += allot(gains, state.thrust, roll, pitch, -yaw, qvel, ctrl_out)
    state.height_error = max(state.height_error, abs(error))
    state.tilt = max(state.tilt, np.arccos(laws.clip(b[2], 1.0)))


@laws.allocation_free
def allot(gains, thrust, roll, pitch, yaw, qvel, ctrl_out):
    """Controls of the rotors for a thrust [N] and for moments that reduce the errors in roll, pitch and yaw [rad].

    Returns 1 if any control was clipped to its limit, else 0.
    """
    a, b, inertia, saturated = gains.stiffness, gains.damping, gains.inertia, 0.0
    moment_x = inertia[0] * (a[0] * roll - b[0] * qvel[3])
    moment_y = inertia[1] * (a[1] * pitch - b[1] * qvel[4])
    moment_z = inertia[2] * (a[2] * yaw - b[2] * qvel[5])
    for k in range(ctrl_out.shape[0]):
        share = gains.moment_share[k]
        wish = gains.thrust_share[k] * thrust + share[0] * moment_x + share[1] * moment_y + share[2] * moment_z
        ctrl_out[k] = wish
        if wish < gains.least[k] or wish > gains.most[k]:
            ctrl_out[k] = gains.least[k] if wish < gains.least[k] else gains.most[k]
            saturated = 1.0
    return saturated


@laws.reading(gains=_GAINS, state=_STATE)
def rotor_reading(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    """p, v of the body; the planar part of the rotors' thrust along the body axis that the drive used."""
    thrust = 0.0
    for k in range(actuator_force.shape[0]):
        thrust += gains.lift[k] * actuator_force[k]
    for axis in range(2):
        p_out[axis] = qpos[axis]
        v_out[axis] = qvel[axis]
        force_out[axis] = thrust * state.axis[axis]
