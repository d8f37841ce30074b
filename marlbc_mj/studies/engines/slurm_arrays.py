"""Engine that runs jobs in a SLURM job array; results come back through the study's folder, which all nodes must see.

submitit submits the array. Each of its tasks runs a share of the jobs and appends their results to its own pack. SLURM requeues a
task if its node dies, and submitit requeues one if its time is up. The task then resumes after the last result in its pack. If
tasks end without all of their results, the missing jobs are submitted again. If a study is killed, its next run takes over the
results of the array.

Partition, account, memory and time limit are set by SLURM's own environment variables: ``SBATCH_PARTITION``, ``SBATCH_ACCOUNT``,
``SBATCH_MEM_PER_NODE``, ``SBATCH_TIMELIMIT``.
"""

import shutil
import subprocess
from collections.abc import Generator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple

from marlbc_mj.studies import codec
from marlbc_mj.studies.engines.base import MOST_TRIES, EngineCallbacks, Outcome, Task, Work, attempt
from marlbc_mj.studies.packs import PACK_SUFFIX, PackWriter, entries
from marlbc_mj.studies.protocol import JobT, ResultT
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import writing
from marlbc_mj.util.text import one_line

RESULTS_EVERY = 0.5  # time between two checks for results [s]
ALIVE_EVERY = 5.0  # time between two checks whether tasks are alive [s]
CANCELLED = 60.0  # longest wait for the end of a cancelled array [s]
SLICE = 60  # time after which a task makes room for others and resumes later [min]
MOST_SLICES = 10_000
_ARRAYS, _LOGS = "arrays", "logs"


class ArrayShare(NamedTuple):
    """The share of jobs that one task of the array runs; submitit pickles it, and calls it again after a timeout."""

    work: Work[Any, Any]
    tasks: tuple[Task, ...]
    pack: Path

    def __call__(self) -> None:
        """Run the jobs whose results are not yet in the pack."""
        done = {entry.key for entry in entries(self.pack)} if self.pack.exists() else set()
        with PackWriter(self.pack) as results:
            for task in self.tasks:
                if task.key not in done:
                    results.add(task.key, codec.to_bytes(attempt(self.work, task)))

    def checkpoint(self) -> Any:
        """The submission that submitit makes after a timeout: the same share again."""
        return import_module("submitit").helpers.DelayedSubmission(self)


class SlurmArray:
    """Engine that shares the jobs among the tasks of a SLURM array.

    Args:
        workers: number of tasks in the array.
        cluster: ``slurm``, or ``local`` for submitit's processes on this machine, which replace SLURM in tests.

    Raises:
        ConfigurationError: submitit is not installed, or there is no command ``sbatch``.
    """

    def __init__(self, workers: int, cluster: str = "slurm") -> None:
        self.workers, self.cluster = workers, cluster
        try:
            self.submitit: Any = import_module("submitit")
        except ImportError as error:
            raise ConfigurationError("the engine slurm needs submitit: pip install 'marlbc-mj[slurm]'") from error
        if cluster == "slurm" and shutil.which("sbatch") is None:
            raise ConfigurationError("SLURM is not available here: the command sbatch was not found")
        self._jobs: list[Any] = []  # submitit jobs of the last array

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: EngineCallbacks) -> Generator[tuple[int, ResultT]]:
        if ears.stop is not None or work.scratch is None:
            raise ConfigurationError("the engine slurm needs an output folder and cannot run jobs that save their own progress")
        with writing(work.scratch):
            (work.scratch / _LOGS).mkdir(parents=True, exist_ok=True)
        self._cancel(work.scratch)
        array = _Array({task.key: task for task in tasks}, work.scratch)
        yield from array.arrived(failed=False)  # results of an earlier array whose study was killed
        array.clear()
        try:
            yield from self._rounds(work, array, ears)
        finally:
            self._cancel(work.scratch)
        shutil.rmtree(work.scratch, ignore_errors=True)

    def _rounds(self, work: Work[JobT, ResultT], array: "_Array", ears: EngineCallbacks) -> Generator[tuple[int, ResultT]]:
        """Submit an array, and further ones if tasks end without all of their results."""
        for tries in range(MOST_TRIES):
            if not array.left:
                return
            if tries:
                ears.retried(f"SLURM tasks ended with {len(array.left)} results missing")
            jobs = self._submit(work, list(array.left.values()), work.scratch, tries)
            looked = monotonic()
            while array.left:
                yield from array.arrived()
                if monotonic() > looked + ALIVE_EVERY:
                    looked = monotonic()
                    if not self._alive(jobs):
                        yield from array.arrived()  # results written between the two checks
                        break
                sleep(RESULTS_EVERY)
        if array.left:
            raise SimulationError(f"SLURM tasks ended {MOST_TRIES} times without all results{_last_words(work.scratch)}")

    def _submit(self, work: Work[Any, Any], tasks: list[Task], scratch: Path | None, tries: int) -> list[Any]:
        assert scratch is not None
        count = min(self.workers, len(tasks))
        executor = self.submitit.AutoExecutor(scratch / _LOGS, cluster=self.cluster, slurm_max_num_timeout=MOST_SLICES)
        executor.update_parameters(name="marlbc", timeout_min=SLICE, slurm_cpus_per_task=1)
        shares = [ArrayShare(work, tuple(tasks[k::count]), scratch / f"{tries}-{k}{PACK_SUFFIX}") for k in range(count)]
        try:
            with executor.batch():
                jobs = [executor.submit(share) for share in shares]
        except (self.submitit.core.utils.FailedJobError, OSError, subprocess.SubprocessError) as error:
            raise ConfigurationError(f"SLURM rejected the jobs: {one_line(str(error)[-300:])}") from error
        with (scratch / _ARRAYS).open("a") as file:
            file.writelines(f"{name}\n" for name in dict.fromkeys(str(job.job_id).split("_")[0] for job in jobs))
        self._jobs = jobs
        return jobs

    def _alive(self, jobs: list[Any]) -> bool:
        """Whether any task of the array is waiting or running."""
        if self.cluster != "slurm":
            return not all(job.done() for job in jobs)
        return bool(_queued({str(job.job_id).split("_")[0] for job in jobs}))

    def _cancel(self, scratch: Path) -> None:
        """Cancel all arrays that this study has submitted, including those of an earlier run."""
        if not (scratch / _ARRAYS).is_file():
            return
        names = set((scratch / _ARRAYS).read_text().split())
        if self.cluster != "slurm":
            for job in self._jobs:
                with suppress(OSError):
                    job.cancel(check=False)
            until = monotonic() + CANCELLED
            while self._alive(self._jobs) and monotonic() < until:
                sleep(RESULTS_EVERY)
        elif names:
            subprocess.run(["scancel", *names], capture_output=True, check=False)
            until = monotonic() + CANCELLED
            while _queued(names) and monotonic() < until:
                sleep(RESULTS_EVERY)
        (scratch / _ARRAYS).unlink(missing_ok=True)


class _Array:
    """The jobs without results, and the position up to which each pack has been read."""

    def __init__(self, left: dict[str, Task], scratch: Path) -> None:
        self.left = left
        self.scratch = scratch
        self._read: dict[Path, int] = {}

    def clear(self) -> None:
        """Remove all packs and forget their positions, since new packs may have the same names."""
        for pack in self.scratch.glob(f"*{PACK_SUFFIX}"):
            pack.unlink()
        self._read.clear()

    def arrived(self, *, failed: bool = True) -> Generator[tuple[int, Any]]:
        """Yield the results that were written since the last call.

        Args:
            failed: whether to raise the error of a failed job; if not, the job is left to run again.

        Raises:
            ConfigurationError, SimulationError: the error that a job raised.
        """
        for pack in sorted(self.scratch.glob(f"*{PACK_SUFFIX}")):
            for entry in entries(pack, self._read.get(pack, 0)):
                self._read[pack] = entry.start + entry.length
                task = self.left.get(entry.key)
                outcome: Outcome = codec.from_bytes(entry.payload())
                if task is not None and (failed or not outcome.error):
                    result = outcome.unpack()
                    del self.left[entry.key]
                    yield task.place, result


def _queued(names: set[str]) -> list[str]:
    """IDs of the waiting or running tasks of these arrays; if SLURM does not answer, the names of all arrays."""
    for _ in range(MOST_TRIES):
        said = subprocess.run(["squeue", "--noheader", "--format=%i %F"], capture_output=True, text=True, check=False)
        if said.returncode == 0:
            lines = [line.split() for line in said.stdout.splitlines()]
            return [line[0] for line in lines if line and line[-1] in names]
        sleep(ALIVE_EVERY)
    return sorted(names)


def _last_words(scratch: Path | None) -> str:
    """The last line of the newest error log that is not empty, for an error message."""
    assert scratch is not None
    for path in sorted((scratch / _LOGS).glob("*.err"), key=lambda path: path.stat().st_mtime, reverse=True):
        lines = path.read_text(errors="replace").split("\n")
        words = [line for line in lines if line.strip()]
        if words:
            return f": {one_line(words[-1])[:300]} ({path.name})"
    return ""
