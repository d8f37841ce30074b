"""The errors that this package raises on purpose; each message names the wrong value and the valid ones."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from marlbc_mj.util.text import nearest_word


class MarlbcError(Exception):
    """Base class of all errors that marlbc_mj raises on purpose; the command line reports them in one line."""

    exit_status = 2


class ConfigurationError(MarlbcError, ValueError):
    """An invalid setting, file or combination of settings. Exit status 2."""


class SimulationError(MarlbcError, RuntimeError):
    """A run that started but could not finish, for example because a world diverged. Exit status 3."""

    exit_status = 3


class NoSpaceError(ConfigurationError):
    """An output that does not fit on the disk, although the command is valid. Exit status 3."""

    exit_status = 3


def unknown(kind: str, name: object, valid: Iterable[str]) -> ConfigurationError:
    """The error for a name that is not in a list; its message has the name, a similarly spelled one and the list."""
    names = list(valid)
    if isinstance(name, str) and name.endswith(".py") and "FILE.py:NAME" in names:
        return ConfigurationError(f"{name!r} is a file; add the name of the {kind} in it: {name}:NAME")
    like = nearest_word(name, names) if isinstance(name, str) else None
    perhaps = "" if like is None else f" perhaps {like!r};"
    return ConfigurationError(f"unknown {kind} {name!r};{perhaps} choose from: {', '.join(names)}")


def check_named_once(kind: str, names: Sequence[str]) -> None:
    """Check that no name occurs twice; ``kind`` is the word for the named things in the message.

    Raises:
        ConfigurationError: a name occurs twice; the message lists all names.
    """
    if len(set(names)) != len(names):
        raise ConfigurationError(f"a{'n' if kind[0] in 'aeiou' else ''} {kind} is named twice: {', '.join(names)}")


@contextmanager
def enough_memory(what: str) -> Iterator[None]:
    """Turn an out-of-memory error of Python, NumPy or torch inside the block into a one-line error about ``what``.

    Raises:
        ConfigurationError: there is not enough memory.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MarlbcError) or not (isinstance(error, MemoryError) or "allocate memory" in str(error)):
            raise
        raise ConfigurationError(f"{what} need more memory than is available") from error
