"""The command line, ``marlbc``. Heavy imports wait until a command needs them, so that help is instant."""

import sys
from typing import Annotated, Any

from tyro.conf import subcommand

from marlbc_mj.cli.benchmark import BenchCommand, EvaluateCommand, RunCommand, SafetyCommand
from marlbc_mj.cli.cache import suggest_cache
from marlbc_mj.cli.ending import in_one_line
from marlbc_mj.cli.export import ExportCommand
from marlbc_mj.cli.learners import ArmsCommand, StudyCommand
from marlbc_mj.cli.listing import ListCommand
from marlbc_mj.cli.measuring import (
    AblationCommand,
    CalibrateCommand,
    CommunicationCommand,
    OracleCommand,
    PerfCommand,
    RegretCommand,
    ScaleCommand,
)
from marlbc_mj.cli.parsing import parse
from marlbc_mj.cli.recordings import LogCommand, VideoCommand, ViewCommand
from marlbc_mj.cli.robot import RobotCommand
from marlbc_mj.cli.ship import ShipCommand
from marlbc_mj.cli.suite import SuiteCommand
from marlbc_mj.cli.terminal import prepare_gl
from marlbc_mj.cli.training import TrainCommand
from marlbc_mj.util.progress import hushed

Command = (
    Annotated[BenchCommand, subcommand("bench")]
    | Annotated[RunCommand, subcommand("run")]
    | Annotated[EvaluateCommand, subcommand("evaluate")]
    | Annotated[SuiteCommand, subcommand("suite")]
    | Annotated[SafetyCommand, subcommand("safety")]
    | Annotated[TrainCommand, subcommand("train")]
    | Annotated[ShipCommand, subcommand("ship")]
    | Annotated[ExportCommand, subcommand("export")]
    | Annotated[StudyCommand, subcommand("study")]
    | Annotated[ArmsCommand, subcommand("arms")]
    | Annotated[VideoCommand, subcommand("video")]
    | Annotated[ViewCommand, subcommand("view")]
    | Annotated[LogCommand, subcommand("log")]
    | Annotated[ListCommand, subcommand("list")]
    | Annotated[RobotCommand, subcommand("robot")]
    | Annotated[PerfCommand, subcommand("perf")]
    | Annotated[ScaleCommand, subcommand("scale")]
    | Annotated[AblationCommand, subcommand("ablation")]
    | Annotated[CommunicationCommand, subcommand("communication")]
    | Annotated[CalibrateCommand, subcommand("calibrate")]
    | Annotated[OracleCommand, subcommand("oracle")]
    | Annotated[RegretCommand, subcommand("regret")]
)

DESCRIPTION = (
    "Benchmark of mission supervisors and controllers for robot teams on MuJoCo physics. Start with: marlbc bench paper. "
    "Version: marlbc --version"
)


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 for a wrong setting, 3 for a failed run, see :func:`~marlbc_mj.cli.ending.in_one_line`."""
    with in_one_line("marlbc"):
        if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
            from marlbc_mj.util.provenance import versions

            print(f"marlbc {versions()['marlbc-mj']}")
            return
        command: Any = parse(Command, arguments, prog="marlbc", description=DESCRIPTION)
        with hushed(command.output.quiet):
            prepare_gl(strict=isinstance(command, VideoCommand))
            command.run()
            suggest_cache()
