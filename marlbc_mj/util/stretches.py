"""Runs of equal consecutive values in a sequence."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np


def stretches(values: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Yield (start, end, value) for every run of equal consecutive integers in ``values`` (M,); ``end`` is exclusive."""
    if len(values):
        cuts = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
        yield from ((start, end, int(values[start])) for start, end in pairwise(cuts))
