"""``marlbc robot check`` and ``gate``: check one robot, or fly robots through their gate mission."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from marlbc_mj.cli.choices import GateControllerName, GateSupervisorNames, RobotName, RobotNames
from marlbc_mj.cli.output import ReportOptions


@dataclass(frozen=True)
class RobotCheckCommand:
    """Go through the checklist of a robot; exit status 1 if something fails."""

    file: Positional[RobotName]
    """A robot's MJCF, Python file, or name."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Print one line per check."""
        from marlbc_mj.studies.robot_check import checklist

        items = []
        for item in checklist(self.file):
            self.output.say(f"{'ok  ' if item.passed else 'FAIL'}  {item.name:<10}  {item.said}")
            items.append(item)
        self.output.report("", items)
        if not all(item.passed for item in items):
            sys.exit(1)


@dataclass(frozen=True)
class RobotGateCommand:
    """Fly the gate mission, scaled to each robot, under scripted, FSAMS with hysteresis and MPCMS: a table, stills and clips."""

    robots: RobotNames = ()
    """Robots; all but the point mass by default."""
    supervisors: GateSupervisorNames = ("scripted", "fsams-hysteresis", "mpcms")
    """Supervisors; the first one's episodes are shown."""
    controller: GateControllerName = "pd"
    """Controller, with the robot's gains."""
    out: Path = Path("out/robots")
    """Folder of gate.md, gate.json, PNG and MP4."""
    clips: bool = True
    """Draw stills and clips."""
    workers: int = 1
    """Processes that share the jobs, or tasks of a SLURM array."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: processes of this machine, Ray (the cluster in RAY_ADDRESS, else this machine), or an array of SLURM."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Fly, write, and print the table.

        Raises:
            SimulationError: a robot is not where its mission is; the table says so, too.
        """
        from marlbc_mj.studies.robot_gate import SHOWN, run_gates

        with self.output.progress() as told:
            done = run_gates(
                self.robots or SHOWN,
                self.supervisors,
                self.out,
                controller=self.controller,
                clips=self.clips,
                overwrite=self.overwrite,
                workers=self.workers,
                engine=self.engine,
                progress=told.progress,
            )
        self.output.report(done.report.text, done.report.document)
        if any(row.failure for row in done.results):
            sys.exit(3)


@dataclass(frozen=True)
class RobotCommand:
    """Check a robot of your own, or fly robots through their gate."""

    action: OmitSubcommandPrefixes[
        Annotated[RobotCheckCommand, subcommand("check")] | Annotated[RobotGateCommand, subcommand("gate")]
    ]

    def run(self) -> None:
        """Run the chosen subcommand."""
        self.action.run()
