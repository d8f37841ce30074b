"""What the README shows runs as shown."""

import re
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"


def test_python_blocks_run_in_order() -> None:
    """Every Python block of the README runs, each with what the ones before it defined."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) >= 5
    names: dict[str, object] = {"__name__": "readme"}
    folder = README.parent / ".cache" / "readme"
    folder.mkdir(parents=True, exist_ok=True)
    for k, block in enumerate(blocks):
        path = folder / f"block{k}.py"  # numba caches by file, so the blocks need one
        if not path.exists() or path.read_text() != block:
            path.write_text(block)
        exec(compile(block, str(path), "exec"), names)
    world = names["world"]
    assert world.native  # type: ignore[attr-defined]


def test_commands_exist() -> None:
    """Every ``marlbc`` subcommand and make target that the README names exists."""
    from marlbc_mj import cli

    text = README.read_text()
    source = Path(cli.__file__).read_text()
    for name in set(re.findall(r"`marlbc (\w+)", text)):
        assert f'subcommand("{name}")' in source, name
    makefile = (README.parent / "Makefile").read_text()
    for target in set(re.findall(r"make (\w+)", text)) & {"benchmark", "test", "lint", "clean"}:
        assert f"\n{target}:" in makefile, target
