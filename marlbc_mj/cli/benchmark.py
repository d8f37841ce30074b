"""``marlbc bench``, ``run``, ``evaluate`` and ``safety``, and the changes to a scenario that they share."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from marlbc_mj.cli.choices import (
    ROBOTS_SETTING,
    Compositions,
    ControllerName,
    MissionNames,
    ScenarioName,
    ScenarioSettings,
    SomeComposition,
    SomeControllers,
    SomeCount,
    SomeDisturbance,
    SomeFormation,
    SomeNumber,
    SomeRange,
    SomeReference,
    SomeRobot,
    SomeSplit,
    SomeSupervisors,
    SupervisorName,
)
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.cli.terminal import print_results, result_line
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.progress import note

if TYPE_CHECKING:
    from marlbc_mj.results.seeds import SeedResults
    from marlbc_mj.results.summary import Result
    from marlbc_mj.scenarios import Scenario
    from marlbc_mj.studies.bench import BenchConfig


@dataclass(frozen=True)
class ScenarioOptions:
    """Changes to the scenario."""

    substep: SomeNumber = None
    """Physics and control step [s]; must divide the mission step of 0.05 s."""
    reference: SomeReference = None
    """Where behaviors are evaluated: at the reference (virtual) or at the measured position (actual)."""
    composition: SomeComposition = None
    """How an order becomes a reference: avoidance as an equality task (null-space) or as an inequality (set-based)."""
    two_sided: bool = False
    """Obstacle avoidance as the published equality task, which also attracts (erratum 6)."""
    disturbance: SomeDisturbance = None
    """Unknown dynamics."""
    drag_scale: SomeNumber = None
    """Multiplies the disturbance."""
    force_limit: SomeNumber = None
    """Actuator limit per axis [N]; laws without limit (see `marlbc list`) ignore it."""
    duration: SomeNumber = None
    """Mission time [s]."""
    robot: SomeRobot = None
    """Robot of every agent; the scenario takes its mass, force and limits."""
    agents: SomeCount = None
    """Size of the team, 2 to 256, for scenarios that are made for any."""
    formation: SomeFormation = None
    """Formation of the team, for the same scenarios."""
    room: bool = False
    """Give a team the room that it needs: from 12 agents on a longer way, a column of several files and wider openings."""
    along_lines: bool = False
    """Agents come to their slots in the column along the slots' lines, not straight: first across the path, then along it."""
    split: SomeSplit = None
    """Layout split to draw from, for scenarios that draw layouts; train, unless a command says otherwise."""
    set: ScenarioSettings = ()
    """Settings of communication and imperfections, and each agent's robot where they differ: communication.range=8
    robots=disc,disc,omni,crazyflie."""

    allow_code: bool = False
    """Run the Python file that a scenario file names as its robot."""

    def build(self, name: str) -> "Scenario":
        """The named scenario with these changes."""
        from marlbc_mj.core.disturbances import make_disturbance
        from marlbc_mj.scenarios import make_scenario
        from marlbc_mj.scenarios.teams import room_for
        from marlbc_mj.util.changes import with_settings

        keys = ("substep", "reference", "composition", "force_limit", "duration", "agents", "formation", "split")
        changes: dict[str, Any] = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        if self.room:
            changes = {**room_for(name, self.formation, self.agents), **changes}
        if self.along_lines:
            changes["column_approach"] = "line"
        if self.two_sided:
            changes["two_sided"] = True
        if self.disturbance is not None or self.drag_scale is not None:
            scale = 1.0 if self.drag_scale is None else self.drag_scale
            changes["disturbance"] = make_disturbance(self.disturbance or "paper", scale)
        settings, robots = self._split_settings()
        scenario = make_scenario(name, allow_code=self.allow_code, **self._robot_changes(name, robots), **changes)
        return with_settings(scenario, settings)

    def _split_settings(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The settings without that of the robots, and the names that it gives: their scale is the scenario's from the start."""
        given = [setting for setting in self.set if setting.partition("=")[0] == ROBOTS_SETTING]
        names = given[-1].partition("=")[2].split(",") if given else []
        return tuple(setting for setting in self.set if setting not in given), tuple(names)

    def _robot_changes(self, name: str, robots: tuple[str, ...]) -> dict[str, Any]:
        """Fields that another robot, or one of each agent's, changes, without those that other options set.

        Raises:
            ConfigurationError: both are given, or a robot that cannot be made.
        """
        from marlbc_mj.robots import make_fleet

        if self.robot is not None and robots:
            raise ConfigurationError(
                f"--robot {self.robot} is every agent's, and robots={','.join(robots)} each agent's; give one"
            )
        if self.robot is None and not robots:
            return {}
        chosen = {"robots": robots} if robots else {"robot": self.robot, "robots": ()}
        if name == "robot_gate":
            return chosen
        scale = make_fleet(robots or (str(self.robot),)).scale()
        return {**{key: value for key, value in scale.items() if getattr(self, key, None) is None}, **chosen}


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
    teams: Annotated[tuple[str, ...], arg(metavar="TEAM ...")] = ()
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
