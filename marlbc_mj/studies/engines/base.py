"""Engines and their tasks.

An engine only moves work: :meth:`Work.do` is the same call in every process and on every machine, so results are the same bits
whatever the engine. It owns no state that outlives it: the runner stores every result.
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
"""Tries of a job whose worker dies."""


class StopRequest(Protocol):
    """Whether somebody asked the study to stop: the number of the signal, or 0."""

    signal: int


class JobError(SimulationError):
    """A job raised something that is no error of this package's; the message says what and where."""


class Task(NamedTuple):
    """A job on its way."""

    place: int  # among the jobs of the study
    key: str  # content address; empty where nothing is stored
    job: Any


@dataclass(frozen=True)
class Work(Generic[JobT, ResultT]):
    """The data that workers need besides their tasks; picklable."""

    study: Study[JobT, ResultT]
    files: Path | None = None
    """Folder for the large files of all jobs; None: there are none."""
    scratch: Path | None = None
    """Folder for what an engine shares with its workers; None: nothing is stored."""

    def visible(self) -> "Work[JobT, ResultT]":
        """The same on a machine that may not see the study's folder: jobs leave large files where they are seen, or nowhere."""
        if self.files is None or self.files.is_dir():
            return self
        return replace(self, files=None)

    def do(self, task: Task, progress: Progress = silent, stopping: Callable[[], bool] = never) -> ResultT:
        """Run one job."""
        with job_folder(self.files, task.key) as folder:
            return self.study.run(task.job, Watch(progress, stopping, folder))


class Outcome(NamedTuple):
    """How one job ended, as data that an engine can move."""

    result: Any
    error: str = ""
    """Name of the error of this package that it raised; empty where it did not."""
    message: str = ""

    def unpack(self) -> Any:
        """The result.

        Raises:
            ConfigurationError, SimulationError: what the job raised.
        """
        if self.error:
            raise getattr(errors, self.error, JobError)(self.message)
        return self.result


def attempt(work: Work[Any, Any], task: Task) -> Outcome:
    """Run one job where its errors cannot be raised through."""
    try:
        return Outcome(work.do(task))
    except errors.MarlbcError as error:
        return Outcome(None, type(error).__name__, str(error))
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        said = f"{type(error).__name__}: {one_line(str(error))} ({Path(place.filename).name}, line {place.lineno})"
        return Outcome(None, JobError.__name__, f"a job failed: {said}; --engine local shows more")


@dataclass
class Ears:
    """Callbacks of the study's process for an engine, besides results."""

    progress: Progress = silent
    stop: StopRequest | None = None
    """For jobs that save themselves; None: whatever stops the study interrupts them."""
    retried: Callable[[str], None] = lambda reason: None
    """Called with the reason why a job, or several, are tried again."""

    def stopping(self) -> bool:
        """Whether somebody asked the study to stop."""
        return self.stop is not None and bool(self.stop.signal)


class Engine(Protocol):
    """A place where jobs run."""

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: Ears) -> Generator[tuple[int, ResultT]]:
        """Places of jobs with their results, as they end; closing the generator ends everything that it started.

        A job whose worker dies is tried again, :data:`MOST_TRIES` times at most.

        Raises:
            ConfigurationError: of a job, or the engine cannot be used here.
            SimulationError: of a job, or a worker died once too often.
        """
        ...
