"""The file that an interrupted training run goes on from. It imports nothing heavy: the command line looks for the file first."""

from pathlib import Path

from marlbc_mj.util.errors import ConfigurationError

RESUME = "resume.safetensors"


def saved_run(out: Path) -> Path:
    """The file of the run that was saved in a folder.

    Raises:
        ConfigurationError: there is none.
    """
    path = out / RESUME
    if not path.is_file():
        raise ConfigurationError(f"{out} holds no run to resume: there is no {RESUME}")
    return path
