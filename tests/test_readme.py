"""The README's examples run as shown."""

import importlib
import re
import sys
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"


def test_python_blocks_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The README's Python blocks, joined into one module, run, and run compiled."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert blocks
    (tmp_path / "readme_blocks.py").write_text("\n".join(blocks))
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("readme_blocks")
    monkeypatch.delitem(sys.modules, "readme_blocks")
    assert module.world.native


def test_commands_exist() -> None:
    """Every ``marlbc`` subcommand and make target that the README names exists."""
    from marlbc_mj import cli

    text = README.read_text()
    source = Path(cli.__file__).read_text()
    names = set(re.findall(r"(?:`|^)marlbc (\w+)", text, re.MULTILINE))
    assert len(names) >= 5
    for name in names:
        assert f'subcommand("{name}")' in source, name
    makefile = (README.parent / "Makefile").read_text()
    for target in set(re.findall(r"make (\w+)", text)) & {"benchmark", "test", "lint", "clean"}:
        assert f"\n{target}:" in makefile, target


def test_readme_length_and_links() -> None:
    """It has at most 900 words, read in five minutes, and the files that it links to exist."""
    text = README.read_text()
    assert len(text.split()) <= 900
    for target in re.findall(r"\]\((?!http)([^)#]+)", text):
        assert (README.parent / target).exists(), target
