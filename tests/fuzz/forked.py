"""Runs one case in a forked child: its folder, its limits and its outcome."""

import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import traceback
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import NamedTuple

from marlbc_mj.cli import main

from .cases import Case
from .outside import Bait, Watch

MOST_CPU, MOST_WALL = 8.0, 60.0  # [s] of processor time; of elapsed time, for a case that waits for something
MOST_MEMORY = 2 * 2**30  # bytes
ADDRESS_SPACE = 4 * 2**30  # bytes beyond the parent's address space: torch alone reserves more than it uses
EXIT_TRACEBACK = 70
TRACEBACK = "Traceback (most recent call last)"


class Outcome(NamedTuple):
    """Outcome of a case."""

    status: int  # exit status of the process; if negative, the signal that ended it
    said: str  # text on standard error
    outside: list[str]  # files opened in forbidden places
    memory: int  # largest resident set of the process and of children that it waited for [bytes]
    cpu: float  # [s]
    hung: bool

    def faults(self, case: Case) -> list[str]:
        """Names of the faults found."""
        checked = case.argv[:2] == ["robot", "check"]  # exits with status 1 if a robot failed a check
        there = {
            "hang": self.hung or self.cpu > MOST_CPU,
            "crash": self.status < 0 and not self.hung,
            "traceback": TRACEBACK in self.said or self.status == EXIT_TRACEBACK,
            "status": self.status not in (0, 2, 3, *[1] * checked) and self.status >= 0 and self.status != EXIT_TRACEBACK,
            "outside": bool(self.outside),
            "memory": self.memory > MOST_MEMORY,
            "accepted": case.refused and self.status == 0,
        }
        return [name for name, wrong in there.items() if wrong]


def run(case: Case, folder: Path, watch: Watch, bait: Bait) -> Outcome:
    """Run one case in a child of this process, which must have no threads."""
    lay_out(case, folder)
    bait.taken()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _child(case, folder, watch)
    until, hung = monotonic() + MOST_WALL, False
    ended = os.pidfd_open(child)
    while not select.select([ended], [], [], 0.5)[0]:
        if monotonic() > until or cpu_of(child) > MOST_CPU:
            hung = True
            break
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.close(ended)
    _, status, used = os.wait4(child, 0)
    said = (folder / "stderr").read_text(errors="replace") if (folder / "stderr").exists() else ""
    listed = (folder / "outside").read_text().splitlines() if (folder / "outside").exists() else []
    return Outcome(
        os.waitstatus_to_exitcode(status), said, listed + bait.taken(), used.ru_maxrss * 1024, used.ru_utime + used.ru_stime, hung
    )


def cpu_of(process: int) -> float:
    """Processor time used by a process and the children that it waited for [s]."""
    with suppress(OSError, IndexError):
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def lay_out(case: Case, folder: Path) -> None:
    """Create the case's folder: its files, and pipes, links and folders."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in case.files.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(content)
    for name in ("pipe.toml", "pipe.mcap"):
        os.mkfifo(folder / name)
    (folder / "loop").symlink_to("loop")
    (folder / "link.xml").symlink_to("../../bait/secret.xml")
    (folder / "link.stl").symlink_to("../../bait/secret.stl")
    (folder / "empty").mkdir()
    (folder / "closed").mkdir(mode=0o500)


def _child(case: Case, folder: Path, watch: Watch) -> None:
    """Run the command and end this process."""
    status = EXIT_TRACEBACK
    try:
        _enter(case, folder, watch)
        main(case.argv)
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        watch.allowed = ()
        if watch.found:
            with suppress(OSError):
                (folder / "outside").write_text("\n".join(dict.fromkeys(watch.found)))
        os._exit(status)


def _enter(case: Case, folder: Path, watch: Watch) -> None:
    """Set the limits, folder, output and environment of a case."""
    os.setsid()
    for number, name in ((1, "stdout"), (2, "stderr")):
        descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(descriptor, number)
        os.close(descriptor)
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, 0)
    os.chdir(folder)
    (folder / "tmp").mkdir()
    os.environ.update(HOME=str(folder), TMPDIR=str(folder / "tmp"))
    tempfile.tempdir = None  # else the parent's cached temporary folder would be used
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ADDRESS_SPACE, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    named = [part for word in case.argv for part in (word, word.partition("=")[2]) if part]
    watch.start([str(folder), *[os.path.abspath(part.partition(":")[0] or part) for part in named]])
