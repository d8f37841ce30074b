"""The file that an interrupted training run resumes from. Imports are light, as the command line checks for the file first."""

from pathlib import Path

from marlbc_mj.util.errors import ConfigurationError

RESUME = "resume.safetensors"


def saved_run(out: Path) -> Path:
    """The file in which the run in a folder was saved.

    Raises:
        ConfigurationError: there is no such file.
    """
    path = out / RESUME
    if not path.is_file():
        raise ConfigurationError(f"{out} holds no run to resume: there is no {RESUME}")
    return path
