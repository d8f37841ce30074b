"""One name, one thing: no two modules of the library define the same public function, class or constant."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from test_layers import ROOT, sources

from marlbc_mj.controllers import CONTROLLERS
from marlbc_mj.supervisors import SUPERVISORS
from marlbc_mj.util.method_names import display_key, source_of

PROTOCOL = {
    "load",  # dm_control's suites have a function of this name; robots have their own
}
"""Names that modules share on purpose, since they do the same for different things."""


def defined(path: Path) -> Iterator[str]:
    """Public functions, classes and constants at the top level of a file."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [leaf.id for target in targets for leaf in ast.walk(target) if isinstance(leaf, ast.Name)]
        else:
            names = []
        yield from (name for name in dict.fromkeys(names) if not name.startswith("_"))


@cache
def repeated(root: Path) -> dict[str, list[str]]:
    """The files that define each name, for names that more than one file defines."""
    homes = defaultdict(list)
    for path in sources(root):
        for name in dict.fromkeys(defined(path)):
            homes[name].append(path.relative_to(root).as_posix())
    return {name: files for name, files in homes.items() if len(files) > 1}


def test_every_public_name_stands_once() -> None:
    assert {name: files for name, files in repeated(ROOT).items() if name not in PROTOCOL} == {}


def test_nothing_in_studies_or_cli_shares_a_name() -> None:
    """These modules have no exceptions, unlike other packages."""
    own = ("marlbc_mj/studies/", "marlbc_mj/cli/", "marlbc_mj/results/seeds.py")
    assert {name: files for name, files in repeated(ROOT).items() if any(file.startswith(own) for file in files)} == {}


@pytest.mark.parametrize("line", ["def judge(): ...", "class judge: ...", "judge = 3", "judge: int = 3", "a, judge = 1, 2"])
def test_a_planted_twin_is_found(tmp_path: Path, line: str) -> None:
    for folder, text in (("core", "def judge(): ...\ndef _own(): ...\n"), ("engine", line + "\ndef _own(): ...\n")):
        (tmp_path / "marlbc_mj" / folder).mkdir(parents=True)
        (tmp_path / "marlbc_mj" / folder / "laws.py").write_text(text)
    assert repeated(tmp_path) == {"judge": ["marlbc_mj/core/laws.py", "marlbc_mj/engine/laws.py"]}


@pytest.mark.parametrize("name", [*SUPERVISORS, *CONTROLLERS])
def test_every_method_has_a_name_for_people_and_a_source(name: str) -> None:
    """Display names are unique; a class from a user's file is displayed as file and name."""
    shown = source_of(name)
    others = {source_of(other).display for other in (*SUPERVISORS, *CONTROLLERS) if other != name}
    assert shown.citation and shown.display not in {name, *others}
    assert display_key(f"{name}+mine.Soft") == f"{shown.display} + mine.Soft"


def test_names_of_users_methods_are_short() -> None:
    assert source_of("some/mine.py:Careful").display == "mine.Careful" and source_of("runs/best.safetensors").display == "best"
    assert display_key("video of MPCMS + SORLC") == "video of MPCMS + SORLC" and display_key("jobs") == "jobs"
