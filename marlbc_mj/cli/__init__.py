"""The command line, ``marlbc``. Heavy imports wait until a command needs them, so that help is instant."""

import sys
from typing import Annotated

import tyro
from tyro.conf import subcommand

from marlbc_mj.cli.benchmark import Bench, Run
from marlbc_mj.cli.recordings import Log, Video, View
from marlbc_mj.cli.studies import Ablation, ListAll, OracleSearch, Perf
from marlbc_mj.errors import MarlbcError
from marlbc_mj.terminal import prepare_gl

Command = (
    Annotated[Bench, subcommand("bench")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Video, subcommand("video")]
    | Annotated[View, subcommand("view")]
    | Annotated[Log, subcommand("log")]
    | Annotated[ListAll, subcommand("list")]
    | Annotated[Perf, subcommand("perf")]
    | Annotated[Ablation, subcommand("ablation")]
    | Annotated[OracleSearch, subcommand("oracle")]
)

DESCRIPTION = "Benchmark of mission supervisors and controllers for robot teams on MuJoCo physics. Start with: marlbc bench paper"


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 for a wrong setting, 3 for a failed run."""
    command = tyro.cli(Command, prog="marlbc", description=DESCRIPTION, args=arguments)
    try:
        prepare_gl(strict=isinstance(command, Video))
        command.run()
    except MarlbcError as error:
        print(f"marlbc: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        print("marlbc: interrupted", file=sys.stderr)
        sys.exit(130)
