"""The kinds of laws: the signature of each kind, and the function on rows of float64 that the loop calls for its laws."""

import zlib
from types import FunctionType
from typing import Any

from numba import types
from numba.extending import intrinsic, overload

from marlbc_mj.core.compiling import Law, plain
from marlbc_mj.core.names import Names, interface

_VECTOR = types.float64[::1]
_MATRIX = types.float64[:, ::1]

BEHAVIOR = types.int64(_VECTOR, _VECTOR, _MATRIX, _MATRIX, _MATRIX, types.int64, _VECTOR, _MATRIX)
"""gains (P,), p (2,) [m], path (2, 2): desired centroid [m] and its velocity [m/s], obstacles (K, 3): x, y, radius [m], or
(K, 5) with their velocity [m/s] if they move, team (N, 2): positions of all agents [m], agent: its index, velocity_out (2,)
[m/s], jacobian_out (2, 2) -> number of rows of the Jacobian in use."""

CONTROLLER = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR)
"""gains (P,), state (S,) changed in place, p (2,) [m], v (2,) [m/s], p_r (2,) [m], v_r (2,) [m/s], drag (2,) [N]: the
true f(chi), for laws that assume a known model, h [s], force_out (2,) [N]."""

DISTURBANCE = types.void(_VECTOR, types.float64, _VECTOR, _VECTOR, _VECTOR)
"""gains (P,), t [s], p (2,) [m], v (2,) [m/s], force_out (2,) [N]."""

DRIVE = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR)
"""gains (P,), state (S,) changed in place, the robot's own part of qpos and of qvel, desired planar force (2,) [N], h [s],
ctrl_out (actuators,): MuJoCo's controls, in the order of the robot's MJCF. Called before every substep."""

READING = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR)
"""gains (P,), state (S,) as the drive left it, the robot's own part of qpos, of qvel and of actuator_force, p_out (2,) [m],
v_out (2,) [m/s], force_out (2,) [N]: the planar force that the actuators applied. Called after every substep."""

TEAM_CONTROLLER = types.void(_MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, types.float64, _MATRIX)
"""A controller applied to every agent in turn: the arguments of :data:`CONTROLLER`, one row per agent."""

TEAM_DISTURBANCE = types.void(_VECTOR, types.float64, _MATRIX, _MATRIX, _MATRIX)
"""A disturbance applied to every agent in turn: the arguments of :data:`DISTURBANCE`, with one row per agent
in p, v and force_out."""

_SPANS = types.int64[:, :, ::1]
TEAM_DRIVE = types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _MATRIX, types.float64, _SPANS, _VECTOR)
"""A drive applied to every robot in turn: gains (N, P), state (N, S), the whole qpos and qvel, forces (N, 2), h, spans (N, 3, 2):
first and last + 1 index of each robot in qpos, in qvel and in ctrl; the whole ctrl."""

TEAM_READING = types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR, _SPANS, _MATRIX, _MATRIX, _MATRIX)
"""A reading applied to every robot in turn: gains, state, the whole qpos, qvel and actuator_force, spans; p, v, force (N, 2)."""


def _law(*arguments: Any) -> Any:
    """Placeholder for the law in the templates below."""


def _gains(row: Any) -> Any:
    """Placeholder for the view of a row of gains by their names."""


def _state(row: Any) -> Any:
    """Placeholder for the view of a row of state by its names."""


def _behavior_on_rows(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    return _law(_gains(gains), p, path, obstacles, team, agent, velocity_out, jacobian_out)


def _controller_team(gains, state, p, v, p_r, v_r, drag, h, force_out):
    for i in range(p.shape[0]):
        _law(_gains(gains[i]), _state(state[i]), p[i], v[i], p_r[i], v_r[i], drag[i], h, force_out[i])


def _disturbance_team(gains, t, p, v, force_out):
    for i in range(p.shape[0]):
        _law(_gains(gains), t, p[i], v[i], force_out[i])


def _drive_team(gains, state, qpos, qvel, force, h, spans, ctrl_out):
    for i in range(force.shape[0]):
        q, v, u = spans[i, 0], spans[i, 1], spans[i, 2]
        own = qpos[q[0] : q[1]], qvel[v[0] : v[1]]
        _law(_gains(gains[i]), _state(state[i]), own[0], own[1], force[i], h, ctrl_out[u[0] : u[1]])


def _reading_team(gains, state, qpos, qvel, actuator_force, spans, p_out, v_out, force_out):
    for i in range(p_out.shape[0]):
        q, v, u = spans[i, 0], spans[i, 1], spans[i, 2]
        own = qpos[q[0] : q[1]], qvel[v[0] : v[1]], actuator_force[u[0] : u[1]]
        _law(_gains(gains[i]), _state(state[i]), own[0], own[1], own[2], p_out[i], v_out[i], force_out[i])


ON_ROWS = {
    BEHAVIOR: (BEHAVIOR, _behavior_on_rows),
    CONTROLLER: (TEAM_CONTROLLER, _controller_team),
    DISTURBANCE: (TEAM_DISTURBANCE, _disturbance_team),
    DRIVE: (TEAM_DRIVE, _drive_team),
    READING: (TEAM_READING, _reading_team),
}
"""Signature and template of the function that the loop calls for each kind of law."""


@intrinsic
def _as_record(typing_context, row, dtype):
    """View the beginning of a row as a record, in compiled code only.

    NumPy's ``view`` does the same with checks that cost more than a small law. They are unnecessary here, because every row that
    the loop passes was packed with the same names.
    """
    record = dtype.dtype

    def codegen(context, builder, signature, args):
        array = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.bitcast(array.data, context.get_value_type(record))

    return record(row, dtype), codegen


def _reader(names: Names) -> Law:
    """Make the function that turns a row into the argument of a law: a record, or the row itself if there are no names."""
    dtype = names.dtype

    def read(row):
        return names.view(row)

    @overload(read, inline="always")
    def compiled_face(row):
        return (lambda row: _as_record(row, dtype)) if names.shapes else (lambda row: row)

    return read


def on_rows(law: Law, signature: Any) -> Law:
    """Insert a law into the template of its kind; returns a Python function that can be called or compiled.

    The function is made from a code object because of numba's cache, which stores compiled code under the file, first line and
    name of a function and a pickle of its closure. The pickle of a compiled law differs between processes, so an ordinary closure
    over one would be compiled again in each of them. Therefore the template refers to its law by a global name, and takes over
    the law's file, line and name. The function's name includes a checksum of the names of gains and state: if these are declared
    in another file, numba does not notice that they change.
    """
    declared = interface(law)
    name, source = getattr(law, "__name__", "law"), getattr(plain(law), "__code__", None)
    checksum = zlib.crc32(repr((declared.gains.shapes, declared.state.shapes)).encode())
    code = ON_ROWS[signature][1].__code__
    if source is not None:
        code = code.replace(co_filename=source.co_filename, co_firstlineno=source.co_firstlineno)
    bound = {"_law": law, "_gains": _reader(declared.gains), "_state": _reader(declared.state), "range": range}
    function = FunctionType(code.replace(co_name=f"{name}_on_rows"), bound, f"{name}_on_rows")
    function.__module__ = law.__module__
    function.__qualname__ = f"{getattr(law, '__qualname__', name)}_on_rows_{checksum:08x}"
    return function
