"""``marlbc bench``, ``run``, ``evaluate`` and ``safety``."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import (
    Compositions,
    ControllerName,
    MissionNames,
    ScenarioName,
    SomeControllers,
    SomeCount,
    SomeRange,
    SomeSupervisors,
    SupervisorName,
    TeamNames,
)
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.cli.scenario_options import ScenarioOptions
from marlbc_mj.cli.terminal import print_results, result_line
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.progress import note

if TYPE_CHECKING:
    from marlbc_mj.results.seeds import SeedResults
    from marlbc_mj.results.summary import Result
    from marlbc_mj.scenarios import Scenario
    from marlbc_mj.studies.bench import BenchConfig


@dataclass(frozen=True)
class BenchCommand:
    """Run supervisors and controllers on one scenario and write tables, figures, logs, a video and a page.

    By default scripted runs with every controller, and every supervisor with sorlc except those that run only if named:
    mpcms-mujoco, oracle-schedule, fixed, set-based-rule, lookahead, lookahead-distributed, rollout, orca, cbf-qp, marlms-general.
    """

    scenario: Positional[ScenarioName] = "paper"
    """Scenario to run."""
    supervisors: SomeSupervisors = None
    """Supervisors to run, each with all --controllers; scripted, if only controllers are named."""
    controllers: SomeControllers = None
    """Controllers to run with each supervisor; sorlc, if only supervisors are named."""
    out: Path = Path("out/paper")
    """Folder of the results."""
    seed: int = 0
    """Seed of the scenario's random draw; if nothing is perturbed, all seeds give the same episode."""
    seeds: SomeCount = None
    """Run this many random draws of the scenario, from --seed on; writes tables with intervals instead of logs and videos."""
    drag_range: SomeRange = None
    """With --seeds, the range of a random factor on the disturbance; 5 5 fixes it at 5. For the case study 0 2 by default."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs; use 1 to measure decision times."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    video: Literal["first", "all", "none"] = "first"
    """Which methods get a video."""
    no_figures: bool = False
    """Leave out the figures."""
    no_logs: bool = False
    """Leave out the MCAP logs of the episodes."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    shield: bool = False
    """Give agents a shield, which changes forces where needed so that agents can always stop in time."""
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Run all methods, then print the results and where they are."""
        if self.seeds is None:
            self._run_once()
        else:
            self._run_draws()
        self.output.say(f"{self.out / 'index.html'} shows all results")

    def _run_once(self) -> None:
        """Run one episode of every method; as each ends, print a line and add it to the page."""
        scenario = self.scenario_drawn()
        from marlbc_mj.results.summary import summary
        from marlbc_mj.studies.bench import run_bench
        from marlbc_mj.util.provenance import versions

        config = self.config()
        with self.output.progress(ends=False) as told:
            counted = _Counted(len(config.methods), told.line)
            results, problems = run_bench(scenario, config, self.out, progress=told.progress, ended=counted.tell)
        self.output.report(lambda: print_results(results), summary(results, scenario.name, versions()))
        self.output.complain(problems)

    def _run_draws(self) -> None:
        """Run every method on the same draws."""
        scenario = self.scenario_drawn()
        from marlbc_mj.studies.draws import run_bench_seeds

        with self.output.progress() as told:
            results = run_bench_seeds(scenario, self.config(), self.out, progress=told.progress)
        self.output.report("", seed_document(results))

    def config(self) -> "BenchConfig":
        """The configuration of the benchmark, made from the options."""
        from marlbc_mj.studies.bench import BenchConfig

        given = {each.name: getattr(self, each.name) for each in fields(BenchConfig) if hasattr(self, each.name)}
        return BenchConfig(**given, figures=not self.no_figures, logs=not self.no_logs)

    def scenario_drawn(self) -> "Scenario":
        """The scenario with the changes of the options, including --drag-range.

        Raises:
            ConfigurationError: --drag-range without --seeds.
        """
        if self.drag_range is None:
            return self.mission.build(self.scenario)
        if self.seeds is None:
            raise ConfigurationError(f"--drag-range {self.drag_range[0]:g} {self.drag_range[1]:g} needs --seeds")
        scenario = self.mission.build(self.scenario)
        from marlbc_mj.studies.draws import with_drag_range

        return with_drag_range(scenario, self.drag_range)


@dataclass
class _Counted:
    """Prints one line per method that has ended."""

    total: int
    line: Callable[[str], None]
    ended: int = 0

    def tell(self, result: "Result") -> None:
        self.ended += 1
        self.line(result_line(result, self.ended, self.total))


def seed_document(results: "SeedResults") -> dict[str, Any]:
    """The content of summary.json for many draws."""
    from marlbc_mj.report.seed_files import seed_summary
    from marlbc_mj.results.seed_statistics import analyse
    from marlbc_mj.util.provenance import versions

    return seed_summary(results, analyse(results), versions())


@dataclass(frozen=True)
class RunCommand:
    """Run one episode of one method and log it."""

    scenario: Positional[ScenarioName] = "paper"
    """Scenario to run."""
    supervisor: SupervisorName = "scripted"
    """Mission supervisor."""
    controller: ControllerName = "sorlc"
    """Controller that tracks the references."""
    out: Path = Path("out/run")
    """Folder of the log, the metrics and the configuration."""
    seed: int = 0
    """Seed of the scenario's random draw."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    shield: bool = False
    """Give agents a shield, which changes forces where needed so that agents can always stop in time."""
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Run the episode, write its log and metrics, and print the result."""
        scenario = self.mission.build(self.scenario)
        from marlbc_mj.results.summary import summary
        from marlbc_mj.studies.bench import run_single
        from marlbc_mj.util.provenance import versions

        if self.seed > 0 and not scenario.draws:
            note(f"{self.scenario} has nothing random: seed {self.seed} gives the same episode as any other seed")
        with self.output.progress(ends=False) as told:
            result = run_single(
                scenario,
                self.supervisor,
                self.controller,
                self.out,
                seed=self.seed,
                overwrite=self.overwrite,
                shield=self.shield,
                progress=told.progress,
            )
        self.output.report(lambda: print_results([result]), summary([result], scenario.name, versions()))
        self.output.say(f"{self.out} holds the log, the metrics and the configuration")


@dataclass(frozen=True)
class EvaluateCommand:
    """Run supervisors on held-out layouts of a scenario family and report success, violation and collision rates with intervals.

    By default all supervisors run that `marlbc bench` runs, except the learned ones. The schedules of scripted and oracle need a
    scenario with the same geometry for every seed; elsewhere these two are reported as failed, with the reason.
    """

    scenario: Positional[ScenarioName] = "field"
    """Scenario with random layouts."""
    supervisors: SomeSupervisors = None
    """Supervisors to run."""
    controller: ControllerName = "sorlc"
    """Controller that all supervisors run with."""
    seeds: int = 200
    """Number of held-out layouts."""
    seed: int = 0
    """Seed of the first layout."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs; use 1 to measure decision times."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    out: Path = Path("out/evaluation")
    """Folder of the results."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    shield: bool = False
    """Give agents a shield, which changes forces where needed so that agents can always stop in time."""
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Evaluate, and print the table of outcomes; exit with status 3 if no mission could be flown to its end."""
        scenario = self.mission.build(self.scenario)
        from marlbc_mj.report.seed_tables import outcome_tables
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
        with self.output.progress() as told:
            results = run_evaluation(scenario, config, self.out, progress=told.progress)
        self.output.report("\n".join(map(to_markdown, outcome_tables(results))), seed_document(results))
        self.output.complain(failures_of(results))
        self.output.say(f"{self.out / 'index.html'} shows all results")
        if all(len(method.failed) == len(method.runs) for method in results.methods):
            sys.exit(3)


def failures_of(results: "SeedResults") -> list[str]:
    """One line for every method that failed on some layouts: how many, and the first reason."""
    return [
        f"{method.supervisor} failed on {len(method.failed)} of {len(method.runs)} layouts: {method.failed[0].failure}"
        for method in results.methods
        if method.failed
    ]


@dataclass(frozen=True)
class SafetyCommand:
    """Run supervisors on several missions, under both compositions, without a shield and with one, and write tables of outcomes.

    Missions are held-out layouts of families, or random draws of the case study with its drag multiplied by 0, 2 or 5:
    paper-drag-0, paper-drag-2 and paper-drag-5.
    """

    missions: Positional[MissionNames] = ("field", "forest", "gates", "corridor", "traffic")
    """Scenarios with random layouts, or random draws of the case study."""
    teams: TeamNames = ()
    """Teams to fly instead of each family's own, as FORMATION-AGENTS, for example wedge-16; large teams get more room. With
    -lines appended, agents join the column along the lines of its slots."""
    supervisors: SomeSupervisors = None
    """Supervisors to run; by default all but oracle, oracle-schedule, mpcms-mujoco and rlms."""
    compositions: Compositions = ("null-space", "set-based")
    """How orders become references."""
    shields: tuple[Literal["no", "yes"], ...] = ("no", "yes")
    """Whether agents have a shield."""
    layouts: int = 1000
    """Layouts per supervisor and mission."""
    searched: int = 100
    """Layouts per mission for mpcms and rollout, which take about a second per layout."""
    seed: int = 80_000
    """Seed of the first layout."""
    controller: ControllerName = "sorlc"
    """Controller that all supervisors run with."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    out: Path = Path("out/safety")
    """Folder of the tables."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Run the study, and print its tables."""
        from marlbc_mj.studies.runner import run_study
        from marlbc_mj.studies.safety import SafetyStudy

        names = ("missions", "compositions", "layouts", "searched", "seed", "controller")
        settings: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.supervisors is not None:
            settings["supervisors"] = self.supervisors
        if self.teams:
            settings["missions"] = tuple(f"{mission}-{team}" for team in self.teams for mission in self.missions)
        study = SafetyStudy(**settings, shields=tuple(shield == "yes" for shield in self.shields))
        with self.output.progress() as told:
            done = run_study(
                study, self.out, overwrite=self.overwrite, workers=self.workers, engine=self.engine, progress=told.progress
            )
        self.output.report(done.report.text, done.report.document)
        self.output.say(f"{self.out / 'safety.csv'} has all numbers")
