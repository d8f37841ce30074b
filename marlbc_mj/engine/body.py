"""Conversion of planar forces to MuJoCo's controls and back, directly or by the robots' own laws."""

from marlbc_mj.core.compiling import allocation_free, on_both_paths
from marlbc_mj.engine.native import as_drive, as_reading

DIVERGED = 1e9
"""A position, velocity or force beyond this (or NaN) stops the world before MuJoCo sees it."""


@allocation_free
def scale_rows(rows, factors):
    """Multiply each row of ``rows`` (N, 2) by its entry of ``factors`` (N,), in place."""
    for i in range(rows.shape[0]):
        for axis in range(2):
            rows[i, axis] *= factors[i]


@allocation_free
def shrink_rows(rows, units):
    """Divide each row of ``rows`` (N, 2) by its entry of ``units`` (N,), in place."""
    for i in range(rows.shape[0]):
        factor = 1.0 / units[i]
        for axis in range(2):
            rows[i, axis] *= factor


@allocation_free
def out_of_range(spans, ctrl):
    """1 + the first of the agents with these ``spans`` (n, 3, 2) that has a huge or non-finite control; 0 if there is none."""
    for i in range(spans.shape[0]):
        for k in range(spans[i, 2, 0], spans[i, 2, 1]):
            if not abs(ctrl[k]) < DIVERGED:
                return 1 + i
    return 0


@on_both_paths
def actuate(drives, plant, state, qpos, qvel, force, h, ctrl):
    """Convert planar forces (N, 2) to ctrl: unchanged for direct robots, by the ``drives`` of the groups for others.

    Returns 0, or 1 + agent if a control of a group is huge or not finite.
    """
    for i in range(force.shape[0]):
        if plant.ctrl_index[i, 0] >= 0:
            for axis in range(2):
                ctrl[plant.ctrl_index[i, axis]] = force[i, axis]
    for g in range(plant.groups.shape[0]):
        first, end = plant.groups[g, 0], plant.groups[g, 1]
        law, spans = as_drive(drives[g]), plant.spans[first:end]
        law(plant.robot_params[first:end], state[first:end], qpos, qvel, force[first:end], h, spans, ctrl)
        failed = out_of_range(spans, ctrl)
        if failed:
            return first + failed
    return 0


@on_both_paths
def read_robots(readings, plant, state, qpos, qvel, actuator_force, p, v, force):
    """Read p and v (N, 2) after a step, and the planar ``force`` (N, 2) that the actuators applied."""
    for i in range(p.shape[0]):
        if plant.ctrl_index[i, 0] >= 0:
            for axis in range(2):
                p[i, axis] = qpos[plant.qpos_index[i, axis]]
                v[i, axis] = qvel[plant.qvel_index[i, axis]]
                force[i, axis] = actuator_force[plant.ctrl_index[i, axis]]
    for g in range(plant.groups.shape[0]):
        first, end = plant.groups[g, 0], plant.groups[g, 1]
        law, own, spans = as_reading(readings[g]), state[first:end], plant.spans[first:end]
        law(plant.robot_params[first:end], own, qpos, qvel, actuator_force, spans, p[first:end], v[first:end], force[first:end])
