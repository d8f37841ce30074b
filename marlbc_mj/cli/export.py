"""``marlbc export``: export a trained policy for another computer, or a log for other programs."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import ExistingPath
from marlbc_mj.cli.output import OutputOptions
from marlbc_mj.util.errors import ConfigurationError

LOG_SUFFIX, POLICY_SUFFIX = ".mcap", ".safetensors"


@dataclass(frozen=True)
class ExportCommand:
    """Write a checkpoint's policy as ONNX (needs the extra onnx), or a log in another format.

    The general policy becomes the graph of one agent, with what it senses and hears as inputs and its action as output. Formats
    of a log: a table (.csv, .jsonl, or .parquet with the extra parquet), arrays (.npz), or a Rerun recording (.rrd).
    """

    source: Positional[ExistingPath]
    """MCAP log, or checkpoint, for example checkpoint/best.safetensors of a run."""
    out: Positional[Path]
    """File to write, for example policy.onnx or episode.csv; for a log, the suffix selects the format."""
    overwrite: bool = False
    """Replace an existing file."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Export, and print the file or the inputs and outputs of the policy."""
        if self.source.suffix == LOG_SUFFIX:
            from marlbc_mj.recording.exports import export_log

            export_log(self.source, self.out, overwrite=self.overwrite)
            self.output.say(self.out)
            return
        if self.source.suffix != POLICY_SUFFIX:
            what = "a folder" if self.source.is_dir() else f"a file that ends in {self.source.suffix or 'nothing'}"
            raise ConfigurationError(
                f"export takes a log ({LOG_SUFFIX}) or a checkpoint ({POLICY_SUFFIX}); {self.source} is {what}"
            )
        from marlbc_mj.training.export import export_policy

        self.output.say(export_policy(self.source, self.out, overwrite=self.overwrite))
