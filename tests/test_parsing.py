"""Messages for arguments that the command line cannot parse: ours where tyro has its hook, tyro's own elsewhere."""

import json
import re
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
import pytest
import tyro

import marlbc_mj
from marlbc_mj.cli import Command, main, parsing
from marlbc_mj.cli.choices import selectable
from marlbc_mj.cli.names import registered
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.cli.parsing import Refusal
from marlbc_mj.cli.terminal import seldom


def said_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The text on stderr of a command that exits with status 2."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    return capsys.readouterr().err


def leaves(kind, path=()):
    """Yield every command without subcommands, with the words that select it."""
    inner = parsing.subcommands_of(kind)
    if not inner:
        yield path, kind
    for word, command in inner.items():
        yield from leaves(command, (*path, word))


def test_options_and_subcommands_are_those_of_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    """For every command, the options that can be suggested are exactly those in its help."""
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
        (["run", "papre"], "unknown scenario 'papre'; perhaps 'paper'"),
        (["bench", "--supervisors", "scripted", "scriptd"], "unknown supervisor 'scriptd'; perhaps 'scripted'"),
        (["run", "--set=robots=disc,dsic"], "unknown robot 'dsic'; perhaps 'disc'"),
        (["run", "--supervisor", "mine.py"], "'mine.py' is a file; add the name of the supervisor in it: mine.py:NAME"),
        (["run", "--agents", "x"], "--agents must be a whole number, got 'x'"),
        (["run", "--agents=5.5"], "--agents must be a whole number, got '5.5'"),
        (["run", "--duration", "abc"], "--duration must be a number, got 'abc'"),
        (["bench", "--drag-range", "1", "a"], "--drag-range must be a number, got 'a'"),
        (["run", "--out="], "--out must not be empty"),
        (["run", "--out", ""], "--out must not be empty"),
        (["--json", "run"], "--json must come after the command; choose from: bench, run,"),
        (["--versoin"], "unknown option --versoin; perhaps --version; commands: bench, run,"),
    ],
)
def test_a_wrong_word_is_found_before_tyro_loads_what_it_parses_with(arguments, said, monkeypatch, capsys) -> None:
    monkeypatch.setattr(tyro, "cli", None)
    text = said_of(arguments, capsys)
    assert text.count("\n") == 1 and said in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["robot", "check"], r"Missing from marlbc robot check: ROBOT file; see `marlbc robot check --help`"),
        (["ship"], r"Missing from marlbc ship: PATH run-folder, STR name; see `marlbc ship --help`"),
        (["run", "--seed"], r"Missing value for argument '--seed'; see `marlbc run --help`"),
        (["study", "--form", "x"], r"Unrecognized options: --form, x; perhaps --from; see `marlbc study --help`"),
        (["bench", "paper", "extra"], r"Unrecognized options: extra; see `marlbc bench --help`"),
        (["bench", "--drag-range", "1"], r"Error parsing --drag-range: .*FLOAT FLOAT.*; see `marlbc bench --help`"),
    ],
)
def test_what_is_wrong_is_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.fullmatch(f"marlbc: {said}\n", said_of(arguments, capsys))


@pytest.mark.parametrize("missing", ["module", "hook"])
def test_without_the_hook_tyro_speaks_for_itself(
    missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A later tyro may drop its hook: the error is still reported, and the exit status is still 2."""
    if missing == "module":
        monkeypatch.delattr(tyro, "_errors")
    else:
        monkeypatch.delattr("tyro._errors.on_parse_error")
    assert "Unrecognized options" in said_of(["run", "--sed", "1"], capsys)


def test_an_event_that_is_new_is_left_to_tyro() -> None:
    class Unheard:
        prog = "marlbc"

    assert parsing._refusal(Unheard(), Command) is None


WRONG_WORDS = {
    "benhc": "unknown command 'benhc'; perhaps 'bench'; choose from: bench, run",
    "robot chek": "unknown command 'chek'; perhaps 'check'; choose from: check, gate; see `marlbc robot --help`",
    "log": "Expected one of {info, recover, export}; see `marlbc log --help`",
    "run --contrlr pd": "Unrecognized options: --contrlr, pd; perhaps --controller; see `marlbc run --help`",
    "run papr": "unknown scenario 'papr'; perhaps 'paper'; choose from: paper",
    "run --supervisor oracl": "unknown supervisor 'oracl'; perhaps 'oracle'; choose from: scripted",
    "bench --controllers sorlc pid": "unknown controller 'pid'; perhaps 'pd'; choose from: sorlc",
    "bench --engine rai": "perhaps 'ray'",
    "evaluate --composition setbased": "unknown composition 'setbased'; perhaps 'set-based'; choose from: null-space, set-based",
    "evaluate --formation wegde": "unknown formation 'wegde'; perhaps 'wedge'",
    "run --robot omnni": "unknown robot 'omnni'; perhaps 'omni'",
    "run --set comunication.range=3": "unknown setting 'comunication.range'; perhaps 'communication.range'",
    "run --set range": "--set takes name=value, got 'range'",
    "train --set gama=3": "unknown setting 'gama'; perhaps 'gamma'",
    "train marlmss": "unknown method 'marlmss'; perhaps 'marlms'",
    "suite --track familys": "unknown track 'familys'; perhaps 'families'",
    "list robot": "unknown kind 'robot'; perhaps 'robots'",
    "video nothing.mcap": "cannot read nothing.mcap: No such file or directory",
    "run nothing.toml": "cannot read nothing.toml: No such file or directory",
    "run --supervisor nothing.py:Mine": "cannot read nothing.py: No such file or directory",
    "safety --teams grid-nine": "a team must be FORMATION-AGENTS, for example wedge-4, got 'grid-nine'",
    "safety --teams wedge-4 gird-9-lines": "unknown formation 'gird'; perhaps 'grid'",
    "bench --seeds 0": "seeds must be at least 1, got 0",
    "suite --layouts=-1": "layouts must be at least 1, got -1",
    "safety --seed -1": "seed must not be negative, got -1",
    "run field --agents 1": "agents must be at least 2, got 1",
    "evaluate field --agents -1": "agents must be at least 2, got -1",
    "run --duration -1": "duration must be positive and finite, got -1.0",
    "bench --substep=0": "substep must be positive and finite, got 0.0",
    "robot gate --workers 0": "workers must be at least 1, got 0",
    "suite --from nowhere": "nowhere holds no results of the suite: cannot read nowhere/suite.json: No such file or directory",
    "study --from nowhere": "cannot read nowhere/study.csv: No such file or directory",
    "train --resume nowhere": "nowhere holds no run to resume: there is no resume.safetensors",
    "ship nowhere name": "cannot read nowhere/checkpoint/best.safetensors: No such file or directory",
}
HEAVY = """
import json, sys
from marlbc_mj.cli import main
for line in json.loads(sys.argv[1]):
    try:
        main(line)
    except SystemExit as stop:
        print(stop.code)
print({"numpy", "numba", "mujoco", "torch"} & set(sys.modules))
"""


@pytest.mark.parametrize("line", WRONG_WORDS)
def test_a_wrong_word_is_answered_with_the_nearest_right_one(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = said_of(line.split(), capsys)
    assert said.startswith("marlbc: ") and WRONG_WORDS[line] in said and said.count("\n") == 1


def test_messages_import_nothing_heavy() -> None:
    """A process reports wrong words and prints help and lists without importing NumPy, Numba, MuJoCo or torch."""
    lines = [*(line.split() for line in WRONG_WORDS), ["--help"], ["bench", "--help"], ["list"], ["list", "robots"]]
    done = subprocess.run([sys.executable, "-c", HEAVY, json.dumps(lines)], capture_output=True, text=True, check=True)
    *_, loaded = done.stdout.splitlines()
    assert done.stdout.count("2\n") >= len(WRONG_WORDS) and loaded == "set()"


def test_names_are_those_of_the_registries() -> None:
    """If this fails, ``python -m marlbc_mj.cli.names`` rewrites the file."""
    assert registered() == selectable()


def test_every_choice_is_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    """The help also has no repeated title and no default of None."""
    for path in (["run"], ["bench"], ["evaluate"], ["suite"], ["train"]):
        with pytest.raises(SystemExit):
            main([*path, "--help"])
        text = capsys.readouterr().out
        words = re.sub(r"[\s│]+", " ", text)
        assert "options options" not in text and "(default: None)" not in words, path
        kinds = {"run": ("supervisors", "controllers", "robots", "disturbances", "settings of a scenario")}.get(path[0], ())
        assert all(name in words for kind in kinds for name in selectable()[kind])


def test_one_kind_can_be_listed(capsys: pytest.CaptureFixture[str]) -> None:
    main(["list", "robots"])
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == list(selectable()["robots"])
    main(["list", "robots", "--json"])
    assert json.loads(capsys.readouterr().out) == {"robots": selectable()["robots"]}
    main(["list", "--quiet"])
    assert capsys.readouterr().out == ""


def test_a_line_per_method_where_nobody_watches(capsys: pytest.CaptureFixture[str]) -> None:
    """A method is reported once, by its display name, when it ends; long stages also report in between."""
    tell = seldom()
    for done in range(201):
        tell("fsams+sorlc", done, 200)
    tell("jobs", 3, 26)
    assert re.fullmatch(r"FSAMS \+ SORLC: 200 of 200 in \d+\.\d s\n", capsys.readouterr().err)
    for done in (0, 100, 200):  # as of the next job
        tell("fsams+sorlc", done, 200)
    assert capsys.readouterr().err.count("FSAMS + SORLC: 200 of 200") == 1
    often = seldom(every=0.0, ends=False)
    for done in (0, 100, 200):
        often("mpcms+pd", done, 200)
    lines = capsys.readouterr().err.splitlines()
    assert lines and all(line.startswith("MPCMS + Saturated PD: ") and line.endswith(" s left") for line in lines)


def test_a_document_holds_numbers_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    """This covers dataclasses, named tuples and arrays; NumPy scalars become numbers, and non-finite values null."""

    class Row(NamedTuple):
        passed: Any
        values: Any

    rows = {"rows": [Row(np.bool_(True), np.array([1.5, np.inf])), Row(np.int64(3), Refusal("a", "b"))]}
    ReportOptions(json=True).report("text", rows)
    first, second = {"passed": True, "values": [1.5, None]}, {"passed": 3, "values": {"message": "a", "command": "b"}}
    assert json.loads(capsys.readouterr().out) == {"rows": [first, second]}
    ReportOptions(quiet=True).report("text", rows)
    assert capsys.readouterr().out == ""


def test_every_command_can_be_quiet_and_those_that_report_give_json() -> None:
    silent = {("ship",), ("export",), ("video",), ("view",), ("log", "recover"), ("log", "export")}
    for path, command in leaves(Command):
        options = set(parsing.options_of(command))
        assert "--quiet" in options and ("--json" in options) == (path not in silent), path


def test_the_version_is_one_line(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"marlbc {marlbc_mj.__version__}\n"
