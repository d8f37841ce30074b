"""Small helpers for text that people read."""

from collections.abc import Iterable

LIKE = 0.6
"""Likeness from which a word counts as a misspelling of another, from 0 to 1."""
_LONGEST = 60  # characters; nobody misspells a name by more


def one_line(text: object) -> str:
    """``str(text)`` on one line: every run of white space becomes one space."""
    return " ".join(str(text).split())


def nearest(word: str, words: Iterable[str]) -> str | None:
    """The word that is spelled most like ``word``, whatever their case; None where none is like it."""
    from difflib import get_close_matches

    by_spelling = {each.lower(): each for each in words}
    close = get_close_matches(word.lower(), by_spelling, 1, LIKE) if len(word) <= _LONGEST else []
    return by_spelling[close[0]] if close else None
