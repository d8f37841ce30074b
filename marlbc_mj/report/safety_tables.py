"""Tables of many layouts, missions, compositions and shields: rates on all missions, then all scores of each mission."""

import csv
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from marlbc_mj.report.formats import DASH, fixed, interval, percent, significant
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.layouts import CellScores, MissionCell
from marlbc_mj.results.statistics import Estimate
from marlbc_mj.util.method_names import display_name


def write_cells(rows: Sequence[CellScores], path: Path) -> None:
    """Write a CSV file with one line per cell: shares in [0, 1], medians, and their intervals; missing numbers are empty."""
    columns: list[tuple[str, list[str]]] = [
        (name, [str(row.cell[k]) for row in rows]) for k, name in enumerate(MissionCell._fields)
    ]
    for name in CellScores._fields[1:]:
        values = [getattr(row, name) for row in rows]
        if rows and isinstance(values[0], Estimate):
            ends = zip((name, f"{name}_low", f"{name}_high"), zip(*values, strict=True), strict=True)
            columns += [(head, [_number(value) for value in column]) for head, column in ends]
        else:
            columns.append((name, [value if isinstance(value, str) else _number(value) for value in values]))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([head for head, _ in columns])
        writer.writerows(zip(*(cells for _, cells in columns), strict=True))


def _number(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""


def safety_tables(rows: Sequence[CellScores]) -> list[Table]:
    """Tables of success and violation rates on all missions, each without and with a shield; then one table per mission."""
    overviews = [
        _overview(rows, name, shield)
        for name in ("success", "violation")
        for shield in dict.fromkeys(row.cell.shield for row in rows)
    ]
    missions = groupby(rows, lambda row: row.cell.mission)
    return [*overviews, *(_mission_table(mission, list(each)) for mission, each in missions)]


def _overview(rows: Sequence[CellScores], name: str, shield: bool) -> Table:
    """One rate of every supervisor on every mission, in percent; a dash if nothing was flown."""
    missions = list(dict.fromkeys(row.cell.mission for row in rows))
    shown = {
        (row.cell.supervisor, row.cell.composition, row.cell.mission): interval(percent(getattr(row, name)), 1)
        for row in rows
        if row.cell.shield == shield and not row.refused
    }
    methods = dict.fromkeys(key[:2] for key in shown)
    cells = tuple(
        (display_name(method[0]), method[1], *(shown.get((*method, mission), DASH) for mission in missions)) for method in methods
    )
    columns = (Column("", "supervisor"), Column("", "composition"), *(Column("", mission) for mission in missions))
    caption = f"{name.capitalize()}, % of layouts, {'with' if shield else 'without'} a shield"
    return Table(f"safety-{name}-{'shield' if shield else 'free'}", caption, columns, cells)


def _mission_table(mission: str, rows: Sequence[CellScores]) -> Table:
    columns = (
        Column("", "supervisor"),
        Column("", "composition"),
        Column("", "shield"),
        Column("", "layouts"),
        Column("success", "rate", "%"),
        Column("violation", "rate", "%"),
        Column("agents collided", "rate", "%"),
        Column("return", "team, median"),
        Column("switches", "sum, median"),
        Column("effort", "sum, median", "N s"),
        Column("decision", "median", "ms"),
    )
    flown = [row for row in rows if not row.refused]
    reasons = {row.reason: display_name(row.cell.supervisor) for row in rows if row.refused}
    notes = tuple(f"Not run: {supervisor}: {reason}." for reason, supervisor in reasons.items())
    return Table(f"safety-{mission}", mission, columns, tuple(map(_cells, flown)), notes)


def _cells(row: CellScores) -> tuple[str, ...]:
    rates = (interval(percent(one), 1) for one in (row.success, row.violation, row.collided))
    names = display_name(row.cell.supervisor), row.cell.composition, "yes" if row.cell.shield else "no"
    numbers = (interval(row.total, 0), fixed(row.switches, 0), fixed(row.effort, 0), significant(row.decision_ms, 2))
    return (*names, str(row.layouts), *rates, *numbers)
