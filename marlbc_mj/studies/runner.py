"""The runner of all studies: it looks up the jobs that are already done, has an engine run the rest, and makes the report.

A study is a list of jobs, each a pure function of its configuration (:mod:`~marlbc_mj.studies.protocol`).

**Addresses.** A job's key is a hash of its configuration and of the code that runs it (:mod:`~marlbc_mj.studies.addresses`).
A key has one result, no matter where, when and by which process it is computed. So one look-up tells whether a job is done, a
longer study reuses the results of a shorter one, and after a change of a setting or of the code no outdated result is found.

**Storage.** Each result is appended under its key to a pack, a file of up to about 256 MiB (:mod:`~marlbc_mj.studies.packs`).
A whole record marks its job as done. A torn record, left by a killed process or a full disk, is cut off by the next run. Values
are stored without pickle and restored bit for bit (:mod:`~marlbc_mj.studies.codec`). A job's large files are in a temporary
folder until it ends; then one rename gives the folder the job's key as its name. Only the study's process writes packs. It holds
the lock of the folder, so a second run is refused.

**The folder.** ``OUT/.jobs`` holds all this while a run is unfinished (:mod:`~marlbc_mj.studies.store`). The report is written
from all results into another folder, which replaces OUT in one rename; only then is the run finished and ``.jobs`` removed. With
``--overwrite``, the previous contents of OUT stay until then. So the same command either resumes the run or is refused because
OUT is finished.

**Engines** move work and store nothing: processes on this machine, Ray tasks, SLURM arrays (:mod:`~marlbc_mj.studies.engines`).
They yield results in any order as jobs end; the report has them in the order of the jobs. An engine retries a job when its worker
dies. A job that raises an error ends the study, after the jobs that run beside it have been stored.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Generic, NamedTuple

from marlbc_mj.studies.addresses import Addresses, code_version
from marlbc_mj.studies.engines import Task, Work, make_engine
from marlbc_mj.studies.engines.base import EngineCallbacks, StopRequest
from marlbc_mj.studies.protocol import JobT, Report, ResultT, Stopped, Study
from marlbc_mj.studies.store import RunStore, open_store
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import JOBS_FOLDER, staged_folder
from marlbc_mj.util.progress import Progress, note, silent


class Conclusion(NamedTuple, Generic[ResultT]):
    """Results and report of a finished study."""

    results: list[ResultT]
    """One per job, in the order of the jobs."""
    report: Report


class EngineSettings(NamedTuple):
    """The engine and the number of workers; no result depends on them."""

    workers: int = 1
    """Processes on this machine, CPUs of a Ray instance started for this study, or tasks of a SLURM array."""
    engine: str = "local"
    """A key of ENGINES."""


def run_study(
    study: Study[JobT, ResultT],
    out: Path | None,
    *,
    overwrite: bool = False,
    workers: int = 1,
    engine: str = "local",
    progress: Progress = silent,
    ended: Callable[[JobT, ResultT], None] | None = None,
) -> Conclusion[ResultT]:
    """Run all jobs that are not done, and write the report into ``out``, whole or not at all.

    Finished jobs are kept in ``out`` whatever interrupts the run, and the same call resumes from there.

    Args:
        study: the study to run.
        out: folder of the report; None: nothing is written.
        overwrite: whether ``out`` may hold a finished report, which is replaced at the end, or results that cannot be used here.
        workers: processes on this machine, CPUs of a Ray instance started for this study, or tasks of a SLURM array.
        engine: where jobs run, a key of ENGINES.
        progress: called with the progress of jobs, if the engine passes it on, and with the number of jobs done.
        ended: called with each job and its result as soon as it ends, and with those that were already done.

    Raises:
        ConfigurationError: an invalid setting, ``out`` cannot be written or is in use, a user's file that jobs use was edited
            meanwhile, or the engine cannot be used.
        SimulationError: a job raised it, or a worker died too often.
    """
    if out is None:
        results = run_jobs(study, workers=workers, engine=engine, progress=progress, ended=ended)
        return Conclusion(results, study.report(results, None, progress))
    jobs = study.jobs()
    addresses = Addresses(study)
    keys = [addresses.key(job) for job in jobs]
    with open_store(out, overwrite=overwrite) as store:
        _begin(store, study, keys, out, overwrite)
        try:
            results = _Run(study, jobs, keys, store, ended, addresses.check_unchanged).results(
                EngineSettings(workers, engine), EngineCallbacks(progress)
            )
            store.close()
            with staged_folder(out, overwrite=overwrite) as folder:
                store.place_files(dict.fromkeys(keys), folder)
                report = study.report(results, folder, progress)
        except BaseException as error:
            if store.kept:
                done = sum(key in store.kept for key in keys)
                error.add_note(
                    f"{done} of {len(keys)} jobs are done and kept in {out / JOBS_FOLDER}; repeat the command to resume"
                )
            raise
    return Conclusion(results, report)


def run_jobs(
    study: Study[JobT, ResultT],
    *,
    workers: int = 1,
    engine: str = "local",
    progress: Progress = silent,
    ended: Callable[[JobT, ResultT], None] | None = None,
    stop: StopRequest | None = None,
) -> list[ResultT]:
    """Run all jobs and return their results, in the order of the jobs; nothing is stored.

    Args:
        study: the study to run.
        workers: see :func:`run_study`.
        engine: see :func:`run_study`.
        progress: see :func:`run_study`.
        ended: see :func:`run_study`.
        stop: stop request for jobs that save their state, checked between jobs and by the jobs; None: Ctrl-C interrupts at once.

    Raises:
        ConfigurationError: fewer than one worker, or raised by a job.
        SimulationError: raised by a job, or a worker died too often.
        Stopped: ``stop`` was set; the state of jobs that had started is saved.
    """
    jobs = study.jobs()
    results = _Run(study, jobs, [""] * len(jobs), None, ended).results(
        EngineSettings(workers, engine), EngineCallbacks(progress, stop)
    )
    if stop is not None and stop.signal:
        raise Stopped(stop.signal)
    return results


def counting(jobs: Sequence[JobT], stage: Callable[[JobT], str], progress: Progress) -> Callable[[JobT, object], None]:
    """A callback for ``ended`` that reports after every job how many jobs of its ``stage`` are done, and their total."""
    total, done = Counter(map(stage, jobs)), Counter[str]()

    def tell(job: JobT, _: object) -> None:
        name = stage(job)
        done[name] += 1
        progress(name, done[name], total[name])

    return tell


class _Run(NamedTuple):
    """The jobs of one study, their keys, and the store for results."""

    study: Study[Any, Any]
    jobs: Sequence[Any]
    keys: Sequence[str]
    store: RunStore | None
    ended: Callable[[Any, Any], None] | None
    check: Callable[[], None] = lambda: None  # raises if results may no longer belong to the keys

    def results(self, means: EngineSettings, ears: EngineCallbacks) -> list[Any]:
        """Results in the order of the jobs; fewer if the study was stopped."""
        engine = make_engine(means.engine, means.workers)
        found = {place: self.store.result(key) for place, key in self._found()} if self.store is not None else {}
        for place, result in found.items():
            self._tell(place, result)
        equal = _same_keys(self.keys)
        tasks = [Task(place, self.keys[place], self.jobs[place]) for place in equal if place not in found]
        count = _Count(len(self.jobs), len(found), ears.progress if self.store is not None and len(self.jobs) > 1 else silent)
        ears.retried = count.retried
        work = Work(self.study) if self.store is None else Work(self.study, self.store.files, self.store.engine)
        with closing(engine.map(work, tasks, ears)) as finished:
            for place, result in finished:
                if self.store is not None:
                    self.check()
                    self.store.keep(self.keys[place], result)
                for each in equal[place]:
                    found[each] = result
                    self._tell(each, result)
                    count.ended()
        return [found[place] for place in sorted(found)]

    def _found(self) -> list[tuple[int, str]]:
        """Indices and keys of the jobs that are already done."""
        assert self.store is not None
        return [(place, key) for place, key in enumerate(self.keys) if key in self.store.kept]

    def _tell(self, place: int, result: Any) -> None:
        if self.ended is not None:
            self.ended(self.jobs[place], result)


def _same_keys(keys: Sequence[str]) -> dict[int, list[int]]:
    """Indices of the jobs with the same result, by the index of the first of them; without keys, every job by itself."""
    first: dict[str, int] = {}
    found: dict[int, list[int]] = {}
    for place, key in enumerate(keys):
        found.setdefault(first.setdefault(key, place) if key else place, []).append(place)
    return found


class _Count:
    """Reports how many jobs are done, and how often a worker died."""

    def __init__(self, total: int, done: int, progress: Progress) -> None:
        self.total, self.done, self.again, self.progress = total, done, 0, progress
        progress("jobs", done, total)

    def ended(self) -> None:
        """One more job is done."""
        self.done += 1
        self.progress("jobs", self.done, self.total)

    def retried(self, reason: str) -> None:
        """Report that a worker died and that its work is repeated."""
        self.again += 1
        note(f"{reason}; repeating this work (repetition {self.again})")


def _begin(store: RunStore, study: Study[Any, Any], keys: Sequence[str], out: Path, overwrite: bool) -> None:
    """Report which results of an unfinished run are reused, drop all if none can be, and describe this run in the store.

    Raises:
        ConfigurationError: none of the results can be used here, and they must not be removed without ``overwrite``.
    """
    before = store.about()
    wanted = set(keys)
    used = len(wanted & store.kept.keys())
    others = len(store.kept) - used
    if others:
        changed = before.get("code") != code_version()
        why = f"other code ({before.get('code')})" if changed else "another configuration"
        unused = f"{others} results of {why}"
        if not used and not overwrite:
            raise ConfigurationError(
                f"{out} holds an unfinished run with {unused}, none of which can be used here; choose another or add --overwrite"
            )
        note(f"{unused} in {out / JOBS_FOLDER} cannot be used here")
    if not used:
        store.drop()
    else:
        note(f"resuming the unfinished run in {out}: {used} of {len(wanted)} jobs are done")
    store.begin({"study": type(study).__name__, "code": code_version(), "jobs": len(keys)})
