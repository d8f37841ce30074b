"""Small helpers for text that people read."""


def one_line(text: object) -> str:
    """``str(text)`` without line breaks."""
    return " ".join(str(text).split())
