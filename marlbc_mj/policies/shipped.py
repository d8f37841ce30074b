"""Checkpoints that come with the package; each has a model card beside it."""

from importlib.resources import files
from pathlib import Path

FOLDER = Path(str(files("marlbc_mj") / "training" / "checkpoints"))


def shipped(name: str) -> Path:
    """Path of the checkpoint that is shipped under this name; it need not exist."""
    return FOLDER / f"{name}.safetensors"


def called(path: Path) -> Path:
    """What messages call a checkpoint: a shipped one by its file's name, the same on every machine; another one by its path."""
    return Path(path.name) if path.parent == FOLDER else path
