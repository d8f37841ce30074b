"""The benchmark: a matrix of supervisors and controllers on one scenario, and the folder of results it leaves."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from marlbc_mj.controllers import CONTROLLERS, Controller, make_controller
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Frame, run_episode
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.report.bundle import write_report
from marlbc_mj.report.seed_page import write_seed_report
from marlbc_mj.results.seeds import SeedResults, check_free, perturbed, run_methods, seed_range
from marlbc_mj.results.summary import Result, method_key
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors import ON_REQUEST, SUPERVISORS, Decision, Supervisor, make_supervisor
from marlbc_mj.util.errors import ConfigurationError, MarlbcError, SimulationError, unknown
from marlbc_mj.util.files import check_folder, staged_folder, write_json
from marlbc_mj.util.provenance import provenance

Progress = Callable[[str, float, float], None]
"""Called with what is being done, how much of it is done and how much there is."""


@dataclass(frozen=True)
class BenchConfig:
    """What one benchmark run does."""

    supervisors: tuple[str, ...] | None = None  # None: see matrix
    controllers: tuple[str, ...] | None = None
    seed: int = 0
    figures: bool = True
    logs: bool = True
    video: Literal["first", "all", "none"] = "first"
    overwrite: bool = False
    seeds: int | None = None  # this many draws around the scenario, from ``seed`` on, instead of one
    workers: int = 1  # processes that share the methods of ``seeds``
    against: str | None = None  # with ``seeds``: the method that others are compared with; None: the first

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
        """Names of supervisor and controller of every method, in order."""
        return matrix(self.supervisors, self.controllers)


def matrix(supervisors: Sequence[str] | None = None, controllers: Sequence[str] | None = None) -> list[tuple[str, str]]:
    """The methods of a benchmark, as names of supervisor and controller.

    Without names: every registered supervisor but those ``ON_REQUEST`` with ``sorlc``, then ``scripted`` with every other
    controller; ``scripted`` with ``sorlc`` comes first. With names: every named supervisor with every named controller, where
    ``sorlc`` stands for controllers and ``scripted`` for supervisors that are not named.
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
        if name not in known:
            raise unknown(kind, name, known)
    if len(set(names)) != len(names):
        raise ConfigurationError(f"a {kind} is named twice: {', '.join(names)}")


def run_bench(
    scenario: Scenario, config: BenchConfig, out: Path, *, progress: Progress | None = None
) -> tuple[list[Result], list[str]]:
    """Run the whole matrix and write ``out``; returns the results and what could not be written (a video without GL).

    A method that fails, or cannot start in this scenario, is a reported outcome, not a missing row.

    Raises:
        ConfigurationError: a setting or the output folder; nothing is written then.
    """
    say = progress or (lambda what, done, total: None)
    with staged_folder(out, overwrite=config.overwrite) as folder:
        write_json(folder / "config.json", _config(scenario, config))
        results = [
            run_method(scenario, supervisor, controller, config.seed, folder if config.logs else None, say)
            for supervisor, controller in config.methods
        ]
        videos, problems = _render_videos(results, config, folder, say)
        write_report(results, folder, config=_config(scenario, config), videos=videos, figures=config.figures, progress=say)
    return results, problems


def run_bench_seeds(scenario: Scenario, config: BenchConfig, out: Path, *, progress: Progress | None = None) -> SeedResults:
    """The whole matrix on ``config.seeds`` draws around the scenario; writes tables with intervals, no logs and no videos.

    Raises:
        ConfigurationError: a setting or the output folder; nothing is written then.
    """
    scenario, seeds = perturbed(scenario), seed_range(config.seeds or 0, config.seed)
    with staged_folder(out, overwrite=config.overwrite) as folder:
        write_json(folder / "config.json", _config(scenario, config))
        results = run_methods(scenario, config.methods, seeds, progress, reference=config.against, workers=config.workers)
        write_seed_report(results, folder, config=_config(scenario, config), figures=config.figures, progress=progress)
    return results


def _config(scenario: Scenario, config: BenchConfig) -> dict[str, Any]:
    return {
        **provenance(),
        "command": " ".join(["marlbc", *sys.argv[1:]]),
        "seed": config.seed,
        "scenario": scenario,
        "bench": config,
    }


class Stopwatch:
    """A supervisor whose memory may tell, as ``solver_ms``, how long its network or solver took in the last decision [ms]."""

    def __init__(self, supervisor: Supervisor) -> None:
        self.supervisor = supervisor
        self.solver_ms: list[float] = []

    def start(self, scenario: Scenario, teams: int) -> Any:
        """The supervisor's memory."""
        return self.supervisor.start(scenario, teams)

    def decide(self, observation: Observation, memory: Any) -> tuple[Decision, Any]:
        """The supervisor's orders."""
        orders, memory = self.supervisor.decide(observation, memory)
        spent = getattr(memory, "solver_ms", None)
        if spent is not None:
            self.solver_ms.append(float(spent))
        return orders, memory

    def share(self, decision_ms: np.ndarray) -> float | None:
        """Solver's time over the whole decisions' (M,); None where the supervisor did not tell."""
        return sum(self.solver_ms) / float(decision_ms.sum()) if self.solver_ms else None


def run_method(
    scenario: Scenario,
    supervisor: str,
    controller: str,
    seed: int,
    folder: Path | None,
    say: Progress,
    overwrite: bool = False,
) -> Result:
    """One episode of one method, logged to ``folder/logs`` if there is a folder; a method that cannot start has failed.

    Raises:
        ConfigurationError: unknown names, or a log that may not be written.
    """
    key, names = method_key(supervisor, controller), (supervisor, controller)
    law, chief = make_controller(controller), Stopwatch(make_supervisor(supervisor, controller))
    try:
        world = World(scenario, law, record=True)
        chief.start(scenario, 1)
    except MarlbcError as error:
        return Result.failed(*names, f"cannot start: {error}")

    def step_done(frame: Frame) -> None:
        if frame.observation.step % 50 == 0:
            say(key, float(frame.observation.time), scenario.duration)

    try:
        if folder is None:
            trajectory = run_episode(world, chief, seed=seed, names=names, on_frame=step_done)
        else:
            path = folder / "logs" / f"{key}.mcap"
            with open_log(
                path, scenario, law, supervisor=supervisor, controller=controller, seed=seed, overwrite=overwrite
            ) as log:

                def record(frame: Frame) -> None:
                    log.write(frame)
                    step_done(frame)

                trajectory = run_episode(world, chief, seed=seed, names=names, on_frame=record)
        check_free(trajectory, law)
    except SimulationError as error:
        return Result.failed(*names, str(error))
    say(key, scenario.duration, scenario.duration)
    return Result.of(trajectory, chief.share(trajectory.decision_ms))


def open_log(
    path: Path, scenario: Scenario, law: Controller, *, supervisor: str, controller: str, seed: int, overwrite: bool = False
) -> LogWriter:
    """A log writer for one method, with everything that defines the run in its configuration."""
    config = {"scenario": scenario, "controller": law, "supervisor": make_supervisor(supervisor, controller), "seed": seed}
    return LogWriter(
        path,
        scenario,
        law,
        supervisor=supervisor,
        controller_name=controller,
        seed=seed,
        config=config,
        overwrite=overwrite,
    )


def _render_videos(results: list[Result], config: BenchConfig, folder: Path, say: Progress) -> tuple[list[Path], list[str]]:
    """Videos of the methods that ran; a machine without off-screen GL loses the videos and nothing else."""
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
            render_video(log, path, progress=lambda done, total, key=key: say(f"video {key}", done, total))  # type: ignore[misc]
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
    progress: Progress | None = None,
) -> Result:
    """One method, its log, metrics.json and config.json in ``out``.

    The log grows in place as ``*.mcap.partial``, so that a killed run can be recovered.

    Raises:
        ConfigurationError: a setting or the output folder.
        SimulationError: the run failed; its log stays as it was.
    """
    config = BenchConfig((supervisor,), (controller,), seed=seed, overwrite=overwrite)
    check_folder(out, overwrite=overwrite)
    World(scenario, make_controller(controller))
    make_supervisor(supervisor, controller).start(scenario, 1)  # a method that cannot start is a wrong setting here
    say = progress or (lambda what, done, total: None)
    result = run_method(scenario, supervisor, controller, seed, out, say, overwrite)
    if result.metrics is None:
        raise SimulationError(result.failure)
    write_json(out / "config.json", _config(scenario, config))
    write_json(out / "metrics.json", result.metrics)
    return result
