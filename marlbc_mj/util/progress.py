"""How work that takes long tells how far it is: one shape for bars, lines and tests."""

from collections.abc import Callable

Progress = Callable[[str, float, float], None]
"""Called with what is being done, how much of it is done and how much there is."""


def silent(what: str, done: float, total: float) -> None:
    """The progress that nobody watches."""
