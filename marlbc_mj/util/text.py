"""Small helpers for text that people read."""


def one_line(text: object) -> str:
    """``str(text)`` on one line: every run of white space becomes one space."""
    return " ".join(str(text).split())
