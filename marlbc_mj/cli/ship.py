"""``marlbc ship``: copy a training run's best checkpoint into the package."""

from dataclasses import dataclass, field

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import TrainedRun
from marlbc_mj.cli.output import OutputOptions


@dataclass(frozen=True)
class ShipCommand:
    """Copy the best checkpoint of a run to the shipped ones and write its model card. For developers of the package."""

    run_folder: Positional[TrainedRun]
    """Folder of the training run."""
    name: Positional[str]
    """Name that the supervisor gets: marlms, rlms, marlms-general."""
    overwrite: bool = False
    """Replace an existing checkpoint."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Copy, write the card, say where."""
        from marlbc_mj.policies.general import is_general
        from marlbc_mj.training.general.shipping import ship_general
        from marlbc_mj.training.ship import ship

        best = self.run_folder / "checkpoint" / "best.safetensors"
        put = ship_general if is_general(best) else ship
        self.output.say(put(self.run_folder, self.name, overwrite=self.overwrite))
