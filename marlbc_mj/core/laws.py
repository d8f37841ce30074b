"""What a law is: a small compiled function of arrays for one agent, with one fixed signature per kind.

Behaviors (6)-(11), controllers (36)-(41), disturbances (1) and the two sides of a robot are all *laws*. A law is decorated with
:func:`behavior`, :func:`controller`, :func:`disturbance`, :func:`drive` or :func:`reading`; it is then compiled on first use,
callable from Python as an ordinary function, and callable by address from the compiled closed loop. A law that a user writes is
therefore the equal of one shipped here. All arrays are contiguous float64; outputs are written in place, nothing is returned
but a behavior's number of rows.

=============  ==========================================================================================
kind           arguments
=============  ==========================================================================================
behavior       ``(params, p, path, obstacles, team, agent, velocity_out, jacobian_out) -> rows``
controller     ``(params, state, p, v, p_r, v_r, drag, h, force_out)``
disturbance    ``(params, t, p, v, force_out)``
drive          ``(params, state, qpos, qvel, force, h, ctrl_out)``
reading        ``(params, state, qpos, qvel, actuator_force, p_out, v_out, force_out)``
=============  ==========================================================================================

Set ``NUMBA_DISABLE_JIT=1`` to run every law as plain Python, for a debugger or for coverage.
"""

import os
from collections.abc import Callable
from types import FunctionType
from typing import Any, cast

# Read once, when the first OpenMP library loads. Threads that spin while they wait would take the cores from torch's (and from
# other processes'): with both at work the same training step took 4 to 6 times longer.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numba.extending import register_jitable

from marlbc_mj.util.errors import ConfigurationError

Law = Callable[..., Any]
"""A compiled law, or a plain Python function with the same arguments (controllers only)."""

_VECTOR = types.float64[::1]
_MATRIX = types.float64[:, ::1]

BEHAVIOR = types.int64(_VECTOR, _VECTOR, _MATRIX, _MATRIX, _MATRIX, types.int64, _VECTOR, _MATRIX)
"""params (P,), p (2,) [m], path (2, 2): desired centroid [m] and its velocity [m/s], obstacles (K, 3): x, y, radius [m], or
(K, 5) where they move: their velocity [m/s] too, team (N, 2): everyone's position [m], agent, velocity_out (2,) [m/s],
jacobian_out (2, 2) -> rows used of the Jacobian."""

CONTROLLER = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR)
"""params (P,), state (S,) changed in place, p (2,) [m], v (2,) [m/s], p_r (2,) [m], v_r (2,) [m/s], drag (2,) [N]: the
true f(chi), for laws that assume a known model, h [s], force_out (2,) [N]."""

DISTURBANCE = types.void(_VECTOR, types.float64, _VECTOR, _VECTOR, _VECTOR)
"""params (P,), t [s], p (2,) [m], v (2,) [m/s], force_out (2,) [N]."""

DRIVE = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR)
"""params (P,), state (S,) changed in place, the robot's own part of qpos and of qvel, planar force (2,) [N] that is wanted,
h [s], ctrl_out (actuators,): MuJoCo's controls, in the order of the robot's MJCF. Called before every substep."""

READING = types.void(_VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR)
"""params (P,), state (S,) as the drive left it, the robot's own part of qpos, of qvel and of actuator_force, p_out (2,) [m],
v_out (2,) [m/s], force_out (2,) [N]: the planar force that the actuators really gave. Called after every substep."""

TEAM_CONTROLLER = types.void(_MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX, types.float64, _MATRIX)
"""A controller for every agent in turn: the arguments of :data:`CONTROLLER`, one row an agent."""

TEAM_DISTURBANCE = types.void(_VECTOR, types.float64, _MATRIX, _MATRIX, _MATRIX)
"""A disturbance for every agent in turn: the arguments of :data:`DISTURBANCE`, one row an agent."""

_SPANS = types.int64[:, :, ::1]
TEAM_DRIVE = types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _MATRIX, types.float64, _SPANS, _VECTOR)
"""A drive for every robot in turn: params (N, P), state (N, S), the whole qpos and qvel, forces (N, 2), h, spans (3, N, 2): first
and last + 1 of each robot in qpos, in qvel and in ctrl; the whole ctrl."""

TEAM_READING = types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR, _SPANS, _MATRIX, _MATRIX, _MATRIX)
"""A reading of every robot in turn: params, state, the whole qpos, qvel and actuator_force, spans; p, v, force (N, 2)."""


def _jit(function: Law, **options: Any) -> Law:
    """Compile, and keep the result on disk where there is a place for it: not for a function typed at a prompt, nor without a
    writable folder.
    """
    options = {"error_model": "numpy", "nogil": True, **options}
    try:
        return numba.njit(cache=True, **options)(function)  # type: ignore[no-any-return]
    except RuntimeError:
        return numba.njit(**options)(function)  # type: ignore[no-any-return]


def threaded(function: Law) -> Law:
    """Compile a loop over worlds whose ``numba.prange`` is shared out over threads."""
    return _jit(function, parallel=True)


def compiled(function: Law) -> Law:
    """Compile a helper: cached on disk, IEEE division, the GIL released."""
    return _jit(function)


def inlined(function: Law) -> Law:
    """A helper of laws, pasted into its caller: for a few lines that run in every substep."""
    return register_jitable(inline="always")(function)  # type: ignore[no-any-return]


@inlined
def clip(value, limit):  # type: ignore[no-untyped-def]
    """Saturation (2): ``value`` within +-limit. NaN passes through, so that the run stops instead of going on at the limit."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value


def allocation_free(function: Law) -> Law:
    """Compile a law, or a helper that laws call: as :func:`compiled`, and without reference counting.

    Counting the arguments of one call costs more than the arithmetic of most laws. The price: the function cannot create arrays;
    scratch belongs in a controller's ``state``.
    """
    return _jit(function, _nrt=False)


def _controller_team(params, state, p, v, p_r, v_r, drag, h, force_out):  # type: ignore[no-untyped-def]
    for i in range(p.shape[0]):
        law(params[i], state[i], p[i], v[i], p_r[i], v_r[i], drag[i], h, force_out[i])  # type: ignore[name-defined]  # noqa: F821


def _disturbance_team(params, t, p, v, force_out):  # type: ignore[no-untyped-def]
    for i in range(p.shape[0]):
        law(params, t, p[i], v[i], force_out[i])  # type: ignore[name-defined]  # noqa: F821


def _drive_team(params, state, qpos, qvel, force, h, spans, ctrl_out):  # type: ignore[no-untyped-def]
    for i in range(force.shape[0]):
        q, v, u = spans[0, i], spans[1, i], spans[2, i]
        law(params[i], state[i], qpos[q[0] : q[1]], qvel[v[0] : v[1]], force[i], h, ctrl_out[u[0] : u[1]])  # type: ignore[name-defined]  # noqa: F821


def _reading_team(params, state, qpos, qvel, actuator_force, spans, p_out, v_out, force_out):  # type: ignore[no-untyped-def]
    for i in range(p_out.shape[0]):
        q, v, u = spans[0, i], spans[1, i], spans[2, i]
        own = qpos[q[0] : q[1]], qvel[v[0] : v[1]], actuator_force[u[0] : u[1]]
        law(params[i], state[i], own[0], own[1], own[2], p_out[i], v_out[i], force_out[i])  # type: ignore[name-defined]  # noqa: F821


_TEAMS = {
    CONTROLLER: (TEAM_CONTROLLER, _controller_team),
    DISTURBANCE: (TEAM_DISTURBANCE, _disturbance_team),
    DRIVE: (TEAM_DRIVE, _drive_team),
    READING: (TEAM_READING, _reading_team),
}


def for_team(law: Law, signature: Any) -> Law:
    """The law applied to every agent in turn, as a Python function; for every kind but :data:`BEHAVIOR`.

    The template above becomes a function of its own whose global ``law`` is this one, with the law's file and line as its place,
    by which numba's cache knows it when it is compiled.
    """
    name, source = getattr(law, "__name__", "law"), getattr(plain(law), "__code__", None)
    code = _TEAMS[signature][1].__code__.replace(co_name=f"{name}_team")
    if source is not None:
        code = code.replace(co_filename=source.co_filename, co_firstlineno=source.co_firstlineno)
    function = FunctionType(code, {"law": law, "range": range}, f"{name}_team")
    function.__module__ = law.__module__
    function.__qualname__ = f"{getattr(law, '__qualname__', name)}_team"
    return function


def _declare(function: Law, signature: Any) -> Law:
    """Compile a law, and for the loop its team form: an indirect call costs more than most laws, so the loop makes one a team."""
    law: Any = allocation_free(function)
    if is_compiled(law):
        law.signature_of_law = signature
        law.entry = allocation_free(for_team(law, signature)) if signature in _TEAMS else law
    return cast(Law, law)


def behavior(function: Law) -> Law:
    """Declare an elementary behavior; arguments as in :data:`BEHAVIOR`."""
    return _declare(function, BEHAVIOR)


def controller(function: Law) -> Law:
    """Declare a controller; arguments as in :data:`CONTROLLER`."""
    return _declare(function, CONTROLLER)


def disturbance(function: Law) -> Law:
    """Declare an unknown dynamics f(chi) of (1); arguments as in :data:`DISTURBANCE`."""
    return _declare(function, DISTURBANCE)


def drive(function: Law) -> Law:
    """Declare how a robot turns a planar force into controls; arguments as in :data:`DRIVE`."""
    return _declare(function, DRIVE)


def reading(function: Law) -> Law:
    """Declare how a robot's planar motion and force are read; arguments as in :data:`READING`."""
    return _declare(function, READING)


def is_compiled(law: Law) -> bool:
    """Whether the compiled loop can call this law; a plain Python function runs through the Python loop."""
    return isinstance(law, Dispatcher)


def plain(law: Law) -> Law:
    """The law as plain Python: for a debugger, and for measuring what compilation is worth."""
    return law.py_func if isinstance(law, Dispatcher) else law


def address(law: Law, signature: Any) -> int:
    """Machine address of a compiled law for the compiled loop: of its team form for all but behaviors.

    Raises:
        ConfigurationError: the law is plain Python, was declared as another kind of law, or does not compile.
    """
    name = getattr(law, "__name__", repr(law))
    if not isinstance(law, Dispatcher):
        raise ConfigurationError(f"law {name!r} is not compiled; decorate it with marlbc_mj.core.laws")
    declared = getattr(law, "signature_of_law", None)
    if declared != signature:
        raise ConfigurationError(f"law {name!r} was declared as {declared}, but is used as {signature}")
    kind = _TEAMS[signature][0] if signature in _TEAMS else signature
    try:
        law.compile(signature.args)
        entry = law.entry  # type: ignore[attr-defined]
        entry.compile(kind.args)
    except NumbaError as error:
        raise ConfigurationError(f"law {name!r} does not compile as {signature}: {_last_line(error)}") from error
    result = entry.get_compile_result(kind)
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def _last_line(error: Exception) -> str:
    """The line of a numba error that says what is wrong, with a hint where a law creates arrays."""
    text = str(error)
    if "NRT required" in text or "Only accept returning of array" in text:
        return "a law cannot create arrays; keep scratch in its state"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line.lower() or "not" in line.lower()), lines[0])
