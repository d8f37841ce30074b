"""TensorBoard scalars of a training run, if the ``tensorboard`` extra is installed."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from marlbc_mj.util.files import writing

EVALUATION = ("return", "violation_time", "clearance_min", "switches")
"""Prefixes of the names of evaluation scalars."""


class TensorBoard:
    """Writes scalars under ``train/*`` and ``eval/*``; does nothing if TensorBoard is not installed.

    Args:
        folder: folder of the event files.

    Raises:
        ConfigurationError: the folder cannot be written; every method can raise it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            with writing(folder):
                self._writer = SummaryWriter(str(folder))

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """Write one value per name.

        Args:
            step: number of mission steps simulated so far.
            scalars: the values by name.
        """
        if self._writer is None:
            return
        with writing(self._folder):
            for name, value in scalars.items():
                group = "eval" if name.startswith(EVALUATION) else "train"
                self._writer.add_scalar(f"{group}/{name}", value, step)
            self._writer.flush()

    def close(self) -> None:
        """Flush the buffer and close the files."""
        if self._writer is not None:
            with writing(self._folder):
                self._writer.close()
