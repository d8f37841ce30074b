"""Progress of long work: one callback type for bars, lines and tests."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float, float], None]
"""Called with the stage, the amount done and the total."""


def silent(what: str, done: float, total: float) -> None:
    """A progress callback that does nothing."""


def note(line: str) -> None:
    """Say something that the user should know and did not ask for, in one line on standard error; see :func:`hushed`."""
    if not _hushed:
        print(f"marlbc: {line}", file=sys.stderr, flush=True)


_hushed = False


@contextmanager
def hushed(quiet: bool) -> Iterator[None]:
    """Within the block, if ``quiet``, :func:`note` says nothing."""
    global _hushed
    before, _hushed = _hushed, quiet or _hushed
    try:
        yield
    finally:
        _hushed = before
