"""The order of packages: each imports only those before it, so that they can be read in this order."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ORDER = (
    *("util", "core", "controllers", "robots", "scenarios", "engine", "policies", "supervisors", "episode"),
    *("recording", "results", "report", "tasks", "training", "studies", "cli"),
)
"""Packages, first to last. ``marlbc_mj`` itself only re-exports names, and ``__main__`` starts ``cli``."""
PROJECT = ("marlbc_mj", "tasks", "training")
"""First parts of the names by which modules of the project could be imported; only the first may be used."""


def sources(root: Path) -> Iterator[Path]:
    """Every source file of the library, once: files below a symbolic link are skipped."""
    for top in ("marlbc_mj", "tasks", "training"):
        yield from (path for path in sorted((root / top).rglob("*.py")) if not any(p.is_symlink() for p in path.parents))


def layer(module: str) -> str:
    """Package of a module: ``"engine"`` for ``marlbc_mj.engine.world``; empty for ``marlbc_mj`` itself."""
    return module.split(".")[1] if "." in module else ""


def imported(path: Path) -> Iterator[str]:
    """Names of the project's modules that a file imports, also inside functions; ``.`` for a relative import."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] in PROJECT)
        elif isinstance(node, ast.ImportFrom) and node.level:
            yield "."
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            yield from (arg.value for arg in node.args if isinstance(arg, ast.Constant) and arg.value.split(".")[0] in PROJECT)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PROJECT:
            whole = node.module == "marlbc_mj"
            yield from (f"{node.module}.{alias.name}" if whole else str(node.module) for alias in node.names)


def back_imports(root: Path) -> list[str]:
    """``file imports module`` for every import of a later package, or of a name from ``marlbc_mj`` itself."""
    found = []
    for path in sources(root):
        own = path.relative_to(root).parts
        name = own[0] if own[0] != "marlbc_mj" else own[1].removesuffix(".py")
        if name in ("__init__", "__main__"):
            continue
        assert name in ORDER, f"{name} has no place in the order of packages"
        for module in dict.fromkeys(imported(path)):
            if not module.startswith("marlbc_mj") or layer(module) not in ORDER or ORDER.index(layer(module)) > ORDER.index(name):
                found.append(f"{path.relative_to(root)} imports {module}")
    return found


def test_every_package_imports_only_those_before_it() -> None:
    assert back_imports(ROOT) == []


@pytest.mark.parametrize(
    "line",
    [
        "from marlbc_mj.engine.world import World",
        "import marlbc_mj.cli",
        "from marlbc_mj import World",
        "def f():\n    import marlbc_mj.tasks",
        "from ..engine.world import World",
        "from importlib import import_module\nimport_module('marlbc_mj.engine.world')",
        "import training.run",
    ],
)
def test_a_planted_back_import_is_found(tmp_path: Path, line: str) -> None:
    (tmp_path / "marlbc_mj" / "core").mkdir(parents=True)
    (tmp_path / "marlbc_mj" / "core" / "laws.py").write_text(line + "\n")
    assert [text.split(" imports ")[0] for text in back_imports(tmp_path)] == ["marlbc_mj/core/laws.py"]


def test_the_package_root_holds_few_files() -> None:
    assert len([path for path in (ROOT / "marlbc_mj").iterdir() if path.suffix == ".py"]) <= 8
