"""``marlbc train``: train a mission supervisor, or resume a training run."""

import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import MethodName, PresetName, SomeCount, SomeDevice, SomePath, TrainingSettings
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.training.resuming import saved_run
from marlbc_mj.util.errors import ConfigurationError, unknown

if TYPE_CHECKING:
    from marlbc_mj.training.config import TrainConfig
    from marlbc_mj.training.general.config import GeneralConfig
    from marlbc_mj.training.run import Interrupted


@dataclass(frozen=True)
class TrainCommand:
    """Train a mission supervisor from scratch, with checkpoints, learning curves and evaluations."""

    method: Positional[MethodName] = "marlms"
    """Training method."""
    preset: PresetName = "fast"
    """Preset of hyper-parameters; paper has the published ones."""
    seed: int = 0
    """Random seed of networks, exploration and starts."""
    out: SomePath = None
    """Folder of the run; runs/METHOD-PRESET-SEED by default."""
    resume: SomePath = None
    """Folder of an interrupted run to resume with its own settings; results equal those of an uninterrupted run."""
    budget: SomeCount = None
    """Number of mission steps to train for, over all worlds."""
    threads: SomeCount = None
    """Number of threads for simulation and networks."""
    device: SomeDevice = None
    """Device for the networks."""
    set: TrainingSettings = ()
    """Any other settings, for example: gamma=0.98 copies=1 shaping.margin=0.1."""
    overwrite: bool = False
    """Write into a folder that is not empty."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Train with a progress display; if interrupted, print how to resume the run."""
        if self.resume is not None:
            self.refuse_others()
            saved_run(self.resume)
        from marlbc_mj.cli.terminal import training_display
        from marlbc_mj.training import run
        from marlbc_mj.training.general.config import GENERAL
        from marlbc_mj.training.general.run import is_general_run

        if is_general_run(self.resume) if self.resume is not None else self.method == GENERAL:
            self.run_general()
            return
        with self.output.display(training_display) as progress:
            if self.resume is not None:
                folder, ended = self.resume, run.resume(self.resume, progress=progress)
            else:
                config = self.config()
                folder = self.out or Path("runs") / f"{config.method}-{config.preset}-{config.seed}"
                ended = run.train(config, folder, overwrite=self.overwrite, progress=progress)
        if isinstance(ended, run.Interrupted):
            exit_interrupted(folder, ended)
        best = max(ended, key=run.rank)
        switches = "/".join(f"{value:.0f}" for name, value in best.items() if name.startswith("switches_"))
        text = (
            f"best of {len(ended)} evaluations, after {best['mission_steps']:.0f} mission steps and {best['wall_s']:.0f} s: "
            f"return {best['return']:.0f}, switches {switches}, violation of the worst agent {best['violation_time']:.3f} s"
        )
        self.output.report(text, best)
        self.output.say(f"{folder / 'checkpoint'} holds the best and the last policy")

    def run_general(self) -> None:
        """Train the general policy; if interrupted, print how to resume the run."""
        from marlbc_mj.cli.terminal import general_display
        from marlbc_mj.training.general.run import judged_rank, resume_general, train_general
        from marlbc_mj.training.run import Interrupted

        with self.output.display(general_display) as progress:
            if self.resume is not None:
                folder, ended = self.resume, resume_general(self.resume, progress=progress)
            else:
                config = self.general_config()
                folder = self.out or Path("runs") / f"{self.method}-{config.seed}"
                ended = train_general(config, folder, overwrite=self.overwrite, progress=progress)
        if isinstance(ended, Interrupted):
            exit_interrupted(folder, ended)
        best = max(ended, key=judged_rank)
        rates = ", ".join(f"{k.removeprefix('success_')} {100 * v:.4g} %" for k, v in best.items() if k.startswith("success_"))
        text = f"best of {len(ended)} evaluations, after {best['mission_steps']:.0f} mission steps: success {rates}"
        self.output.report(text, best)
        self.output.say(f"{folder / 'checkpoint'} holds the best and the last policy")

    def general_config(self) -> "GeneralConfig":
        """The settings of the general policy, with the command line's changes.

        Raises:
            ConfigurationError: an option that this method does not have.
        """
        from marlbc_mj.training.general.config import GeneralConfig
        from marlbc_mj.util.changes import with_settings

        if self.preset != "fast":
            raise ConfigurationError(f"{self.method} has no presets; leave out --preset")
        return with_settings(GeneralConfig(seed=self.seed, **self.given()), self.set)

    def given(self) -> dict[str, Any]:
        """The settings with an option of their own, if that option was given."""
        options = {"budget": self.budget, "threads": self.threads, "device": self.device}
        return {name: value for name, value in options.items() if value is not None}

    def refuse_others(self) -> None:
        """Refuse other options with --resume, since a resumed run has its own settings.

        Raises:
            ConfigurationError: another option was given with --resume.
        """
        settings = [f for f in fields(self) if f.name not in ("resume", "output")]
        given = [f.name for f in settings if getattr(self, f.name) != f.default]
        if given:
            names = ", ".join(name if name == "method" else f"--{name}" for name in given)
            raise ConfigurationError(f"--resume continues a run with the settings saved in its folder; leave out {names}")

    def config(self) -> "TrainConfig":
        """The preset with the method's and the command line's changes."""
        from marlbc_mj.training.config import make_config
        from marlbc_mj.training.general.config import GENERAL
        from marlbc_mj.training.methods import METHODS
        from marlbc_mj.util.changes import with_settings

        if self.method not in METHODS:
            raise unknown("method", self.method, (*METHODS, GENERAL))
        changes = {**METHODS[self.method][0], "method": self.method, "seed": self.seed, **self.given()}
        config = make_config(self.preset, **changes)
        return with_settings(config, self.set)


def exit_interrupted(folder: Path, ended: "Interrupted") -> NoReturn:
    """Print how to resume an interrupted run, and exit with the status of the signal."""
    print(f"marlbc: saved; resume with: marlbc train --resume {folder}", file=sys.stderr)
    sys.exit(128 + ended.signal)
