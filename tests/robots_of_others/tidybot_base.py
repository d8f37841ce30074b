"""The TidyBot base: its slides have position servos of known law, which is solved for the control that gives a wanted force."""

from pathlib import Path

from marlbc_mj.core import laws
from marlbc_mj.robots import Robot

STIFFNESS, DAMPING = 1e6, 5e4  # kp [N/m] and kv [N s/m] of the servos along x and y
_GAINS = ("stiffness", "damping")


@laws.drive(gains=_GAINS)
def tidybot_drive(gains, state, qpos, qvel, force, h, ctrl_out):
    """Control u with kp (u - q) - kv q' = F; the heading's servo holds 0."""
    for axis in range(2):
        ctrl_out[axis] = qpos[axis] + (force[axis] + gains.damping * qvel[axis]) / gains.stiffness
    ctrl_out[2] = 0.0


@laws.reading(gains=_GAINS)
def tidybot_reading(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    """Position, velocity and servo force of each slide."""
    for axis in range(2):
        p_out[axis], v_out[axis], force_out[axis] = qpos[axis], qvel[axis], actuator_force[axis]


ROBOT = Robot(
    name="tidybot_base",
    mjcf=Path(__file__).with_name("tidybot_base.xml"),
    description="60 kg base on position servos",
    joints=("joint_x", "joint_y"),
    body="base_link",
    radius=0.37,
    drive=tidybot_drive,
    reading=tidybot_reading,
    params={"stiffness": STIFFNESS, "damping": DAMPING},
    mass=60.0,
    force_limit=120.0,  # chosen freely: the file limits neither control nor force
    speed_limit=1.0,
    acceleration_limit=1.0,
    gains=(36.0, 12.0),
    length=0.75,
    substep=0.0025,
)
