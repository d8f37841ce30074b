"""``marlbc train``: learn a mission supervisor, or go on learning."""

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tyro.conf import Positional

from marlbc_mj.util.errors import ConfigurationError, unknown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from marlbc_mj.training.config import TrainConfig


@dataclass(frozen=True)
class TrainCommand:
    """Learn a mission supervisor from scratch, with checkpoints, curves and evaluations on the case study."""

    method: Positional[str] = "marlms"
    """What is learned, see `marlbc list`."""
    preset: str = "fast"
    """Hyper-parameters: fast, or paper for the published ones."""
    seed: int = 0
    """Random seed of networks, exploration and starts."""
    out: Path | None = None
    """Folder of the run; runs/METHOD-PRESET-SEED by default."""
    resume: Path | None = None
    """Folder of a run that was interrupted: it goes on, bit for bit, with its own settings."""
    budget: int | None = None
    """Mission steps, over all worlds."""
    threads: int | None = None
    """Threads of simulation and networks."""
    device: str | None = None
    """Device of the networks: cpu or cuda."""
    set: tuple[str, ...] = ()
    """Any other setting of the preset, name=value: gamma=0.98 copies=1 shaping.margin=0.1."""
    overwrite: bool = False
    """Write into a folder that is not empty."""

    def run(self) -> None:
        """Train with a progress display; an interrupted run says how to continue it."""
        from marlbc_mj.cli.terminal import training_display
        from marlbc_mj.training import run

        with training_display() as progress:
            if self.resume is not None:
                self.refuse_others()
                folder, ended = self.resume, run.resume(self.resume, progress=progress)
            else:
                config = self.config()
                folder = self.out or Path("runs") / f"{config.method}-{config.preset}-{config.seed}"
                ended = run.train(config, folder, overwrite=self.overwrite, progress=progress)
        if isinstance(ended, run.Interrupted):
            print(f"marlbc: saved; go on with: marlbc train --resume {folder}", file=sys.stderr)
            sys.exit(128 + ended.signal)
        best = max(ended, key=run.rank)
        switches = "/".join(f"{value:.0f}" for name, value in best.items() if name.startswith("switches_"))
        print(
            f"best of {len(ended)} evaluations, after {best['mission_steps']:.0f} mission steps and {best['wall_s']:.0f} s: "
            f"return {best['return']:.0f}, switches {switches}, violation {best['violation_time']:.3f} s"
        )
        print(f"{folder / 'checkpoint'} holds the best and the last policy")

    def refuse_others(self) -> None:
        """A resumed run has its own settings.

        Raises:
            ConfigurationError: anything else was given with --resume.
        """
        given = [f.name for f in fields(self) if f.name != "resume" and getattr(self, f.name) != f.default]
        if given:
            names = ", ".join(name if name == "method" else f"--{name}" for name in given)
            raise ConfigurationError(f"--resume continues a run in its folder with its own settings; leave out {names}")

    def config(self) -> "TrainConfig":
        """The preset with the method's and the command line's changes."""
        from marlbc_mj.training.config import METHODS, make_config

        if self.method not in METHODS:
            raise unknown("method", self.method, METHODS)
        given = {name: getattr(self, name) for name in ("budget", "threads", "device") if getattr(self, name) is not None}
        changes = {**METHODS[self.method][0], "method": self.method, "seed": self.seed, **given}
        config = make_config(self.preset, **changes)
        return with_settings(config, self.set)


Settings = TypeVar("Settings", bound="DataclassInstance")


def with_settings(config: Settings, settings: tuple[str, ...]) -> Settings:
    """A frozen dataclass with fields replaced by ``name=value`` texts; ``outer.inner=value`` reaches a nested one.

    Raises:
        ConfigurationError: no such field, or a value of the wrong kind.
    """
    from dataclasses import replace

    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"--set takes name=value, got {setting!r}")
        outer, dot, inner = name.partition(".")
        names = [f.name for f in fields(config)]
        if outer not in names:
            raise unknown("setting", outer, names)
        present = getattr(config, outer)
        value = with_settings(present, (f"{inner}={text}",)) if dot else _value(outer, present, text)
        config = replace(config, **{outer: value})
    return config


def _value(name: str, present: Any, text: str) -> Any:
    """``text`` as the type of the value it replaces."""
    try:
        if isinstance(present, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(present, tuple):
            return tuple(int(part) for part in text.split(","))
        return type(present)(text)
    except (KeyError, ValueError):
        kind = {bool: "true or false", tuple: "whole numbers separated by commas"}.get(type(present), type(present).__name__)
        raise ConfigurationError(f"setting {name} must be {kind}, got {text!r}") from None
