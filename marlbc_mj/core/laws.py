"""What a law is: a small compiled function of arrays for one agent, with one fixed signature per kind.

Behaviors (6)-(11), controllers (36)-(41), disturbances (1) and the two sides of a robot are all *laws*. A law is decorated with
:func:`behavior`, :func:`controller`, :func:`disturbance`, :func:`drive` or :func:`reading`; it is then compiled on first use,
callable from Python as an ordinary function, and callable by address from the compiled closed loop. A law that a user writes is
therefore the equal of one shipped here. Outputs are written in place; only a behavior returns something, its number of rows.

=============  ==========================================================================================
kind           arguments
=============  ==========================================================================================
behavior       ``(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out) -> rows``
controller     ``(gains, state, p, v, p_r, v_r, drag, h, force_out)``
disturbance    ``(gains, t, p, v, force_out)``
drive          ``(gains, state, qpos, qvel, force, h, ctrl_out)``
reading        ``(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out)``
=============  ==========================================================================================

The decorator declares the names of gains and state, which the law then reads and writes as attributes::

    @laws.controller(gains=("position_gain", "limit"), state={"integral": 2})
    def law(gains, state, p, v, p_r, v_r, drag, h, force_out): ... gains.limit ... state.integral[axis] ...

All other arguments are contiguous float64 arrays and numbers. For the loop, gains and state are rows of float64 as well: what it
calls by address is the law's team form, which sees each row by its names. A law that declares no names is handed the rows.

Set ``NUMBA_DISABLE_JIT=1`` to run every law as plain Python, for a debugger or for coverage.
"""

import zlib
from types import FunctionType
from typing import Any, cast

import numba
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numba.extending import intrinsic, overload

from marlbc_mj.core.compiling import Law, allocation_free, clip, compiled, inlined, is_compiled, plain, threaded
from marlbc_mj.core.names import (
    Declared,
    Interface,
    Names,
    Numbers,
    as_gains,
    as_state,
    gains_of,
    interface,
    name_of,
    pack_gains,
    pack_state,
    refuse_undeclared,
    require_kind,
)
from marlbc_mj.util.errors import ConfigurationError

_VECTOR = types.float64[::1]
_MATRIX = types.float64[:, ::1]

BEHAVIOR = types.int64(_VECTOR, _VECTOR, _MATRIX, _MATRIX, _MATRIX, types.int64, _VECTOR, _MATRIX)
"""gains (P,), p (2,) [m], path (2, 2): desired centroid [m] and its velocity [m/s], obstacles (K, 3): x, y, radius [m], or
(K, 5) where they move: their velocity [m/s] too, team (N, 2): everyone's position [m], agent, velocity_out (2,) [m/s],
jacobian_out (2, 2) -> rows used of the Jacobian."""

CONTROLLER = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR)
"""gains (P,), state (S,) changed in place, p (2,) [m], v (2,) [m/s], p_r (2,) [m], v_r (2,) [m/s], drag (2,) [N]: the
true f(chi), for laws that assume a known model, h [s], force_out (2,) [N]."""

DISTURBANCE = types.void(_VECTOR, types.float64, _VECTOR, _VECTOR, _VECTOR)
"""gains (P,), t [s], p (2,) [m], v (2,) [m/s], force_out (2,) [N]."""

DRIVE = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR)
"""gains (P,), state (S,) changed in place, the robot's own part of qpos and of qvel, planar force (2,) [N] that is wanted,
h [s], ctrl_out (actuators,): MuJoCo's controls, in the order of the robot's MJCF. Called before every substep."""

READING = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR)
"""gains (P,), state (S,) as the drive left it, the robot's own part of qpos, of qvel and of actuator_force, p_out (2,) [m],
v_out (2,) [m/s], force_out (2,) [N]: the planar force that the actuators really gave. Called after every substep."""

TEAM_CONTROLLER = types.void(_MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, types.float64, _MATRIX)
"""A controller for every agent in turn: the arguments of :data:`CONTROLLER`, one row per agent."""

TEAM_DISTURBANCE = types.void(_VECTOR, types.float64, _MATRIX, _MATRIX, _MATRIX)
"""A disturbance for every agent in turn: the arguments of :data:`DISTURBANCE`, one row per agent."""

_SPANS = types.int64[:, :, ::1]
TEAM_DRIVE = types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _MATRIX, types.float64, _SPANS, _VECTOR)
"""A drive for every robot in turn: gains (N, P), state (N, S), the whole qpos and qvel, forces (N, 2), h, spans (3, N, 2): first
and last + 1 of each robot in qpos, in qvel and in ctrl; the whole ctrl."""

TEAM_READING = types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR, _SPANS, _MATRIX, _MATRIX, _MATRIX)
"""A reading of every robot in turn: gains, state, the whole qpos, qvel and actuator_force, spans; p, v, force (N, 2)."""


def _law(*arguments: Any) -> Any:
    """Stands for the law in the templates below."""


def _gains(row: Any) -> Any:
    """Stands for the view of a row of gains by their names."""


def _state(row: Any) -> Any:
    """Stands for the view of a row of state by its names."""


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
        q, v, u = spans[0, i], spans[1, i], spans[2, i]
        own = qpos[q[0] : q[1]], qvel[v[0] : v[1]]
        _law(_gains(gains[i]), _state(state[i]), own[0], own[1], force[i], h, ctrl_out[u[0] : u[1]])


def _reading_team(gains, state, qpos, qvel, actuator_force, spans, p_out, v_out, force_out):
    for i in range(p_out.shape[0]):
        q, v, u = spans[0, i], spans[1, i], spans[2, i]
        own = qpos[q[0] : q[1]], qvel[v[0] : v[1]], actuator_force[u[0] : u[1]]
        _law(_gains(gains[i]), _state(state[i]), own[0], own[1], own[2], p_out[i], v_out[i], force_out[i])


_ON_ROWS = {
    BEHAVIOR: (BEHAVIOR, _behavior_on_rows),
    CONTROLLER: (TEAM_CONTROLLER, _controller_team),
    DISTURBANCE: (TEAM_DISTURBANCE, _disturbance_team),
    DRIVE: (TEAM_DRIVE, _drive_team),
    READING: (TEAM_READING, _reading_team),
}
"""What the loop calls for each kind of law: its signature, and the template of the function."""


@intrinsic
def _as_record(typing_context, row, dtype):
    """The beginning of a row as a record; compiled code only.

    NumPy's ``view`` does the same with checks that cost more than a small law. They are needless: every row that the loop hands
    on was packed by the same names.
    """
    record = dtype.dtype

    def codegen(context, builder, signature, args):
        array = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.bitcast(array.data, context.get_value_type(record))

    return record(row, dtype), codegen


def _reader(names: Names) -> Law:
    """The function that turns a row into what the law is handed: a record, or the row itself where there are no names."""
    dtype = names.dtype

    def read(row):
        return names.view(row)

    @overload(read, inline="always")
    def compiled_face(row):
        return (lambda row: _as_record(row, dtype)) if names.shapes else (lambda row: row)

    return read


def _on_rows(law: Law, signature: Any) -> Law:
    """The template of a kind of law with this very law in it: a Python function, to be called or to be compiled.

    Why it is put together from a code object: numba keeps compiled code on disk under the file, first line and name of a
    function, and under a pickle of what the function closes over. An ordinary closure over a compiled law would be compiled
    anew in every process, because the pickle of a compiled law is a different one in each. So the template refers to its law by a
    global name, and takes the place (file and line) and the name of the law for its own. The names of gains and state go into
    the function's name by a checksum: were they declared in another file, numba would not see them change.
    """
    declared = interface(law)
    name, source = getattr(law, "__name__", "law"), getattr(plain(law), "__code__", None)
    checksum = zlib.crc32(repr((declared.gains.shapes, declared.state.shapes)).encode())
    code = _ON_ROWS[signature][1].__code__
    if source is not None:
        code = code.replace(co_filename=source.co_filename, co_firstlineno=source.co_firstlineno)
    bound = {"_law": law, "_gains": _reader(declared.gains), "_state": _reader(declared.state), "range": range}
    function = FunctionType(code.replace(co_name=f"{name}_on_rows"), bound, f"{name}_on_rows")
    function.__module__ = law.__module__
    function.__qualname__ = f"{getattr(law, '__qualname__', name)}_on_rows_{checksum:08x}"
    return function


def for_team(law: Law, signature: Any) -> Law:
    """The law for the Python path: on rows of float64, as the loop calls it; applied to every agent in turn, a behavior to one.

    The function raises ConfigurationError where the law reads a name that it does not declare.
    """
    team = _on_rows(law, signature)

    def checked(*arguments: Any) -> Any:
        try:
            return team(*arguments)
        except (AttributeError, KeyError) as error:
            refuse_undeclared(law, error)
            raise

    return checked if any(names.shapes for names in interface(law)[1:]) else team


def _declare(function: Law, signature: Any, gains: Declared, state: Declared = ()) -> Law:
    """Compile a law, and the team form that the loop calls: an indirect call costs more than most laws, so it makes one per team.

    The team form of a law that closes over values is not cached on disk, since numba cannot see those values there.
    """
    vars(function)["interface"] = Interface(signature, Names.of(gains), Names.of(state))
    law: Any = allocation_free(function)
    if is_compiled(law):
        law.entry = allocation_free(_on_rows(law, signature), cache=not getattr(function, "__closure__", None))
    return cast(Law, law)


def _decorator(function: Law | None, signature: Any, gains: Declared, state: Declared = ()) -> Law:
    """The law, or the decorator where its names come first."""
    return _declare(function, signature, gains, state) if function else lambda law: _declare(law, signature, gains, state)


def behavior(function: Law | None = None, *, gains: Declared = ()) -> Law:
    """Declare an elementary behavior and the names of its gains; arguments as in :data:`BEHAVIOR`."""
    return _decorator(function, BEHAVIOR, gains)


def controller(function: Law | None = None, *, gains: Declared = (), state: Declared = ()) -> Law:
    """Declare a controller and the names of its gains and state; arguments as in :data:`CONTROLLER`."""
    return _decorator(function, CONTROLLER, gains, state)


def disturbance(function: Law | None = None, *, gains: Declared = ()) -> Law:
    """Declare an unknown dynamics f(chi) of (1) and the names of its gains; arguments as in :data:`DISTURBANCE`.

    Raises:
        ConfigurationError: the first gain is not named ``scale``: a perturbation draw multiplies it.
    """
    names = Names.of(gains)
    if names.shapes and names.shapes[0] != ("scale", ()):
        raise ConfigurationError(f"the first gain of a disturbance must be the number 'scale', got {', '.join(names.names)}")
    return _decorator(function, DISTURBANCE, names)


def drive(function: Law | None = None, *, gains: Declared = (), state: Declared = ()) -> Law:
    """Declare how a robot turns a planar force into controls, and the names of gains and state; arguments as in :data:`DRIVE`."""
    return _decorator(function, DRIVE, gains, state)


def reading(function: Law | None = None, *, gains: Declared = (), state: Declared = ()) -> Law:
    """Declare how a robot's planar motion and force are read. It shares gains and state with the drive, so name them alike;
    arguments as in :data:`READING`.
    """
    return _decorator(function, READING, gains, state)


def address(law: Law, signature: Any) -> int:
    """Machine address of what the compiled loop calls for a law: its team form, and for a behavior the behavior itself.

    Raises:
        ConfigurationError: the law is plain Python, was declared as another kind of law, reads a name that it does not declare,
            or does not compile.
    """
    name = name_of(law)
    if not isinstance(law, Dispatcher):
        raise ConfigurationError(f"law {name!r} is not compiled; decorate it with marlbc_mj.core.laws")
    require_kind(law, signature)
    kind, entry = _ON_ROWS[signature][0], cast(Any, law).entry
    try:
        law.compile(_arguments(interface(law)))
        entry.compile(kind.args)
    except KeyError as error:
        refuse_undeclared(law, error)
        raise
    except NumbaError as error:
        raise ConfigurationError(f"law {name!r} does not compile as {signature}: {_last_line(error)}") from error
    result = entry.get_compile_result(kind)
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def _arguments(declared: Interface) -> tuple[Any, ...]:
    """Types of a law's own arguments: records where it has names."""
    arguments = list(declared.signature.args)
    for at, names in enumerate(declared[1:]):
        if names.shapes:
            arguments[at] = numba.from_dtype(names.dtype)
    return tuple(arguments)


def _last_line(error: Exception) -> str:
    """The line of a numba error that says what is wrong, with a hint where a law creates arrays."""
    text = str(error)
    if "NRT required" in text or "Only accept returning of array" in text:
        return "a law cannot create arrays; keep scratch in its state"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line.lower() or "not" in line.lower()), lines[0])


__all__ = [
    "BEHAVIOR",
    "CONTROLLER",
    "DISTURBANCE",
    "DRIVE",
    "READING",
    "TEAM_CONTROLLER",
    "TEAM_DISTURBANCE",
    "TEAM_DRIVE",
    "TEAM_READING",
    "Law",
    "Names",
    "Numbers",
    "address",
    "allocation_free",
    "as_gains",
    "as_state",
    "behavior",
    "clip",
    "compiled",
    "controller",
    "disturbance",
    "drive",
    "for_team",
    "gains_of",
    "inlined",
    "interface",
    "is_compiled",
    "pack_gains",
    "pack_state",
    "plain",
    "reading",
    "threaded",
]
