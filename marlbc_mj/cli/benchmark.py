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

    By default scripted runs with every controller, and every supervisor with sorlc but those that are to be named: mpcms-mujoco,
    oracle-schedule, fixed, set-based-rule, lookahead, lookahead-distributed, rollout, orca, cbf-qp and marlms-general.
    """

    scenario: Positional[ScenarioName] = "paper"
    """Scenario."""
    supervisors: SomeSupervisors = None
    """Supervisors to run, each with every one of --controllers (scripted, if only those are named)."""
    controllers: SomeControllers = None
    """Controllers to run each supervisor with (sorlc, if only supervisors are named)."""
    out: Path = Path("out/paper")
    """Folder of the results."""
    seed: int = 0
    """Draw of the scenario; every seed is the same where nothing is perturbed."""
    seeds: SomeCount = None
    """Number of draws around the scenario, from --seed on: tables with intervals instead of logs and videos."""
    drag_range: SomeRange = None
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
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Run the matrix, then say where the results are and what they are."""
        if self.seeds is None:
            self._run_once()
        else:
            self._run_draws()
        self.output.say(f"{self.out / 'index.html'} shows it all")

    def _run_once(self) -> None:
        """One episode of every method; the page grows and a line is printed as each ends."""
        from marlbc_mj.results.summary import summary
        from marlbc_mj.studies.bench import run_bench
        from marlbc_mj.util.provenance import versions

        config, scenario = self.config(), self.scenario_drawn()
        with self.output.progress(ends=False) as told:
            counted = _Counted(len(config.methods), told.line)
            results, problems = run_bench(scenario, config, self.out, progress=told.progress, ended=counted.tell)
        self.output.report(lambda: print_results(results), summary(results, scenario.name, versions()))
        for problem in problems:
            print(f"marlbc: {problem}", file=sys.stderr)

    def _run_draws(self) -> None:
        """Every method on the same draws."""
        from marlbc_mj.studies.draws import run_bench_seeds

        with self.output.progress() as told:
            results = run_bench_seeds(self.scenario_drawn(), self.config(), self.out, progress=told.progress)
        self.output.report("", seed_document(results))

    def config(self) -> "BenchConfig":
        """The options under the names that the benchmark gives them."""
        from marlbc_mj.studies.bench import BenchConfig

        return BenchConfig(**{each.name: getattr(self, each.name) for each in fields(BenchConfig) if hasattr(self, each.name)})

    def scenario_drawn(self) -> "Scenario":
        """The scenario with the options' changes, and with the range of factors of its disturbance over draws.

        Raises:
            ConfigurationError: a range without draws.
        """
        from marlbc_mj.studies.draws import with_drag_range

        if self.drag_range is None:
            return self.mission.build(self.scenario)
        if self.seeds is None:
            raise ConfigurationError(f"--drag-range {self.drag_range[0]:g} {self.drag_range[1]:g} needs --seeds")
        return with_drag_range(self.mission.build(self.scenario), self.drag_range)


@dataclass
class _Counted:
    """Says one line per method that has ended."""

    total: int
    line: Callable[[str], None]
    ended: int = 0

    def tell(self, result: "Result") -> None:
        self.ended += 1
        self.line(result_line(result, self.ended, self.total))


def seed_document(results: "SeedResults") -> dict[str, Any]:
    """What summary.json says of many draws."""
    from marlbc_mj.report.seed_files import seed_summary
    from marlbc_mj.results.seed_statistics import analyse
    from marlbc_mj.util.provenance import versions

    return seed_summary(results, analyse(results), versions())


@dataclass(frozen=True)
class RunCommand:
    """Run one episode of one method and log it."""

    scenario: Positional[ScenarioName] = "paper"
    """Scenario."""
    supervisor: SupervisorName = "scripted"
    """Mission supervisor."""
    controller: ControllerName = "sorlc"
    """Controller."""
    out: Path = Path("out/run")
    """Folder of the log, the metrics and the configuration."""
    seed: int = 0
    """Draw of the scenario."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    shield: bool = False
    """Give agents a shield: forces are changed as little as possible, so that they can always stop in time."""
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """One episode, its log and its metrics."""
        from marlbc_mj.results.summary import summary
        from marlbc_mj.studies.bench import run_single
        from marlbc_mj.util.provenance import versions

        scenario = self.mission.build(self.scenario)
        if self.seed > 0 and not scenario.draws:
            note(f"{self.scenario} draws nothing: seed {self.seed} gives the same episode as any other")
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
    """Run supervisors on held-out layouts of a scenario family: success, violation and collision rates with intervals.

    By default every supervisor without learning. Scripted schedules and the oracle's belong to scenarios whose geometry is the
    same for every seed; elsewhere they are reported as failed, with the reason.
    """

    scenario: Positional[ScenarioName] = "field"
    """Scenario that draws layouts."""
    supervisors: SomeSupervisors = None
    """Supervisors to run."""
    controller: ControllerName = "sorlc"
    """Controller they run with."""
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
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Evaluate, and print the table of outcomes."""
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
            results = run_evaluation(self.mission.build(self.scenario), config, self.out, progress=told.progress)
        self.output.report("\n".join(map(to_markdown, outcome_tables(results))), seed_document(results))
        self.output.say(f"{self.out / 'index.html'} shows it all")


@dataclass(frozen=True)
class SafetyCommand:
    """Run supervisors on several missions, under both compositions, without a shield and with one: one table of outcomes.

    Missions are held-out layouts of families, or draws around the case study with its drag multiplied by 0, 2 or 5:
    paper-drag-0, paper-drag-2 and paper-drag-5.
    """

    missions: Positional[MissionNames] = ("field", "forest", "gates", "corridor", "traffic")
    """Scenarios that draw layouts, or draws around the case study."""
    teams: TeamNames = ()
    """Teams that fly the families with the room that they need, as FORMATION-AGENTS; with -lines behind that, they come to their
    column along the lines of its slots. By default each family has its own team."""
    supervisors: SomeSupervisors = None
    """Supervisors to run; by default every one that knows no map beforehand, and scripted."""
    compositions: Compositions = ("null-space", "set-based")
    """How orders become references."""
    shields: tuple[Literal["no", "yes"], ...] = ("no", "yes")
    """Whether agents have a shield."""
    layouts: int = 1000
    """Layouts of every supervisor on every mission."""
    searched: int = 100
    """Layouts of mpcms and rollout, which take seconds each."""
    seed: int = 80_000
    """First seed of the layouts."""
    controller: ControllerName = "sorlc"
    """Controller that all run with."""
    workers: int = 1
    """Processes that share the layouts."""
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
            done = run_study(study, self.out, overwrite=self.overwrite, workers=self.workers, progress=told.progress)
        self.output.report(done.report.text, done.report.document)
        self.output.say(f"{self.out / 'safety.csv'} has all numbers")
