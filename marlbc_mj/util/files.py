"""Output folders and files, written completely or not at all, without replacing files of other programs."""

import errno
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from marlbc_mj.util.errors import ConfigurationError, NoSpaceError
from marlbc_mj.util.locks import exclusive_lock, held, is_held
from marlbc_mj.util.provenance import plain_data

PARTIAL = ".partial-"
"""Part of the name of an incomplete file or folder; the writing process's number and a random token follow."""
REPLACED = ".old-"
"""Part of the name of a folder that is being replaced; the same number and token follow."""
JOBS_FOLDER = ".jobs"
"""Subfolder of an output folder for files of an unfinished run; it does not count as content and is replaced with the rest."""
MANIFEST = ".marlbc-files.json"
"""File that lists all files that :func:`staged_folder` wrote into a folder; ``overwrite`` removes only these."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""System errors for an output that exceeds the disk, a quota or the process's file size limit."""


@contextmanager
def staged_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder to write into; it becomes ``out`` if the block ends without an error, and is removed otherwise.

    Leftovers of a killed process in the same place are removed. A link to a folder stays a link.

    Args:
        out: output folder.
        overwrite: whether ``out`` may contain files. Files that this function wrote there before are replaced, others stay.

    Raises:
        ConfigurationError: ``out`` is not empty although ``overwrite`` is off, even if another process filled it during the
            block; or it is a file, or cannot be written.
        NoSpaceError: the disk is full.
    """
    check_folder(out, overwrite=overwrite)
    target, place = remove_orphans(out)
    staging = place / f"{target.name or 'out'}{PARTIAL}{_token()}"
    with _begun(out, staging, Path.mkdir):
        try:
            with no_space_is_an_error(out):
                yield staging
            with writing(out):
                _put_in_place(out, target, staging, overwrite)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise


def check_folder(out: Path, *, overwrite: bool) -> None:
    """Raise ConfigurationError if ``out`` is a file, or contains files and ``overwrite`` is off."""
    with writing(out):
        if out.is_file():
            raise ConfigurationError(f"output folder {out} is a file")
        if out.is_dir() and not overwrite and any(not _is_unfinished(path.name) for path in out.iterdir()):
            raise ConfigurationError(f"output folder {out} is not empty; choose another or add --overwrite")


@contextmanager
def alone_in(out: Path, *, overwrite: bool) -> Iterator[None]:
    """Create ``out`` and lock it during the block, so that no other process of this program writes there.

    Folders that were created, parents included, are removed again if they are empty at the end.

    Raises:
        ConfigurationError: another process is writing there; ``out`` is not empty although ``overwrite`` is off; or it cannot be
            written.
    """
    check_folder(out, overwrite=overwrite)
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    with exclusive_lock(out, busy(out)):
        check_folder(out, overwrite=overwrite)  # another process may have filled it in the meantime
        try:
            yield
        finally:
            for folder in made:
                with suppress(OSError):  # it is not empty
                    folder.rmdir()


def busy(out: Path) -> str:
    """The message for an output folder that another process is writing."""
    return f"{out} is being written by another process; wait for it or choose another folder"


def _is_unfinished(name: str) -> bool:
    """Whether a name in an output folder belongs to an unfinished output of this program."""
    return PARTIAL in name or name == JOBS_FOLDER


@contextmanager
def _begun(out: Path, staging: Path, create: Callable[[Path], None]) -> Iterator[None]:
    """Create ``staging`` and hold its lock during the block. It never exists unlocked, as others would then remove it."""
    first = staging.with_name(f".new-{staging.name}")
    with writing(out):
        create(first)
    with held(first):
        first.rename(staging)
        yield


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turn system errors inside the block into one-line errors about ``out``.

    Raises:
        NoSpaceError: there is no space left.
        ConfigurationError: any other system error.
    """
    try:
        yield
    except OSError as error:
        kind = NoSpaceError if error.errno in NO_SPACE else ConfigurationError
        raise kind(f"cannot write {out}: {error.strerror or error}") from error


@contextmanager
def no_space_is_an_error(out: Path) -> Iterator[None]:
    """Turn the errors in ``NO_SPACE`` inside the block into a NoSpaceError about ``out``; others pass unchanged."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise NoSpaceError(f"cannot write {out}: {error.strerror}") from error


def _token() -> str:
    """This process's number, for people to read, and a random one, as processes in containers can share a number."""
    return f"{os.getpid()}-{secrets.token_hex(3)}"


def _stays(folder: Path) -> bool:
    """Whether a folder must be filled in place, as it is a mount point or the current folder."""
    return folder.is_dir() and (folder.is_mount() or folder.samefile(Path.cwd()))


def remove_orphans(out: Path) -> tuple[Path, Path]:
    """Remove leftovers of killed processes for ``out``, and restore a folder that one of them was replacing.

    Returns:
        ``out`` with links resolved, and the folder in which its staging folder goes, created if missing.

    Raises:
        ConfigurationError: a system error occurs.
    """
    target = out.resolve()
    place = target if _stays(target) else target.parent
    with writing(out):
        place.mkdir(parents=True, exist_ok=True)
        _remove_orphans(target, place)
    return target, place


def _remove_orphans(target: Path, place: Path) -> None:
    name = target.name or "out"
    for path in sorted(place.iterdir()):
        if not path.name.startswith((f"{name}{PARTIAL}", f"{name}{REPLACED}")) or not path.is_dir() or is_held(path):
            continue
        if path.name.startswith(f"{name}{REPLACED}") and not target.exists():
            path.rename(target)
        else:
            shutil.rmtree(path, ignore_errors=True)


def _put_in_place(out: Path, target: Path, staging: Path, overwrite: bool) -> None:
    """Turn ``staging`` into the folder ``target``, which messages call ``out``."""
    files = _files(staging)
    (staging / MANIFEST).write_text(json.dumps(files, indent=1) + "\n", encoding="utf-8")
    check_folder(out, overwrite=overwrite)
    ours = _written_before(target)
    taken = [name for name in files if name not in ours and os.path.lexists(target / name)]
    if taken:
        raise ConfigurationError(f"{out / taken[0]} was not written by marlbc; choose another output folder")
    if _stays(target):
        _move_into(out, target, staging, ours)
    elif target.exists() and any(target.iterdir()):
        _swap(target, staging, ours)
    else:
        with _refused_when_filled(out):
            staging.rename(target)


def _files(folder: Path) -> list[str]:
    """Paths of all files below ``folder``, relative to it, except those of an unfinished run."""
    found = (path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
    return sorted(path.relative_to(folder).as_posix() for path in found if not path.is_relative_to(folder / JOBS_FOLDER))


def _written_before(folder: Path) -> set[str]:
    """The files that :func:`staged_folder` wrote into ``folder``, from its manifest; empty if that cannot be read."""
    with suppress(OSError, ValueError, TypeError):
        names = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return {MANIFEST, *(name for name in names if ".." not in PurePosixPath(name).parts and not Path(name).is_absolute())}
    return set()


@contextmanager
def _refused_when_filled(out: Path) -> Iterator[None]:
    """Raise ConfigurationError if another process takes the name or fills the folder inside the block."""
    try:
        yield
    except FileExistsError as error:
        raise ConfigurationError(f"{out} was written by another process in the meantime; choose another name") from error
    except OSError as error:
        if error.errno != errno.ENOTEMPTY:
            raise
        raise ConfigurationError(f"output folder {out} was filled by another process in the meantime; choose another") from error


def _swap(target: Path, staging: Path, ours: set[str]) -> None:
    """Replace ``target`` by ``staging``, after carrying over files of others and empty folders from ``target``."""
    for name in _files(target):
        if name not in ours:
            (staging / name).parent.mkdir(parents=True, exist_ok=True)
            duplicate(target / name, staging / name)
    for folder in (path for path in target.rglob("*") if path.is_dir() and not path.is_symlink() and not any(path.iterdir())):
        if folder.is_relative_to(target / JOBS_FOLDER):
            continue
        (staging / folder.relative_to(target)).mkdir(parents=True, exist_ok=True)
    old = target.with_name(f"{target.name}{REPLACED}{_token()}")
    with held(target):
        target.rename(old)
        staging.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def duplicate(source: Path, target: Path) -> None:
    """Create a hard link to a file, or a copy if the file system does not support links."""
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copy2(source, target, follow_symlinks=False)


def _move_into(out: Path, target: Path, staging: Path, ours: set[str]) -> None:
    """Move every file of ``staging`` into ``target``, which remains the same folder."""
    for name in ours:
        (target / name).unlink(missing_ok=True)
    with _refused_when_filled(out), open(target / MANIFEST, "x", encoding="utf-8") as claim:
        claim.write((staging / MANIFEST).read_text(encoding="utf-8"))
    (staging / MANIFEST).unlink()
    for name in _files(staging):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (staging / name).rename(target / name)
    shutil.rmtree(staging)
    shutil.rmtree(target / JOBS_FOLDER, ignore_errors=True)


def _sync(path: Path) -> None:
    """Flush a file or folder to the disk, so that it survives a power loss."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def staged_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file beside ``path``, with its suffix; it is flushed and becomes ``path`` if the block ends without an error.

    Leftovers of a killed process for the same file are removed.

    Args:
        path: output file.
        overwrite: whether an existing file may be replaced.

    Raises:
        ConfigurationError: ``path`` exists although ``overwrite`` is off, even if it appeared during the block; or it cannot be
            written.
        NoSpaceError: the disk is full.
    """
    check_target(path, overwrite=overwrite)
    prefix = f".{path.stem}{PARTIAL}"
    staging = path.with_name(f"{prefix}{_token()}{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_orphan_files(path, prefix)
    try:
        with _begun(path, staging, Path.touch), writing(path):
            yield staging
            _sync(staging)
            if overwrite:
                staging.replace(path)
            else:
                take_name(staging, path)
            _sync(path.parent)
    finally:
        staging.unlink(missing_ok=True)


def _remove_orphan_files(path: Path, prefix: str) -> None:
    """Remove leftovers of killed processes for the file ``path``."""
    for other in path.parent.iterdir():
        if other.name.startswith(prefix) and other.suffix == path.suffix and not is_held(other):
            other.unlink(missing_ok=True)


def take_name(staging: Path, path: Path) -> None:
    """Give a file the name ``path``, unless it is taken; the file may keep its old name as well.

    Raises:
        ConfigurationError: another process has taken the name.
    """
    with _refused_when_filled(path):
        try:
            os.link(staging, path)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            check_target(path, overwrite=False)
            staging.replace(path)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of :func:`staged_file` that killed processes left in ``folder`` and below.

    Raises:
        ConfigurationError: a file cannot be removed.
    """
    for path in folder.rglob(f".*{PARTIAL}*"):
        with writing(path):
            path.unlink(missing_ok=True)


def check_target(path: Path, *, overwrite: bool) -> None:
    """Raise ConfigurationError if ``path`` is a folder, or exists and ``overwrite`` is off."""
    with writing(path):
        if path.is_dir():
            raise ConfigurationError(f"cannot write {path}: it is a folder")
        if path.exists() and not overwrite:
            raise ConfigurationError(f"{path} exists; choose another name or add --overwrite")


def check_writable(path: Path, *, overwrite: bool) -> None:
    """Raise ConfigurationError if a file cannot be written; call it before long work. The check leaves no trace."""
    check_target(path, overwrite=overwrite)
    made = [folder for folder in path.parents if not folder.exists()]
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        for folder in made:
            folder.rmdir()


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON through a temporary file; numbers that are not finite become texts, see :func:`plain_data`."""
    with staged_file(path, overwrite=True) as staging:
        staging.write_text(json.dumps(plain_data(value), indent=2, allow_nan=False) + "\n")
