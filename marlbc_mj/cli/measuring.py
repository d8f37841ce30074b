"""Commands that measure speed, the effect of single choices, and the distance from the best known return."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import (
    CalibratedNames,
    ControllerName,
    QuestionNames,
    ScenarioName,
    ScenarioNames,
    SomePath,
    SupervisorName,
    SupervisorNames,
)
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.cli.scenario_options import ScenarioOptions


@dataclass(frozen=True)
class PerfCommand:
    """Measure the speed of this machine: bare mj_step, closed loop, Python loop, batches, an episode, a log, training."""

    out: SomePath = None
    """JSON file for the measurements."""
    rounds: int = 9
    """Number of rounds, each of which runs every variant once; results are medians."""
    overwrite: bool = False
    """Replace an existing file."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Measure, print, and write if asked."""
        _check_writable(self.out, overwrite=self.overwrite)
        from marlbc_mj.studies.perf import PerfStudy
        from marlbc_mj.studies.runner import run_jobs

        study = PerfStudy(self.rounds)
        results = run_jobs(study, progress=self.output.lines("measuring "))
        self.output.report(study.report(results, None).text, study.gather(results))
        if self.out is not None:
            study.report(results, self.out)
            self.output.say(self.out)


@dataclass(frozen=True)
class ScaleCommand:
    """Measure the time of a mission step per agent and the memory of a world, for teams of 4 to 256 agents."""

    out: SomePath = None
    """Folder for scale.md, scale.json and figures/scale.{pdf,png}."""
    rounds: int = 7
    """Number of rounds, each of which runs every size once; results are medians."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Measure, print the table, and write table and figure if asked."""
        from marlbc_mj.studies.scale import run_scale

        done = run_scale(self.rounds, self.out, overwrite=self.overwrite, progress=self.output.lines("measuring "))
        self.output.report(done.report.text, done.report.document)
        if self.out is not None:
            self.output.say(f"{self.out} holds table, figures and numbers")


@dataclass(frozen=True)
class AblationCommand:
    """Measure the effect of SORLC's basis, gains and compensator, of the reference mode, of the avoidance and of the substep."""

    study: QuestionNames = ()
    """Studies to run; all of them by default."""
    out: SomePath = None
    """Folder for ablation.md, ablation.csv and index.html."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Run the studies, print their tables, and write the page if asked."""
        from marlbc_mj.studies.ablation import run_ablation, select_questions

        questions = select_questions(self.study)
        with self.output.progress() as told:
            done = run_ablation(
                questions, self.out, overwrite=self.overwrite, workers=self.workers, engine=self.engine, progress=told.progress
            )
        self.output.report(done.report.text, done.report.document)
        if self.out is not None:
            self.output.say(f"{self.out / 'index.html'} shows all results")


@dataclass(frozen=True)
class CommunicationCommand:
    """Measure how range, delay, loss of messages and a silent agent affect a distributed supervisor on held-out layouts.

    Ranges are unlimited, 2 and 1.2 times the distance between neighbors, delays 0, 0.1 and 0.3 s, losses 0, 20 and 50 %.
    """

    missions: Positional[ScenarioNames] = ("gates", "corridor")
    """Scenarios with random layouts."""
    supervisor: SupervisorName = "lookahead-distributed"
    """Distributed supervisor to measure."""
    controller: ControllerName = "sorlc"
    """Controller that the supervisor runs with."""
    seeds: int = 40
    """Number of held-out layouts."""
    seed: int = 65000
    """Seed of the first layout."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    agreement: bool = False
    """Only measure how long agents take to agree by flooding and by consensus; writes no files."""
    out: Path = Path("out/communication")
    """Folder for communication.csv and config.json."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    shield: bool = False
    """Give agents a shield, which changes forces where needed so that agents can always stop in time."""
    mission: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Fly all cases, write their numbers, and print the table."""
        from marlbc_mj.report.table import table_document, to_markdown
        from marlbc_mj.results.seeds import seed_range
        from marlbc_mj.scenarios import held_out
        from marlbc_mj.studies.communication import CommunicationStudy, agreement_table
        from marlbc_mj.studies.runner import counting, run_study

        if self.agreement:
            table = agreement_table()
            self.output.report(to_markdown(table), table_document(table))
            return
        missions = tuple(held_out(self.mission.build(name)) for name in self.missions)
        seeds = seed_range(self.seeds, self.seed)
        study = CommunicationStudy(missions, self.supervisor, seeds, self.controller, self.shield)
        with self.output.progress() as told:
            ended = counting(study.jobs(), lambda job: job.scenario.name, told.progress)
            done = run_study(study, self.out, overwrite=self.overwrite, workers=self.workers, engine=self.engine, ended=ended)
        self.output.report(done.report.text, done.report.document)
        self.output.say(f"{self.out / 'communication.csv'} holds the numbers")


@dataclass(frozen=True)
class CalibrateCommand:
    """Find the velocity gains that reproduce the largest forces published in Table 6, and compare them with the shipped gains."""

    controllers: CalibratedNames = ("finite-time", "fixed-time")
    """Controllers to calibrate."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Search and print the table."""
        from marlbc_mj.studies.calibration import CalibrationStudy
        from marlbc_mj.studies.runner import run_study

        with self.output.progress() as told:
            done = run_study(CalibrationStudy(self.controllers), None, progress=told.progress)
        self.output.report(done.report.text, done.report.document)


@dataclass(frozen=True)
class OracleCommand:
    """Search for the best safe switch times in simulation, for the supervisor oracle; takes minutes."""

    scenario: ScenarioName = "paper"
    """Scenario to search on."""
    controller: ControllerName = "sorlc"
    """Controller that tracks the references."""
    seed: int = 0
    """Random seed of the schedule search."""
    budget: int = 4096
    """Most episodes that the search simulates."""
    threads: int = 2
    """Number of threads for the simulation."""
    out: SomePath = None
    """File of schedules to which the result is added; by default the one shipped with the package."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Search, save the schedule, and print its return."""
        _check_writable(self.out, overwrite=True)
        from marlbc_mj.scenarios import make_scenario
        from marlbc_mj.supervisors.oracle import save_schedule, search

        scenario = make_scenario(self.scenario)
        with self.output.progress() as told:
            found = search(
                scenario,
                self.controller,
                seed=self.seed,
                budget=self.budget,
                threads=self.threads,
                progress=lambda done, total: told.progress("search", done, self.budget),
            )
        save_schedule(found, scenario, self.controller, self.out)
        text = f"return {found.total:.0f} after {found.episodes} episodes (schedule of the scenario: {found.scripted})"
        self.output.report(text, {"return": found.total, "episodes": found.episodes, "scripted": found.scripted})


@dataclass(frozen=True)
class RegretCommand:
    """Compare supervisors with the best schedule that a search finds for each held-out layout; takes half a minute per layout."""

    missions: Positional[ScenarioNames] = ("field", "forest", "gates", "corridor")
    """Scenarios with random layouts of obstacles at rest; flown under the set-based composition."""
    supervisors: SupervisorNames = ("marlms-general", "rollout", "lookahead", "fixed")
    """Supervisors to compare; the search starts from the best of their flights."""
    layouts: int = 50
    """Layouts per mission."""
    seed: int = 90_000
    """Seed of the first layout."""
    budget: int = 512
    """Most episodes that the search simulates per layout."""
    controller: ControllerName = "sorlc"
    """Controller that tracks the references."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    out: Path = Path("out/regret")
    """Folder for regret.csv, regret.md and config.json."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Fly and search, write the numbers, and print the table."""
        from marlbc_mj.studies.regret import RegretStudy
        from marlbc_mj.studies.runner import counting, run_study

        study = RegretStudy(self.missions, self.supervisors, self.layouts, self.seed, self.budget, self.controller)
        with self.output.progress() as told:
            ended = counting(study.jobs(), lambda job: job.mission, told.progress)
            done = run_study(study, self.out, overwrite=self.overwrite, workers=self.workers, engine=self.engine, ended=ended)
        self.output.report(done.report.text, done.report.document)
        self.output.say(f"{self.out / 'regret.csv'} holds the numbers")


def _check_writable(out: Path | None, *, overwrite: bool) -> None:
    """Refuse a file that cannot be written, before the modules that measure or search are loaded."""
    from marlbc_mj.util.files import check_writable

    if out is not None:
        check_writable(out, overwrite=overwrite)
