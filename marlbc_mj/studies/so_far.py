"""The page of an unfinished run: rewritten as methods end, in the folder of the run's temporary files."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import Generic, TypeVar

from marlbc_mj.util.files import JOBS_FOLDER, writing
from marlbc_mj.util.progress import note

EndedT = TypeVar("EndedT")
REWRITE_AFTER = 1.0  # least time between two rewrites of the page [s]
WRITING_SHARE = 0.1  # greatest share of the run's time spent on writing the page


class PartialPage(Generic[EndedT]):
    """The page and tables of an unfinished run; they grow as methods end.

    Args:
        out: output folder of the run.
        keys: keys of all methods, in display order.
        write: called with the results so far, the total number of methods, and the folder to write into.
    """

    def __init__(self, out: Path, keys: Sequence[str], write: Callable[[Sequence[EndedT], int, Path], None]) -> None:
        self.folder, self.keys, self.write = out / JOBS_FOLDER / "so_far", keys, write
        self.results: dict[str, EndedT] = {}
        self._next = -math.inf  # earliest time of the next rewrite [s]

    def add(self, key: str, result: EndedT) -> None:
        """Add the result of a method that has ended, and rewrite the page if it is due."""
        self.results[key] = result
        if monotonic() < self._next and len(self.results) < len(self.keys):
            return
        began = monotonic()
        if not self.folder.is_dir():
            with writing(self.folder):
                self.folder.mkdir(parents=True)
            note(f"{self.folder / 'index.html'} is updated as methods end")
        with writing(self.folder):
            self.write([self.results[key] for key in self.keys if key in self.results], len(self.keys), self.folder)
        now = monotonic()
        self._next = now + max(REWRITE_AFTER, (now - began) / WRITING_SHARE)
