"""Passing by address to compiled code: fields are read and written through a pointer, functions called at their address."""

import copy
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

from marlbc_mj.core.compiling import allocation_free, compiled
from marlbc_mj.engine.by_address import Pointer, call, entry, no_entry, point_to

pytestmark = pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing has an address")


class Pair(NamedTuple):
    rows: np.ndarray
    factor: float
    on: bool
    inner: object  # an entry


@allocation_free
def add_scaled(k, x, pair):
    if pair.on:
        pair.rows[k] += x * pair.factor
    return k + 1


@compiled
def add_at(pair, k, x):
    return call(pair.inner, k, x, pair)


@allocation_free
def halved(x):
    return 0.5 * x


def make_pair() -> Pointer:
    pair = Pair(np.zeros(3), 2.0, True, no_entry(0, 0.0, Pair))
    return point_to(pair._replace(inner=entry(add_scaled, 0, 0.0, point_to(pair))))


def test_a_function_called_by_address_changes_the_very_arrays():
    """Integers and floats are converted to the types of the entry, whatever their types at the call."""
    pair = make_pair()
    assert add_at(pair, 1, 3.0) == 2 and add_at(pair, np.uint8(2), 5) == 3
    np.testing.assert_array_equal(pair.rows, [0.0, 6.0, 10.0])
    assert call(add_scaled, 0, 1.0, pair) == 1 and pair.rows[0] == 2.0  # in Python, the function itself is called


def test_a_pointer_reads_as_its_record_and_is_replaced_like_it():
    pair = make_pair()
    off = pair._replace(on=False)
    assert (pair.factor, pair.on, off.on) == (2.0, True, False) and off.rows is pair.rows
    add_at(off, 0, 1.0)
    assert not pair.rows.any()
    with pytest.raises(AttributeError, match="no_such"):
        _ = pair.no_such


def test_a_copy_refers_to_a_copy():
    pair = make_pair()
    other = copy.deepcopy(pair)
    add_at(other, 0, 1.0)
    assert other.rows[0] == 2.0 and not pair.rows.any()


@compiled
def sum_at(pair, rows):
    return call(pair.inner, rows)


@allocation_free
def count(rows):
    return rows.shape[0]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (np.zeros((3, 2))[:, 0], "must be contiguous"),
        (np.zeros(3, dtype=np.float32), "takes array"),
        (np.zeros((3, 1)), "takes array"),
        (2.0, "takes array"),
        (Pair(np.zeros(1), 1.0, True, 0), "takes array"),
    ],
    ids=["stride", "dtype", "dimensions", "number", "record"],
)
def test_what_an_entry_does_not_take_is_an_error_of_the_compiler(rows, said):
    """It is never a memory error: the type of an entry includes its function's argument types."""
    pair = point_to(Pair(np.zeros(3), 2.0, True, entry(count, np.zeros(2))))
    assert sum_at(pair, np.zeros(4)) == 4
    with pytest.raises(NumbaError, match=said):
        sum_at(pair, rows)


def test_an_entry_must_return_a_whole_number():
    with pytest.raises(TypeError, match="whole number"):
        entry(halved, 1.0)
