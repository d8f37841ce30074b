"""The benchmark: a matrix of supervisors and controllers on one scenario, and the folder of results it writes."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

from marlbc_mj.controllers import CONTROLLERS
from marlbc_mj.recording.reader import read_log
from marlbc_mj.report.bundle import write_report
from marlbc_mj.report.so_far import write_so_far
from marlbc_mj.results.seeds import seed_range
from marlbc_mj.results.summary import Result
from marlbc_mj.scenarios import Scenario
from marlbc_mj.studies.engines import EngineName
from marlbc_mj.studies.episodes import EpisodeJob, fly, fly_or_fail, name_method, prepare
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import run_study
from marlbc_mj.studies.so_far import PartialPage
from marlbc_mj.supervisors import CHECKPOINT_SUFFIX, ON_REQUEST, SUPERVISORS
from marlbc_mj.util.errors import ConfigurationError, MarlbcError, SimulationError, check_named_once, unknown
from marlbc_mj.util.files import check_folder, write_json
from marlbc_mj.util.modules import names_attribute
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance


@dataclass(frozen=True)
class BenchConfig:
    """Settings of one benchmark run."""

    supervisors: tuple[str, ...] | None = None  # None: the default of matrix
    controllers: tuple[str, ...] | None = None
    seed: int = 0
    figures: bool = True
    logs: bool = True
    video: Literal["first", "all", "none"] = "first"
    overwrite: bool = False
    seeds: int | None = None  # number of draws around the scenario, from ``seed`` on; None: one episode
    workers: int = 1  # processes that run the jobs
    engine: EngineName = "local"  # where jobs run, see marlbc_mj.studies.engines
    shield: bool = False  # give agents a shield, see marlbc_mj.core.shield
    against: str | None = None  # with ``seeds``: key of the method that others are compared with; None: the first

    def __post_init__(self) -> None:
        for kind, names, known in (
            ("supervisor", self.supervisors, SUPERVISORS),
            ("controller", self.controllers, CONTROLLERS),
        ):
            if names is not None:
                _check_names(kind, names, known)
        if self.seeds is not None:
            seed_range(self.seeds, self.seed)
        if self.seed < 0:
            raise ConfigurationError(f"seed must not be negative, got {self.seed}")
        if self.workers < 1:
            raise ConfigurationError(f"workers must be at least 1, got {self.workers}")
        if self.video != "none" and not self.logs:
            raise ConfigurationError("videos are rendered from logs; use --video none together with --no-logs")

    @property
    def methods(self) -> list[tuple[str, str]]:
        """Names of the supervisor and controller of every method, in order."""
        return matrix(self.supervisors, self.controllers)


def matrix(supervisors: Sequence[str] | None = None, controllers: Sequence[str] | None = None) -> list[tuple[str, str]]:
    """The methods of a benchmark, as pairs of supervisor and controller names.

    Without names: every registered supervisor except those in ``ON_REQUEST`` with ``sorlc``, then ``scripted`` with every other
    controller; ``scripted`` with ``sorlc`` comes first. With names: every named supervisor with every named controller. If only
    one kind is named, the other defaults to ``scripted`` or ``sorlc``.
    """
    if supervisors is None and controllers is None:
        first = sorted((name for name in SUPERVISORS if name not in ON_REQUEST), key=lambda name: name != "scripted")
        return [(name, "sorlc") for name in first] + [("scripted", name) for name in CONTROLLERS if name != "sorlc"]
    return list(
        product(("scripted",) if supervisors is None else supervisors, ("sorlc",) if controllers is None else controllers)
    )


def _check_names(kind: str, names: Sequence[str], known: dict[str, Any]) -> None:
    if not names:
        raise ConfigurationError(f"name at least one {kind}: {', '.join(known)}")
    for name in names:
        if name not in known and not names_attribute(name) and not name.endswith(CHECKPOINT_SUFFIX):
            raise unknown(kind, name, known)
    check_named_once(kind, names)


@dataclass(frozen=True)
class BenchStudy:
    """One episode of every method. A method that fails, or cannot start in this scenario, has a result that gives the reason."""

    scenario: Scenario
    config: BenchConfig

    def jobs(self) -> list[EpisodeJob]:
        return [EpisodeJob(self.scenario, *method, self.config.seed, self.config.shield) for method in self.config.methods]

    def run(self, job: EpisodeJob, watch: Watch) -> Result:
        return fly_or_fail(job, watch.folder if self.config.logs else None, watch.progress)

    def describe(self, job: EpisodeJob) -> tuple[EpisodeJob, bool]:
        """Everything that a job's result and files depend on."""
        return job, self.config.logs

    def report(self, results: Sequence[Result], out: Path | None, progress: Progress = silent) -> Report:
        if out is None:
            return Report()
        facts = describe(self.scenario, self.config)
        write_json(out / "config.json", facts)
        videos, problems = _render_videos(results, self.config, out, progress)
        write_report(results, out, config=facts, videos=videos, figures=self.config.figures, progress=progress)
        return Report(problems=tuple(problems))


def run_bench(
    scenario: Scenario,
    config: BenchConfig,
    out: Path,
    *,
    progress: Progress | None = None,
    ended: Callable[[Result], None] | None = None,
) -> tuple[list[Result], list[str]]:
    """Run the whole matrix and write ``out``; returns the results, and messages about outputs not written (a video without GL).

    A method that fails, or cannot start in this scenario, is a reported outcome, not a missing row. Until all methods have ended,
    ``out/.jobs/so_far`` holds a page and tables of those that have.

    Args:
        scenario: the scenario of all episodes.
        config: the methods, and the outputs to write.
        out: folder of the results.
        progress: called with the current stage, the amount done and the total.
        ended: called with the result of each method as soon as it ends.

    Raises:
        ConfigurationError: an invalid setting or output folder; nothing is written then.
    """
    study = BenchStudy(scenario, config)
    page = PartialPage(out, [job.key for job in study.jobs()], partial(write_so_far, config=describe(scenario, config)))

    def tell(job: EpisodeJob, result: Result) -> None:
        page.add(result.key, result)
        if ended is not None:
            ended(result)

    done = run_study(
        study,
        out,
        overwrite=config.overwrite,
        workers=config.workers,
        engine=config.engine,
        progress=progress or silent,
        ended=tell,
    )
    return done.results, list(done.report.problems)


def describe(scenario: Scenario, config: BenchConfig) -> dict[str, Any]:
    """The contents of config.json: versions, revision, machine, command line and every setting."""
    return {
        **provenance(),
        "command": " ".join(["marlbc", *sys.argv[1:]]),
        "seed": config.seed,
        "scenario": scenario,
        "bench": config,
    }


def _render_videos(
    results: Sequence[Result], config: BenchConfig, folder: Path, progress: Progress
) -> tuple[list[Path], list[str]]:
    """Render videos of the methods that ran; without off-screen GL only the videos are missing."""
    if config.video == "none":
        return [], []
    from marlbc_mj.recording.video import render_video

    ran = [r for r in results if r.trajectory is not None]
    chosen = ran if config.video == "all" else ran[:1]
    videos: list[Path] = []
    try:
        for result in chosen:
            key = result.key
            path = folder / "video" / f"{key}.mp4"
            log = read_log(folder / "logs" / f"{key}.mcap")
            render_video(log, path, progress=partial(progress, f"video of {result.display}"))
            videos.append(path)
    except MarlbcError as error:
        return videos, [f"no video: {error}"]
    return videos, []


def run_single(
    scenario: Scenario,
    supervisor: str,
    controller: str,
    out: Path,
    *,
    seed: int = 0,
    overwrite: bool = False,
    shield: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Run one method; write its log, metrics.json and config.json into ``out``.

    The log grows in place as ``*.mcap.partial``, so that a killed run can be recovered.

    Raises:
        ConfigurationError: an invalid setting or output folder, or a method that cannot start.
        SimulationError: the run failed; its log is kept as it is.
    """
    config = BenchConfig((supervisor,), (controller,), seed=seed, overwrite=overwrite, shield=shield)
    check_folder(out, overwrite=overwrite)
    job = EpisodeJob(scenario, supervisor, controller, seed, shield)
    flight = prepare(job, *name_method(job))
    result = fly(flight, out, progress or silent, overwrite=overwrite)
    if result.metrics is None:
        raise SimulationError(result.failure)
    write_json(out / "config.json", describe(scenario, config))
    write_json(out / "metrics.json", result.metrics)
    return result
