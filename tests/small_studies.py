"""Studies of small jobs, in a module that worker processes import quickly."""

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marlbc_mj.studies.protocol import Report, Stopped, Watch
from marlbc_mj.util.errors import SimulationError
from marlbc_mj.util.progress import silent

PATIENCE = 10.0  # longest wait of number 3 for the second try of number 2 [s]


@dataclass(frozen=True)
class Squares:
    """A study that squares numbers. At number 3, ``trouble`` happens instead: "death", "stop", or an error with this text."""

    count: int = 4
    trouble: str = ""

    def jobs(self) -> list[int]:
        return list(range(self.count))

    def run(self, job: int, watch: Watch) -> int:
        time.sleep(0.02 * (self.count - job))  # the first ends last
        if job == 3 and self.trouble:
            self.fail(watch)
        if watch.folder is not None:
            (watch.folder / f"{job}.txt").write_text(str(job))
        for step in (1, 2):
            watch.progress(f"job {job}", step, 2)
        return job * job

    def fail(self, watch: Watch) -> None:
        if self.trouble == "death":
            os._exit(9)
        if self.trouble == "stop":
            while not watch.stopping():
                time.sleep(0.01)
            raise Stopped
        raise SimulationError(self.trouble)

    def report(self, results: Sequence[int], out: Path | None, progress=silent) -> Report:
        if out is not None:
            (out / "sum.txt").write_text(str(sum(results)))
        return Report(f"sum {sum(results)}", ("no picture",))


@dataclass(frozen=True)
class Roots:
    """A study of square roots. With ``once``, number 2 first kills its worker; with ``trouble``, number 3 then fails."""

    count: int = 5
    trouble: str = ""
    once: Path | None = None
    """File that contains ``once`` or ``again`` after the first or second try of number 2."""

    def jobs(self) -> list[int]:
        return list(range(self.count))

    def run(self, job: int, watch: Watch) -> np.ndarray:
        if job == 2 and self.once is not None:
            if not self.once.exists():
                self.once.write_text("once")
                os.kill(os.getpid(), signal.SIGKILL)
            self.once.write_text("again")
        if job == 3 and self.trouble:
            self.fail()
        if watch.folder is not None:
            (watch.folder / f"{job}.txt").write_text(str(job))
        return np.sqrt(np.arange(job, job + 3.0))

    def fail(self) -> None:
        if self.trouble == "error":
            raise ZeroDivisionError("nothing to divide")
        until = time.monotonic() + PATIENCE
        while self.once is not None and not (self.once.exists() and self.once.read_text() == "again"):
            if time.monotonic() > until:
                break
            time.sleep(0.05)
        raise SimulationError(self.trouble)

    def report(self, results: Sequence[np.ndarray], out: Path | None, progress=silent) -> Report:
        if out is not None:
            np.array(results).tofile(out / "all.bin")
        return Report()
