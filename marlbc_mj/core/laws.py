"""Laws: small compiled functions of arrays for one agent, with one fixed signature per kind.

Behaviors (6)-(11), controllers (36)-(41), disturbances (1), and drives and readings of robots are *laws*. A law is decorated with
:func:`behavior`, :func:`controller`, :func:`disturbance`, :func:`drive` or :func:`reading`; it is then compiled on first use,
callable from Python as an ordinary function, and callable by address from the compiled closed loop. So user-defined laws work
exactly like those shipped here. Outputs are written in place; only a behavior returns a value, its number of Jacobian rows.

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

All other arguments are contiguous float64 arrays and numbers. The loop stores gains and state as rows of float64. It calls the
law's team form by address, which views each row by its names. A law that declares no names receives the rows themselves.

Set ``NUMBA_DISABLE_JIT=1`` to run every law as plain Python, for a debugger or for coverage.
"""

import inspect
from typing import Any, cast

import numba
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError

from marlbc_mj.core.compiling import Law, allocation_free, clip, compiled, inlined, is_compiled, plain, raising_line, threaded
from marlbc_mj.core.kinds import (
    BEHAVIOR,
    CONTROLLER,
    DISTURBANCE,
    DRIVE,
    ON_ROWS,
    READING,
    TEAM_CONTROLLER,
    TEAM_DISTURBANCE,
    TEAM_DRIVE,
    TEAM_READING,
    on_rows,
)
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
from marlbc_mj.util.errors import ConfigurationError, MarlbcError, SimulationError
from marlbc_mj.util.modules import blame


def for_team(law: Law, signature: Any) -> Law:
    """The law in the form that the Python path calls: on rows of float64, for all agents in turn, or for one if it is a behavior.

    The returned function raises ConfigurationError if the law reads a name that it does not declare, and SimulationError for any
    other error of the law.
    """
    team = _entry(law, signature) if is_compiled(law) else on_rows(law, signature)

    def checked(*arguments: Any) -> Any:
        try:
            return team(*arguments)
        except MarlbcError:
            raise
        except Exception as error:
            if isinstance(error, AttributeError) or (is_compiled(law) and isinstance(error, KeyError)):
                refuse_undeclared(law, error)
            raise SimulationError(f"law {name_of(law)!r} fails: {blame(error)}") from error

    return checked


def _declare(function: Law, signature: Any, gains: Declared, state: Declared = ()) -> Law:
    """Compile a law and the team form that the loop calls: an indirect call costs more than most laws, so it makes one per team.

    The team form of a closure is not cached on disk, because numba would not notice a change of the values that it closes over.
    """
    _check_arguments(function, signature)
    vars(function)["interface"] = Interface(signature, Names.of(gains), Names.of(state))
    law: Any = allocation_free(function)
    if is_compiled(law):
        law.entry = allocation_free(on_rows(law, signature), cache=not getattr(function, "__closure__", None))
    return cast(Law, law)


ARGUMENTS = {
    BEHAVIOR: "gains, p, path, obstacles, team, agent, velocity_out, jacobian_out",
    CONTROLLER: "gains, state, p, v, p_r, v_r, drag, h, force_out",
    DISTURBANCE: "gains, t, p, v, force_out",
    DRIVE: "gains, state, qpos, qvel, force, h, ctrl_out",
    READING: "gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out",
}
"""Positional arguments of every kind of law."""


def _check_arguments(function: Law, signature: Any) -> None:
    """Raise ConfigurationError if a law does not take the number of arguments of its kind."""
    wanted = ARGUMENTS[signature]
    try:
        inspect.signature(function).bind(*wanted.split(", "))
    except TypeError as error:
        given, name = ", ".join(inspect.signature(function).parameters), name_of(function)
        raise ConfigurationError(f"law {name!r} takes ({given}), but its kind is called with ({wanted})") from error


def _decorator(function: Law | None, signature: Any, gains: Declared, state: Declared = ()) -> Law:
    """Declare the law, or return a decorator if only the names are given."""
    return _declare(function, signature, gains, state) if function else lambda law: _declare(law, signature, gains, state)


def behavior(function: Law | None = None, *, gains: Declared = ()) -> Law:
    """Declare an elementary behavior and the names of its gains; arguments as in :data:`BEHAVIOR`."""
    return _decorator(function, BEHAVIOR, gains)


def controller(function: Law | None = None, *, gains: Declared = (), state: Declared = ()) -> Law:
    """Declare a controller and the names of its gains and state; arguments as in :data:`CONTROLLER`."""
    return _decorator(function, CONTROLLER, gains, state)


def disturbance(function: Law | None = None, *, gains: Declared = ()) -> Law:
    """Declare a disturbance f(chi) of (1) and the names of its gains; arguments as in :data:`DISTURBANCE`.

    Raises:
        ConfigurationError: the first gain is not ``scale``, which the draw of a perturbation multiplies.
    """
    names = Names.of(gains)
    if names.shapes and names.shapes[0] != ("scale", ()):
        raise ConfigurationError(f"the first gain of a disturbance must be the number 'scale', got {', '.join(names.names)}")
    return _decorator(function, DISTURBANCE, names)


def drive(function: Law | None = None, *, gains: Declared = (), state: Declared = ()) -> Law:
    """Declare how a robot turns a planar force into controls, and the names of gains and state; arguments as in :data:`DRIVE`."""
    return _decorator(function, DRIVE, gains, state)


def reading(function: Law | None = None, *, gains: Declared = (), state: Declared = ()) -> Law:
    """Declare how a robot's planar motion and force are read; arguments as in :data:`READING`.

    It shares gains and state with the drive, so both must declare the same names.
    """
    return _decorator(function, READING, gains, state)


def address(law: Law, signature: Any) -> int:
    """Machine address of the function that the compiled loop calls for a law: its team form, or for a behavior one agent's form.

    The law keeps the address, so it is looked up only once.

    Raises:
        ConfigurationError: the law is plain Python, was declared as another kind of law, reads a name that it does not declare,
            raises errors (which threads would lose), or does not compile.
    """
    if not isinstance(law, Dispatcher):
        raise ConfigurationError(f"law {name_of(law)!r} is not compiled; decorate it with marlbc_mj.core.laws")
    require_kind(law, signature)
    kept: Any = law
    if not hasattr(kept, "address"):
        kept.address = _find_address(law, signature)
    return int(kept.address)


def _find_address(law: Any, signature: Any) -> int:
    """Find the :func:`address` of a compiled law that was declared as this kind."""
    name, line = name_of(law), raising_line(law, set())
    if line is not None:
        raise ConfigurationError(
            f"law {name!r} raises an error ({line}), which compiled code cannot do; to end the run, write NaN to an output"
        )
    kind, entry = ON_ROWS[signature][0], _entry(law, signature)
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


def _entry(law: Law, signature: Any) -> Any:
    """The team form of a law: made when the law is declared, or here if the law was unpickled."""
    if not hasattr(law, "entry"):
        cast(Any, law).entry = allocation_free(on_rows(law, signature), cache=False)
    return cast(Any, law).entry


def _arguments(declared: Interface) -> tuple[Any, ...]:
    """Types of a law's own arguments, with records for gains and state that have names."""
    arguments = list(declared.signature.args)
    for at, names in enumerate(declared[1:]):
        if names.shapes:
            arguments[at] = numba.from_dtype(names.dtype)
    return tuple(arguments)


def _last_line(error: Exception) -> str:
    """The line of a numba error that states the cause, or a hint if a law creates arrays."""
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
