"""How laws and the helpers that they call are compiled: by numba, on first use, cached on disk."""

import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

# Read once, when the first OpenMP library loads. Threads that spin while they wait would take the cores from torch's (and from
# other processes'): with both at work the same training step took 4 to 6 times longer.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba
from numba.core.dispatcher import Dispatcher
from numba.extending import register_jitable

Law = Callable[..., Any]
"""A compiled law, or, of every kind but behaviors, a plain Python function with the same arguments."""


def sources_stamp(package: Path) -> int:
    """Checksum of all source files below ``package`` that hold compiled code.

    numba keeps compiled code until the file of its function changes. What a function calls is compiled into it, from whatever
    file, so code of this package is kept until any of these files changes.
    """
    texts = (path.read_bytes() for path in sorted(package.rglob("*.py")))
    return zlib.crc32(b"".join(text for text in texts if any(mark in text for mark in COMPILED_MARKS)))


def threads_usable(threads: int) -> bool:
    """Have numba share loops out over ``threads`` threads; False: the loop is to run in series, with the same results.

    A process that was forked from one whose threads ran has none, and GNU OpenMP would end it: it works in series. Processes that
    are started with ``spawn`` have threads of their own.
    """
    global _threads_of
    if threads == 1 or _threads_of not in (0, os.getpid()):
        return False
    _threads_of = os.getpid()
    numba.set_num_threads(threads)
    return True


_threads_of = 0
"""The process whose threads numba has started; 0: none has."""

COMPILED_MARKS = (b"import numba", b"from numba", b"core.laws", b"core.compiling", b"core import laws")
"""What is found in files that hold compiled code."""
SOURCES = sources_stamp(Path(__file__).parents[1])


def _jit(function: Law, cache: bool = True, **options: Any) -> Law:
    """Compile, and keep the result on disk where there is a place for it: not for a function typed at a prompt, nor without a
    writable folder.
    """
    options = {"error_model": "numpy", "nogil": True, **options}
    try:
        law = numba.njit(cache=cache, **options)(function)
    except RuntimeError:
        return cast(Law, numba.njit(**options)(function))
    if cache and is_compiled(law):
        index = law._cache._cache_file
        index._source_stamp = (index._source_stamp, SOURCES)
    return cast(Law, law)


def threaded(function: Law) -> Law:
    """Compile a loop over worlds whose ``numba.prange`` is shared out over threads."""
    return _jit(function, parallel=True)


def compiled(function: Law) -> Law:
    """Compile a helper: cached on disk, IEEE division, the GIL released."""
    return _jit(function)


def inlined(function: Law) -> Law:
    """A helper of laws, pasted into its caller: for a few lines that run in every substep."""
    return cast(Law, register_jitable(inline="always")(function))


@inlined
def clip(value, limit):
    """Saturation (2): ``value`` within +-limit. NaN passes through, so that the run stops instead of going on at the limit."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value


def allocation_free(function: Law, cache: bool = True) -> Law:
    """Compile a law, or a helper that laws call: as :func:`compiled`, and without reference counting.

    Counting the arguments of one call costs more than the arithmetic of most laws. The price: the function cannot create arrays;
    scratch belongs in a law's ``state``.
    """
    return _jit(function, cache, _nrt=False)


def is_compiled(law: Law) -> bool:
    """Whether the compiled loop can call this law; a plain Python function runs through the Python loop."""
    return isinstance(law, Dispatcher)


def plain(law: Law) -> Law:
    """The law as plain Python: for a debugger, and for measuring what compilation is worth."""
    return law.py_func if isinstance(law, Dispatcher) else law
