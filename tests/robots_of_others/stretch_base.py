"""The Stretch's base, led by a point ahead of its axle: motors drive the wheels' sum and difference, and bearings brake."""

from pathlib import Path

import mujoco
import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.robots import Robot
from marlbc_mj.robots.wheels import heading, inertia

WHEEL, HALF_TRACK, AHEAD, BRAKE, GEAR = 0.05, 0.17035, 0.2, 0.3, 3.0  # [m, m, m, N m s/rad, 1]
MJCF = Path(__file__).with_name("stretch_base.xml")
_GAINS = ("wheel", "half_track", "ahead", "brake", "gear", "mass", "inertia", "offset")
_STATE = ("heading", "speed", "turn_rate", "braking", "twisting", "saturated")


@laws.drive(gains=_GAINS, state=_STATE)
def stretch_drive(gains, state, qpos, qvel, force, h, ctrl_out):
    """Force and moment for p'' = F / m of the leading point, plus the bearings' torque; the MJCF's wheels turn backwards."""
    t = heading(qpos[3:7])
    state.heading, state.turn_rate = t, qvel[5]
    state.speed = np.cos(t) * qvel[0] + np.sin(t) * qvel[1]
    along, across = np.cos(t) * force[0] + np.sin(t) * force[1], np.cos(t) * force[1] - np.sin(t) * force[0]
    push = gains.mass * (along / gains.mass + gains.ahead * state.turn_rate**2) - gains.offset * state.turn_rate**2
    moment = gains.inertia * (across / gains.mass - state.speed * state.turn_rate) / gains.ahead
    moment += gains.offset * state.speed * state.turn_rate
    state.braking, state.twisting = gains.brake * (qvel[6] + qvel[7]), gains.brake * (qvel[6] - qvel[7])
    ctrl_out[0] = laws.clip((state.braking - gains.wheel * push) / gains.gear, 1.0)
    ctrl_out[1] = laws.clip((state.twisting - gains.wheel * moment / gains.half_track) / gains.gear, 1.0)
    state.saturated += 1.0 if max(abs(ctrl_out[0]), abs(ctrl_out[1])) >= 1.0 else 0.0


@laws.reading(gains=_GAINS, state=_STATE)
def stretch_reading(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    """p and v of the leading point; force = m p'' from the motors' and bearings' torques, for the motion that the drive saw."""
    t, w = heading(qpos[3:7]), qvel[5]
    p_out[0], p_out[1] = qpos[0] + gains.ahead * np.cos(t), qpos[1] + gains.ahead * np.sin(t)
    v_out[0], v_out[1] = qvel[0] - gains.ahead * w * np.sin(t), qvel[1] + gains.ahead * w * np.cos(t)
    t, w = state.heading, state.turn_rate
    push = (state.braking - gains.gear * actuator_force[0]) / gains.wheel
    moment = (state.twisting - gains.gear * actuator_force[1]) * gains.half_track / gains.wheel
    along = push + (gains.offset - gains.mass * gains.ahead) * w**2
    across = gains.mass * (gains.ahead * (moment - gains.offset * state.speed * w) / gains.inertia + state.speed * w)
    force_out[0], force_out[1] = np.cos(t) * along - np.sin(t) * across, np.sin(t) * along + np.cos(t) * across


def robot() -> Robot:
    """The robot, with inertias read from the MJCF; spinning wheels add to mass and turning inertia."""
    own = inertia(mujoco.MjSpec.from_file(str(MJCF)))
    mass, turn = own.mass + 2.0 * own.wheel / WHEEL**2, own.turn + 2.0 * own.wheel * (HALF_TRACK / WHEEL) ** 2
    gains = {"wheel": WHEEL, "half_track": HALF_TRACK, "ahead": AHEAD, "brake": BRAKE, "gear": GEAR, "mass": mass}
    return Robot(
        name="stretch_base",
        mjcf=MJCF,
        description="base on two wheels, led by a point 0.2 m ahead of its axle",
        joints=("joint1",),
        body="base_link",
        radius=0.3,
        drive=stretch_drive,
        reading=stretch_reading,
        params={**gains, "inertia": turn, "offset": own.mass * own.ahead},
        report=("saturated",),
        mass=mass,
        force_limit=25.0,
        speed_limit=0.12,  # at which the bearings take half of the motors' torque
        acceleration_limit=0.15,
        gains=(9.0, 6.0),
        length=0.6,
        substep=0.0025,
        contact=True,
        ground=True,
    )
