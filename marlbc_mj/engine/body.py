"""Between planar forces and MuJoCo's controls, and back: directly, or by the robot's own laws."""

from marlbc_mj.core.laws import allocation_free, inlined
from marlbc_mj.engine.native import as_drive, as_reading

DIVERGED = 1e9
"""A position, velocity or force beyond this (or NaN) stops the world before MuJoCo sees it."""


@allocation_free
def scale_rows(rows, factor):  # type: ignore[no-untyped-def]
    """Multiply (N, 2) by a number, in place."""
    for i in range(rows.shape[0]):
        for axis in range(2):
            rows[i, axis] *= factor


@allocation_free
def out_of_range(spans, ctrl):  # type: ignore[no-untyped-def]
    """0, or 1 + the first agent with a control that is not finite or huge."""
    for i in range(spans.shape[1]):
        for k in range(spans[2, i, 0], spans[2, i, 1]):
            if not abs(ctrl[k]) < DIVERGED:
                return 1 + i
    return 0


@inlined
def actuate(body, state, indices, qpos, qvel, force, h, ctrl):  # type: ignore[no-untyped-def]
    """Turn planar forces (N, 2) into ctrl: as they are for direct robots, by the drive of ``body`` for others.

    ``body`` = drive, reading, spans, params. Returns 0, or 1 + agent where a control is not finite or huge.
    """
    spans = body[2]
    failed = 0
    if spans.shape[1] == 0:
        for i in range(force.shape[0]):
            for axis in range(2):
                ctrl[indices[2, i, axis]] = force[i, axis]
    else:
        drive = as_drive(body[0])
        drive(body[3], state, qpos, qvel, force, h, spans, ctrl)
        failed = out_of_range(spans, ctrl)
    return failed


@inlined
def measure(body, state, indices, qpos, qvel, actuator_force, p, v, force):  # type: ignore[no-untyped-def]
    """Read p and v (N, 2) after a step, and for robots that are not direct the planar force that their actuators gave."""
    spans = body[2]
    if spans.shape[1] > 0:
        reading = as_reading(body[1])
        reading(body[3], state, qpos, qvel, actuator_force, spans, p, v, force)
    else:
        for i in range(p.shape[0]):
            for axis in range(2):
                p[i, axis] = qpos[indices[0, i, axis]]
                v[i, axis] = qvel[indices[1, i, axis]]
