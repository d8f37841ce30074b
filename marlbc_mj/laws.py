"""What a law is: a small compiled function of arrays for one agent, with one fixed signature per kind.

Behaviors (6)-(11), controllers (36)-(41) and disturbances (1) are all *laws*. A law is decorated with
:func:`behavior`, :func:`controller` or :func:`disturbance`; it is then compiled on first use, callable from Python as an
ordinary function, and callable by address from the compiled closed loop. A law that a user writes is therefore
the equal of one shipped here. All arrays are contiguous float64; outputs are written in place, nothing is returned
but a behavior's number of rows.

=============  ==========================================================================================
kind           arguments
=============  ==========================================================================================
behavior       ``(params, p, path, obstacles, team, agent, velocity_out, jacobian_out) -> rows``
controller     ``(params, state, p, v, p_r, v_r, drag, h, force_out)``
disturbance    ``(params, t, p, v, force_out)``
=============  ==========================================================================================

Set ``NUMBA_DISABLE_JIT=1`` to run every law as plain Python, for a debugger or for coverage.
"""

from collections.abc import Callable
from typing import Any

import numba
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numba.extending import register_jitable

from marlbc_mj.errors import ConfigurationError

Law = Callable[..., Any]
"""A compiled law, or a plain Python function with the same arguments (controllers only)."""

_VECTOR = types.float64[::1]
_MATRIX = types.float64[:, ::1]

BEHAVIOR = types.int64(_VECTOR, _VECTOR, _MATRIX, _MATRIX, _MATRIX, types.int64, _VECTOR, _MATRIX)
"""params (P,), p (2,) [m], path (2, 2): desired centroid [m] and its velocity [m/s], obstacles (K, 3): x, y, radius [m],
team (N, 2): everyone's position [m], agent, velocity_out (2,) [m/s], jacobian_out (2, 2) -> rows used of the Jacobian."""

CONTROLLER = types.void(
    _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, types.float64, _VECTOR
)
"""params (P,), state (S,) changed in place, p (2,) [m], v (2,) [m/s], p_r (2,) [m], v_r (2,) [m/s], drag (2,) [N]: the true f(chi),
for laws that assume a known model, h [s], force_out (2,) [N]."""

DISTURBANCE = types.void(_VECTOR, types.float64, _VECTOR, _VECTOR, _VECTOR)
"""params (P,), t [s], p (2,) [m], v (2,) [m/s], force_out (2,) [N]."""


def compiled(function: Law) -> Law:
    """Compile a helper: cached on disk, IEEE division, the GIL released."""
    return numba.njit(cache=True, error_model="numpy", nogil=True)(function)  # type: ignore[no-any-return]


def inlined(function: Law) -> Law:
    """A helper of laws, pasted into its caller: for a few lines that run in every substep."""
    return register_jitable(inline="always")(function)  # type: ignore[no-any-return]


def allocation_free(function: Law) -> Law:
    """Compile a law, or a helper that laws call: as :func:`compiled`, and without reference counting.

    Counting the arguments of one call costs more than the arithmetic of most laws. The price: the function cannot create arrays;
    scratch belongs in a controller's ``state``.
    """
    return numba.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)(function)  # type: ignore[no-any-return]


def _declare(function: Law, signature: Any) -> Law:
    law = allocation_free(function)
    law.signature_of_law = signature  # type: ignore[attr-defined]
    return law


def behavior(function: Law) -> Law:
    """Declare an elementary behavior; arguments as in :data:`BEHAVIOR`."""
    return _declare(function, BEHAVIOR)


def controller(function: Law) -> Law:
    """Declare a controller; arguments as in :data:`CONTROLLER`."""
    return _declare(function, CONTROLLER)


def disturbance(function: Law) -> Law:
    """Declare an unknown dynamics f(chi) of (1); arguments as in :data:`DISTURBANCE`."""
    return _declare(function, DISTURBANCE)


def is_compiled(law: Law) -> bool:
    """Whether the compiled loop can call this law; a plain Python function runs through the Python loop."""
    return isinstance(law, Dispatcher)


def plain(law: Law) -> Law:
    """The law as plain Python: for a debugger, and for measuring what compilation is worth."""
    return law.py_func if isinstance(law, Dispatcher) else law


def address(law: Law, signature: Any) -> int:
    """Machine address of a compiled law, for the compiled loop.

    Raises:
        ConfigurationError: the law is plain Python, or was declared as another kind of law.
    """
    name = getattr(law, "__name__", repr(law))
    if not isinstance(law, Dispatcher):
        raise ConfigurationError(f"law {name!r} is not compiled; decorate it with marlbc_mj.laws")
    declared = getattr(law, "signature_of_law", signature)
    if declared != signature:
        raise ConfigurationError(f"law {name!r} was declared as {declared}, but is used as {signature}")
    try:
        law.compile(signature.args)
    except NumbaError as error:
        raise ConfigurationError(f"law {name!r} does not compile as {signature}: {_last_line(error)}") from error
    compiled_law = law.get_compile_result(signature)
    return int(compiled_law.library.get_pointer_to_function(compiled_law.fndesc.llvm_func_name))


def _last_line(error: Exception) -> str:
    """The line of a numba error that says what is wrong, with a hint where a law creates arrays."""
    text = str(error)
    if "NRT required" in text or "Only accept returning of array" in text:
        return "a law cannot create arrays; keep scratch in its state"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line.lower() or "not" in line.lower()), lines[0])
