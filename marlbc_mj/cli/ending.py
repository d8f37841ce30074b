"""How a command ends: exit statuses, signals, and output that nobody reads to its end."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from marlbc_mj.util.errors import MarlbcError
from marlbc_mj.util.files import NO_SPACE
from marlbc_mj.util.text import one_line

INTERRUPTED, TERMINATED, PIPE_CLOSED = 130, 143, 141
"""128 and the number of the signal, as shells have it."""


class Terminated(BaseException):
    """SIGTERM was received; what is half written is removed on the way out, as after Ctrl-C."""


@contextmanager
def in_one_line(prog: str) -> Iterator[None]:
    """Run a command; whatever stops it is said in one line.

    Exits with 2 for a wrong setting, 3 for a failed run or a full disk, 130 after Ctrl-C, 143 after SIGTERM, and with 141,
    quietly, if the reader of its output has gone.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal that has no box-drawing characters, or names that are no text
    try:
        with _terminable():
            try:
                yield
            finally:
                sys.stdout.flush()
    except MarlbcError as error:
        _end(f"{prog}: {one_line(error)}", error.exit_status)
    except KeyboardInterrupt:
        _end(f"{prog}: interrupted", INTERRUPTED)
    except Terminated:
        _end(f"{prog}: terminated", TERMINATED)
    except BrokenPipeError:
        _end("", PIPE_CLOSED)
    except OSError as error:
        if error.errno not in NO_SPACE and error.filename is None:
            raise
        what = "standard output" if error.filename is None else error.filename
        _end(f"{prog}: {one_line(f'cannot use {what}: {error.strerror}')}", 3 if error.errno in NO_SPACE else 2)


def _end(said: str, status: int) -> None:
    """Exit, after one line on standard error; what standard output does not take is dropped."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
    if said:
        with suppress(OSError):
            print(said, file=sys.stderr, flush=True)
    sys.exit(status)


@contextmanager
def _terminable() -> Iterator[None]:
    """Turn SIGTERM into :class:`Terminated`, and pass it on to worker processes, during the block."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def stop(number: int, frame: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one would stop the removal of what is half written
        for child in multiprocessing.active_children():
            child.terminate()
        raise Terminated

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
