"""Which files and folders a living process is writing: it holds the system's lock on them, which ends with the process."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from marlbc_mj.util.errors import ConfigurationError

if sys.platform != "win32":
    import fcntl


def lock(descriptor: int) -> None:
    """Hold the lock of an open file or folder until it is closed; nothing where the system has none."""
    if sys.platform != "win32":
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # :func:`is_held` of another process takes it for a moment


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold the lock of a file or folder during the block, whatever its name becomes; nothing where the system has none."""
    if sys.platform == "win32":
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        lock(descriptor)
        yield
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether a process holds the lock of a file or folder; true also where that cannot be told."""
    if sys.platform == "win32":
        return True
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    else:
        return False
    finally:
        os.close(descriptor)


@contextmanager
def held_alone(path: Path, otherwise: str) -> Iterator[None]:
    """Hold the lock of a folder, or of a file, which is made, during the block; nothing where the system has none.

    Raises:
        ConfigurationError: ``otherwise``; another process holds it, or has removed the file meanwhile.
    """
    if sys.platform == "win32":
        yield
        return
    try:
        descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT, 0o666)
    except FileNotFoundError:
        raise ConfigurationError(otherwise) from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigurationError(otherwise) from None
        except OSError:  # a file system without locks
            pass
        if not path.exists() or not os.path.samestat(os.fstat(descriptor), path.stat()):
            raise ConfigurationError(otherwise)
        yield
    finally:
        os.close(descriptor)
