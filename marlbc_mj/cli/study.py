"""``marlbc study``: train every variant of the learner on several seeds, in worker processes, and compare them."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from marlbc_mj.training.config import with_settings
from marlbc_mj.util.errors import ConfigurationError, MarlbcError, SimulationError, unknown
from marlbc_mj.util.files import write_json

if TYPE_CHECKING:
    from marlbc_mj.training.config import TrainConfig

Say = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """Compare learners: MARLMS, its ablations and rivals, each on several seeds; the same command goes on where it stopped."""

    variants: tuple[str, ...] = ()
    """Variants to train; all of them by default."""
    seeds: int = 5
    """Runs of a variant, with seeds from 0 on."""
    budget: int | None = None
    """Mission steps of a run; by default those of the preset `fast`."""
    workers: int = 2
    """Processes that share the runs, one thread each."""
    out: Path = Path("runs/study")
    """Folder of runs, study.csv, curves.csv, study.md, study.tex, and the figure as PDF and PNG."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Only make table and figure again, from study.csv and curves.csv in this folder."""
    set: tuple[str, ...] = ()
    """Any setting of all runs, name=value, as for `marlbc train`."""

    def run(self) -> None:
        """Train what is missing, then write and print the comparison; a stopped study compares what there is."""
        from marlbc_mj.report.table import to_markdown
        from marlbc_mj.studies import learners as study
        from marlbc_mj.studies import learners_report as study_report
        from marlbc_mj.training.config import make_config

        if self.source is not None:
            rows, curves, folder, stopped = *study.read_study(self.source), self.source, 0
        else:
            adjust = partial(with_settings, settings=self.set)
            budget = make_config("fast").budget if self.budget is None else self.budget
            jobs = plan(self.variants, self.seeds, budget, self.out, adjust)
            stopped = run_study(jobs, self.workers, partial(print, file=sys.stderr, flush=True))
            rows, curves = study.collect(self.out)
            folder = self.out
            if rows:
                study.write_csvs(folder, rows, curves)
        if rows:
            study_report.write_report(folder, rows, curves)
            print(to_markdown(study_report.study_table(rows)))
            print(f"{folder / 'study.md'} and {folder / 'curves.pdf'} show it all")
        if stopped:
            print("marlbc: stopped, and every run saved; the same command goes on", file=sys.stderr)
            sys.exit(128 + stopped)


class Job(NamedTuple):
    """One run to be: what is trained and where."""

    variant: str
    config: "TrainConfig"
    folder: Path

    @property
    def key(self) -> str:
        """The run's name in every message."""
        return f"{self.variant} seed {self.config.seed}"

    @property
    def hash(self) -> str:
        """Of the configuration."""
        from marlbc_mj.util.provenance import config_hash

        return config_hash({"train": self.config})


def plan(
    variants: Sequence[str],
    seeds: int,
    budget: int,
    out: Path,
    adjust: Callable[["TrainConfig"], "TrainConfig"] = lambda config: config,
) -> list[Job]:
    """Every variant on seeds 0 to ``seeds - 1``, seed by seed, so that a study that is stopped compares all variants.

    Args:
        variants: names in VARIANTS; none stands for all.
        seeds: runs of a variant.
        budget: mission steps of a run.
        out: folder of the study.
        adjust: changes every configuration.

    Raises:
        ConfigurationError: an unknown variant or one named twice, a number below 1, a setting that cannot be run, or a folder
            with a run of another configuration.
    """
    from marlbc_mj.results.seeds import seed_range
    from marlbc_mj.studies.learners import VARIANTS

    for name in variants:
        if name not in VARIANTS:
            raise unknown("variant", name, VARIANTS)
    if len(set(variants)) != len(variants):
        raise ConfigurationError(f"a variant is named twice: {', '.join(variants)}")
    jobs = []
    for seed in seed_range(seeds):
        for name in variants or VARIANTS:
            jobs.append(Job(name, adjust(VARIANTS[name].config(seed, budget)), out / name / str(seed)))
    for job in jobs:
        found = _trained(job.folder)
        if found is not None and found != job.hash:
            raise ConfigurationError(f"{job.folder} was trained with other settings; remove it or choose another --out")
    if out.is_file():
        raise ConfigurationError(f"output folder {out} is a file")
    return jobs


def _trained(folder: Path) -> str | None:
    """Hash of the configuration that the folder's run finished with, or goes on with."""
    from marlbc_mj.studies.learners import DONE, read_json
    from marlbc_mj.training.config import from_json
    from marlbc_mj.training.run import RESUME
    from marlbc_mj.util.provenance import config_hash

    if (folder / DONE).is_file():
        return str(read_json(folder / DONE, "config_hash"))
    if (folder / RESUME).is_file():
        return config_hash({"train": from_json(read_json(folder / "config.json", "train"))})
    return None


class Ended(NamedTuple):
    """How a job ended: ``finished``, ``found`` (finished before), ``failed``, or ``stopped`` by a signal."""

    key: str
    how: str
    reason: str = ""
    signal: int = 0


def run_job(job: Job, say: Say, stopping: Callable[[], bool] = lambda: False) -> Ended:
    """Train, or go on training; a run that fails is kept with its reason, and tried again by the next call.

    Args:
        job: what to run; finished before, it is left as it is.
        say: called with a line at the start and after every tenth of the budget.
        stopping: asked after every decision; the run saves itself and ends once it is true.

    Raises:
        ConfigurationError: the outcome cannot be written.
    """
    from marlbc_mj.studies.learners import DONE, FAILED
    from marlbc_mj.training import run
    from marlbc_mj.util.text import one_line

    folder, begun = job.folder, run.resumable(job.folder)
    if (folder / DONE).is_file():
        _prune(folder)
        return Ended(job.key, "found")
    if stopping():
        return Ended(job.key, "stopped")
    tenth = 0

    def watch(trainer: Any, row: Mapping[str, float]) -> None:
        nonlocal tenth
        if stopping():
            signal.raise_signal(signal.SIGTERM)  # noted by the run, which saves itself
        share = min(1.0, trainer.steps / job.config.budget)
        if int(10 * share) > tenth:
            tenth = int(10 * share)
            scores = f"return {row['return']:.0f}, violation of the worst agent {row['violation_time']:.2f} s"
            say(f"{job.key}: {share:4.0%}, {trainer.steps / 1e6:.2f} M steps, {scores}")

    (folder / FAILED).unlink(missing_ok=True)
    say(f"{job.key}: {'goes on' if begun else 'begins'}")
    try:
        ended = run.resume(folder, progress=watch) if begun else run.train(job.config, folder, overwrite=True, progress=watch)
    except Exception as error:  # whatever stops one learner must not stop the others
        reason = one_line(str(error) if isinstance(error, MarlbcError) else f"{type(error).__name__}: {error}")
        write_json(folder / FAILED, {"failure": reason, "train": job.config})
        return Ended(job.key, "failed", reason)
    if isinstance(ended, run.Interrupted):
        return Ended(job.key, "stopped", signal=ended.signal)
    write_json(folder / DONE, {"config_hash": job.hash})
    _prune(folder)
    return Ended(job.key, "finished")


def _prune(folder: Path) -> None:
    """Leave evaluations, progress, configuration and the best checkpoint of a finished run."""
    from marlbc_mj.studies.learners import FAILED
    from marlbc_mj.training.run import RESUME

    for path in (folder / RESUME, folder / FAILED, *(folder / "checkpoint").glob("last.*")):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)


def run_study(jobs: Sequence[Job], workers: int, say: Say) -> int:
    """Every job; returns the signal that stopped the study, or 0.

    Args:
        jobs: of :func:`plan`.
        workers: processes that share them; with one, all run in this process.
        say: called with a line of progress; workers of their own write to stderr instead.

    Raises:
        ConfigurationError: fewer than one worker, or a folder that cannot be written.
        SimulationError: a worker died; what was saved goes on with the next call.
    """
    from marlbc_mj.training.run import stopper

    if workers < 1:
        raise ConfigurationError(f"workers must be at least 1, got {workers}")
    count = 0
    with stopper() as stop:
        each = _alone(jobs, say, lambda: bool(stop.signal)) if workers == 1 else _pooled(jobs, workers, lambda: bool(stop.signal))
        try:
            for ended in each:
                count += ended.how != "stopped"
                stop.signal = stop.signal or (ended.signal if workers == 1 else 0)
                if ended.how != "stopped":
                    say(f"[{count}/{len(jobs)}] {ended.key}: {ended.how}{': ' if ended.reason else ''}{ended.reason}")
        except BrokenProcessPool as error:
            if not stop.signal:
                raise SimulationError("a worker process died (out of memory?); the same command goes on") from error
        return stop.signal


def _alone(jobs: Sequence[Job], say: Say, stopping: Callable[[], bool]) -> Iterator[Ended]:
    for job in jobs:
        yield run_job(job, say, stopping)


def _pooled(jobs: Sequence[Job], workers: int, stopping: Callable[[], bool]) -> Iterator[Ended]:
    context = get_context("spawn")
    event = context.Event()
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _begin_worker, (event,)) as pool:
        try:
            waiting = {pool.submit(_work, job) for job in jobs}
            while waiting:
                done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
                if stopping():
                    event.set()
                for future in done:
                    yield future.result()
        finally:
            event.set()  # after an error the others save themselves


_event: Event | None = None


def _begin_worker(event: Event) -> None:
    """Ctrl-C reaches the whole group of processes: a worker leaves it to the study, which asks it to stop."""
    global _event
    _event = event
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(job: Job) -> Ended:
    parent = parent_process()

    def orphaned() -> bool:
        return parent is not None and not parent.is_alive()

    ended = run_job(
        job, partial(print, file=sys.stderr, flush=True), lambda: orphaned() or (_event is not None and _event.is_set())
    )
    if orphaned():
        os._exit(1)
    return ended
