"""TensorBoard scalars of a training run, where the ``tensorboard`` extra is installed."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from marlbc_mj.util.files import writing

EVALUATION = ("return", "violation_time", "clearance_min", "switches")


class TensorBoard:
    """Scalars under ``train/*`` and ``eval/*``; does nothing without TensorBoard.

    Raises:
        ConfigurationError: the folder cannot be written; all methods do so.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            with writing(folder):
                self._writer = SummaryWriter(str(folder))

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """One value a name, at this many mission steps."""
        if self._writer is None:
            return
        with writing(self._folder):
            for name, value in scalars.items():
                group = "eval" if name.startswith(EVALUATION) else "train"
                self._writer.add_scalar(f"{group}/{name}", value, step)
            self._writer.flush()

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            with writing(self._folder):
                self._writer.close()
