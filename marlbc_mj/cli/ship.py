"""``marlbc ship``: copy a training run's best checkpoint, or the mean of several runs, into the package."""

from dataclasses import dataclass, field

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import TrainedRun
from marlbc_mj.cli.output import OutputOptions


@dataclass(frozen=True)
class ShipCommand:
    """Copy the best checkpoint of a run into the package and write its model card; for developers of the package."""

    run_folder: Positional[TrainedRun]
    """Folder of the training run."""
    name: Positional[str]
    """Name of the shipped supervisor: marlms, rlms or marlms-general."""
    mean_with: tuple[TrainedRun, ...] = ()
    """More runs of the general policy; the shipped policy then uses the mean action values of the last networks of all runs."""
    overwrite: bool = False
    """Replace an existing checkpoint."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Copy, write the card, and print the path of the checkpoint."""
        from marlbc_mj.policies.general import is_general
        from marlbc_mj.training.general.shipping import ship_general, ship_mean
        from marlbc_mj.training.ship import ship

        if self.mean_with:
            parts = [run / "checkpoint" / "last.safetensors" for run in (self.run_folder, *self.mean_with)]
            self.output.say(ship_mean(parts, self.name, overwrite=self.overwrite))
            return
        put = ship_general if is_general(self.run_folder / "checkpoint" / "best.safetensors") else ship
        self.output.say(put(self.run_folder, self.name, overwrite=self.overwrite))
