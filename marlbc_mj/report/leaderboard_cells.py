"""Cells of a leaderboard's tables: a number, its interval as a small drawing, and whether it is the best of its column."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from marlbc_mj.report.formats import DASH, fixed, significant
from marlbc_mj.results.layout_runs import Method
from marlbc_mj.results.standings import Standing
from marlbc_mj.results.statistics import Estimate
from marlbc_mj.supervisors import OWN, VELOCITY_SUPERVISORS
from marlbc_mj.util.method_names import source_of

WIDTH = 64
"""Width of the drawing of an interval [CSS pixels]."""


class IntervalMark(NamedTuple):
    """The drawing of an estimate: its interval and its value, in CSS pixels from the left."""

    low: float
    value: float
    high: float


class BoardCell(NamedTuple):
    """One cell: a number of one method."""

    text: str
    sort: float  # sort key; NaN comes last
    ends: str = ""  # the interval as text
    mark: IntervalMark | None = None
    best: bool = False
    level: bool = False  # success on this mission is not significantly below the best


class Name(NamedTuple):
    """Texts that describe a method."""

    display: str
    citation: str
    facts: str  # composition and shield
    key: str  # the method's name in files


class BoardRow(NamedTuple):
    """The row of one method."""

    name: Name
    place: str  # position by mean rank; a dash if the method did not fly every mission
    cells: tuple[BoardCell, ...]


class BoardColumn(NamedTuple):
    """One column: its heading, and how to read and show its value of a standing."""

    head: str
    read: Callable[[Standing], Estimate]
    digits: int | None = None  # decimals; None: three significant digits
    better: int = 1  # 1: larger is better, -1: smaller is, 0: neither
    span: tuple[float, float] | None = None  # range of values in the drawing; None: no drawing
    mission: str = ""  # the mission, if the column shows the success on a single one
    unit: str = ""

    @property
    def text(self) -> str:
        """The heading with its unit."""
        return self.head + (f" [{self.unit}]" if self.unit else "")


def shown_name(method: Method, *, by_controller: bool = False) -> Name:
    """Texts of a method under its supervisor's name, or under its controller's."""
    source = source_of(method.controller if by_controller else method.supervisor)
    composition = OWN if method.supervisor in VELOCITY_SUPERVISORS else method.composition
    facts = [*([] if by_controller else [composition]), *(["shield"] if method.shield else [])]
    return Name(source.display, source.citation, ", ".join(facts), method.key)


def board_rows(
    standings: Sequence[Standing], columns: Sequence[BoardColumn], *, by_controller: bool = False
) -> tuple[BoardRow, ...]:
    """All rows, in the order of the standings; the best of a column is marked if fewer than half of the methods share it."""
    grid = [[_cell(column, standing) for column in columns] for standing in standings]
    for k, column in enumerate(columns):
        values = [column.better * row[k].sort for row in grid if not math.isnan(row[k].sort)]
        if column.better and 2 * values.count(max(values, default=0.0)) < len(values):  # only if few share the best
            for row in grid:
                row[k] = row[k]._replace(best=column.better * row[k].sort == max(values))
    places = [str(k) if not math.isnan(standing.rank.value) else DASH for k, standing in enumerate(standings, 1)]
    return tuple(
        BoardRow(shown_name(standing.method, by_controller=by_controller), place, tuple(cells))
        for standing, place, cells in zip(standings, places, grid, strict=True)
    )


def _cell(column: BoardColumn, standing: Standing) -> BoardCell:
    estimate = column.read(standing)
    if math.isnan(estimate.value):
        return BoardCell(DASH, math.nan)
    value, low, high = (_number(number, column.digits) for number in estimate)
    ends = "" if math.isnan(estimate.low) else f"{low} to {high}"
    level = bool(column.mission) and column.mission in standing.level
    return BoardCell(value, estimate.value, ends, _mark(estimate, column.span), level=level)


def _number(value: float, digits: int | None) -> str:
    return significant(value) if digits is None else fixed(value, digits)


def _mark(estimate: Estimate, span: tuple[float, float] | None) -> IntervalMark | None:
    if span is None or math.isnan(estimate.low):
        return None
    first, last = span
    places = (WIDTH * min(1.0, max(0.0, (number - first) / (last - first))) for number in estimate)
    value, low, high = (round(place, 1) for place in places)
    return IntervalMark(low, value, high)
