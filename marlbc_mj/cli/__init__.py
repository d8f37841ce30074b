"""The command line, ``marlbc``. Heavy imports wait until a command needs them, so that help is instant."""

import io
import re
import sys
from contextlib import redirect_stderr
from typing import Annotated

import tyro
from tyro.conf import subcommand

from marlbc_mj.cli.benchmark import BenchCommand, EvaluateCommand, RunCommand
from marlbc_mj.cli.export import ExportCommand
from marlbc_mj.cli.learners import StudyCommand
from marlbc_mj.cli.listing import ListCommand
from marlbc_mj.cli.measuring import AblationCommand, CalibrateCommand, OracleCommand, PerfCommand, ScaleCommand
from marlbc_mj.cli.recordings import LogCommand, VideoCommand, ViewCommand
from marlbc_mj.cli.robot import RobotCommand
from marlbc_mj.cli.ship import ShipCommand
from marlbc_mj.cli.terminal import prepare_gl
from marlbc_mj.cli.training import TrainCommand
from marlbc_mj.util.errors import MarlbcError

Command = (
    Annotated[BenchCommand, subcommand("bench")]
    | Annotated[RunCommand, subcommand("run")]
    | Annotated[EvaluateCommand, subcommand("evaluate")]
    | Annotated[TrainCommand, subcommand("train")]
    | Annotated[ShipCommand, subcommand("ship")]
    | Annotated[ExportCommand, subcommand("export")]
    | Annotated[StudyCommand, subcommand("study")]
    | Annotated[VideoCommand, subcommand("video")]
    | Annotated[ViewCommand, subcommand("view")]
    | Annotated[LogCommand, subcommand("log")]
    | Annotated[ListCommand, subcommand("list")]
    | Annotated[RobotCommand, subcommand("robot")]
    | Annotated[PerfCommand, subcommand("perf")]
    | Annotated[ScaleCommand, subcommand("scale")]
    | Annotated[AblationCommand, subcommand("ablation")]
    | Annotated[CalibrateCommand, subcommand("calibrate")]
    | Annotated[OracleCommand, subcommand("oracle")]
)

DESCRIPTION = "Benchmark of mission supervisors and controllers for robot teams on MuJoCo physics. Start with: marlbc bench paper"


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 for a wrong setting, 3 for a failed run."""
    command = _parse(arguments)
    try:
        prepare_gl(strict=isinstance(command, VideoCommand))
        command.run()
    except MarlbcError as error:
        print(f"marlbc: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        print("marlbc: interrupted", file=sys.stderr)
        sys.exit(130)


def _parse(arguments: list[str] | None) -> Command:
    """The command that the arguments spell; what tyro would say about wrong ones in a box becomes one line."""
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            command: Command = tyro.cli(Command, prog="marlbc", description=DESCRIPTION, args=arguments)
    except SystemExit as stopped:
        if stopped.code in (None, 0):  # help was asked for and printed
            raise
        print(f"marlbc: {_one_line(said.getvalue())}", file=sys.stderr)
        sys.exit(2)
    return command


def _one_line(box: str) -> str:
    """Text of tyro's box: what is wrong, the subcommands or options there are, and where help is.

    Rules part the box. Of the first part its first paragraph is kept, of one that explains options their names. A terminal
    without UTF-8 gets a title and a rule in place of the frame.
    """
    lines = [line.strip("│ ") for line in box.splitlines()]
    ruled = "\n".join(line for line in lines[1:] if not line.startswith("╰"))
    parts = [part.strip() for part in re.split(r"^(?:─+|-+)$", ruled, flags=re.MULTILINE) if part.strip()]
    kept = [parts[0].split("\n\n")[0]]
    for part in parts[1:]:
        if part.startswith("Available subcommands"):
            kept.append(part)
        elif part.startswith("Perhaps you meant"):
            kept.append("perhaps " + ", ".join(dict.fromkeys(re.findall(r"^--[\w-]+", part, re.MULTILINE))))
    advice = re.search(r"marlbc[\w -]* --help", " ".join(parts[-1].split()))
    if advice:
        kept.append(f"see `{advice[0]}`")
    text = "; ".join(" ".join(part.split()).rstrip(".:") for part in kept)
    return re.sub(r" ([.,])", r"\1", text)
