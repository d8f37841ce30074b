"""``marlbc bench`` and ``marlbc run``, and the changes to a scenario that they share."""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.terminal import print_results, progress_bars
from marlbc_mj.util.errors import ConfigurationError

if TYPE_CHECKING:
    from marlbc_mj.scenarios import Scenario


@dataclass(frozen=True)
class ScenarioOptions:
    """Changes to the scenario."""

    substep: float | None = None
    """Physics and control step [s]; must divide the mission step of 0.05 s."""
    reference: str | None = None
    """Where behaviors are evaluated: virtual (at the reference) or actual (at the measured position)."""
    two_sided: bool = False
    """Obstacle avoidance as the printed equality task, which also attracts (erratum 6)."""
    disturbance: str | None = None
    """Unknown dynamics: paper, linear, quadratic, wind or gusts."""
    drag_scale: float | None = None
    """Multiplies the disturbance."""
    force_limit: float | None = None
    """Actuator limit per axis [N]; laws without limit (see `marlbc list`) ignore it."""
    duration: float | None = None
    """Mission time [s]."""
    split: str | None = None
    """Whose layouts a scenario that draws them takes: train (default) or test, the held-out ones."""

    def build(self, name: str) -> "Scenario":
        """The named scenario with these changes."""
        from marlbc_mj.core.disturbances import make_disturbance
        from marlbc_mj.scenarios import make_scenario

        keys = ("substep", "reference", "force_limit", "duration", "split")
        changes: dict[str, Any] = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        if self.two_sided:
            changes["two_sided"] = True
        if self.disturbance is not None or self.drag_scale is not None:
            scale = 1.0 if self.drag_scale is None else self.drag_scale
            changes["disturbance"] = make_disturbance(self.disturbance or "paper", scale)
        return make_scenario(name, **changes)


@dataclass(frozen=True)
class Bench:
    """Run supervisors and controllers on one scenario and write tables, figures, logs, a video and a page.

    By default every supervisor but two (mpcms-mujoco, oracle-schedule) runs with sorlc, and scripted with every controller.
    """

    scenario: Positional[str] = "paper"
    """Scenario, see `marlbc list`, or a .toml file."""
    supervisors: tuple[str, ...] | None = None
    """Supervisors to run, each with every one of --controllers (scripted, if only those are named)."""
    controllers: tuple[str, ...] | None = None
    """Controllers to run each supervisor with (sorlc, if only supervisors are named)."""
    out: Path = Path("out/paper")
    """Folder of the results."""
    seed: int = 0
    """Draw of the scenario; every seed is the same where nothing is perturbed."""
    seeds: int | None = None
    """Number of draws around the scenario, from --seed on: tables with intervals instead of logs and videos."""
    drag_range: tuple[float, float] | None = None
    """With --seeds, a draw from this range multiplies the disturbance: 0 2 by default, 5 5 for five times throughout."""
    workers: int = 1
    """Processes that share the methods of --seeds."""
    video: Literal["first", "all", "none"] = "first"
    """Which methods get a video."""
    figures: bool = True
    """Draw the figures."""
    logs: bool = True
    """Write an MCAP log of every episode."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """Run the matrix, then say where the results are and what they are."""
        from marlbc_mj.results.seeds import CASE_STUDY_PERTURBATION
        from marlbc_mj.studies.bench import BenchConfig, run_bench, run_bench_seeds

        config = BenchConfig(
            supervisors=self.supervisors,
            controllers=self.controllers,
            seed=self.seed,
            figures=self.figures,
            logs=self.logs,
            video=self.video,
            overwrite=self.overwrite,
            seeds=self.seeds,
            workers=self.workers,
        )
        if self.drag_range is not None and self.seeds is None:
            raise ConfigurationError(f"--drag-range {self.drag_range[0]:g} {self.drag_range[1]:g} needs --seeds")
        if self.seeds is not None:
            scenario = self.options.build(self.scenario)
            if self.drag_range is not None:
                scenario = replace(scenario, perturbation=replace(CASE_STUDY_PERTURBATION, drag_scale=self.drag_range))
            with progress_bars() as progress:
                run_bench_seeds(scenario, config, self.out, progress=progress)
            print(f"{self.out / 'index.html'} shows it all")
            return
        with progress_bars() as progress:
            results, problems = run_bench(self.options.build(self.scenario), config, self.out, progress=progress)
        print_results(results)
        for problem in problems:
            print(f"marlbc: {problem}", file=sys.stderr)
        print(f"{self.out / 'index.html'} shows it all")


@dataclass(frozen=True)
class Run:
    """Run one episode of one method and log it."""

    scenario: Positional[str] = "paper"
    """Scenario, see `marlbc list`, or a .toml file."""
    supervisor: str = "scripted"
    """Mission supervisor."""
    controller: str = "sorlc"
    """Controller."""
    out: Path = Path("out/run")
    """Folder of the log, the metrics and the configuration."""
    seed: int = 0
    """Draw of the scenario."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """One episode, its log and its metrics."""
        from marlbc_mj.studies.bench import run_single

        with progress_bars() as progress:
            result = run_single(
                self.options.build(self.scenario),
                self.supervisor,
                self.controller,
                self.out,
                seed=self.seed,
                overwrite=self.overwrite,
                progress=progress,
            )
        print_results([result])
        print(f"{self.out} holds the log, the metrics and the configuration")
