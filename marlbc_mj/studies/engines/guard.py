"""Ends what a killed study leaves of a Ray that it has started: ``python -I -S guard.py TOKEN``, which imports nothing else.

Ray's agents outlive a raylet that was killed. All processes of that Ray have the token in their environment. This one, in a
session of its own, waits until its standard input ends, which the study's process holds, and ends them.
"""

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

TOKEN = "MARLBC_RAY"
"""Variable of the environment."""
RAY_GRACE = 2.0  # that processes have to end by themselves [s]
PAUSE = 0.1  # between two looks [s]
CLEAN_LOOKS = 3  # in a row, after which nothing is left; one alone may miss a process in the middle of its exec


def marked(token: str) -> list[int]:
    """Numbers of the processes that have the token in their environment, on systems that show it; zombies show none."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if f"{TOKEN}={token}".encode() in entry.read_bytes().split(b"\0"):
                found.append(int(entry.parent.name))
    return found


def end_marked(token: str, within: float = 10.0) -> bool:
    """End all of these processes but this one, and what they start meanwhile; whether none is left.

    Who is alive after a look was started by somebody whom that look found. So looks that find nobody are the end.

    Args:
        token: of the processes.
        within: time after which it gives up [s].
    """
    until, clean = time.monotonic() + within, 0
    while clean < CLEAN_LOOKS and time.monotonic() < until:
        others = [process for process in marked(token) if process != os.getpid()]
        for process in others:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        clean = 0 if others else clean + 1
        time.sleep(PAUSE)
    return clean == CLEAN_LOOKS


if __name__ == "__main__":
    sys.stdin.read()
    time.sleep(RAY_GRACE)
    end_marked(sys.argv[1])
