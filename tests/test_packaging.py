"""The package holds together: links, imports, installed files, declared dependencies, versions and the table of symbols."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.resources import files
from pathlib import Path

import mujoco
import pytest

import marlbc_mj

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(marlbc_mj.__file__).parent
LINKED = ("models", "tasks", "training")
FIXED_BY_OWNER = {"mujoco", "dm-control", "torch", "numpy", "gymnasium", "mcap"}
SOURCES = sorted(PACKAGE.rglob("*.py")) + [path for name in LINKED[1:] for path in sorted((PACKAGE / name).rglob("*.py"))]
NAMED_IN_REFERENCES = re.findall(r"^### `marlbc_mj/(.+\.py)`$", (PACKAGE / "REFERENCES.md").read_text(), re.MULTILINE)

in_repository = pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="needs the repository's files")


@cache
def _imports(path: Path) -> set[str]:
    """Top-level names that a file imports anywhere."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add((node.module or "").split(".")[0])
    return found


def _normal(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


def _project() -> dict[str, object]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def _requirements() -> set[str]:
    return {_normal(re.split(r"[^\w.-]", line, maxsplit=1)[0]) for line in _project()["dependencies"]}


@in_repository
@pytest.mark.parametrize("name", LINKED)
def test_links_are_relative_and_resolve(name: str) -> None:
    """marlbc_mj/{models,tasks,training} point to the folders beside the package, wherever the clone is."""
    link = ROOT / "marlbc_mj" / name
    if not (ROOT / name).exists():
        pytest.skip("an sdist holds real folders in place of the links")
    assert link.is_symlink()
    assert link.readlink() == Path("..") / name
    assert link.resolve() == ROOT / name


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_folders_are_imported_through_the_package_only(path: Path) -> None:
    """``import tasks`` works in a clone and nowhere else."""
    assert not _imports(path) & set(LINKED)


def test_models_are_package_data() -> None:
    """Every robot's and arena's MJCF is found through importlib.resources and compiles."""
    models = sorted(entry.name for entry in (files("marlbc_mj") / "models").iterdir() if entry.name.endswith(".xml"))
    assert {"arena.xml", "point_mass.xml"} <= set(models)
    for name in models:
        mujoco.MjModel.from_xml_string((files("marlbc_mj") / "models" / name).read_text())


@pytest.mark.parametrize("name", ["py.typed", "REFERENCES.md"])
def test_data_files_are_there(name: str) -> None:
    """Type checkers and readers of an installed package find their file."""
    assert (files("marlbc_mj") / name).is_file()


@in_repository
def test_wheel_holds_every_file(tmp_path: Path) -> None:
    """A wheel contains all of marlbc_mj, including the linked folders, and nothing else."""
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("marlbc_mj", *LINKED):
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    build = "from setuptools import build_meta; build_meta.build_wheel('.')"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path, check=True, capture_output=True)
    assert next(tmp_path.glob("*.whl")).stat().st_size < 2_000_000
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    walk = os.walk(tmp_path / "marlbc_mj", followlinks=True)
    paths = {(Path(folder) / name).relative_to(tmp_path).as_posix() for folder, _, names in walk for name in names}
    assert held == paths


def test_public_names_exist() -> None:
    """Each name of ``__all__`` exists and occurs once, and there are at most 24."""
    names = getattr(marlbc_mj, "__all__", ())
    assert len(names) == len(set(names)) <= 24
    assert [name for name in names if not hasattr(marlbc_mj, name)] == []


def _loaded_by(code: str) -> set[str]:
    """Top-level modules that a fresh process has loaded after ``code``."""
    report = f"import sys\n{code}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    return set(subprocess.run([sys.executable, "-c", report], check=True, capture_output=True, text=True).stdout.split())


def test_the_package_itself_loads_nothing_heavy() -> None:
    """So a renderer can still be chosen: its environment variable must be set before MuJoCo is imported."""
    assert not {"mujoco", "numba", "numpy", "torch"} & _loaded_by("import marlbc_mj")


@pytest.mark.parametrize("name", ["ConfigurationError", "laws", "paper", "World"])
def test_a_public_name_needs_no_other(name: str) -> None:
    """A class, a function or a module can each be the first import of a process."""
    assert "marlbc_mj" in _loaded_by(f"from marlbc_mj import {name}")


def test_what_does_not_learn_loads_no_torch() -> None:
    """Supervisors with a trained policy, environments, reports and the command line load no torch; only training/ imports it."""
    names = ("supervisors", "policies.checkpoint", "episode", "tasks.gymnasium_env", "report", "cli", "training.config")
    loaded = _loaded_by("\n".join(f"import marlbc_mj.{name}" for name in names))
    assert "mujoco" in loaded and "torch" not in loaded
    using = [path.relative_to(ROOT).parts for path in SOURCES if "torch" in _imports(path)]
    learning = {"training" if "training" in parts else parts[-2] for parts in using}
    assert learning == {"training", "policies"}  # policies/greedy.py imports its types only


@pytest.mark.parametrize("name", ["marlbc_mj.controllers", "marlbc_mj.scenarios", "marlbc_mj.supervisors", "marlbc_mj.tasks"])
def test_public_names_of_subpackages_exist(name: str) -> None:
    """Each name of a subpackage's ``__all__`` exists."""
    module = importlib.import_module(name)
    assert [public for public in getattr(module, "__all__", ()) if not hasattr(module, public)] == []


@in_repository
def test_version_is_the_same_everywhere() -> None:
    """pyproject.toml, CITATION.cff, CHANGELOG.md, the installed metadata and ``__version__`` agree."""
    declared = str(_project()["version"])
    changelog = re.search(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    citation = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert changelog is not None
    assert citation is not None
    assert changelog[1] == citation[1] == declared
    assert getattr(marlbc_mj, "__version__", declared) == declared
    try:
        installed = version("marlbc-mj")
    except PackageNotFoundError:
        installed = declared  # run from a clone that is not installed
    assert installed == declared


@in_repository
def test_imports_and_dependencies_agree() -> None:
    """Every third-party import is declared, and everything declared is imported or fixed by the project's owner."""
    providers = packages_distributions()
    imported = set().union(*map(_imports, SOURCES)) - set(sys.stdlib_module_names) - {"marlbc_mj"}
    used = {name: {_normal(one) for one in providers.get(name, [name])} for name in imported}
    declared = _requirements()
    assert {name for name, distributions in used.items() if not distributions & declared} == set()
    assert declared - FIXED_BY_OWNER - set().union(*used.values()) == set()


@in_repository
def test_constraints_pin_every_dependency() -> None:
    """constraints.txt names exact versions without build tags, and covers what pyproject.toml declares."""
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert [line for line in lines if not re.fullmatch(r"[\w.-]+==[\w.]+", line)] == []
    assert _requirements() - {_normal(line.split("==")[0]) for line in lines} == set()


def _identifiers(source: str) -> set[str]:
    """Every name that a source file defines or uses: variables, arguments, functions, classes and string keys."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
            found.add(node.value)
    return found


def _section(module: str) -> str:
    text = (PACKAGE / "REFERENCES.md").read_text()
    return re.split(r"^##", text.split(f"### `marlbc_mj/{module}`", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]


@pytest.mark.parametrize("module", NAMED_IN_REFERENCES)
def test_symbol_table_names_what_exists(module: str) -> None:
    """Each identifier that REFERENCES.md gives for a file occurs in that file."""
    cells = [row.split(" | ")[1] for row in _section(module).splitlines() if row.startswith("| ")][1:]
    named = {identifier for cell in cells for identifier in re.findall(r"`(\w+)`", cell)}
    assert named
    assert named - _identifiers((PACKAGE / module).read_text()) == set()


@pytest.mark.parametrize("module", NAMED_IN_REFERENCES)
def test_symbol_table_is_complete(module: str) -> None:
    """Each public function and class of those files is in the table."""
    body = ast.parse((PACKAGE / module).read_text()).body
    public = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")}
    assert {name for name in public if f"`{name}`" not in _section(module)} == set()


def test_errata_that_are_cited_are_listed() -> None:
    """Each "erratum 4" in the sources has an entry in REFERENCES.md, which numbers 17 of them."""
    errata = (PACKAGE / "REFERENCES.md").read_text().split("## 2. Errata")[1].split("## 3.")[0]
    listed = {int(number) for number in re.findall(r"^(\d+)\. ", errata, re.MULTILINE)}
    text = "\n".join(path.read_text() for path in SOURCES)
    lists = re.findall(r"errat(?:um|a) ((?:\d+(?:, | and )?)+)", text)
    assert listed == set(range(1, 18))
    assert {int(number) for cited in lists for number in re.findall(r"\d+", cited)} <= listed
