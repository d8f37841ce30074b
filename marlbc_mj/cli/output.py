"""Where a command writes: results on standard output, as text or as one JSON document; progress on standard error."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from marlbc_mj.cli.terminal import Told, no_display, progress_bars, progress_lines
from marlbc_mj.util.progress import Progress, silent


@dataclass(frozen=True)
class OutputOptions:
    """What the command prints."""

    quiet: bool = False
    """Print nothing but errors."""

    @property
    def talks(self) -> bool:
        """Whether text for people goes to standard output."""
        return not self.quiet

    def say(self, *lines: object) -> None:
        """Print lines for people on standard output."""
        if self.talks:
            for line in lines:
                print(line)

    def complain(self, problems: Iterable[str]) -> None:
        """Print what could not be made, one line per problem on standard error, also if the command is quiet."""
        for problem in problems:
            print(f"marlbc: {problem}", file=sys.stderr)

    @contextmanager
    def progress(self, *, ends: bool = True) -> Iterator[Told]:
        """See :func:`~marlbc_mj.cli.terminal.progress_bars`; nothing is shown if the command is quiet."""
        if self.quiet:
            yield Told(silent, lambda line: None)
            return
        with progress_bars(ends=ends) as told:
            yield told

    def display(self, shown: Callable[[], Any]) -> Any:
        """The display of a training run; nothing is shown if the command is quiet."""
        return nullcontext(no_display) if self.quiet else shown()

    def lines(self, before: str = "") -> Progress:
        """See :func:`~marlbc_mj.cli.terminal.progress_lines`; nothing is shown if the command is quiet."""
        return silent if self.quiet else progress_lines(before)


@dataclass(frozen=True)
class ReportOptions(OutputOptions):
    """What the command prints."""

    json: bool = False
    """Print one JSON document on standard output, and nothing else there."""

    @property
    def talks(self) -> bool:
        """Whether text for people goes to standard output."""
        return not (self.quiet or self.json)

    def report(self, text: str | Callable[[], None], document: Any) -> None:
        """Print the result as text for people, or as JSON, in which numbers that are not finite are null.

        Args:
            text: the text to print, empty for none, or a function that prints it.
            document: the result as dataclasses, named tuples, arrays, mappings, lists, texts and numbers.
        """
        if self.json:
            json.dump(_plain(document), sys.stdout, indent=2, ensure_ascii=False, allow_nan=False)
            print()
        elif self.talks and callable(text):
            text()
        elif self.talks and text:
            print(text)


def _plain(value: Any) -> Any:
    """JSON data: dataclasses and named tuples become objects, numbers that are not finite become null."""
    from marlbc_mj.util.provenance import plain_data

    return plain_data(_named(value), not_finite=lambda _: None)


def _named(value: Any) -> Any:
    """Nested dataclasses and named tuples as dicts, and NumPy's numbers as Python's."""
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: _named(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: _named(entry) for name, entry in value._asdict().items()}
    if isinstance(value, dict):
        return {key: _named(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_named(entry) for entry in value]
    return value.item() if hasattr(value, "dtype") and getattr(value, "ndim", 1) == 0 else value
