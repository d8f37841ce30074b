"""Turns arguments into a command: tyro parses them, and its errors are reported in one line.

Words that select a command are looked up here, so that tyro makes only the parser of that command.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff, Positional
from tyro.constructors import PrimitiveConstructorSpec

from marlbc_mj.cli.choices import WrongWord
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.text import nearest_word, one_line

MINIMUMS = {"--seed": 0, "--seeds": 1, "--layouts": 1, "--workers": 1, "--agents": 2}
"""Smallest values of options that have the same meaning in every command."""
_WITHOUT_COMMAND = ("-h", "--help", "--tyro-print-completion", "--tyro-write-completion")
_NUMBERS = {int: "a whole number", float: "a number"}
ABOVE_ZERO = ("--duration", "--substep")
"""Options whose value, a time, must be above zero in every command."""


class Refusal(NamedTuple):
    """The error in the arguments, and the command whose help explains more."""

    message: str
    command: str


class Chosen(NamedTuple):
    """A command or a union of commands, and the remaining arguments."""

    kind: Any
    prog: str
    rest: list[str]


def parse(commands: Any, arguments: Sequence[str] | None, *, prog: str, description: str) -> Any:
    """Make the command that the arguments describe; for invalid arguments, print one line and exit with 2.

    tyro reports errors to a hook, which is not part of its stable interface. Without the hook, or for a new kind of event, tyro
    shows its own error box and exits with the same status.

    Args:
        commands: union of dataclasses, each annotated with its subcommand.
        arguments: arguments of the command line; None: those of this process.
        prog: name of the program.
        description: first line of the help.

    Raises:
        ConfigurationError: an invalid word.
    """
    chosen = choose_command(commands, sys.argv[1:] if arguments is None else list(arguments), prog)
    refusal = _refused_word(chosen)
    if refusal is not None:
        _exit(prog, refusal)

    def refuse(event: Any) -> None:
        refusal = _refusal(event, chosen.kind)
        if refusal is not None:
            _exit(prog, refusal)

    hook = getattr(getattr(tyro, "_errors", None), "on_parse_error", None)
    about = description if chosen.kind is commands else None
    try:
        check_words(chosen)
        with nullcontext() if hook is None else hook(refuse):
            return _of_tyro(chosen, about)
    except WrongWord as wrong:
        raise wrong.error from None


def _of_tyro(chosen: Chosen, description: str | None) -> Any:
    return tyro.cli(chosen.kind, prog=chosen.prog, description=description, args=chosen.rest, config=(FlagCreatePairsOff,))


def choose_command(commands: Any, given: list[str], prog: str) -> Chosen:
    """The command that the first words select."""
    chosen = Chosen(commands, prog, given)
    while chosen.rest and (known := subcommands_of(chosen.kind)) and chosen.rest[0] in known:
        word, *rest = chosen.rest
        chosen = Chosen(known[word], f"{chosen.prog} {word}", rest)
    return chosen


def check_words(chosen: Chosen) -> None:
    """Check names and numbers in the arguments. tyro does so, too, but takes half a second to load other packages first.

    Raises:
        WrongWord: an invalid word.
    """
    if not is_dataclass(chosen.kind):
        return
    hints = dict(_named_options(chosen.kind))
    own = get_type_hints(chosen.kind, include_extras=True).values()
    hint: Any = next((each for each in own if _POSITIONAL in get_args(each)[1:]), None)
    name = ""
    for word in chosen.rest:
        if word.startswith("--"):
            name, equals, value = word.partition("=")
            hint, words = hints.get(name.replace("_", "-")), [value] if equals else []
        else:
            words = [word]
        if words:
            check_number(name, words[0], hint)
            check_least(name, words[0])
        constructor = _constructor_of(hint)
        if words and constructor is not None:
            constructor.instance_from_str(words)
            hint = hint if _is_tuple(hint) else None


def check_least(option: str, word: str) -> None:
    """Raise WrongWord for a number below the minimum of an option. The code that uses it checks it, too, once it is loaded."""
    if option in ABOVE_ZERO and (number := _number(word)) is not None and number <= 0.0:
        raise WrongWord(ConfigurationError(f"{option.removeprefix('--')} must be positive and finite, got {number}"))
    least = MINIMUMS.get(option)
    if least is None or not word.removeprefix("-").isdecimal() or int(word) >= least:
        return
    bound = f"must be at least {least}" if least else "must not be negative"
    raise WrongWord(ConfigurationError(f"{option.removeprefix('--')} {bound}, got {int(word)}"))


def check_number(option: str, word: str, hint: Any) -> None:
    """Raise WrongWord for a word that is not a number, where an option takes one, or that is empty, where it takes anything."""
    kinds = {kind for kind in _kinds_of(hint) if kind in _NUMBERS}
    if option and not word:
        raise WrongWord(ConfigurationError(f"{option} must not be empty"))
    if kinds and _number(word) is None:
        raise WrongWord(ConfigurationError(f"{option} must be {_NUMBERS[kinds.pop()]}, got {word!r}"))
    if kinds == {int} and not word.removeprefix("-").isdecimal():
        raise WrongWord(ConfigurationError(f"{option} must be {_NUMBERS[int]}, got {word!r}"))


def _kinds_of(hint: Any) -> Iterator[Any]:
    """All types in a field's annotation."""
    yield hint
    for part in get_args(hint):
        yield from _kinds_of(part)


def _number(word: str) -> float | None:
    """A word as a number; None if it is not a number."""
    try:
        return float(word)
    except ValueError:
        return None


def _constructor_of(hint: Any) -> PrimitiveConstructorSpec[Any] | None:
    """The constructor in a field's annotation that converts words, if any. Paths are left to tyro, which counts words first."""
    for part in () if Path in get_args(hint) else get_args(hint):
        found = part if isinstance(part, PrimitiveConstructorSpec) else _constructor_of(part)
        if found is not None:
            return found
    return None


def _is_tuple(hint: Any) -> bool:
    """Whether a field accepts several words."""
    return get_origin(hint) is tuple or any(map(_is_tuple, get_args(hint)))


def _refused_word(chosen: Chosen) -> Refusal | None:
    """The error if a subcommand is missing or unknown; None if there is no error, or if tyro reports it."""
    known = subcommands_of(chosen.kind)
    if not known:
        return None
    listed = ", ".join(known)
    if not chosen.rest:
        return Refusal(f"Expected one of {{{listed}}}", chosen.prog)
    option = chosen.rest[0].partition("=")[0]
    if option in _WITHOUT_COMMAND:
        return None
    if option in options_of(chosen.kind):
        return Refusal(f"{option} must come after the command; choose from: {listed}", chosen.prog)
    if option.startswith("-"):
        like = nearest_word(option, ("--help", "--version"))
        perhaps = f" perhaps {like};" if like else ""
        return Refusal(f"unknown option {option};{perhaps} commands: {listed}", chosen.prog)
    like = nearest_word(chosen.rest[0], known)
    perhaps = f" perhaps {like!r};" if like else ""
    return Refusal(f"unknown command {chosen.rest[0]!r};{perhaps} choose from: {listed}", chosen.prog)


def _exit(prog: str, refusal: Refusal) -> None:
    print(f"{prog}: {one_line(refusal.message)}; see `{refusal.command} --help`", file=sys.stderr)
    sys.exit(2)


def _refusal(event: Any, kind: Any) -> Refusal | None:
    """The error that an event of tyro describes; None for an unknown kind of event."""
    match type(event).__name__:
        case "MissingSubcommand":
            said = f"Expected one of {{{', '.join(event.subcommand_spec.parser_from_name)}}}"
        case "MissingArgs":
            missing = [f"{each.arg.lowered.metavar} {_name(each.arg)}" for each in event.missing_arguments]
            command = f"{event.prog} {event.missing_arguments[0].source_parser.prog_suffix}".strip()
            return Refusal(f"Missing from {command}: {', '.join(missing)}", command)
        case "BadValue" if event.reason == "too_few_values":
            said = f"Missing value for argument {_name(event.argument)!r}"
        case "InvalidChoice":
            like = nearest_word(str(event.value), map(str, event.choices))
            perhaps = f"; perhaps {like!r}" if like else ""
            said = (
                f"invalid choice {event.value!r} for argument {_name(event.argument)!r}{perhaps}. Expected one of {event.choices}"
            )
        case "InstantiationFailure" if event.argument is not None:
            said = f"Error parsing {_name(event.argument)}: {event.message}"
        case "UnrecognizedArgs":
            said = f"Unrecognized options: {', '.join(event.tokens)}{_suggestion(event.tokens, kind)}"
        case _:
            return None
    return Refusal(said, event.prog)


def _name(argument: Any) -> str:
    """The name to show: ``--seed`` for an option, ``out`` for a positional argument."""
    return str(argument.display_name()).rpartition(".")[2]


def _suggestion(tokens: Sequence[str], kind: Any) -> str:
    """Text that suggests options with a spelling similar to that of unknown ones."""
    known = list(dict.fromkeys(options_of(kind)))
    like = [nearest_word(token.partition("=")[0], known) for token in tokens if token.startswith("--")]
    found = list(dict.fromkeys(name for name in like if name is not None))
    return f"; perhaps {', '.join(found)}" if found else ""


def subcommands_of(kind: Any) -> dict[str, Any]:
    """Dataclasses by subcommand, of a union or of a dataclass with an ``action``; empty for a command without subcommands."""
    if is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        return subcommands_of(get_args(hints["action"])[0]) if "action" in hints else {}
    members = [get_args(member) for member in get_args(kind)]
    return {mark.name: member for member, *marks in members for mark in marks}


def options_of(kind: Any) -> Iterator[str]:
    """Spelling of every option of a command or a union of commands, with repetitions."""
    return (name for name, _ in _named_options(kind))


def _named_options(kind: Any) -> Iterator[tuple[str, Any]]:
    """Spelling and type hint of every option of a command or a union of commands, with repetitions."""
    for command in subcommands_of(kind).values():
        yield from _named_options(command)
    if not is_dataclass(kind):
        return
    defaults = {each.name: each.default for each in fields(kind)}
    for name, hint in get_type_hints(kind, include_extras=True).items():  # Annotated[kind, mark, ...] or a kind
        inner, *marks = get_args(hint) or (hint,)
        if is_dataclass(inner):
            yield from _named_options(inner)
        elif name != "action" and _POSITIONAL not in marks:
            renamed = [mark.name for mark in marks if isinstance(getattr(mark, "name", None), str)]
            spelled = (renamed or [name])[0].replace("_", "-")
            yield (f"--no-{spelled}" if inner is bool and defaults[name] is True else f"--{spelled}"), hint


_POSITIONAL = get_args(Positional[int])[1]
