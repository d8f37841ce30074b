"""``marlbc suite``: supervisors and controllers on a fixed set of missions, and the leaderboard."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import OmitArgPrefixes

from marlbc_mj.cli.choices import (
    SomeCompositions,
    SomeControllers,
    SomeCount,
    SomeSupervisors,
    SuiteMissionNames,
    SuiteSource,
    TrackNames,
)
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.util.errors import ConfigurationError

if TYPE_CHECKING:
    from marlbc_mj.studies.suite.study import SuiteStudy


@dataclass(frozen=True)
class SuiteCommand:
    """Fly supervisors and controllers on a fixed set of missions, and write a leaderboard.

    Tracks: paper, families, teams, robots and control. Every supervisor flies under the compositions that it is meant for;
    the track control compares controllers under one schedule. The whole suite takes days on one core: start with --quick.
    """

    track: TrackNames = ()
    """Tracks to fly; by default all, or with --quick paper, families and control."""
    missions: SuiteMissionNames = ()
    """Missions of these tracks to fly; by default all."""
    supervisors: SomeSupervisors = None
    """Supervisors to fly; by default all but mpcms-mujoco, and with --quick also without mpcms and rollout."""
    controllers: SomeControllers = None
    """Controllers to fly on the track control; by default all."""
    compositions: SomeCompositions = None
    """Compositions for every supervisor; by default those that each is meant for."""
    shield: bool = False
    """Fly every method with a shield as well."""
    quick: bool = False
    """Fly only the first 50 layouts of every mission, without supervisors that search."""
    layouts: SomeCount = None
    """Fly only this many layouts of every mission, the first ones."""
    source: SuiteSource = None
    """Folder of earlier suite results to show next to the new ones."""
    page: bool = False
    """Fly nothing; only write the page for the results in --from."""
    clips: bool = False
    """Render the worst and the median layout of every method."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs; use 1 to measure decision times."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    out: Path = Path("out/suite")
    """Folder for suite.json, a CSV file per track, leaderboard.html and leaderboard.tex."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Fly, then print the first tables and say where the page is."""
        from marlbc_mj.report.leaderboard import LEADERBOARD_PAGE
        from marlbc_mj.studies.runner import counting, run_study

        study = self.study()
        with self.output.progress() as told:
            ended = counting(study.jobs(), lambda job: job.track, told.progress)
            done = run_study(
                study,
                self.out,
                overwrite=self.overwrite,
                workers=self.workers,
                engine=self.engine,
                progress=told.progress,
                ended=ended,
            )
        self.output.report(done.report.text, done.report.document)
        self.output.complain(done.report.problems)
        self.output.say(f"{self.out / LEADERBOARD_PAGE} shows all results")

    def study(self) -> "SuiteStudy":
        """The suite study that the options describe.

        Raises:
            ConfigurationError: incompatible options, unknown names, or earlier results that cannot be compared with these.
        """
        from marlbc_mj.studies.suite.definition import QUICK, QUICK_TRACKS, check_frozen, choose_missions
        from marlbc_mj.studies.suite.entries import Choice
        from marlbc_mj.studies.suite.files import read_suite
        from marlbc_mj.studies.suite.study import SuiteStudy

        if self.page and self.source is None:
            raise ConfigurationError("--page needs --from, the folder with the results to show")
        layouts = QUICK if self.quick and self.layouts is None else self.layouts
        tracks = QUICK_TRACKS if self.quick and not self.track else self.track
        missions = [] if self.page else choose_missions(tracks, self.missions, layouts)
        check_frozen(list(dict.fromkeys(mission.track for mission in missions)))
        choice = Choice(self.supervisors, self.controllers, self.compositions, self.shield, self.quick)
        if self.source is not None:
            read_suite(self.source)  # refuses results that cannot be compared before anything is flown
        return SuiteStudy(tuple(missions), choice, self.source, self.clips)
