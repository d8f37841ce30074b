"""Jobs in an array of SLURM, submitted by submitit; results come through the folder of the study, which all nodes must see.

Every task of the array has a share of the jobs and appends their results to a pack of its own. SLURM requeues a task whose node
died, and submitit one whose time is up; both go on behind the last result in their pack. A task that ended without all of its
results is submitted again. What an array did whose study was killed is taken over by the next run.

Partition, account, memory and time limit are SLURM's own variables: ``SBATCH_PARTITION``, ``SBATCH_ACCOUNT``,
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
from marlbc_mj.studies.engines.base import MOST_TRIES, Ears, Outcome, Task, Work, attempt
from marlbc_mj.studies.packs import PACK_SUFFIX, PackWriter, entries
from marlbc_mj.studies.protocol import JobT, ResultT
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import writing
from marlbc_mj.util.text import one_line

RESULTS_EVERY = 0.5  # between two looks for results [s]
ALIVE_EVERY = 5.0  # between two looks whether tasks are alive [s]
CANCELLED = 60.0  # until an array that was cancelled has gone [s]
SLICE = 60  # after which a task of the array makes room for others, and goes on later [min]
MOST_SLICES = 10_000
_ARRAYS, _LOGS = "arrays", "logs"


class ArrayShare(NamedTuple):
    """What one task of an array does; submitit pickles it, and calls it again after its time was up."""

    work: Work[Any, Any]
    tasks: tuple[Task, ...]
    pack: Path

    def __call__(self) -> None:
        """Run the jobs whose results are not in the pack."""
        done = {entry.key for entry in entries(self.pack)} if self.pack.exists() else set()
        with PackWriter(self.pack) as results:
            for task in self.tasks:
                if task.key not in done:
                    results.add(task.key, codec.to_bytes(attempt(self.work, task)))

    def checkpoint(self) -> Any:
        """What submitit submits when the time of a task is up: the same again."""
        return import_module("submitit").helpers.DelayedSubmission(self)


class SlurmArray:
    """One array of tasks that share the jobs.

    Args:
        workers: tasks of the array.
        cluster: ``slurm``, or ``local`` for submitit's processes on this machine, which stand for an array in tests.

    Raises:
        ConfigurationError: submitit is not installed, or there is no SLURM.
    """

    def __init__(self, workers: int, cluster: str = "slurm") -> None:
        self.workers, self.cluster = workers, cluster
        try:
            self.submitit: Any = import_module("submitit")
        except ImportError as error:
            raise ConfigurationError("the engine slurm needs submitit: pip install 'marlbc-mj[slurm]'") from error
        if cluster == "slurm" and shutil.which("sbatch") is None:
            raise ConfigurationError("no SLURM here: there is no command sbatch")
        self._jobs: list[Any] = []  # of the last array

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: Ears) -> Generator[tuple[int, ResultT]]:
        if ears.stop is not None or work.scratch is None:
            raise ConfigurationError("the engine slurm needs an output folder, and jobs that do not save themselves")
        with writing(work.scratch):
            (work.scratch / _LOGS).mkdir(parents=True, exist_ok=True)
        self._cancel(work.scratch)
        array = _Array({task.key: task for task in tasks}, work.scratch)
        yield from array.arrived(failed=False)  # of an array whose study was killed
        array.clear()
        try:
            yield from self._rounds(work, array, ears)
        finally:
            self._cancel(work.scratch)
        shutil.rmtree(work.scratch, ignore_errors=True)

    def _rounds(self, work: Work[JobT, ResultT], array: "_Array", ears: Ears) -> Generator[tuple[int, ResultT]]:
        """An array, and others for what tasks that died have left."""
        for tries in range(MOST_TRIES):
            if not array.left:
                return
            if tries:
                ears.retried(f"tasks of SLURM ended without {len(array.left)} of their results")
            jobs = self._submit(work, list(array.left.values()), work.scratch, tries)
            looked = monotonic()
            while array.left:
                yield from array.arrived()
                if monotonic() > looked + ALIVE_EVERY:
                    looked = monotonic()
                    if not self._alive(jobs):
                        yield from array.arrived()  # what came between the two looks
                        break
                sleep(RESULTS_EVERY)
        if array.left:
            raise SimulationError(f"tasks of SLURM ended {MOST_TRIES} times without their results{_last_words(work.scratch)}")

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
            raise ConfigurationError(f"SLURM takes no jobs: {one_line(str(error)[-300:])}") from error
        with (scratch / _ARRAYS).open("a") as file:
            file.writelines(f"{name}\n" for name in dict.fromkeys(str(job.job_id).split("_")[0] for job in jobs))
        self._jobs = jobs
        return jobs

    def _alive(self, jobs: list[Any]) -> bool:
        """Whether any task of the array waits or runs."""
        if self.cluster != "slurm":
            return not all(job.done() for job in jobs)
        return bool(_queued({str(job.job_id).split("_")[0] for job in jobs}))

    def _cancel(self, scratch: Path) -> None:
        """End all arrays that this study has submitted, also those of an earlier run."""
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
    """Jobs whose results have not arrived, and how far each pack has been read."""

    def __init__(self, left: dict[str, Task], scratch: Path) -> None:
        self.left = left
        self.scratch = scratch
        self._read: dict[Path, int] = {}

    def clear(self) -> None:
        """Remove all packs; new ones of the same names are read from their beginning."""
        for pack in self.scratch.glob(f"*{PACK_SUFFIX}"):
            pack.unlink()
        self._read.clear()

    def arrived(self, *, failed: bool = True) -> Generator[tuple[int, Any]]:
        """Results since the last call.

        Args:
            failed: whether jobs that raised count; if not, they are left, and done again.

        Raises:
            ConfigurationError, SimulationError: what a job raised.
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
    """Which tasks of these arrays wait or run; when SLURM does not answer, all of them may."""
    for _ in range(MOST_TRIES):
        said = subprocess.run(["squeue", "--noheader", "--format=%i %F"], capture_output=True, text=True, check=False)
        if said.returncode == 0:
            lines = [line.split() for line in said.stdout.splitlines()]
            return [line[0] for line in lines if line and line[-1] in names]
        sleep(ALIVE_EVERY)
    return sorted(names)


def _last_words(scratch: Path | None) -> str:
    """The last line of an error output, for a message."""
    assert scratch is not None
    for path in sorted((scratch / _LOGS).glob("*.err"), key=lambda path: path.stat().st_mtime, reverse=True):
        lines = path.read_text(errors="replace").split("\n")
        words = [line for line in lines if line.strip()]
        if words:
            return f": {one_line(words[-1])[:300]} ({path.name})"
    return ""
