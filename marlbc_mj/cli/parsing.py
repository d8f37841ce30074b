"""From arguments to a command: tyro parses, and what it refuses is said in one line."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import is_dataclass
from difflib import SequenceMatcher
from typing import Any, NamedTuple, get_args, get_type_hints

import tyro
from tyro.conf import Positional

from marlbc_mj.util.text import one_line

ALIKE = 0.8  # likeness from which an option is suggested
MOST_SUGGESTED = 3


class Refusal(NamedTuple):
    """What is wrong with the arguments, and the command whose help tells more."""

    said: str
    command: str


def parse(commands: Any, arguments: Sequence[str] | None, *, prog: str, description: str) -> Any:
    """The command that the arguments spell; exits with 2 after one line about arguments that spell none.

    tyro tells its hook what is wrong. The hook is not part of tyro's stable interface: without it, or for an event of a new kind,
    tyro's own box is shown, with the same exit status.

    Args:
        commands: union of dataclasses, each annotated with its subcommand.
        arguments: of the command line; None: those of this process.
        prog: name of the program.
        description: first line of the help.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)

    def refuse(event: Any) -> None:
        refusal = _refusal(event, commands, given)
        if refusal is not None:
            print(f"{prog}: {one_line(refusal.said)}; see `{refusal.command} --help`", file=sys.stderr)
            sys.exit(2)

    hook = getattr(getattr(tyro, "_errors", None), "on_parse_error", None)
    with nullcontext() if hook is None else hook(refuse):
        return tyro.cli(commands, prog=prog, description=description, args=given)


def _refusal(event: Any, commands: Any, given: Sequence[str]) -> Refusal | None:
    """The event in words; None for a kind that is not known here."""
    match type(event).__name__:
        case "MissingSubcommand":
            said = f"Expected one of {{{', '.join(event.subcommand_spec.parser_from_name)}}}"
        case "MissingArgs":
            missing = [f"{each.arg.lowered.metavar} {_name(each.arg)}" for each in event.missing_arguments]
            command = f"{event.prog} {event.missing_arguments[0].source_parser.prog_suffix}".strip()
            return Refusal(f"Missing from {command}: {', '.join(missing)}", command)
        case "BadValue" if event.reason == "too_few_values":
            said = f"Missing value for argument {_name(event.argument)!r}. Expected {event.argument.lowered.nargs} values"
        case "InvalidChoice":
            said = f"invalid choice {event.value!r} for argument {_name(event.argument)!r}. Expected one of {event.choices}"
        case "InstantiationFailure" if event.argument is not None:
            said = f"Error parsing {_name(event.argument)}: {event.message}"
        case "UnrecognizedArgs":
            said = f"Unrecognized options: {', '.join(event.tokens)}{_suggestion(event.tokens, commands, given)}"
        case _:
            return None
    return Refusal(said, event.prog)


def _name(argument: Any) -> str:
    """``--seed`` of an option, ``out`` of a positional argument."""
    return str(argument.display_name()).rpartition(".")[2]


def _suggestion(tokens: Sequence[str], commands: Any, given: Sequence[str]) -> str:
    """The subcommands where none has been chosen, and options that are spelled like an unknown one."""
    level = subcommands_of(commands)
    for word in given:
        if word not in level:
            break
        level = subcommands_of(level[word])
    listed = f"; Available subcommands: {', '.join(level)}" if level else ""
    unknown = [token for token in tokens if token.startswith("--")]
    scores = {
        name: max(SequenceMatcher(a=token, b=name).ratio() for token in unknown) for name in options_of(commands) if unknown
    }
    close = sorted((name for name in scores if scores[name] >= ALIKE), key=lambda name: (-scores[name], name))
    return listed + (f"; perhaps {', '.join(close[:MOST_SUGGESTED])}" if close else "")


def subcommands_of(kind: Any) -> dict[str, Any]:
    """Dataclasses by subcommand, of a union or of the field of a dataclass that is one; empty for a command without."""
    if is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        return subcommands_of(get_args(hints["action"])[0]) if "action" in hints else {}
    members = [get_args(member) for member in get_args(kind)]
    return {mark.name: member for member, *marks in members for mark in marks}


def options_of(kind: Any) -> Iterator[str]:
    """Spelling of every option of a command or a union of commands, once or more often."""
    for command in subcommands_of(kind).values():
        yield from options_of(command)
    if not is_dataclass(kind):
        return
    for name, hint in get_type_hints(kind, include_extras=True).items():  # Annotated[kind, mark, ...] or a kind
        inner, *marks = get_args(hint) or (hint,)
        if is_dataclass(inner):
            yield from options_of(inner)
        elif name != "action" and _POSITIONAL not in marks:
            renamed = [mark.name for mark in marks if isinstance(getattr(mark, "name", None), str)]
            spelled = (renamed or [name])[0].replace("_", "-")
            yield from (f"--{spelled}", f"--no-{spelled}") if inner is bool else (f"--{spelled}",)


_POSITIONAL = get_args(Positional[int])[1]
