"""The one runner of all studies: it finds what is done already, has an engine run the rest, and makes the report.

A study is a list of jobs, each a pure function of its configuration (:mod:`~marlbc_mj.studies.protocol`).

**Addresses.** A job's key is a hash of its configuration and of the code that runs it (:mod:`~marlbc_mj.studies.addresses`).
Under one key there is one result, whoever computes it, where and when. So whether a job is done is one look-up, a longer study
takes over the results of a shorter one, and a changed setting or source finds nothing instead of something wrong.

**Storage.** Each result is appended to a pack under its key (:mod:`~marlbc_mj.studies.packs`), a file for as many results as
256 MiB hold. A record that is whole is the mark that its job is done. A torn one, of a process that was killed or a disk that was
full, is cut off by the next run. Values are stored without pickle and come back bit for bit (:mod:`~marlbc_mj.studies.codec`).
Large files of a job lie in a folder of its own until it ends, then get its key as their name in one rename. Only the process of
the study writes packs, and it holds the lock of the folder: a second run is refused.

**The folder.** ``OUT/.jobs`` holds all this while a run has not ended (:mod:`~marlbc_mj.studies.store`). The report is made from
all results in another folder, which replaces OUT in one rename; only then is the run finished and ``.jobs`` gone. What OUT held
before, with ``--overwrite``, stays until then. So the same command, at any time, either goes on, or is told that OUT is finished.

**Engines** move work and keep nothing: processes of this machine, Ray's tasks, SLURM's arrays
(:mod:`~marlbc_mj.studies.engines`). They yield results as they come, in any order; the report has them in the order of the jobs.
An engine tries a job again whose worker died. A job that raises ends the study, after what runs beside it has been stored.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Generic, NamedTuple

from marlbc_mj.studies.addresses import Addresses, code_version
from marlbc_mj.studies.engines import Task, Work, make_engine
from marlbc_mj.studies.engines.base import Ears, StopRequest
from marlbc_mj.studies.protocol import JobT, Report, ResultT, Stopped, Study
from marlbc_mj.studies.store import RunStore, open_store
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import JOBS_FOLDER, staged_folder
from marlbc_mj.util.progress import Progress, note, silent


class Conclusion(NamedTuple, Generic[ResultT]):
    """Results and report of a study that ran to its end."""

    results: list[ResultT]
    """One per job, in the order of the jobs."""
    report: Report


class Means(NamedTuple):
    """Engine and workers; no result depends on them."""

    workers: int = 1
    """Processes on this machine, CPUs of a Ray that is started for this study, or tasks of a SLURM array."""
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
    """Run all jobs that are not done, and write the report into ``out``, whole or not at all; None: nothing is written.

    What is done is kept in ``out``, whatever stops this, and the same call goes on from there.

    Args:
        study: whose jobs are run.
        out: folder of the report.
        overwrite: whether ``out`` may hold a finished report, which is replaced at the end, or results that are of no use here.
        workers: processes on this machine, CPUs of a Ray that is started for this study, or tasks of a SLURM array.
        engine: where jobs run, a key of ENGINES.
        progress: called with what a job tells, where the engine passes that on, and with how many jobs are done.
        ended: called with a job and its result as soon as it ends, also of those that were done.

    Raises:
        ConfigurationError: a setting, ``out`` cannot be written or is in use, or the engine cannot be used.
        SimulationError: of a job, or a worker died again and again.
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
            results = _Run(study, jobs, keys, store, ended).results(Means(workers, engine), Ears(progress))
            store.close()
            with staged_folder(out, overwrite=overwrite) as folder:
                store.place_files(dict.fromkeys(keys), folder)
                report = study.report(results, folder, progress)
        except BaseException as error:
            if store.kept:
                done = sum(key in store.kept for key in keys)
                error.add_note(f"{done} of {len(keys)} jobs are done and kept in {out / JOBS_FOLDER}; the same command goes on")
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
    """Results of all jobs, in the order of the jobs; nothing is stored.

    Args:
        study: whose jobs are run.
        workers: see :func:`run_study`.
        engine: see :func:`run_study`.
        progress: see :func:`run_study`.
        ended: see :func:`run_study`.
        stop: for jobs that save themselves: asked between them and, where a job asks, within; None: Ctrl-C interrupts at once.

    Raises:
        ConfigurationError: fewer than one worker, or of a job.
        SimulationError: of a job, or a worker died again and again.
        Stopped: ``stop`` was set; what had begun is saved.
    """
    jobs = study.jobs()
    results = _Run(study, jobs, [""] * len(jobs), None, ended).results(Means(workers, engine), Ears(progress, stop))
    if stop is not None and stop.signal:
        raise Stopped(stop.signal)
    return results


def counting(jobs: Sequence[JobT], stage: Callable[[JobT], str], progress: Progress) -> Callable[[JobT, object], None]:
    """For ``ended``: tells after every job how many of the same ``stage`` are done, and how many there are."""
    total, done = Counter(map(stage, jobs)), Counter[str]()

    def tell(job: JobT, _: object) -> None:
        name = stage(job)
        done[name] += 1
        progress(name, done[name], total[name])

    return tell


class _Run(NamedTuple):
    """The jobs of one study, their keys, and where results are kept."""

    study: Study[Any, Any]
    jobs: Sequence[Any]
    keys: Sequence[str]
    store: RunStore | None
    ended: Callable[[Any, Any], None] | None

    def results(self, means: Means, ears: Ears) -> list[Any]:
        """Results in the order of the jobs; fewer where the study was stopped."""
        engine = make_engine(means.engine, means.workers)
        found = {place: self.store.result(key) for place, key in self._found()} if self.store is not None else {}
        for place, result in found.items():
            self._tell(place, result)
        tasks = [Task(place, self.keys[place], job) for place, job in enumerate(self.jobs) if place not in found]
        count = _Count(len(self.jobs), len(found), ears.progress if self.store is not None and means != Means() else silent)
        ears.retried = count.retried
        work = Work(self.study) if self.store is None else Work(self.study, self.store.files, self.store.engine)
        with closing(engine.map(work, tasks, ears)) as finished:
            for place, result in finished:
                if self.store is not None:
                    self.store.keep(self.keys[place], result)
                found[place] = result
                self._tell(place, result)
                count.ended()
        return [found[place] for place in sorted(found)]

    def _found(self) -> list[tuple[int, str]]:
        """Places and keys of the jobs that are done."""
        assert self.store is not None
        return [(place, key) for place, key in enumerate(self.keys) if key in self.store.kept]

    def _tell(self, place: int, result: Any) -> None:
        if self.ended is not None:
            self.ended(self.jobs[place], result)


class _Count:
    """Tells how many jobs are done, and how often a worker died."""

    def __init__(self, total: int, done: int, progress: Progress) -> None:
        self.total, self.done, self.again, self.progress = total, done, 0, progress
        progress("jobs", done, total)

    def ended(self) -> None:
        """One more job is done."""
        self.done += 1
        self.progress("jobs", self.done, self.total)

    def retried(self, reason: str) -> None:
        """A worker died, and what it did is done again."""
        self.again += 1
        note(f"{reason}; what it did is done again ({self.again} so far)")


def _begin(store: RunStore, study: Study[Any, Any], keys: Sequence[str], out: Path, overwrite: bool) -> None:
    """Report which results of an unfinished run are used and which are not.

    Raises:
        ConfigurationError: nothing of it is of use here, and it may not be removed.
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
                f"{out} holds an unfinished run, {unused}, of which nothing can be used here; choose another or add --overwrite"
            )
        note(f"{unused} in {out / JOBS_FOLDER} cannot be used here")
    if not used:
        store.drop()
    else:
        note(f"going on with the unfinished run in {out}: {used} of {len(wanted)} jobs are done")
    store.begin({"study": type(study).__name__, "code": code_version(), "jobs": len(keys)})
