"""Reads, compiles and steps untrusted MJCF files in separate processes, which may crash, hang or run out of memory.

Run as a program, it is a server that loads MuJoCo once. Every input line is a request (JSON): the server forks to run it and
writes one line as the answer. It exits at the end of its input. :func:`try_out` is the client.
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

MOST_SAID = 2000  # bytes of a trial's output that are kept


class Limits(NamedTuple):
    """Limits of one trial."""

    seconds: float  # elapsed time [s]
    cpu: int  # processor time [s]
    memory: int  # address space [bytes]


class TryOut(NamedTuple):
    """The result of a trial."""

    status: int | None
    """0: success, 3: MuJoCo rejected the file, below 0: minus the signal that ended it, None: timeout; others: failure."""
    said: str
    """Output of the trial; the reason if MuJoCo rejected the file."""


class _Server:
    """A server process that belongs to the process that started it."""

    def __init__(self) -> None:
        command = [sys.executable, "-P", __file__]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        self.owner = os.getpid()
        atexit.register(self.end)

    def ask(self, request: dict[str, Any]) -> Any:
        """The server's answer to a request.

        Raises:
            OSError: the server has ended.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(request).encode() + b"\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise BrokenPipeError("no answer")
        return json.loads(line)

    def end(self) -> None:
        """End the server if this process started it; after a fork, leave it to the parent process."""
        atexit.unregister(self.end)
        if self.owner == os.getpid():
            self.process.kill()
            self.process.wait()
        else:
            self.process.returncode = 0  # so that Popen does not poll a process that is not its child
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()


_server: _Server | None = None


def try_out(path: Path, limits: Limits) -> TryOut:
    """Read, compile and step an MJCF file in a separate process, where it can do no harm.

    Args:
        path: path of the file.
        limits: limits of the trial.

    Raises:
        OSError: no server can be started, or a second one ends without an answer.
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
        except BaseException:  # after Ctrl-C, the pending answer must not be taken for that of the next request
            _server.end()
            _server = None
            raise
    raise AssertionError("unreachable")


def _fly(path: str) -> int:
    """Compile the file and simulate two steps; returns 0, or 3 after printing the reason if MuJoCo rejects the file."""
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
    """Run the trial in this forked process and exit; never returns."""
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
    """Exit status of a child process, or None if it was killed after ``seconds``."""
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
    """Answer requests until the input ends."""
    import mujoco  # noqa: F401  # loaded once here instead of in every trial

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
