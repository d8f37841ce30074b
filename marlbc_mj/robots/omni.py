"""A base on three omnidirectional wheels that can apply a planar force in any direction and holds its heading at zero."""

import mujoco
import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.robots.base import MODELS, Robot
from marlbc_mj.robots.wheels import heading, inertia

OMNI = "5.5 kg base on three omnidirectional wheels with motors, heading held"
_WHEEL, ARM = 0.04, 0.16  # radius of a wheel, its distance from the center [m]
STIFFNESS, DAMPING = 60.0, 15.0  # gains of the heading loop [1/s^2, 1/s]
_MJCF = MODELS / "robots" / "omni.xml"


_GAINS = ("wheel", "arm", "inertia", "torque_limit", "stiffness", "damping")  # [m, m, kg m^2, N m, 1/s^2, 1/s]
_STATE = ("heading", "saturated")  # [rad], number of substeps with a torque at its limit


@laws.drive(gains=_GAINS, state=_STATE)
def omni_drive(gains, state, qpos, qvel, force, h, ctrl_out):
    """tau_k = r (2/3 t_k . F + M / (3 R)), where t_k is the driving direction of wheel k and M turns the heading back to zero."""
    state.heading = heading(qpos[3:7])
    moment = -gains.inertia * (gains.stiffness * state.heading + gains.damping * qvel[5])
    saturated = 0.0
    for k in range(3):
        angle = state.heading + np.pi * (2 * k + 1) / 3.0
        along = -np.sin(angle) * force[0] + np.cos(angle) * force[1]
        wish = gains.wheel * (2.0 / 3.0 * along + moment / (3.0 * gains.arm))
        ctrl_out[k] = laws.clip(wish, gains.torque_limit)
        saturated = 1.0 if ctrl_out[k] != wish else saturated
    state.saturated += saturated


@laws.reading(gains=_GAINS, state=_STATE)
def omni_reading(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    """p, v of the center; F = sum of t_k tau_k / r with the heading that the drive used."""
    for axis in range(2):
        p_out[axis] = qpos[axis]
        v_out[axis] = qvel[axis]
        force_out[axis] = 0.0
    for k in range(3):
        angle = state.heading + np.pi * (2 * k + 1) / 3.0
        force_out[0] -= np.sin(angle) * actuator_force[k] / gains.wheel
        force_out[1] += np.cos(angle) * actuator_force[k] / gains.wheel


def omni() -> Robot:
    """The omnidirectional base. Inertias come from the MJCF; the wheels that a planar force spins add 3/2 I / r^2 to the mass."""
    own = inertia(mujoco.MjSpec.from_file(str(_MJCF)))
    turn = own.turn + 3.0 * own.wheel * (ARM / _WHEEL) ** 2
    gains = {"wheel": _WHEEL, "arm": ARM, "inertia": turn, "torque_limit": 1.2, "stiffness": STIFFNESS, "damping": DAMPING}
    return Robot(
        name="omni",
        mjcf=_MJCF,
        joints=("root",),
        body="body",
        radius=0.2,
        description=OMNI,
        drive=omni_drive,
        reading=omni_reading,
        params=gains,
        report=("heading", "saturated"),
        mass=own.mass + 1.5 * own.wheel / _WHEEL**2,
        force_limit=12.0,
        speed_limit=1.5,
        acceleration_limit=1.5,
        gains=(64.0, 16.0),
        length=0.5,
        substep=0.0025,
        contact=True,
        force_error=3.0,  # studies/shield_robots measures 2.3 N that last; ``slip`` covers the lag of the wheels
        slip=0.004,
    )
