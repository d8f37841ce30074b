"""A differential drive with a caster: a point ahead of the axle follows second-order laws as if it were a point mass.

The point p = c + l (cos t, sin t) has p'' = R(t) (u' - l w^2, l w' + u w) for the axle's speed u and turn rate w. So p'' gives
u', w' and the wheels' torques (d'Andrea-Novel, Campion, Bastin 1995). With the center of mass d ahead of the axle,
m u' = F + m d w^2 and I w' = M - m d u w.
"""

import mujoco
import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.robots.base import MODELS, Robot
from marlbc_mj.robots.wheels import heading, inertia

DIFF_DRIVE = "6.6 kg base on two driven wheels and a caster, led by a point 0.15 m ahead of its axle"
_WHEEL, TRACK, AHEAD = 0.06, 0.17, 0.15  # radius of a wheel, half the track, distance from the axle to the point [m]
_MJCF = MODELS / "robots" / "diff_drive.xml"


_GAINS = (
    "wheel",  # r, radius of a wheel [m]
    "half_track",  # b [m]
    "ahead",  # l, distance from the axle to the point ahead [m]
    "mass",  # m, spinning wheels included [kg]
    "inertia",  # I about z, spinning wheels included [kg m^2]
    "offset",  # m d, d from the axle to the center of mass [kg m]
    "torque_limit",  # [N m]
)
# t [rad], u [m/s], w [rad/s], substeps at the torque limit (each wheel counts 0.5)
_STATE = ("heading", "speed", "turn_rate", "saturated")


@laws.drive(gains=_GAINS, state=_STATE)
def diff_drive_drive(gains, state, qpos, qvel, force, h, ctrl_out):
    """Torques of the left and right wheel for p'' = F / m."""
    r, b, ahead, mass, turn, offset = gains.wheel, gains.half_track, gains.ahead, gains.mass, gains.inertia, gains.offset
    t = heading(qpos[3:7])
    u, w = np.cos(t) * qvel[0] + np.sin(t) * qvel[1], qvel[5]
    along, across = np.cos(t) * force[0] + np.sin(t) * force[1], np.cos(t) * force[1] - np.sin(t) * force[0]
    push = mass * (along / mass + ahead * w * w) - offset * w * w
    moment = turn * (across / mass - u * w) / ahead + offset * u * w
    state.heading, state.speed, state.turn_rate = t, u, w
    for k in range(2):
        wish = 0.5 * r * (push + (2 * k - 1) * moment / b)
        ctrl_out[k] = laws.clip(wish, gains.torque_limit)
        state.saturated += 0.5 if ctrl_out[k] != wish else 0.0


@laws.reading(gains=_GAINS, state=_STATE)
def diff_drive_reading(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    """p, v of the point ahead; force = m p'' for the applied torques, with heading and rates that the drive used."""
    r, b, ahead, mass, turn, offset = gains.wheel, gains.half_track, gains.ahead, gains.mass, gains.inertia, gains.offset
    t, w = heading(qpos[3:7]), qvel[5]
    p_out[0], p_out[1] = qpos[0] + ahead * np.cos(t), qpos[1] + ahead * np.sin(t)
    v_out[0], v_out[1] = qvel[0] - ahead * w * np.sin(t), qvel[1] + ahead * w * np.cos(t)
    t, u, w = state.heading, state.speed, state.turn_rate
    push, moment = (actuator_force[0] + actuator_force[1]) / r, (actuator_force[1] - actuator_force[0]) * b / r
    along = push + offset * w * w - mass * ahead * w * w
    across = mass * (ahead * (moment - offset * u * w) / turn + u * w)
    force_out[0] = np.cos(t) * along - np.sin(t) * across
    force_out[1] = np.sin(t) * along + np.cos(t) * across


def diff_drive() -> Robot:
    """The differential drive. Inertias come from the MJCF; wheel spin adds 2 I / r^2 to m and 2 I (b / r)^2 to yaw inertia."""
    own = inertia(mujoco.MjSpec.from_file(str(_MJCF)))
    mass, turn = own.mass + 2.0 * own.wheel / _WHEEL**2, own.turn + 2.0 * own.wheel * (TRACK / _WHEEL) ** 2
    return Robot(
        name="diff_drive",
        mjcf=_MJCF,
        joints=("root",),
        body="body",
        radius=0.23,  # about the middle of the shell
        description=DIFF_DRIVE,
        drive=diff_drive_drive,
        reading=diff_drive_reading,
        params={
            "wheel": _WHEEL,
            "half_track": TRACK,
            "ahead": AHEAD,
            "mass": mass,
            "inertia": turn,
            "offset": own.mass * own.ahead,
            "torque_limit": 0.8,
        },
        report=("heading", "saturated"),
        mass=mass,
        force_limit=10.0,
        speed_limit=1.2,
        acceleration_limit=1.0,
        gains=(36.0, 12.0),
        length=0.6,
        substep=0.0025,
        contact=True,
        tube=0.3,  # measured: 0.23 m, see studies/shield_robots
    )
