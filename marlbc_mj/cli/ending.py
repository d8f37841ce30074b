"""How a command ends: exit statuses, signals, and pipes that the reader closes early."""

import multiprocessing
import os
import signal
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from marlbc_mj.util.errors import MarlbcError
from marlbc_mj.util.files import NO_SPACE
from marlbc_mj.util.text import one_line

INTERRUPTED, TERMINATED, PIPE_CLOSED = 130, 143, 141
"""Exit statuses: 128 plus the number of the signal, as in shells."""


class Terminated(BaseException):
    """SIGTERM was received. Incomplete output is removed while the exception propagates, as after Ctrl-C."""


class CtrlC(KeyboardInterrupt):
    """Ctrl-C was received."""


_STOPS: dict[int, type[BaseException]] = {signal.SIGTERM: Terminated, signal.SIGINT: CtrlC}
_AGAIN = 0.25  # time after which a dropped exception is raised again [s]


@contextmanager
def in_one_line(prog: str) -> Iterator[None]:
    """Run a command, and report whatever stops it in one line.

    Exits with 2 for a wrong setting, 3 for a failed run, a full disk or a lack of memory, 130 after Ctrl-C, 143 after
    SIGTERM, and 141, without a message, if the reader of its output has closed the pipe.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without box-drawing characters, or names that are not valid text
    try:
        with _stoppable():
            try:
                yield
            finally:
                sys.stdout.flush()
    except MarlbcError as error:
        _end(_line(prog, str(error), error), error.exit_status)
    except KeyboardInterrupt as error:
        _end(_line(prog, "interrupted", error), INTERRUPTED)
    except Terminated as error:
        _end(_line(prog, "terminated", error), TERMINATED)
    except MemoryError as error:
        _end(_line(prog, "not enough memory", error), 3)
    except BrokenPipeError:
        _end("", PIPE_CLOSED)
    except OSError as error:
        if error.errno not in NO_SPACE and error.filename is None:
            raise
        what = "standard output" if error.filename is None else error.filename
        _end(_line(prog, f"cannot use {what}: {error.strerror}", error), 3 if error.errno in NO_SPACE else 2)


def _line(prog: str, said: str, error: BaseException) -> str:
    """One line with the reason for the stop and the notes of the error, for example on results that are kept."""
    return f"{prog}: {one_line('; '.join([said, *getattr(error, '__notes__', ())]))}"


def _end(said: str, status: int) -> None:
    """Exit after one line on standard error; output that standard output does not accept is dropped."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
    if said:
        with suppress(OSError):
            print(said, file=sys.stderr, flush=True)
    exec("")  # clears Python's record of an unhandled Ctrl-C, with which it would end by a signal instead of the status
    sys.exit(status)


class _Stop:
    """Ends a command on a signal by an exception, which is raised again until it propagates.

    Python drops an exception that a signal handler raises while C code calls back into Python. numba's compiler calls back after
    every compilation, and a signal that arrives during compilation is handled there.
    """

    def __init__(self) -> None:
        self.insists = hasattr(signal, "setitimer") and signal.getsignal(signal.SIGALRM) == signal.SIG_DFL  # nobody else uses it
        self._kind: type[BaseException] | None = None
        self._error: weakref.ref[BaseException] | None = None

    def on_signal(self, number: int, frame: Any) -> None:
        """Pass SIGTERM on to worker processes, and raise; a second SIGTERM does not stop the removal of incomplete output."""
        if number == signal.SIGTERM:
            if self._on_its_way():
                return
            for child in multiprocessing.active_children():
                child.terminate()
        self._kind = _STOPS[number]
        if self.insists:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
        self._throw()

    def on_alarm(self, number: int, frame: Any) -> None:
        """Raise the exception again if it has been dropped."""
        if self._kind is not None and not self._on_its_way():
            self._throw()

    def _on_its_way(self) -> bool:
        """Whether the exception still exists. Once it is dropped, no references to it remain."""
        return self._error is not None and self._error() is not None

    def _throw(self) -> None:
        assert self._kind is not None
        error = self._kind()
        self._error = weakref.ref(error)
        try:
            raise error
        finally:
            del error  # otherwise this frame would keep the exception alive


@contextmanager
def _stoppable() -> Iterator[None]:
    """Turn SIGTERM into :class:`Terminated` and Ctrl-C into :class:`CtrlC` during the block, also while numba compiles."""
    stop, ours = _Stop(), (signal.SIG_DFL, signal.default_int_handler)
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    taken: dict[int, Any] = {number: stop.on_signal for number in _STOPS if signal.getsignal(number) in ours}
    if stop.insists:
        taken[signal.SIGALRM] = stop.on_alarm
    before = {number: signal.signal(number, handler) for number, handler in taken.items()}
    say = sys.unraisablehook
    sys.unraisablehook = lambda dropped: None if issubclass(dropped.exc_type, tuple(_STOPS.values())) else say(dropped)
    try:
        yield
    finally:
        if stop.insists:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = say
