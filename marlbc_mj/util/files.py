"""Output folders and files, which appear whole or not at all."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import plain_data

PARTIAL = ".partial-"
"""Part of the name of an incomplete file or folder, before the number of the process that writes it."""


@contextmanager
def staged_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into; it becomes ``out`` if the block ends without an error, and is removed otherwise.

    Args:
        out: the folder.
        overwrite: whether ``out`` may hold something, which is then replaced.

    Raises:
        ConfigurationError: ``out`` is not empty (and ``overwrite`` is off), is a file, or cannot be written.
    """
    check_folder(out, overwrite=overwrite)
    staging = out.with_name(f"{out.name}{PARTIAL}{os.getpid()}")
    _begin(out, staging.mkdir)
    try:
        yield staging
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise
    _replace(out, staging)


def check_folder(out: Path, *, overwrite: bool) -> None:
    """Raise ConfigurationError if ``out`` holds something that may not be overwritten."""
    if out.is_file():
        raise ConfigurationError(f"output folder {out} is a file")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise ConfigurationError(f"output folder {out} is not empty; choose another or add --overwrite")


def _begin(out: Path, create: Callable[[], None]) -> None:
    """Make the folder that ``out`` is in, then, by ``create``, what is written in its place."""
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        create()


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turn the system's errors inside the block, no space left for example, into a ConfigurationError about ``out``."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(f"cannot write {out}: {error.strerror or error}") from error


def _sync(path: Path) -> None:
    """Flush a file or a folder to the disk, so that it survives a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _replace(out: Path, staging: Path) -> None:
    """Put ``staging`` in the place of ``out``; the old content is removed once the new one is there."""
    old = out.with_name(f"{out.name}.old-{os.getpid()}")
    if out.exists():
        out.rename(old)
    staging.rename(out)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def staged_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path beside ``path``, with its suffix; it becomes ``path``, on the disk, if the block ends without an error.

    Args:
        path: the file.
        overwrite: whether an existing file may be replaced.

    Raises:
        ConfigurationError: ``path`` exists (and ``overwrite`` is off), or the system refuses to write it.
    """
    check_target(path, overwrite=overwrite)
    staging = path.with_name(f".{path.stem}{PARTIAL}{os.getpid()}{path.suffix}")
    _begin(path, staging.touch)
    try:
        with writing(path):
            yield staging
            _sync(staging)
            staging.replace(path)
            _sync(path.parent)
    finally:
        staging.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove what :func:`staged_file` left in ``folder`` and below when a process was killed while it wrote.

    Raises:
        ConfigurationError: the system refuses to remove it.
    """
    for path in folder.rglob(f".*{PARTIAL}*"):
        with writing(path):
            path.unlink(missing_ok=True)


def check_target(path: Path, *, overwrite: bool) -> None:
    """Raise ConfigurationError if ``path`` exists and must not be replaced, or is a folder."""
    if path.is_dir():
        raise ConfigurationError(f"cannot write {path}: it is a folder")
    if path.exists() and not overwrite:
        raise ConfigurationError(f"{path} exists; choose another name or add --overwrite")


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON through a temporary file; numbers that are not finite are texts in it, see :func:`plain_data`."""
    with staged_file(path, overwrite=True) as staging:
        staging.write_text(json.dumps(plain_data(value), indent=2, allow_nan=False) + "\n")
