"""A study of 40 small jobs, for ``make slurm-test`` and ``make kills``: ``python tests/digests.py OUT ENGINE WORKERS PAUSE``."""

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
    """A study that hashes numbers and writes a file for each; ``pause`` is the time that each job takes [s]."""

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


def main(out: str, engine: str, workers: int, pause: float) -> None:
    """Run the study on an engine and compare its results with those of this process."""
    from digests import Digests as Same  # workers cannot import the class from __main__

    def show(what: str, done: float, total: float) -> None:
        print(f"{what}: {done} of {total}", file=sys.stderr, flush=True)

    done = run_study(Same(pause=pause), Path(out), overwrite=True, engine=engine, workers=workers, progress=show)
    if done.results != run_jobs(Same()):
        sys.exit("results differ from those of one process")
    if len(list(Path(out).glob("*.txt"))) != JOBS + 1:
        sys.exit("files are missing")
    print(f"{JOBS} of {JOBS} results, equal to those of one process")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]))
