"""The command line, ``marlbc``. Heavy imports wait until a command needs them, so that help is instant."""

import io
import re
import sys
from contextlib import redirect_stderr
from typing import Annotated

import tyro
from tyro.conf import subcommand

from marlbc_mj.cli.benchmark import Bench, Run
from marlbc_mj.cli.export import Export
from marlbc_mj.cli.missions import Evaluate, Scale
from marlbc_mj.cli.recordings import Log, Video, View
from marlbc_mj.cli.robot import RobotCommand
from marlbc_mj.cli.ship import Ship
from marlbc_mj.cli.studies import Ablation, Calibrate, ListAll, OracleSearch, Perf
from marlbc_mj.cli.study import Study
from marlbc_mj.cli.terminal import prepare_gl
from marlbc_mj.cli.training import Train
from marlbc_mj.util.errors import MarlbcError
from marlbc_mj.util.text import one_line

Command = (
    Annotated[Bench, subcommand("bench")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Ship, subcommand("ship")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Study, subcommand("study")]
    | Annotated[Video, subcommand("video")]
    | Annotated[View, subcommand("view")]
    | Annotated[Log, subcommand("log")]
    | Annotated[ListAll, subcommand("list")]
    | Annotated[RobotCommand, subcommand("robot")]
    | Annotated[Perf, subcommand("perf")]
    | Annotated[Scale, subcommand("scale")]
    | Annotated[Ablation, subcommand("ablation")]
    | Annotated[Calibrate, subcommand("calibrate")]
    | Annotated[OracleSearch, subcommand("oracle")]
)

DESCRIPTION = "Benchmark of mission supervisors and controllers for robot teams on MuJoCo physics. Start with: marlbc bench paper"


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 for a wrong setting, 3 for a failed run."""
    command = _parse(arguments)
    try:
        prepare_gl(strict=isinstance(command, Video))
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
    advice = re.search(r"marlbc[\w -]* --help", one_line(parts[-1]))
    if advice:
        kept.append(f"see `{advice[0]}`")
    text = "; ".join(one_line(part).rstrip(".:") for part in kept)
    return re.sub(r" ([.,])", r"\1", text)
