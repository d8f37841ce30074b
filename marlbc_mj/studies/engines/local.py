"""Jobs in this process, one after the other, or in worker processes of this machine."""

import os
import signal
import threading
import time
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, InvalidStateError, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from typing import Any, NamedTuple

from marlbc_mj.studies.engines.base import MOST_TRIES, EngineCallbacks, Task, Work
from marlbc_mj.studies.protocol import JobT, ResultT, Stopped
from marlbc_mj.util.errors import SimulationError
from marlbc_mj.util.progress import Progress

POLL = 0.2  # time between two checks of the workers [s]
GRACE = 5.0  # time for a worker to end by itself after its study was killed [s]
DIED = "a worker process died (out of memory?)"


class ThisProcess:
    """Engine that runs one job after another. A stopped job yields no result; later ones are still tried, as some may be done."""

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: EngineCallbacks) -> Generator[tuple[int, ResultT]]:
        for task in tasks:
            try:
                yield task.place, work.do(task, ears.progress, ears.stopping)
            except Stopped as stopped:
                if ears.stop is None:
                    raise
                ears.stop.signal = ears.stop.signal or stopped.signal


class Processes:
    """Engine that runs jobs in worker processes. After an error it asks running jobs to save their state and waits for them."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: EngineCallbacks) -> Generator[tuple[int, ResultT]]:
        left = {task.place: task for task in tasks}
        tries = 1
        while left:
            try:
                for place, result in _pooled(work, list(left.values()), ears, self.workers):
                    del left[place]
                    tries = 1
                    yield place, result
                return
            except BrokenProcessPool as error:
                if ears.stop is not None:
                    if not ears.stopping():
                        raise SimulationError(f"{DIED}; repeat the command to resume") from error
                    return
                if tries == MOST_TRIES:
                    raise SimulationError(DIED) from error
                tries += 1
                ears.retried(DIED)


def _pooled(
    work: Work[JobT, ResultT], tasks: Sequence[Task], ears: EngineCallbacks, workers: int
) -> Generator[tuple[int, ResultT]]:
    context = get_context("spawn")
    stopping, told = context.Event(), context.SimpleQueue()
    with (
        _quiet_when_broken(),
        ProcessPoolExecutor(min(workers, len(tasks)), context, _begin_worker, (told, stopping, ears.stop is not None)) as pool,
    ):
        with _ctrl_c_later():
            places = {pool.submit(_work, work, task): task.place for task in tasks}
        waiting, failure = set(places), None
        try:
            while waiting:
                done, waiting = wait(waiting, POLL, FIRST_COMPLETED)
                _pass_on(told, ears.progress)
                for future in done:
                    error = future.exception()
                    if error is None:
                        yield places[future], future.result()
                    elif not isinstance(error, Stopped):
                        failure = failure or error
                if failure is not None or ears.stopping():
                    stopping.set()
                if failure is not None:
                    waiting = {future for future in waiting if not future.cancel()}
        finally:
            stopping.set()
            _drain(waiting, told, ears.progress)
    if failure is not None:
        raise failure


@contextmanager
def _quiet_when_broken() -> Iterator[None]:
    """Hide the traceback that a thread of Python's executor prints for a job that is cancelled while its pool breaks."""
    say = threading.excepthook
    threading.excepthook = lambda event: None if event.exc_type is InvalidStateError else say(event)
    try:
        yield
    finally:
        threading.excepthook = say


@contextmanager
def _ctrl_c_later() -> Iterator[None]:
    """Block Ctrl-C while workers start. They inherit the block, so that Ctrl-C during their imports prints no tracebacks."""
    _mask("SIG_BLOCK")
    try:
        yield
    finally:
        _mask("SIG_UNBLOCK")


@contextmanager
def _ctrl_c_now() -> Iterator[None]:
    """Unblock Ctrl-C, including a pending one. Outside this block it stays blocked in a worker, while jobs are unpickled."""
    _mask("SIG_UNBLOCK")
    try:
        yield
    finally:
        _mask("SIG_BLOCK")


def _mask(how: str) -> None:
    """Block or unblock Ctrl-C for this thread and for processes that it starts, on systems with signal masks."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(getattr(signal, how), {signal.SIGINT})


def _drain(waiting: set[Future[Any]], told: "SimpleQueue[Any]", progress: Progress) -> None:
    """Wait for running jobs and keep reading their messages: a worker blocked by a full pipe would never end."""
    waiting = {future for future in waiting if not future.cancel()}
    while waiting:
        _, waiting = wait(waiting, POLL)
        _pass_on(told, progress)


def _pass_on(told: "SimpleQueue[Any]", progress: Progress) -> None:
    """Pass the new progress messages of the workers to ``progress``."""
    while not told.empty():
        progress(*told.get())


class _Worker(NamedTuple):
    """State of a worker process besides its jobs."""

    told: "SimpleQueue[Any]"
    stopping: Event  # shared by the study's process and all workers
    saving: bool  # whether jobs save their own state


_worker: _Worker | None = None


def _begin_worker(told: "SimpleQueue[Any]", stopping: Event, saving: bool) -> None:
    """Set up a worker process, whose jobs report their progress to the study's process.

    Ctrl-C reaches the whole process group. If jobs save their own state, a worker ignores it, and the study asks the worker to
    stop. Otherwise a worker ends soon after its study was killed, whatever its job is doing.
    """
    global _worker
    _worker = _Worker(told, stopping, saving)
    if saving:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    else:
        threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        time.sleep(GRACE)
        os._exit(1)


def _work(work: Work[JobT, ResultT], task: Task) -> ResultT:
    """Run a job in a worker. Jobs that do not save their own state, also queued ones, do not begin once the study is ending.

    The worker exits if the study's process no longer exists, for example because it was killed.
    """
    assert _worker is not None
    told, stopping, saving = _worker
    try:
        with _ctrl_c_now():
            if not saving and stopping.is_set():
                raise Stopped
            return work.do(task, lambda *step: told.put(step), lambda: stopping.is_set() or _orphaned())
    except KeyboardInterrupt:
        stopping.set()
        raise
    finally:
        if _orphaned():
            os._exit(1)


def _orphaned() -> bool:
    parent = parent_process()
    return parent is not None and not parent.is_alive()
