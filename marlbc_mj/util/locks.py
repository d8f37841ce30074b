"""Locks on files and folders that a running process is writing; the system releases them when the process ends."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from marlbc_mj.util.errors import ConfigurationError

if sys.platform != "win32":
    import fcntl


def lock(descriptor: int) -> None:
    """Lock an open file or folder until it is closed; does nothing on systems without locks."""
    if sys.platform != "win32":
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # waits, as :func:`is_held` of another process takes it briefly


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Lock a file or folder during the block, even if it is renamed; does nothing on systems without locks."""
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
    """Whether a process holds the lock of a file or folder; also true if that cannot be determined."""
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
def exclusive_lock(path: Path, otherwise: str) -> Iterator[None]:
    """Lock a folder, or a file, which is created if missing, during the block; does nothing on systems without locks.

    Raises:
        ConfigurationError: another process holds the lock, or has removed the file or folder; the message is ``otherwise``.
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
