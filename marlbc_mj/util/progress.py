"""Progress of long computations: one callback type for progress bars, printed lines and tests."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float, float], None]
"""Progress callback, called with the name of the stage, the amount done and the total."""


def silent(what: str, done: float, total: float) -> None:
    """A progress callback that does nothing."""


def note(line: str) -> None:
    """Print one line of unrequested information for the user on standard error, unless :func:`hushed`."""
    if not _hushed:
        print(f"marlbc: {line}", file=sys.stderr, flush=True)


_hushed = False


@contextmanager
def hushed(quiet: bool) -> Iterator[None]:
    """If ``quiet``, suppress the output of :func:`note` within the block."""
    global _hushed
    before, _hushed = _hushed, quiet or _hushed
    try:
        yield
    finally:
        _hushed = before
