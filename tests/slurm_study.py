"""A study of 40 small jobs, run by ``make slurm-test`` on an array of 40 tasks, and compared with one in this process."""

import hashlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import run_jobs, run_study
from marlbc_mj.util.progress import silent

JOBS = 40


@dataclass(frozen=True)
class Digests:
    """Digests of numbers, each with a file; ``pause`` is how long each takes [s]."""

    count: int = JOBS
    pause: float = 0.0

    def jobs(self) -> list[int]:
        return list(range(self.count))

    def run(self, job: int, watch: Watch) -> tuple[int, str]:
        time.sleep(self.pause)
        text = hashlib.sha256(str(job).encode()).hexdigest()
        if watch.folder is not None:
            (watch.folder / f"{job}.txt").write_text(text)
        return job, text

    def report(self, results: Sequence[tuple[int, str]], out: Path | None, progress=silent) -> Report:
        if out is not None:
            (out / "all.txt").write_text("".join(f"{job} {text}\n" for job, text in results))
        return Report()


if __name__ == "__main__":
    from slurm_study import Digests as Same  # not of __main__, which tasks cannot import

    out = Path(sys.argv[1])
    done = run_study(
        Same(pause=3.0), out, engine="slurm", workers=JOBS, progress=lambda *step: print(*step, file=sys.stderr, flush=True)
    )
    assert done.results == run_jobs(Same()), "results of the array differ"
    assert len(list(out.glob("*.txt"))) == JOBS + 1
    print(f"{JOBS} of {JOBS} results, equal to those of one process")
