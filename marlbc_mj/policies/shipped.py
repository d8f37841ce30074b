"""Checkpoints that come with the package; each has a model card beside it."""

from importlib.resources import files
from pathlib import Path

FOLDER = Path(str(files("marlbc_mj") / "training" / "checkpoints"))


def shipped(name: str) -> Path:
    """Path of the shipped checkpoint with this name; the file need not exist."""
    return FOLDER / f"{name}.safetensors"


def called(path: Path) -> Path:
    """Name of a checkpoint in messages: the file name of a shipped one, the same on every machine; else the path."""
    return Path(path.name) if path.parent == FOLDER else path
