"""The errors that this package raises on purpose; every message names the value and the valid ones."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from marlbc_mj.util.text import nearest_word


class MarlbcError(Exception):
    """Root of all errors raised on purpose by marlbc_mj; the command line turns them into one line."""

    exit_status = 2


class ConfigurationError(MarlbcError, ValueError):
    """A setting, a file or a combination of settings that cannot be run. Exit status 2."""


class SimulationError(MarlbcError, RuntimeError):
    """A run that started and could not be finished, a diverged world for example. Exit status 3."""

    exit_status = 3


class NoSpaceError(ConfigurationError):
    """An output that the disk has no room for; the command itself was right. Exit status 3."""

    exit_status = 3


def unknown(kind: str, name: object, valid: Iterable[str]) -> ConfigurationError:
    """The error for a name that is not in a list: says which one and which is spelled like it, and shows the list."""
    names = list(valid)
    like = nearest_word(name, names) if isinstance(name, str) else None
    perhaps = "" if like is None else f" perhaps {like!r};"
    return ConfigurationError(f"unknown {kind} {name!r};{perhaps} choose from: {', '.join(names)}")


def check_named_once(kind: str, names: Sequence[str]) -> None:
    """Refuse names of which one is given twice; ``kind`` says what they name.

    Raises:
        ConfigurationError: showing the names.
    """
    if len(set(names)) != len(names):
        raise ConfigurationError(f"a{'n' if kind[0] in 'aeiou' else ''} {kind} is named twice: {', '.join(names)}")


@contextmanager
def enough_memory(what: str) -> Iterator[None]:
    """Turn a lack of memory inside the block, Python's, NumPy's or torch's, into one line about ``what``.

    Raises:
        ConfigurationError: memory was asked for that is not there.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MarlbcError) or not (isinstance(error, MemoryError) or "allocate memory" in str(error)):
            raise
        raise ConfigurationError(f"{what} need more memory than there is") from error
