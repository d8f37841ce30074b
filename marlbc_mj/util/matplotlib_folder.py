"""Where Matplotlib keeps its list of fonts, where its own place cannot be written: a home that is read-only, for example."""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

_VARIABLE = "MPLCONFIGDIR"


def prepare_matplotlib() -> None:
    """Give Matplotlib a temporary folder of this process's own, unless its places can be written or one has been named.

    Matplotlib would do the same, and warn in several lines. Call it before Matplotlib is imported.
    """
    if os.environ.get(_VARIABLE) or not sys.platform.startswith("linux") or all(map(_can_be_written, _places())):
        return
    try:
        folder = tempfile.mkdtemp(prefix="matplotlib-")
    except OSError:  # which Matplotlib explains
        return
    os.environ[_VARIABLE] = folder
    atexit.register(shutil.rmtree, folder, ignore_errors=True)


def _places() -> list[Path]:
    """Matplotlib's folders of settings and of caches."""
    pairs = (("XDG_CONFIG_HOME", ".config"), ("XDG_CACHE_HOME", ".cache"))
    return [Path(os.environ.get(name) or os.path.expanduser(f"~/{usual}")) / "matplotlib" for name, usual in pairs]


def _can_be_written(folder: Path) -> bool:
    """Whether a folder is there, or can be made, and files can be put into it."""
    there = next((each for each in (folder, *folder.parents) if os.path.exists(each)), None)
    return there is not None and os.path.isdir(there) and os.access(there, os.W_OK)
