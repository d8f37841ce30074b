"""What the command line says of arguments that it cannot parse: tyro's hook where there is one, tyro's own words elsewhere."""

import re

import pytest
import tyro

import marlbc_mj
from marlbc_mj.cli import Command, main, parsing


def said_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What goes to stderr, with exit status 2."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    return capsys.readouterr().err


def leaves(kind, path=()):
    """Every command with its words."""
    inner = parsing.subcommands_of(kind)
    if not inner:
        yield path, kind
    for word, command in inner.items():
        yield from leaves(command, (*path, word))


def test_options_and_subcommands_are_those_of_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    """Of every command: what is suggested can be given, and every option can be suggested."""
    found = dict(leaves(Command))
    assert ("bench",) in found and ("log", "recover") in found and len(found) > 18
    for path, command in found.items():
        with pytest.raises(SystemExit):
            main([*path, "--help"])
        rows = re.findall(r"^[^\w\n-]*(--[a-z][\w-]*)(?:, (--[\w-]+))?", capsys.readouterr().out, re.MULTILINE)
        assert set(parsing.options_of(command)) == {name for row in rows for name in row if name}, path


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["robot", "check"], r"Missing from marlbc robot check: STR file; see `marlbc robot check --help`"),
        (["ship"], r"Missing from marlbc ship: PATH run-folder, STR name; see `marlbc ship --help`"),
        (["run", "--seed"], r"Missing value for argument '--seed'. Expected 1 values; see `marlbc run --help`"),
        (["study", "--form", "x"], r"Unrecognized options: --form, x; perhaps --from; see `marlbc --help`"),
        (["bench", "paper", "extra"], r"Unrecognized options: extra; see `marlbc --help`"),
        (["bench", "--drag-range", "1", "a"], r"Error parsing --drag-range: .*FLOAT FLOAT.*; see `marlbc --help`"),
    ],
)
def test_what_is_wrong_is_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.fullmatch(f"marlbc: {said}\n", said_of(arguments, capsys))


@pytest.mark.parametrize("missing", ["module", "hook"])
def test_without_the_hook_tyro_speaks_for_itself(
    missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A later tyro may drop its hook: what is wrong is still said, and the exit status stays 2."""
    if missing == "module":
        monkeypatch.delattr(tyro, "_errors")
    else:
        monkeypatch.delattr("tyro._errors.on_parse_error")
    assert "Unrecognized options" in said_of(["run", "--sed", "1"], capsys)


def test_an_event_that_is_new_is_left_to_tyro() -> None:
    class Unheard:
        prog = "marlbc"

    assert parsing._refusal(Unheard(), Command, []) is None


def test_the_version_is_one_line(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"marlbc {marlbc_mj.__version__}\n"
