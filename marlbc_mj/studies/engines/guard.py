"""Guard process that kills the leftover Ray processes of a killed study: ``python -I -S guard.py TOKEN``.

Ray's agents survive when their raylet is killed. All processes of a Ray instance that a study starts have the token in their
environment. The guard runs in its own session and waits until its standard input ends, which the study's process holds open.
Then it kills the processes with the token. It imports only the standard library.
"""

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

TOKEN = "MARLBC_RAY"
"""Environment variable that holds the token."""
RAY_GRACE = 2.0  # time for processes to end by themselves [s]
PAUSE = 0.1  # time between two scans [s]
CLEAN_LOOKS = 3  # empty scans in a row that mean that no process is left; a single one may miss a process during its exec


def marked(token: str) -> list[int]:
    """IDs of the processes with the token in their environment, on systems with /proc; zombies are not found."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if f"{TOKEN}={token}".encode() in entry.read_bytes().split(b"\0"):
                found.append(int(entry.parent.name))
    return found


def end_marked(token: str, within: float = 10.0) -> bool:
    """Kill all processes with the token except this one, and those that they start meanwhile; returns whether none is left.

    A process that is alive after a scan was started by one that the scan found. So scans that find none mean that none is left.

    Args:
        token: the token of the processes.
        within: time after which the function gives up [s].
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
