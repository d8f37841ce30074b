"""Engines and their tasks.

An engine only decides where jobs run. Every process on every machine makes the same call, :meth:`Work.do`, so all engines give
results that are identical to the last bit. Engines do not keep results: the runner stores them.
"""

import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol

from marlbc_mj.studies.protocol import JobT, ResultT, Study, Watch, never
from marlbc_mj.studies.store import job_folder
from marlbc_mj.util import errors
from marlbc_mj.util.errors import SimulationError
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.text import one_line

MOST_TRIES = 4
"""Most tries of a job whose worker dies."""


class StopRequest(Protocol):
    """A request to stop the study: the number of the signal that was received, or 0."""

    signal: int


class JobError(SimulationError):
    """A job raised an exception that is not one of this package's errors; the message says which one and where."""


class Task(NamedTuple):
    """A job that is passed to an engine."""

    place: int  # index among the jobs of the study
    key: str  # content address; empty if nothing is stored
    job: Any


@dataclass(frozen=True)
class Work(Generic[JobT, ResultT]):
    """Data that all workers need besides their tasks; picklable."""

    study: Study[JobT, ResultT]
    files: Path | None = None
    """Folder for the large files of all jobs; None: jobs write no large files."""
    scratch: Path | None = None
    """Folder that an engine shares with its workers; None: the study stores nothing."""

    def visible(self) -> "Work[JobT, ResultT]":
        """A copy for this machine, without the folder for large files if the machine cannot see it."""
        if self.files is None or self.files.is_dir():
            return self
        return replace(self, files=None)

    def do(self, task: Task, progress: Progress = silent, stopping: Callable[[], bool] = never) -> ResultT:
        """Run one job."""
        with job_folder(self.files, task.key) as folder:
            return self.study.run(task.job, Watch(progress, stopping, folder))


class Outcome(NamedTuple):
    """The result or the error of one job, as data that can be sent between processes."""

    result: Any
    error: str = ""
    """Name of the error class of this package that the job raised; empty if it raised none."""
    message: str = ""

    def unpack(self) -> Any:
        """Return the result, or raise the error of the job.

        Raises:
            ConfigurationError, SimulationError: the error that the job raised.
        """
        if self.error:
            raise getattr(errors, self.error, JobError)(self.message)
        return self.result


def attempt(work: Work[Any, Any], task: Task) -> Outcome:
    """Run one job and return its error as data, for workers whose exceptions do not reach the study's process."""
    try:
        return Outcome(work.do(task))
    except errors.MarlbcError as error:
        return Outcome(None, type(error).__name__, str(error))
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        said = f"{type(error).__name__}: {one_line(str(error))} ({Path(place.filename).name}, line {place.lineno})"
        return Outcome(None, JobError.__name__, f"a job failed: {said}; --engine local shows more")


@dataclass
class EngineCallbacks:
    """Callbacks by which an engine informs the study's process, besides the results that it yields."""

    progress: Progress = silent
    stop: StopRequest | None = None
    """Stop request for jobs that save their own state; None: stopping the study interrupts its jobs."""
    retried: Callable[[str], None] = lambda reason: None
    """Called with the reason when one or more jobs are tried again."""

    def stopping(self) -> bool:
        """Whether the study was asked to stop."""
        return self.stop is not None and bool(self.stop.signal)


class Engine(Protocol):
    """Interface of engines, which run the jobs of a study."""

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: EngineCallbacks) -> Generator[tuple[int, ResultT]]:
        """Yield the index and the result of each job as it ends; closing the generator ends everything that it started.

        A job whose worker dies is tried again, up to :data:`MOST_TRIES` tries in total.

        Raises:
            ConfigurationError: a job raised it, or the engine cannot be used here.
            SimulationError: a job raised it, or a worker died too often.
        """
        ...
