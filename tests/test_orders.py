"""Priority orders: all permutations, and which of them command the same motion."""

from math import factorial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.core.orders import Orders
from marlbc_mj.util.errors import ConfigurationError

PAPER = Orders(("OA", "FM", "FR"), (False, True, True))
teams = st.lists(st.booleans(), min_size=1, max_size=5)


def test_the_paper_has_six_orders_and_four_commands():
    """M! = 6 orders (erratum 10), four of them distinct because J_FM = J_FR = I."""
    assert PAPER.names == ("OA>FM>FR", "OA>FR>FM", "FM>OA>FR", "FM>FR>OA", "FR>OA>FM", "FR>FM>OA")
    assert PAPER.commands == ("OA>FM", "OA>FR", "FM", "FR")
    assert PAPER.command_of.tolist() == [0, 1, 2, 2, 3, 3]
    assert PAPER.representative.tolist() == [0, 1, 2, 4]


@given(teams)
def test_orders_are_all_permutations_and_commands_their_classes(complete):
    """M! distinct rows; a command is a prefix up to its first complete behavior; its representative is an order that gives it."""
    names = [f"b{j}" for j in range(len(complete))]
    orders = Orders(names, complete)
    assert len(orders) == factorial(len(complete)) == len({tuple(row) for row in orders.table.tolist()})
    assert [orders.command_of[k] for k in orders.representative] == list(range(len(orders.commands)))
    for row, command in zip(orders.table, orders.command_of, strict=True):
        flags = [complete[j] for j in row]
        depth = flags.index(True) + 1 if any(flags) else len(flags)
        assert orders.commands[command] == ">".join(names[j] for j in row[:depth])


def test_index_takes_an_order_or_a_command():
    """A command's name gives the first order with that command, a full name exactly that order."""
    for k, name in enumerate(PAPER.names):
        assert PAPER.index(name) == k
    for k, command in enumerate(PAPER.commands):
        assert PAPER.command_of[PAPER.index(command)] == k


@pytest.mark.parametrize("name", ["", "OA", "OA>OA>FM", "fm", "FM>OA", "XX"])
def test_an_unknown_order_is_named_with_the_valid_ones(name):
    """The message quotes the name and lists commands."""
    with pytest.raises(ConfigurationError, match=r"OA>FM, OA>FR, FM, FR") as error:
        PAPER.index(name)
    assert repr(name) in str(error.value)
