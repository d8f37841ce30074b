"""The page of a run that has not ended: written anew as methods end, among the run's other files."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import Generic, TypeVar

from marlbc_mj.util.files import JOBS_FOLDER, writing
from marlbc_mj.util.progress import note

EndedT = TypeVar("EndedT")
REWRITE_AFTER = 1.0  # least time between two versions of the page [s]
WRITING_SHARE = 0.1  # of the run's time, that writing it may take


class SoFar(Generic[EndedT]):
    """The page and the tables of a run that has not ended; they grow as methods end.

    Args:
        out: folder of the run.
        keys: of all methods, in the order in which they are shown.
        write: writes the results that there are, of how many, into a folder.
    """

    def __init__(self, out: Path, keys: Sequence[str], write: Callable[[Sequence[EndedT], int, Path], None]) -> None:
        self.folder, self.keys, self.write = out / JOBS_FOLDER / "so_far", keys, write
        self.results: dict[str, EndedT] = {}
        self._next = -math.inf  # earliest time of the next version [s]

    def add(self, key: str, result: EndedT) -> None:
        """One more method has ended."""
        self.results[key] = result
        if monotonic() < self._next and len(self.results) < len(self.keys):
            return
        began = monotonic()
        if not self.folder.is_dir():
            with writing(self.folder):
                self.folder.mkdir(parents=True)
            note(f"{self.folder / 'index.html'} grows as methods end")
        with writing(self.folder):
            self.write([self.results[key] for key in self.keys if key in self.results], len(self.keys), self.folder)
        now = monotonic()
        self._next = now + max(REWRITE_AFTER, (now - began) / WRITING_SHARE)
