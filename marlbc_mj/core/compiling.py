"""Compilation of laws and of the helpers that they call: by numba, on first use, cached on disk."""

import dis
import os
import pickle
import zlib
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, cast

# OpenMP reads this once, when its first library loads. Threads that spin while they wait would take cores from torch and from
# other processes: with both active, the same training step took 4 to 6 times longer.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba
import numpy as np
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.extending import register_jitable

Law = Callable[..., Any]
"""A compiled law. All kinds except behaviors may also be plain Python functions with the same arguments."""


def sources_stamp(package: Path) -> int:
    """Checksum of all source files below ``package`` that contain compiled code.

    numba keeps compiled code until the file of its function changes. But functions from other files are compiled into their
    callers, so compiled code of this package is kept only until any of these files changes.
    """
    texts = (path.read_bytes() for path in sorted(package.rglob("*.py")))
    return zlib.crc32(b"".join(text for text in texts if any(mark in text for mark in COMPILED_MARKS)))


def threads_usable(threads: int) -> bool:
    """Set numba to ``threads`` threads; False if the loop must run in series, which gives the same results.

    A process forked from one that had started threads has none, and GNU OpenMP would terminate it, so it must run in series.
    Processes started with ``spawn`` have threads of their own.
    """
    global _threads_of
    if threads == 1 or _threads_of not in (0, os.getpid()):
        return False
    _threads_of = os.getpid()
    numba.set_num_threads(threads)
    return True


_threads_of = 0
"""ID of the process in which numba has started threads; 0 if none."""

COMPILED_MARKS = (b"import numba", b"from numba", b"core.laws", b"core.compiling", b"core import laws")
"""Texts that identify files with compiled code."""
_PACKAGE = Path(__file__).parents[1]
SOURCES = sources_stamp(_PACKAGE)
_MOST_BESIDE = 500
"""Greatest number of Python files in the folder of a user's law that are checked for changes."""


def _stamp(function: Law) -> tuple[Any, ...]:
    """Checksums of the sources that a function's compiled code depends on.

    These are this package and, for a user's law, the Python files in its folder and the values and functions that it uses.
    """
    path = Path(function.__code__.co_filename)
    if path.is_relative_to(_PACKAGE):
        return (SOURCES,)
    beside = sorted(path.parent.glob("*.py"))[:_MOST_BESIDE] if path.is_file() else []
    return (SOURCES, *(_checksum(file) for file in beside), zlib.crc32("".join(_used(function, set())).encode()))


def _checksum(file: Path) -> int:
    try:
        return zlib.crc32(file.read_bytes())
    except OSError:
        return 0


_VALUES = (bool, int, float, complex, str, tuple, np.generic, np.ndarray)
"""Types of global values and constants that numba compiles into a function."""


def _used(function: Law, seen: set[int]) -> Iterator[str]:
    """Texts of a function's code and of the values and functions that it uses by global names."""
    function = plain(function)
    code = getattr(function, "__code__", None)
    if code is None or id(function) in seen:
        return
    seen.add(id(function))
    yield f"{code.co_code.hex()} {code.co_names} {[constant for constant in code.co_consts if isinstance(constant, _VALUES)]}"
    for name in code.co_names:
        value: Any = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            file = getattr(value, "__file__", None)
            if file is not None and "site-packages" not in file and not Path(file).is_relative_to(_PACKAGE):
                yield f"{name} {_checksum(Path(file))}"
        elif isinstance(plain(value), FunctionType):
            yield from _used(value, seen)
        elif isinstance(value, _VALUES):
            yield f"{name} {value.tobytes().hex() if isinstance(value, np.ndarray) else value}"


def raising_line(function: Law, seen: set[int]) -> str | None:
    """Location of a ``raise`` or ``assert`` in a function or a compiled helper that it calls; None if there is none.

    Args:
        function: compiled or plain.
        seen: ``id`` of each function already examined.

    Returns:
        A text such as ``file.py, line 12``, or None.
    """
    function = plain(function)
    if id(function) in seen or not isinstance(function, FunctionType):
        return None
    seen.add(id(function))
    code = function.__code__
    for each in dis.get_instructions(code):
        if each.opname == "RAISE_VARARGS" and each.positions is not None:
            return f"{Path(code.co_filename).name}, line {each.positions.lineno}"
    used = (cast(Law, function.__globals__.get(name)) for name in code.co_names)
    return next(filter(None, (raising_line(helper, seen) for helper in used if is_compiled(helper))), None)


def _jit(function: Law, cache: bool = True, **options: Any) -> Law:
    """Compile a function, and cache the result on disk unless it was typed at a prompt or no folder is writable."""
    options = {"error_model": "numpy", "nogil": True, **options}
    try:
        law = numba.njit(cache=cache, **options)(function)
    except RuntimeError:
        _unkept.append(numba.njit(**options)(function))
        return cast(Law, _unkept[-1])
    if cache and is_compiled(law):
        kept = law._cache
        stamp = (kept._cache_file._source_stamp, *_stamp(function))
        kept._cache_file = Index(kept._cache_path, kept._impl.filename_base, stamp)
        kept.load_overload, kept.save_overload = _forgiving(kept.load_overload), _forgiving(kept.save_overload)
    return cast(Law, law)


class Index(IndexDataCacheFile):
    """numba's index of a function's compiled code on disk, in which each signature is pickled by itself.

    A signature may name a type that only some processes can import, such as a NamedTuple of a script. numba pickles all
    signatures together, so one that cannot be unpickled would keep other processes from finding or adding any. Here it is kept
    for the processes that can unpickle it.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            kept = super()._load_index()
        except Exception:  # damaged file
            return {}
        return {_signature(key): name for key, name in kept.items()}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        super()._save_index({key if isinstance(key, bytes) else self._dump(key): name for key, name in overloads.items()})


def _signature(pickled: bytes) -> Any:
    """The unpickled signature; the bytes themselves if this process cannot import a type that it names."""
    try:
        return _unpickled(pickled)
    except Exception:
        return pickled


_unpickled = lru_cache(maxsize=None)(pickle.loads)


_unkept: list[Any] = []
"""Functions whose compiled code cannot be cached on disk."""


def compiled_in_vain() -> bool:
    """Whether the next process must compile something again, because it could not be cached on disk."""
    return any(law.signatures for law in _unkept)


def _forgiving(access: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap an access to the cache: None if its files are damaged, foreign or not writable; the law is then compiled."""

    def attempt(*arguments: Any) -> Any:
        try:
            return access(*arguments)
        except Exception:
            return None

    return attempt


def threaded(function: Law) -> Law:
    """Compile a loop over worlds whose ``numba.prange`` is distributed over threads.

    The loop index is uint64. Pass ``np.int64`` of it to other functions, otherwise each of them is compiled once more.
    """
    return _jit(function, parallel=True)


def compiled(function: Law) -> Law:
    """Compile a helper: cached on disk, IEEE division, the GIL released."""
    return _jit(function)


def inlined(function: Law) -> Law:
    """Inline a helper of laws into its callers: for a few lines that run in every substep."""
    return cast(Law, register_jitable(inline="always")(function))


def on_both_paths(function: Law) -> Law:
    """Declare a part of the loop that runs as Python when called from Python, and is compiled when called from compiled code.

    So it accepts objects (laws, MuJoCo's step) or their addresses. Unlike an :func:`inlined` helper it is compiled only once.
    """
    return cast(Law, register_jitable(error_model="numpy", _nrt=False)(function))


@inlined
def clip(value, limit):
    """Saturation (2): clip ``value`` to +-limit. NaN passes through, so the run stops instead of continuing at the limit."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value


def allocation_free(function: Law, cache: bool = True) -> Law:
    """Compile a law or a helper of laws like :func:`compiled`, but without reference counting.

    Counting the references of one call's arguments costs more than the arithmetic of most laws. The price is that the function
    cannot create arrays; keep scratch in a law's ``state``.
    """
    return _jit(function, cache, _nrt=False)


def is_compiled(law: Law) -> bool:
    """Whether the compiled loop can call this law; a plain Python function runs through the Python loop."""
    return isinstance(law, Dispatcher)


def plain(law: Law) -> Law:
    """The law as plain Python: for a debugger, and for measuring the speedup by compilation."""
    return law.py_func if isinstance(law, Dispatcher) else law
