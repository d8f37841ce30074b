"""The one runner of all studies: job by job in this process, or in worker processes of this machine.

Another engine is one more generator like :func:`_alone` and :func:`_pooled`: it yields the place of a job with its result, as
they end.
"""

import os
import signal
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol

from marlbc_mj.studies.protocol import JobT, Report, ResultT, Stopped, Study, Watch
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import staged_folder
from marlbc_mj.util.progress import Progress, silent

POLL = 0.2  # between two looks at the workers [s]


class Conclusion(NamedTuple, Generic[ResultT]):
    """What is left of a study that ran to its end."""

    results: list[ResultT]
    """One per job, in the order of the jobs."""
    report: Report


class StopRequest(Protocol):
    """Whether somebody asked the study to stop: the number of the signal, or 0."""

    signal: int


def run_study(
    study: Study[JobT, ResultT],
    out: Path | None,
    *,
    overwrite: bool = False,
    workers: int = 1,
    progress: Progress = silent,
    ended: Callable[[JobT, ResultT], None] | None = None,
) -> Conclusion[ResultT]:
    """Run all jobs and write the report into ``out``, which appears whole or not at all; None: nothing is written.

    Args: those of :func:`run_jobs`.

    Raises:
        ConfigurationError: a setting, or ``out`` cannot be written; nothing is left then.
        SimulationError: of a job, or a worker process died.
    """
    with nullcontext() if out is None else staged_folder(out, overwrite=overwrite) as folder:
        results = run_jobs(study, folder=folder, workers=workers, progress=progress, ended=ended)
        report = study.report(results, folder, progress)
    return Conclusion(results, report)


def run_jobs(
    study: Study[JobT, ResultT],
    *,
    folder: Path | None = None,
    workers: int = 1,
    progress: Progress = silent,
    ended: Callable[[JobT, ResultT], None] | None = None,
    stop: StopRequest | None = None,
) -> list[ResultT]:
    """Results of all jobs, in the order of the jobs.

    Args:
        study: whose jobs are run.
        folder: where the jobs put large files.
        workers: processes that share the jobs; with one, all run in this process.
        progress: called with what a job tells, whichever process it runs in.
        ended: called with a job and its result as soon as it ends.
        stop: for jobs that save themselves: asked between them and, where a job asks, within; None: Ctrl-C interrupts at once.

    Raises:
        ConfigurationError: fewer than one worker, or of a job.
        SimulationError: of a job, or a worker process died.
        Stopped: ``stop`` was set; what had begun is saved.
    """
    if workers < 1:
        raise ConfigurationError(f"workers must be at least 1, got {workers}")
    jobs = study.jobs()
    engine = _alone if workers == 1 else partial(_pooled, workers=workers)
    results: dict[int, ResultT] = {}
    try:
        with closing(engine(study, jobs, folder, progress, stop)) as finished:
            for place, result in finished:
                results[place] = result
                if ended is not None:
                    ended(jobs[place], result)
    except BrokenProcessPool as error:
        if stop is None or not stop.signal:
            again = "; the same command goes on" if stop is not None else ""
            raise SimulationError(f"a worker process died (out of memory?){again}") from error
    if stop is not None and stop.signal:
        raise Stopped(stop.signal)
    return [results[place] for place in sorted(results)]


def counting(jobs: Sequence[JobT], stage: Callable[[JobT], str], progress: Progress) -> Callable[[JobT, object], None]:
    """For ``ended``: tells after every job how many of the same ``stage`` are done, and how many there are."""
    total, done = Counter(map(stage, jobs)), Counter[str]()

    def tell(job: JobT, _: object) -> None:
        name = stage(job)
        done[name] += 1
        progress(name, done[name], total[name])

    return tell


def _alone(
    study: Study[JobT, ResultT], jobs: Sequence[JobT], folder: Path | None, progress: Progress, stop: StopRequest | None
) -> Generator[tuple[int, ResultT]]:
    """Every job in turn. One that is stopped yields nothing; those behind it are asked as well, since some may be done."""
    watch = Watch(progress, lambda: stop is not None and bool(stop.signal), folder)
    for place, job in enumerate(jobs):
        try:
            yield place, study.run(job, watch)
        except Stopped as stopped:
            if stop is None:
                raise
            stop.signal = stop.signal or stopped.signal


def _pooled(
    study: Study[JobT, ResultT],
    jobs: Sequence[JobT],
    folder: Path | None,
    progress: Progress,
    stop: StopRequest | None,
    *,
    workers: int,
) -> Generator[tuple[int, ResultT]]:
    """Jobs in worker processes. After an error those that run are asked to save themselves, and awaited."""
    context = get_context("spawn")
    stopping, told = context.Event(), context.SimpleQueue()
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _begin_worker, (told, stopping, folder, stop is not None)) as pool:
        with _ctrl_c_later():
            places = {pool.submit(_work, study, job): place for place, job in enumerate(jobs)}
        waiting = set(places)
        try:
            while waiting:
                done, waiting = wait(waiting, POLL, FIRST_COMPLETED)
                _pass_on(told, progress)
                if stop is not None and stop.signal:
                    stopping.set()
                yield from ((places[future], future.result()) for future in done if not _was_stopped(future))
        finally:
            stopping.set()
            _drain(waiting, told, progress)


@contextmanager
def _ctrl_c_later() -> Iterator[None]:
    """Hold Ctrl-C back while workers are started, which inherit that: during their imports it would be a traceback each."""
    _mask("SIG_BLOCK")
    try:
        yield
    finally:
        _mask("SIG_UNBLOCK")


@contextmanager
def _ctrl_c_now() -> Iterator[None]:
    """Let Ctrl-C through, also one that came before; in a worker it is held back outside, where jobs are unpacked."""
    _mask("SIG_UNBLOCK")
    try:
        yield
    finally:
        _mask("SIG_BLOCK")


def _mask(how: str) -> None:
    """Change what this thread, and what it starts, takes of Ctrl-C, where there are masks."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(getattr(signal, how), {signal.SIGINT})


def _was_stopped(future: Future[Any]) -> bool:
    return isinstance(future.exception(), Stopped)


def _drain(waiting: set[Future[Any]], told: "SimpleQueue[Any]", progress: Progress) -> None:
    """Wait for jobs that have begun, and listen to them meanwhile: a worker whose pipe is full would never end."""
    waiting = {future for future in waiting if not future.cancel()}
    while waiting:
        _, waiting = wait(waiting, POLL)
        _pass_on(told, progress)


def _pass_on(told: "SimpleQueue[Any]", progress: Progress) -> None:
    """Tell here what the workers have told since."""
    while not told.empty():
        progress(*told.get())


class _Worker(NamedTuple):
    """What a worker process knows besides its jobs."""

    watch: Watch
    stopping: Event  # shared by the study's process and all workers
    saving: bool  # whether jobs save themselves


_worker: _Worker | None = None


def _begin_worker(told: "SimpleQueue[Any]", stopping: Event, folder: Path | None, saving: bool) -> None:
    """What a worker's jobs tell goes to the study's process.

    Ctrl-C reaches the whole group of processes: where jobs save themselves, a worker leaves it to the study, which asks it to
    stop.
    """
    global _worker
    watch = Watch(lambda *step: told.put(step), lambda: stopping.is_set() or _orphaned(), folder)
    _worker = _Worker(watch, stopping, saving)
    if saving:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(study: Study[JobT, ResultT], job: JobT) -> ResultT:
    """A job in a worker. Jobs that do not save themselves do not begin once the study ends, also those that are queued here.

    Without its study, which was killed perhaps, the worker ends.
    """
    assert _worker is not None
    try:
        with _ctrl_c_now():
            if not _worker.saving and _worker.watch.stopping():
                raise Stopped
            return study.run(job, _worker.watch)
    except KeyboardInterrupt:
        _worker.stopping.set()
        raise
    finally:
        if _orphaned():
            os._exit(1)


def _orphaned() -> bool:
    parent = parent_process()
    return parent is not None and not parent.is_alive()
