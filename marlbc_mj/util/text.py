"""Small helpers for human-readable text."""

from collections.abc import Iterable

LIKE = 0.6
"""Least likeness, from 0 to 1, at which a word counts as a misspelling of another."""
_LONGEST = 60  # characters; a longer word is no misspelled name


def one_line(text: object) -> str:
    """``str(text)`` on one line: every run of white space becomes one space."""
    return " ".join(str(text).split())


def nearest_word(word: str, words: Iterable[str]) -> str | None:
    """The word spelled most like ``word``, ignoring case; None if none is similar enough."""
    if len(word) > _LONGEST:
        return None
    scored = [(_likeness(word.lower(), each.lower()), each) for each in words]
    best = max(scored, key=lambda pair: pair[0], default=(0.0, ""))
    return best[1] if best[0] >= LIKE else None


def _likeness(one: str, other: str) -> float:
    """Likeness of two words, from 0 to 1; a prefix up to the last dot that both share does not count."""
    from difflib import SequenceMatcher

    (table, _, name), (same, _, like) = one.rpartition("."), other.rpartition(".")
    pair = (name, like) if table == same else (one, other)
    return SequenceMatcher(None, *pair).ratio()
