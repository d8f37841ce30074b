"""``marlbc bench``, ``run``, ``evaluate`` and ``safety``, and the changes to a scenario that they share."""

import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.terminal import print_results, progress_bars
from marlbc_mj.util.errors import ConfigurationError, unknown

if TYPE_CHECKING:
    from marlbc_mj.scenarios import Scenario
    from marlbc_mj.studies.bench import BenchConfig

SETTABLE = ("communication.", "imperfections.")
"""Tables of a scenario whose fields ``--set`` reaches."""


@dataclass(frozen=True)
class ScenarioOptions:
    """Changes to the scenario."""

    substep: float | None = None
    """Physics and control step [s]; must divide the mission step of 0.05 s."""
    reference: str | None = None
    """Where behaviors are evaluated: virtual (at the reference) or actual (at the measured position)."""
    composition: str | None = None
    """How an order becomes a reference: null-space (avoidance as an equality task) or set-based (as an inequality)."""
    two_sided: bool = False
    """Obstacle avoidance as the published equality task, which also attracts (erratum 6)."""
    disturbance: str | None = None
    """Unknown dynamics: paper, linear, quadratic, wind or gusts."""
    drag_scale: float | None = None
    """Multiplies the disturbance."""
    force_limit: float | None = None
    """Actuator limit per axis [N]; laws without limit (see `marlbc list`) ignore it."""
    duration: float | None = None
    """Mission time [s]."""
    robot: str | None = None
    """Robot, by name, path of an .xml or .py file, or FILE.py:NAME; a scenario takes its mass, force and limits."""
    split: str | None = None
    """Layout split to draw from, for scenarios that draw layouts: train (default) or test, the held-out ones."""
    set: tuple[str, ...] = ()
    """Settings of communication and imperfections, name=value: communication.range=8 communication.loss=0.2."""

    allow_code: bool = False
    """Run the Python file that a scenario file names as its robot."""

    def build(self, name: str, **others: Any) -> "Scenario":
        """The named scenario with these changes, and with ``others`` that are not None."""
        from marlbc_mj.core.disturbances import make_disturbance
        from marlbc_mj.scenarios import make_scenario
        from marlbc_mj.util.changes import with_settings

        keys = ("substep", "reference", "composition", "force_limit", "duration", "split")
        changes: dict[str, Any] = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        changes.update({key: value for key, value in others.items() if value is not None})
        if self.two_sided:
            changes["two_sided"] = True
        if self.disturbance is not None or self.drag_scale is not None:
            scale = 1.0 if self.drag_scale is None else self.drag_scale
            changes["disturbance"] = make_disturbance(self.disturbance or "paper", scale)
        scenario = make_scenario(name, allow_code=self.allow_code, **self._robot_changes(name), **changes)
        return with_settings(scenario, self._tables_set())

    def _tables_set(self) -> tuple[str, ...]:
        """The settings of --set; other fields of a scenario follow from each other, so that one alone cannot be set.

        Raises:
            ConfigurationError: a setting that is in neither table.
        """
        for setting in self.set:
            if not setting.startswith(SETTABLE):
                raise unknown("setting", setting.partition("=")[0], [f"{table}NAME=VALUE" for table in SETTABLE])
        return self.set

    def _robot_changes(self, name: str) -> dict[str, Any]:
        """What another robot changes, but for what other options set."""
        from marlbc_mj.robots import make_robot

        if self.robot is None:
            return {}
        if name == "robot_gate":
            return {"robot": self.robot}
        scale = make_robot(self.robot).scale()
        return {key: value for key, value in scale.items() if getattr(self, key, None) is None or key == "robot"}


@dataclass(frozen=True)
class BenchCommand:
    """Run supervisors and controllers on one scenario and write tables, figures, logs, a video and a page.

    By default scripted runs with every controller, and every supervisor with sorlc but those that are to be named: mpcms-mujoco,
    oracle-schedule, fixed, set-based-rule, lookahead, lookahead-distributed, rollout, orca, cbf-qp and marlms-general.
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
    """Processes that share the jobs, or tasks of a SLURM array; decision times are best measured with one."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: processes of this machine, Ray (the cluster in RAY_ADDRESS, else this machine), or an array of SLURM."""
    video: Literal["first", "all", "none"] = "first"
    """Which methods get a video."""
    figures: bool = True
    """Draw the figures."""
    logs: bool = True
    """Write an MCAP log of every episode."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    shield: bool = False
    """Give agents a shield: forces are changed as little as possible, so that they can always stop in time."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """Run the matrix, then say where the results are and what they are."""
        from marlbc_mj.studies.bench import run_bench
        from marlbc_mj.studies.draws import run_bench_seeds

        config = self.config()
        scenario = self.scenario_drawn()
        with progress_bars() as progress:
            if self.seeds is not None:
                run_bench_seeds(scenario, config, self.out, progress=progress)
            else:
                results, problems = run_bench(scenario, config, self.out, progress=progress)
        if self.seeds is None:
            print_results(results)
            for problem in problems:
                print(f"marlbc: {problem}", file=sys.stderr)
        print(f"{self.out / 'index.html'} shows it all")

    def config(self) -> "BenchConfig":
        """The options under the names that the benchmark gives them."""
        from marlbc_mj.studies.bench import BenchConfig

        return BenchConfig(**{each.name: getattr(self, each.name) for each in fields(BenchConfig) if hasattr(self, each.name)})

    def scenario_drawn(self) -> "Scenario":
        """The scenario with the options' changes, and with the range that draws multiply its disturbance by.

        Raises:
            ConfigurationError: a range without draws.
        """
        from marlbc_mj.studies.draws import with_drag_range

        if self.drag_range is None:
            return self.options.build(self.scenario)
        if self.seeds is None:
            raise ConfigurationError(f"--drag-range {self.drag_range[0]:g} {self.drag_range[1]:g} needs --seeds")
        return with_drag_range(self.options.build(self.scenario), self.drag_range)


@dataclass(frozen=True)
class RunCommand:
    """Run one episode of one method and log it."""

    scenario: Positional[str] = "paper"
    """Scenario, see `marlbc list`, or a .toml file."""
    supervisor: str = "scripted"
    """Mission supervisor, FILE.py:NAME, or the path of a checkpoint."""
    controller: str = "sorlc"
    """Controller, or FILE.py:NAME."""
    out: Path = Path("out/run")
    """Folder of the log, the metrics and the configuration."""
    seed: int = 0
    """Draw of the scenario."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    shield: bool = False
    """Give agents a shield: forces are changed as little as possible, so that they can always stop in time."""
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
                shield=self.shield,
                progress=progress,
            )
        print_results([result])
        print(f"{self.out} holds the log, the metrics and the configuration")


@dataclass(frozen=True)
class EvaluateCommand:
    """Run supervisors on held-out layouts of a scenario family: success, violation and collision rates with intervals.

    By default every supervisor without learning. Scripted schedules and the oracle's belong to scenarios whose geometry is the
    same for every seed; elsewhere they are reported as failed, with the reason.
    """

    scenario: Positional[str] = "field"
    """Scenario that draws layouts, see `marlbc list`, or a .toml file."""
    supervisors: tuple[str, ...] | None = None
    """Supervisors to run."""
    controller: str = "sorlc"
    """Controller they run with."""
    agents: int | None = None
    """Size of the team, 4 in most families."""
    formation: str | None = None
    """Formation of the team: line, wedge, circle or grid."""
    seeds: int = 200
    """Number of held-out layouts."""
    seed: int = 0
    """First seed."""
    workers: int = 1
    """Processes that share the jobs, or tasks of a SLURM array; decision times are best measured with one."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: processes of this machine, Ray (the cluster in RAY_ADDRESS, else this machine), or an array of SLURM."""
    out: Path = Path("out/evaluation")
    """Folder of the results."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    shield: bool = False
    """Give agents a shield: forces are changed as little as possible, so that they can always stop in time."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """Evaluate, and print the table of outcomes."""
        from marlbc_mj.report.seed_tables import outcome_table
        from marlbc_mj.report.table import to_markdown
        from marlbc_mj.studies.evaluate import evaluation, run_evaluation

        config = evaluation(
            self.supervisors,
            self.controller,
            seeds=self.seeds,
            seed=self.seed,
            workers=self.workers,
            engine=self.engine,
            overwrite=self.overwrite,
            shield=self.shield,
        )
        with progress_bars() as progress:
            results = run_evaluation(self.scenario_flown(), config, self.out, progress=progress)
        print(to_markdown(outcome_table(results)))
        print(f"{self.out / 'index.html'} shows it all")

    def scenario_flown(self) -> "Scenario":
        """The scenario with the team and the changes of the command line."""
        return self.options.build(self.scenario, agents=self.agents, formation=self.formation)


@dataclass(frozen=True)
class SafetyCommand:
    """Run supervisors on several missions, under both compositions, without a shield and with one: one table of outcomes.

    Missions are held-out layouts of families, or draws around the case study with its drag multiplied by 0, 2 or 5:
    paper-drag-0, paper-drag-2 and paper-drag-5.
    """

    missions: Positional[tuple[str, ...]] = ("field", "forest", "gates", "corridor", "traffic")
    """Scenarios that draw layouts, see `marlbc list`, or draws around the case study."""
    supervisors: tuple[str, ...] | None = None
    """Supervisors to run; by default every one that knows no map beforehand, and scripted."""
    compositions: tuple[str, ...] = ("null-space", "set-based")
    """How orders become references."""
    shields: tuple[Literal["no", "yes"], ...] = ("no", "yes")
    """Whether agents have a shield."""
    layouts: int = 1000
    """Layouts of every supervisor on every mission."""
    searched: int = 100
    """Layouts of mpcms and rollout, which take seconds each."""
    seed: int = 80_000
    """First seed of the layouts."""
    controller: str = "sorlc"
    """Controller that all run with."""
    workers: int = 1
    """Processes that share the layouts."""
    out: Path = Path("out/safety")
    """Folder of the tables."""
    overwrite: bool = False
    """Replace the results in the output folder."""

    def run(self) -> None:
        """Run the study, and print its tables."""
        from marlbc_mj.studies.runner import run_study
        from marlbc_mj.studies.safety import SafetyStudy

        names = ("missions", "compositions", "layouts", "searched", "seed", "controller")
        settings: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.supervisors is not None:
            settings["supervisors"] = self.supervisors
        study = SafetyStudy(**settings, shields=tuple(shield == "yes" for shield in self.shields))
        with progress_bars() as progress:
            done = run_study(study, self.out, overwrite=self.overwrite, workers=self.workers, progress=progress)
        print(done.report.text)
        print(f"{self.out / 'safety.csv'} has all numbers")
