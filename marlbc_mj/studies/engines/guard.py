"""Ends what a killed study leaves of a Ray that it has started: ``python -I -S guard.py TOKEN``, which imports nothing else.

Ray's agents outlive a raylet that was killed. All processes of that Ray have the token in their environment. This one, in a
session of its own, waits until its standard input ends, which the study's process holds, and ends them.
"""

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

TOKEN = "MARLBC_RAY"
"""Variable of the environment."""
RAY_GRACE = 2.0  # that processes have to end by themselves [s]


def marked(token: str) -> Iterator[int]:
    """Numbers of the processes that have the token in their environment, on systems that show it."""
    for entry in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if f"{TOKEN}={token}".encode() in entry.read_bytes().split(b"\0"):
                yield int(entry.parent.name)


def end_marked(token: str) -> None:
    """End all of these processes but this one."""
    for process in marked(token):
        if process != os.getpid():
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)


if __name__ == "__main__":
    sys.stdin.read()
    for _ in range(3):  # a process that was just being started
        time.sleep(RAY_GRACE)
        end_marked(sys.argv[1])
