"""Between planar forces and MuJoCo's controls, and back: directly, or by the robot's own laws."""

from marlbc_mj.core.compiling import allocation_free, on_both_paths
from marlbc_mj.engine.native import as_drive, as_reading

DIVERGED = 1e9
"""A position, velocity or force beyond this (or NaN) stops the world before MuJoCo sees it."""


@allocation_free
def scale_rows(rows, factor):
    """Multiply (N, 2) by a number, in place."""
    for i in range(rows.shape[0]):
        for axis in range(2):
            rows[i, axis] *= factor


@allocation_free
def out_of_range(spans, ctrl):
    """0, or 1 + the first agent with a control that is not finite or huge."""
    for i in range(spans.shape[1]):
        for k in range(spans[2, i, 0], spans[2, i, 1]):
            if not abs(ctrl[k]) < DIVERGED:
                return 1 + i
    return 0


@on_both_paths
def actuate(drive, plant, state, qpos, qvel, force, h, ctrl):
    """Turn planar forces (N, 2) into ctrl: as they are for direct robots, by the robot's ``drive`` law for others.

    Returns 0, or 1 + agent where a control is not finite or huge.
    """
    failed = 0
    if plant.spans.shape[1] == 0:
        for i in range(force.shape[0]):
            for axis in range(2):
                ctrl[plant.ctrl_index[i, axis]] = force[i, axis]
    else:
        law = as_drive(drive)
        law(plant.robot_params, state, qpos, qvel, force, h, plant.spans, ctrl)
        failed = out_of_range(plant.spans, ctrl)
    return failed


@on_both_paths
def read_robot(reading, plant, state, qpos, qvel, actuator_force, p, v, force):
    """Read p and v (N, 2) after a step, and the planar ``force`` (N, 2) that the actuators really gave."""
    if plant.spans.shape[1] > 0:
        law = as_reading(reading)
        law(plant.robot_params, state, qpos, qvel, actuator_force, plant.spans, p, v, force)
    else:
        for i in range(p.shape[0]):
            for axis in range(2):
                p[i, axis] = qpos[plant.qpos_index[i, axis]]
                v[i, axis] = qvel[plant.qvel_index[i, axis]]
                force[i, axis] = actuator_force[plant.ctrl_index[i, axis]]
