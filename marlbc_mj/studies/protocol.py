"""Studies: independent jobs, each a pure function of its configuration, and a report made from their results.

A job is data and holds everything that its result depends on. So jobs can run in any order, in this process, in another one or on
another machine, and a stored result can be found again. A result is data too. Data are None, numbers, strings, paths, arrays, and
lists, tuples, dicts, dataclasses and named tuples of data, see :mod:`marlbc_mj.studies.codec`. Only large files, such as logs and
checkpoints, go into a separate folder. :mod:`marlbc_mj.studies.runner` runs the jobs of any study.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from marlbc_mj.util.progress import Progress, silent

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")


class Stopped(Exception):
    """A job or a study stopped on request, with its state saved."""

    def __init__(self, signal: int = 0) -> None:
        super().__init__(signal)
        self.signal = signal


def never() -> bool:
    """The ``stopping`` callback of a job that is never asked to stop."""
    return False


class Watch(NamedTuple):
    """Services available to a running job; its result must not depend on them."""

    progress: Progress = silent
    stopping: Callable[[], bool] = never
    """Returns whether the job should save its state and raise :class:`Stopped`; jobs that cannot do so may ignore it."""
    folder: Path | None = None
    """Folder for the job's large files, empty at first; file names must be unique within the study. None: write none."""


class Report(NamedTuple):
    """The text and data that a study reports."""

    text: str = ""
    """Text for the terminal."""
    document: Any = None
    """The same report as data, of the kinds allowed in results."""
    problems: tuple[str, ...] = ()
    """Outputs that could not be written, for example a video without GL; one line each."""


class Study(Protocol[JobT, ResultT]):
    """Independent jobs and the report made from their results. Implementations are frozen, picklable dataclasses."""

    def jobs(self) -> Sequence[JobT]:
        """All jobs, in the order of the report.

        Raises:
            ConfigurationError: a setting that cannot be run; nothing has been run or written.
        """
        ...

    def run(self, job: JobT, watch: Watch) -> ResultT:
        """Run one job. A failure that belongs in the report is returned as a result; any other is raised and ends the study."""
        ...

    # If results or files depend on more than the job, for example on a setting of the study, the study also has a method
    # ``describe(job)``. It returns all of that as data, including the job, and stored results are looked up by it.

    def report(self, results: Sequence[ResultT], out: Path | None, progress: Progress = silent) -> Report:
        """Write the study's output files into ``out``, if given, and return the report."""
        ...
