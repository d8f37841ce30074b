"""Studies: independent jobs, each a pure function of its configuration, and a report made from their results.

A job is data: everything that its result depends on, so that it can run in this process, in another one or on another machine, in
any order, and so that a result that is there already is found again. A result is data too. Data are None, numbers, texts, paths,
arrays, and lists, tuples, dicts, dataclasses and named tuples of data, see :mod:`marlbc_mj.studies.codec`. Only large files, logs
and checkpoints, go into a folder beside it. :mod:`marlbc_mj.studies.runner` runs the jobs of any study.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from marlbc_mj.util.progress import Progress, silent

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")


class Stopped(Exception):
    """A job or a study that was asked to stop, and whose state is saved."""

    def __init__(self, signal: int = 0) -> None:
        super().__init__(signal)
        self.signal = signal


def never() -> bool:
    """The stop request of a job that nobody will stop."""
    return False


class Watch(NamedTuple):
    """Services for a job besides its configuration; its result does not depend on them."""

    progress: Progress = silent
    stopping: Callable[[], bool] = never
    """Whether the job should save itself and raise :class:`Stopped`; one that cannot need not ask."""
    folder: Path | None = None
    """Where the job's large files go, under names that no other job of the study uses; empty at first. None: nowhere."""


class Report(NamedTuple):
    """The text and data that a study reports."""

    text: str = ""
    """For the terminal."""
    document: Any = None
    """The same as data, of the kinds that results are made of."""
    problems: tuple[str, ...] = ()
    """Outputs that could not be written, a video without GL for example; one line each."""


class Study(Protocol[JobT, ResultT]):
    """Independent jobs and the report made from their results. Implementations are frozen, picklable dataclasses."""

    def jobs(self) -> Sequence[JobT]:
        """All jobs, in the order of the report.

        Raises:
            ConfigurationError: a setting that cannot be run; nothing has been run or written then.
        """
        ...

    def run(self, job: JobT, watch: Watch) -> ResultT:
        """The job's result. A failure that belongs in the report is a result; any other is raised and ends the study."""
        ...

    # A study whose results or files depend on more than the job, a setting of its own for example, has a further method
    # ``describe(job)``, which returns all of it as data, the job among it; a result is found again only by the same.

    def report(self, results: Sequence[ResultT], out: Path | None, progress: Progress = silent) -> Report:
        """Write what the study leaves into ``out``, where that is given, and say what came out."""
        ...
