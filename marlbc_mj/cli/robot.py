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
    """Check whether a robot meets the requirements of a mission; the exit status is 1 if a check fails."""

    file: Positional[RobotName]
    """Robot: its name, MJCF file or Python file."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Print one line per check."""
        from marlbc_mj.studies.robot_check import checklist

        items = []
        for item in checklist(self.file):
            self.output.say(f"{'ok  ' if item.passed else 'FAIL'}  {item.name:<10}  {item.detail}")
            items.append(item)
        self.output.report("", items)
        if not all(item.passed for item in items):
            sys.exit(1)


@dataclass(frozen=True)
class RobotGateCommand:
    """Fly the gate mission, scaled to each robot, under several supervisors; writes a table, stills and clips.

    Look-ahead and the general policy fly under the set-based composition, the others under the null-space one.
    """

    robots: RobotNames = ()
    """Robots to fly; by default all but the point mass."""
    supervisors: GateSupervisorNames = ()
    """Supervisors to run; by default all. Stills and clips show the episodes of the first one."""
    controller: GateControllerName = "pd"
    """Controller, with the robot's gains."""
    out: Path = Path("out/robots")
    """Folder for gate.md, gate.json, PNG and MP4 files."""
    no_clips: bool = False
    """Leave out stills and clips."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the jobs."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Fly, write the results and print the table; exit with status 3 if an episode failed, which the table shows, too."""
        from marlbc_mj.studies.robot_gate import GATE_METHODS, SHOWN, run_gates

        with self.output.progress() as told:
            done = run_gates(
                self.robots or SHOWN,
                self.supervisors or tuple(GATE_METHODS),
                self.out,
                controller=self.controller,
                clips=not self.no_clips,
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
