"""The learner study: one training run per variant and seed, each in its own folder, from which it resumes after a stop.

A finished run leaves ``DONE`` with the hash of its configuration. A failed run leaves ``FAILED`` with the reason.
"""

import shutil
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from marlbc_mj.report.table import to_markdown
from marlbc_mj.results.seeds import seed_range
from marlbc_mj.studies.learners import records
from marlbc_mj.studies.learners.comparison import learners_table, write_comparison
from marlbc_mj.studies.learners.records import DONE_MARK, FAILED_MARK, CsvLine, read_json
from marlbc_mj.studies.learners.variants import VARIANTS
from marlbc_mj.studies.protocol import Report, Stopped, Watch
from marlbc_mj.studies.runner import run_jobs
from marlbc_mj.training import run as training
from marlbc_mj.training.config import TrainConfig, from_json, make_config
from marlbc_mj.training.resuming import RESUME
from marlbc_mj.util.errors import ConfigurationError, MarlbcError, check_named_once, unknown
from marlbc_mj.util.files import alone_in, write_json
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import config_hash
from marlbc_mj.util.text import one_line


class TrainingJob(NamedTuple):
    """One training run: its variant, its configuration and its folder."""

    variant: str
    config: TrainConfig
    folder: Path

    @property
    def key(self) -> str:
        """Name of the run in messages."""
        return f"{self.variant} seed {self.config.seed}"

    @property
    def hash(self) -> str:
        """Hash of the configuration, which shows whether a folder holds this run."""
        return config_hash({"train": self.config})


class TrainingEnd(NamedTuple):
    """How a run ended: ``finished``, ``found`` (finished in an earlier call) or ``failed``, and the reason for a failure."""

    how: str
    reason: str = ""


def unchanged(config: TrainConfig) -> TrainConfig:
    """The configuration without changes."""
    return config


@dataclass(frozen=True)
class LearnerStudy:
    """Study that trains every variant on seeds 0 to ``seeds - 1`` and compares the variants."""

    out: Path
    """Folder of the study; each run has the folder ``out/VARIANT/SEED``."""
    variants: tuple[str, ...] = ()
    """Names in VARIANTS; empty: all variants."""
    seeds: int = 5
    """Runs per variant."""
    budget: int | None = None
    """Mission steps per run; None: the budget of the preset ``fast``."""
    adjust: Callable[[TrainConfig], TrainConfig] = unchanged
    """Function that changes the configuration of every run."""

    def jobs(self) -> list[TrainingJob]:
        """All runs, seed by seed, so that a stopped study still compares all variants.

        Raises:
            ConfigurationError: an unknown or repeated variant, a number below 1, an invalid setting, or a folder that holds a run
                with another configuration.
        """
        for name in self.variants:
            if name not in VARIANTS:
                raise unknown("variant", name, VARIANTS)
        check_named_once("variant", self.variants)
        budget = make_config("fast").budget if self.budget is None else self.budget
        jobs = [
            TrainingJob(name, self.adjust(VARIANTS[name].config(seed, budget)), self.out / name / str(seed))
            for seed in seed_range(self.seeds)
            for name in self.variants or VARIANTS
        ]
        for job in jobs:
            found = _trained(job.folder)
            if found is not None and found != job.hash:
                raise ConfigurationError(f"{job.folder} was trained with other settings; remove it or choose another --out")
        if self.out.is_file():
            raise ConfigurationError(f"output folder {self.out} is a file")
        return jobs

    def run(self, job: TrainingJob, watch: Watch) -> TrainingEnd:
        return train_job(job, watch)

    def report(self, results: Sequence[TrainingEnd], out: Path | None, progress: Progress = silent) -> Report:
        """Write CSV files, table and figure of all runs in the study's folder, including runs of earlier calls."""
        rows, curves = records.collect(self.out)
        if not rows or out is None:
            return Report(to_markdown(learners_table(rows)) if rows else "", list(rows))
        records.write_csvs(out, rows, curves)
        return compare_learners(rows, curves, out)


def compare_learners(rows: Sequence[CsvLine], curves: Sequence[CsvLine], folder: Path) -> Report:
    """Write the table and the figure, which are made from the lines of the CSV files alone."""
    write_comparison(folder, rows, curves)
    table = to_markdown(learners_table(rows))
    return Report(f"{table}\n{folder / 'study.md'} and {folder / 'curves.pdf'} show all results", list(rows))


def train_learners(study: LearnerStudy, workers: int, progress: Progress = silent) -> int:
    """Train all runs that have not finished; returns the signal that stopped the study, or 0.

    Args:
        study: the study whose runs are trained.
        workers: processes that share the runs.
        progress: called with one line per event, the amount done and the total, in runs when a run ends, else in mission steps.

    Raises:
        ConfigurationError: fewer than one worker, an invalid setting, or a folder that cannot be written or is in use.
        SimulationError: a worker died; the next call resumes the runs from their saved states.
    """
    total, count = len(study.jobs()), 0

    def ended(job: TrainingJob, end: TrainingEnd) -> None:
        nonlocal count
        count += 1
        progress(f"[{count}/{total}] {job.key}: {end.how}{': ' if end.reason else ''}{end.reason}", count, total)

    with training.stopper() as stop:
        try:
            with alone_in(study.out, overwrite=True):
                run_jobs(study, workers=workers, progress=progress, ended=ended, stop=stop)
        except Stopped as stopped:
            return stopped.signal
    return 0


def train_job(job: TrainingJob, watch: Watch) -> TrainingEnd:
    """Train a run from the start or resume it. A failed run is recorded with the reason, and the next call tries it again.

    Args:
        job: the run; it is not trained again if it has finished.
        watch: receives a line at the start and after every tenth of the budget; a stop request is checked after every decision.

    Raises:
        ConfigurationError: ``DONE`` or ``FAILED`` cannot be written.
        Stopped: the run was stopped, and its state is saved or it has not begun.
    """
    if (job.folder / DONE_MARK).is_file():
        _prune(job.folder)
        return TrainingEnd("found")
    if watch.stopping():
        raise Stopped
    begun = training.resumable(job.folder)
    (job.folder / FAILED_MARK).unlink(missing_ok=True)
    watch.progress(f"{job.key}: {'resumes' if begun else 'begins'}", 0, job.config.budget)
    observe = _observer(job, watch)
    try:
        if begun:
            ended = training.resume(job.folder, progress=observe)
        else:
            ended = training.train(job.config, job.folder, overwrite=True, progress=observe)
    except Exception as error:  # an error in one run must not stop the others
        reason = one_line(str(error) if isinstance(error, MarlbcError) else f"{type(error).__name__}: {error}")
        write_json(job.folder / FAILED_MARK, {"failure": reason, "train": job.config})
        return TrainingEnd("failed", reason)
    if isinstance(ended, training.Interrupted):
        raise Stopped(ended.signal)
    write_json(job.folder / DONE_MARK, {"config_hash": job.hash})
    _prune(job.folder)
    return TrainingEnd("finished")


def _observer(job: TrainingJob, watch: Watch) -> Callable[[Any, Mapping[str, float]], None]:
    """Callback after every decision: reports a line after every tenth of the budget, and stops the run on request."""
    tenth = 0

    def observe(trainer: Any, row: Mapping[str, float]) -> None:
        nonlocal tenth
        if watch.stopping():
            signal.raise_signal(signal.SIGTERM)  # the run's signal handler notes it, and the run saves its state
        share = min(1.0, trainer.steps / job.config.budget)
        if int(10 * share) > tenth:
            tenth = int(10 * share)
            scores = f"return {row['return']:.0f}, violation of the worst agent {row['violation_time']:.2f} s"
            line = f"{job.key}: {share:4.0%}, {trainer.steps / 1e6:.2f} M steps, {scores}"
            watch.progress(line, trainer.steps, job.config.budget)

    return observe


def failed_runs(study: LearnerStudy) -> list[str]:
    """Names of the runs of a study whose last try failed."""
    return [job.key for job in study.jobs() if (job.folder / FAILED_MARK).is_file()]


def _trained(folder: Path) -> str | None:
    """Configuration hash of the finished or resumable run in a folder; None if there is no such run."""
    if (folder / DONE_MARK).is_file():
        return str(read_json(folder / DONE_MARK, "config_hash"))
    if (folder / RESUME).is_file():
        return config_hash({"train": from_json(read_json(folder / "config.json", "train"))})
    return None


def _prune(folder: Path) -> None:
    """Remove all files of a finished run but evaluations, progress, configuration and best checkpoint."""
    for path in (folder / RESUME, folder / FAILED_MARK, *(folder / "checkpoint").glob("last.*")):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)
