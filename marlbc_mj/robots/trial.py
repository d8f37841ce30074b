"""Reads, compiles and steps MJCF files of strangers in processes of their own, which may crash, hang or run out of memory.

Run as a program it is a server, which loads MuJoCo once: every line of its input is a request (JSON), for which it forks, and is
answered by a line. It ends with its input. :func:`try_out` is the client.
"""

import atexit
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

MOST_SAID = 2000  # characters of what a trial says that are kept


class Limits(NamedTuple):
    """What a trial may take."""

    seconds: float  # by the clock
    cpu: int  # of a processor [s]
    memory: int  # address space [bytes]


class TryOut(NamedTuple):
    """How a trial ended."""

    status: int | None
    """0: well, 3: MuJoCo refuses the file, below 0: the signal that ended it, None: it ran out of time."""
    said: str
    """Its output; the reason, where MuJoCo refuses the file."""


class _Server:
    """A server that belongs to this process."""

    def __init__(self) -> None:
        command = [sys.executable, "-P", __file__]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        self.owner = os.getpid()
        atexit.register(self.end)

    def ask(self, request: dict[str, Any]) -> Any:
        """The answer.

        Raises:
            OSError: the server has gone.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(request).encode() + b"\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise BrokenPipeError("no answer")
        return json.loads(line)

    def end(self) -> None:
        """End it, if it is this process's; one of a parent is left to the parent."""
        atexit.unregister(self.end)
        if self.owner == os.getpid():
            self.process.kill()
            self.process.wait()
        else:
            self.process.returncode = 0  # so that Popen does not miss a process that is none of its children
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()


_server: _Server | None = None


def try_out(path: Path, limits: Limits) -> TryOut:
    """Read, compile and step an MJCF file where it can do no harm.

    Args:
        path: of the file.
        limits: of the trial.

    Raises:
        OSError: no server can be started.
    """
    global _server
    place = path.resolve()
    request = {"path": str(place), "folder": str(place.parent), **limits._asdict()}
    for again in (True, False):
        if _server is not None and _server.owner != os.getpid():
            _server.end()
            _server = None
        _server = _server or _Server()
        try:
            return TryOut(**_server.ask(request))
        except OSError:
            _server.end()
            _server = None
            if not again:
                raise
        except BaseException:  # Ctrl-C in the middle of an answer: the next one must not be that of this request
            _server.end()
            _server = None
            raise
    raise AssertionError("unreachable")


def _fly(path: str) -> int:
    """Compile the file and make two steps; the exit status, 3 with a line where MuJoCo refuses it."""
    import mujoco

    mujoco.set_mju_user_warning(lambda text: None)
    try:
        model = mujoco.MjSpec.from_file(path).compile()
        data = mujoco.MjData(model)
    except (ValueError, MemoryError, mujoco.FatalError) as error:
        print(" ".join(str(error).split()) or type(error).__name__, flush=True)
        return 3
    for _ in range(2):
        mujoco.mj_step(model, data)
    return 0


def _confined(request: dict[str, Any], output: int) -> None:
    """The trial, in a process that was forked for it; never returns."""
    status = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(request["folder"])
        resource.setrlimit(resource.RLIMIT_AS, (request["memory"],) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (request["cpu"], request["cpu"] + 1))
        status = _fly(request["path"])
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(status)


def _ended(child: int, seconds: float) -> int | None:
    """Exit status of a child, or None if it was ended after this time."""
    until, pause = time.monotonic() + seconds, 0.001
    while True:
        process, status = os.waitpid(child, os.WNOHANG)
        if process:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(pause)
        pause = min(2 * pause, 0.05)


def _serve() -> None:
    """Answer requests until there are no more."""
    import mujoco  # noqa: F401  # loaded here, not in every trial

    for line in sys.stdin:
        request = json.loads(line)
        with tempfile.TemporaryFile() as output:
            child = os.fork()
            if child == 0:
                _confined(request, output.fileno())
            status = _ended(child, request["seconds"])
            output.seek(0)
            said = output.read(MOST_SAID).decode(errors="replace")
        print(json.dumps(TryOut(status, said)._asdict()), flush=True)


if __name__ == "__main__":
    _serve()
