"""A temporary configuration folder for Matplotlib where its own cannot be written, for example in a read-only home."""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

_VARIABLE = "MPLCONFIGDIR"


def prepare_matplotlib() -> None:
    """Give Matplotlib a temporary folder for this process, unless its own folders can be written or MPLCONFIGDIR is set.

    Matplotlib would do the same, but with a warning of several lines. Call this before Matplotlib is imported.
    """
    if os.environ.get(_VARIABLE) or not sys.platform.startswith("linux") or all(map(_can_be_written, _places())):
        return
    try:
        folder = tempfile.mkdtemp(prefix="matplotlib-")
    except OSError:  # Matplotlib reports this itself
        return
    os.environ[_VARIABLE] = folder
    atexit.register(shutil.rmtree, folder, ignore_errors=True)


def _places() -> list[Path]:
    """Matplotlib's folders for settings and caches."""
    pairs = (("XDG_CONFIG_HOME", ".config"), ("XDG_CACHE_HOME", ".cache"))
    return [Path(os.environ.get(name) or os.path.expanduser(f"~/{usual}")) / "matplotlib" for name, usual in pairs]


def _can_be_written(folder: Path) -> bool:
    """Whether a folder exists or can be created, and is writable."""
    there = next((each for each in (folder, *folder.parents) if os.path.exists(each)), None)
    return there is not None and os.path.isdir(there) and os.access(there, os.W_OK)
