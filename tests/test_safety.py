"""The condition for a violation of the safe distance, and stretches of equal values."""

from itertools import pairwise

import numpy as np
import pytest

from marlbc_mj.core import laws
from marlbc_mj.core.safety import violates
from marlbc_mj.util.stretches import stretches


@laws.allocation_free
def how_many(clearance, safe_distance):
    count = 0
    for d in clearance:
        count += violates(d, safe_distance)
    return count


@pytest.mark.parametrize("size", [0, 1, 7])
def test_scalars_arrays_and_compiled_loops_agree(size):
    """Clearances at or below the safe distance violate it; those above it, infinity without obstacles, and NaN do not."""
    clearance = np.array([2.0, np.nextafter(2.0, 3.0), -1.0, np.inf, np.nan, 2.0, 1.9])[:size]
    expected = np.array([True, False, True, False, False, True, True])[:size]
    assert violates(clearance, 2.0).tolist() == expected.tolist()
    assert [bool(violates(d, 2.0)) for d in clearance] == expected.tolist()
    assert how_many(clearance, 2.0) == expected.sum()


def test_stretches_tile_the_sequence():
    """Each is as long as possible, and together they reproduce the values; an empty sequence has none."""
    assert list(stretches(np.array([1, 1, 0, 2, 2]))) == [(0, 2, 1), (2, 3, 0), (3, 5, 2)]
    assert list(stretches(np.array([], dtype=int))) == []
    values = np.random.default_rng(0).integers(0, 3, 200)
    parts = list(stretches(values))
    assert np.concatenate([np.full(end - start, value) for start, end, value in parts]).tolist() == values.tolist()
    assert all(left[2] != right[2] for left, right in pairwise(parts))
