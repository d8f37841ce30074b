"""Rules for every source file: few arguments, names instead of indices, few silenced tools."""

import ast
import re
import tokenize
from pathlib import Path

import pytest
from test_layers import ROOT, sources

MOST_PARAMETERS = 9
MOST_BODY = 60  # lines
MOST_IGNORES = 20
NAMED = ("gains", "params", "state", "limits", "senses", "settings")
"""Arguments of laws that have named entries."""
COMPILED = {"allocation_free", "behavior", "compiled", "controller", "disturbance", "drive", "inlined", "reading", "threaded"}
"""Decorators of laws and of the functions that they call."""


def crowded(path: Path) -> list[str]:
    """``file: function`` for functions with too many parameters or too long a body."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            own = node.args
            names = [each.arg for each in (*own.posonlyargs, *own.args, *own.kwonlyargs)]
            count = len([name for name in names if name not in ("self", "cls")])
            body = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
            if count > MOST_PARAMETERS or (node.end_lineno or 0) - body[0].lineno + 1 > MOST_BODY:
                found.append(f"{path.name}: {node.name}")
    return found


def test_functions_are_short_and_take_few_arguments() -> None:
    assert [entry for path in sources(ROOT) for entry in crowded(path)] == []


@pytest.mark.parametrize("text", ["def f(a, b, c, d, e, f, g, h, i, j): ...", "def f():\n" + "    x = 1\n" * 61])
def test_a_planted_crowd_is_found(tmp_path: Path, text: str) -> None:
    (tmp_path / "planted.py").write_text(text)
    assert crowded(tmp_path / "planted.py") == ["planted.py: f"]


def indexed(text: str) -> list[str]:
    """Laws in a source text that read an entry with a name by a literal index; none in a text that is only a signature."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return []
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    laws = [node for node in functions if any(set(re.findall(r"\w+", ast.unparse(d))) & COMPILED for d in node.decorator_list)]
    return [law.name for law in laws for node in ast.walk(law) if isinstance(node, ast.Subscript) and literal(node)]


def literal(node: ast.Subscript) -> bool:
    """Whether a subscript has a form such as ``gains[3]``, ``gains[3:5]``, ``state[2, 1]`` or ``state[_TAU]``."""
    parts = [part for part in ast.walk(node.slice) if isinstance(part, ast.Constant | ast.Name)]
    constant = any(isinstance(part, ast.Constant) or part.id.isupper() for part in parts)
    return isinstance(node.value, ast.Name) and node.value.id in NAMED and constant


def test_laws_read_names_instead_of_indices() -> None:
    """This holds in the library, the documentation and the README."""
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    blocks = [block for page in pages for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)]
    assert [name for text in (*(path.read_text() for path in sources(ROOT)), *blocks) for name in indexed(text)] == []
    for index in ("3", "3:5", "2, 1", "_TAU"):
        assert indexed(f"@laws.controller\ndef law(params, state): return params[{index}]") == ["law"]


def test_few_lines_are_silenced() -> None:
    text = "\n".join(path.read_text() for path in sources(ROOT))
    assert "fmt: skip" not in text and "fmt: off" not in text
    assert text.count("type: ignore") < MOST_IGNORES


def links_by_mistake(path: Path) -> list[str]:
    """``file: line`` of comments and docstrings with ``[x] [m]``, which the API pages read as a link to m."""
    with path.open() as stream:
        tokens = [
            token for token in tokenize.generate_tokens(stream.readline) if token.type in (tokenize.COMMENT, tokenize.STRING)
        ]
    text = [token for token in tokens if token.type == tokenize.COMMENT or token.string.startswith('"""')]
    return [f"{path.name}: {token.start[0]}" for token in text if re.search(r"\]\s+\[[^\]\s]+\]", token.string)]


def test_no_unit_follows_a_bracket(tmp_path: Path) -> None:
    assert [entry for path in sources(ROOT) for entry in links_by_mistake(path)] == []
    (tmp_path / "planted.py").write_text("x: tuple  # each [x, y] [m]\n")
    assert links_by_mistake(tmp_path / "planted.py") == ["planted.py: 1"]
