"""Output folders and files, which appear whole or not at all, and never replace files of others."""

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
from marlbc_mj.util.locks import held, held_alone, is_held
from marlbc_mj.util.provenance import plain_data

PARTIAL = ".partial-"
"""Part of the name of an incomplete file or folder, before the number of the process that writes it and a random token."""
REPLACED = ".old-"
"""Part of the name of a folder that is being replaced, before the same."""
JOBS_FOLDER = ".jobs"
"""Folder, in an output folder, of what a run that has not ended keeps; not counted as content, and replaced with the rest."""
MANIFEST = ".marlbc-files.json"
"""Names of all files that :func:`staged_folder` wrote into a folder: the only ones that ``overwrite`` removes."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""The system's errors for an output that is too large for the disk, a quota, or a limit of the process."""


@contextmanager
def staged_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into; it becomes ``out`` if the block ends without an error, and is removed otherwise.

    What a killed process left in the same place is removed. A link to a folder stays a link.

    Args:
        out: the folder.
        overwrite: whether ``out`` may hold something. What this function wrote there before is replaced, the rest stays.

    Raises:
        ConfigurationError: ``out`` is not empty (and ``overwrite`` is off), also if another process filled it during the block;
            it is a file, or cannot be written.
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
    """Raise ConfigurationError if ``out`` holds something that may not be overwritten."""
    with writing(out):
        if out.is_file():
            raise ConfigurationError(f"output folder {out} is a file")
        if out.is_dir() and not overwrite and any(not _counts_not(path.name) for path in out.iterdir()):
            raise ConfigurationError(f"output folder {out} is not empty; choose another or add --overwrite")


@contextmanager
def alone_in(out: Path, *, overwrite: bool) -> Iterator[None]:
    """Write into ``out``, which is made, as the only process of this program that does.

    What was made is removed, with its parents, if no file is left there.

    Raises:
        ConfigurationError: another process is at it; ``out`` holds something (and ``overwrite`` is off), or cannot be written.
    """
    check_folder(out, overwrite=overwrite)
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    with held_alone(out, busy(out)):
        check_folder(out, overwrite=overwrite)  # a process that has ended meanwhile may have filled it
        try:
            yield
        finally:
            for folder in made:
                with suppress(OSError):  # there is something in it
                    folder.rmdir()


def busy(out: Path) -> str:
    """What is said where another process writes into ``out``."""
    return f"{out} is being written by another process; wait for it or choose another folder"


def _counts_not(name: str) -> bool:
    """Whether a name in an output folder belongs to an unfinished output of this program."""
    return PARTIAL in name or name == JOBS_FOLDER


@contextmanager
def _begun(out: Path, staging: Path, create: Callable[[Path], None]) -> Iterator[None]:
    """Create ``staging`` and hold its lock during the block. Others never see it without the lock: they would remove it."""
    first = staging.with_name(f".new-{staging.name}")
    with writing(out):
        create(first)
    with held(first):
        first.rename(staging)
        yield


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turn the system's errors inside the block into one line about ``out``.

    Raises:
        NoSpaceError: no space left.
        ConfigurationError: any other error of the system.
    """
    try:
        yield
    except OSError as error:
        kind = NoSpaceError if error.errno in NO_SPACE else ConfigurationError
        raise kind(f"cannot write {out}: {error.strerror or error}") from error


@contextmanager
def no_space_is_an_error(out: Path) -> Iterator[None]:
    """Turn a full disk inside the block into a NoSpaceError about ``out``; other errors pass."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise NoSpaceError(f"cannot write {out}: {error.strerror}") from error


def _token() -> str:
    """The number of this process, for people, and a random one: in containers all processes may have the same number."""
    return f"{os.getpid()}-{secrets.token_hex(3)}"


def _stays(folder: Path) -> bool:
    """Whether a folder must be filled where it is: another file system is mounted there, or it is the current one."""
    return folder.is_dir() and (folder.is_mount() or folder.samefile(Path.cwd()))


def remove_orphans(out: Path) -> tuple[Path, Path]:
    """Remove what killed processes left of ``out``, and bring back a folder that one was about to replace.

    Returns:
        ``out`` without links, and the folder in which it is made, which is there now.

    Raises:
        ConfigurationError: the system refuses.
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
    """Make ``staging`` the folder ``target``, which the user calls ``out``."""
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
    """Names of all files below ``folder``, relative to it, but those of an unfinished run."""
    found = (path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
    return sorted(path.relative_to(folder).as_posix() for path in found if not path.is_relative_to(folder / JOBS_FOLDER))


def _written_before(folder: Path) -> set[str]:
    """What :func:`staged_folder` says that it wrote into ``folder``; nothing where it cannot be read."""
    with suppress(OSError, ValueError, TypeError):
        names = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return {MANIFEST, *(name for name in names if ".." not in PurePosixPath(name).parts and not Path(name).is_absolute())}
    return set()


@contextmanager
def _refused_when_filled(out: Path) -> Iterator[None]:
    """The error for a name that another process took first."""
    try:
        yield
    except FileExistsError as error:
        raise ConfigurationError(f"{out} has been written by another process meanwhile; choose another name") from error
    except OSError as error:
        if error.errno != errno.ENOTEMPTY:
            raise
        raise ConfigurationError(f"output folder {out} has been filled by another process meanwhile; choose another") from error


def _swap(target: Path, staging: Path, ours: set[str]) -> None:
    """Replace ``target`` by ``staging``, into which what others wrote there is taken along first."""
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
    """A second name of the same file, a copy where the file system has no such thing."""
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copy2(source, target, follow_symlinks=False)


def _move_into(out: Path, target: Path, staging: Path, ours: set[str]) -> None:
    """Move every file of ``staging`` into ``target``, which stays the folder that it is."""
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
    """Flush a file or a folder to the disk, so that it survives a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def staged_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path beside ``path``, with its suffix; it becomes ``path``, on the disk, if the block ends without an error.

    What a killed process left of the same file is removed.

    Args:
        path: the file.
        overwrite: whether an existing file may be replaced.

    Raises:
        ConfigurationError: ``path`` exists (and ``overwrite`` is off), also if it appeared during the block, or the system
            refuses to write it.
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
    """Remove what killed processes left of ``path``."""
    for other in path.parent.iterdir():
        if other.name.startswith(prefix) and other.suffix == path.suffix and not is_held(other):
            other.unlink(missing_ok=True)


def take_name(staging: Path, path: Path) -> None:
    """Give a file the name ``path``, unless it is taken; it may keep its old name, too.

    Raises:
        ConfigurationError: another process has taken the name.
    """
    with _refused_when_filled(path):
        try:
            os.link(staging, path)
        except FileExistsError:
            raise
        except OSError:  # a file system without second names
            check_target(path, overwrite=False)
            staging.replace(path)


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
    with writing(path):
        if path.is_dir():
            raise ConfigurationError(f"cannot write {path}: it is a folder")
        if path.exists() and not overwrite:
            raise ConfigurationError(f"{path} exists; choose another name or add --overwrite")


def check_writable(path: Path, *, overwrite: bool) -> None:
    """Raise ConfigurationError if a file cannot be written, before the work that it is to hold. Nothing is left of the trial."""
    check_target(path, overwrite=overwrite)
    made = [folder for folder in path.parents if not folder.exists()]
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        for folder in made:
            folder.rmdir()


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON through a temporary file; numbers that are not finite are texts in it, see :func:`plain_data`."""
    with staged_file(path, overwrite=True) as staging:
        staging.write_text(json.dumps(plain_data(value), indent=2, allow_nan=False) + "\n")
