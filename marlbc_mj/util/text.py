"""Small helpers for text that people read."""

from collections.abc import Iterable

LIKE = 0.6
"""Likeness from which a word counts as a misspelling of another, from 0 to 1."""
_LONGEST = 60  # characters; nobody misspells a name by more


def one_line(text: object) -> str:
    """``str(text)`` on one line: every run of white space becomes one space."""
    return " ".join(str(text).split())


def nearest_word(word: str, words: Iterable[str]) -> str | None:
    """The word that is spelled most like ``word``, whatever their case; None where none is like it."""
    if len(word) > _LONGEST:
        return None
    scored = [(_likeness(word.lower(), each.lower()), each) for each in words]
    best = max(scored, key=lambda pair: pair[0], default=(0.0, ""))
    return best[1] if best[0] >= LIKE else None


def _likeness(one: str, other: str) -> float:
    """From 0 to 1; what two dotted names have in common before their last dot does not count."""
    from difflib import SequenceMatcher

    (table, _, name), (same, _, like) = one.rpartition("."), other.rpartition(".")
    pair = (name, like) if table == same else (one, other)
    return SequenceMatcher(None, *pair).ratio()
