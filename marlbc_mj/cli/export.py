"""``marlbc export``: a trained policy for another computer."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class ExportCommand:
    """Write a checkpoint's policy as an ONNX file for a robot's computer; needs the onnx extra.

    The general policy becomes the graph of one agent: what it sensed and heard goes in, its action comes out.
    """

    checkpoint: Positional[Path]
    """Checkpoint, checkpoint/best.safetensors of a run for example."""
    out: Positional[Path]
    """File to write, policy.onnx for example."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Export, and say what goes in and what comes out."""
        from marlbc_mj.training.export import export_policy

        print(export_policy(self.checkpoint, self.out, overwrite=self.overwrite))
