"""leaderboard.html and leaderboard.tex: separate rankings of the suite's supervisors and controllers."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.report import paper_values
from marlbc_mj.report.formats import percent, spans
from marlbc_mj.report.leaderboard_cells import WIDTH, BoardCell, BoardColumn, BoardRow, Name, board_rows, shown_name
from marlbc_mj.report.page import origin_facts
from marlbc_mj.report.table import Column, Table
from marlbc_mj.report.tables import latex_document
from marlbc_mj.report.templates import render
from marlbc_mj.results.layout_runs import Method, MissionRuns
from marlbc_mj.results.standings import (
    Notable,
    Standing,
    by_cost,
    finished,
    mission_weights,
    notable_layouts,
    on_common_layouts,
    rank_methods,
    share_of,
)
from marlbc_mj.results.statistics import Estimate
from marlbc_mj.util.method_names import display_name

LEADERBOARD_PAGE, LEADERBOARD_TEX = "leaderboard.html", "leaderboard.tex"
SUPERVISOR_REFERENCE = "fsams-hysteresis"
"""The supervisor against which the probability of improvement is measured, with the null-space composition."""
CONTROL_REFERENCE = "sorlc"
"""The controller against which the probability of improvement is measured."""
CONTROL = "control"
"""The track that compares controllers."""
_REFERENCE_NOTE = (
    f"Reference: {display_name(SUPERVISOR_REFERENCE)} under the null-space composition. A run that was not finished, or not "
    "begun because the method refuses the mission, also counts as violated, struck and collided."
)
LEADING = 3
"""Number of columns that every table begins with; in text, only these show their intervals."""
MOST_COLUMNS = 12
"""Largest number of columns that fits a printed page."""


class Board(NamedTuple):
    """One sortable table."""

    name: str
    title: str
    note: str
    columns: tuple[BoardColumn, ...]
    rows: tuple[BoardRow, ...]

    def table(self) -> Table:
        """The board as a text table for LaTeX and the terminal; success on single missions is left out if it would not fit."""
        wide = len(self.columns) > MOST_COLUMNS
        kept = [k for k, column in enumerate(self.columns) if not (wide and column.mission)]
        heads = (Column("", "method"), *(Column("", self.columns[k].text) for k in kept))
        rows = tuple((_words(row.name), *(_text(row.cells[k], with_ends=k < LEADING) for k in kept)) for row in self.rows)
        return Table(f"board-{self.name}", f"{self.title}. {self.note}", heads, rows)


class Failure(NamedTuple):
    """One reason why runs of a method failed on a mission."""

    mission: str
    reason: str
    runs: int  # number of runs that failed for this reason
    of: int  # total number of runs


class NotableLayout(NamedTuple):
    """A layout worth watching."""

    track: str
    kind: str  # ``worst`` or ``median``
    mission: str
    seed: int
    ended: str  # outcome in words
    clip: str  # path of the video; empty: not rendered


class Detail(NamedTuple):
    """Details of one method, shown after a click."""

    name: Name
    facts: str
    failures: tuple[Failure, ...]
    looks: tuple[NotableLayout, ...]


def write_leaderboard(
    groups: Sequence[MissionRuns], facts: Mapping[str, Any], tracks: Mapping[str, str], folder: Path
) -> list[Table]:
    """Write the page and the LaTeX tables; returns the tables.

    Args:
        groups: the runs of every method on every mission that it flew.
        facts: content of suite.json on the origin of the rows.
        tracks: one-line description of every track by name, in display order.
        folder: output folder, which is also searched for clips.
    """
    every = sum(len(each.runs) for each in groups)
    groups = on_common_layouts(groups)
    boards = make_boards(groups, tracks)
    text = render(
        "leaderboard.html",
        title=f"Leaderboard of suite {facts['suite']['version']}",
        facts=_page_facts(groups, facts, every),
        missions=_missions(groups, tracks),
        command=str(facts["command"]),
        boards=boards,
        width=WIDTH,
        details=_details(groups, folder),
        citation=paper_values.CITATION,
        doi=paper_values.DOI,
    )
    (folder / LEADERBOARD_PAGE).write_text(text, encoding="utf-8")
    tables = [board.table() for board in boards]
    (folder / LEADERBOARD_TEX).write_text(latex_document(tables), encoding="utf-8")
    return tables


def leading_tables(tables: Sequence[Table]) -> list[Table]:
    """Tables for the terminal: supervisors over all tracks, and controllers; all tables if there is neither."""
    shown = [table for table in tables if table.name in ("board-supervisors", "board-controllers")]
    return shown or list(tables)


def make_boards(groups: Sequence[MissionRuns], tracks: Mapping[str, str]) -> list[Board]:
    """All tables: supervisors over all tracks, controllers, then supervisors on each track."""
    by_track = {name: [each for each in groups if each.track == name] for name in tracks}
    flown = {name: own for name, own in by_track.items() if own}
    control = flown.pop(CONTROL, [])
    each = {name: _track_board(name, tracks[name], own) for name, own in flown.items()}
    boards = [_overall_board(flown)] if len(flown) > 1 else []
    boards += [_control_board(tracks[CONTROL], control)] if control else []
    return [*boards, *each.values()]


def _share(kind: str) -> Callable[[Standing], Estimate]:
    return lambda standing: percent(standing.shares[kind])


def _median(name: str) -> Callable[[Standing], Estimate]:
    """Read the mean over missions of a score's median, every track with the same weight, without an interval.

    Missions on which no run finished are left out.
    """

    def read(standing: Standing) -> Estimate:
        medians = {mission: np.median(column) for mission, each in standing.flown.items() if len(column := finished(each, name))}
        if not medians:
            return Estimate(np.nan, np.nan, np.nan)
        weights = mission_weights({mission: standing.flown[mission].track for mission in medians}, by_track=True)
        return Estimate(sum(weights[mission] * float(median) for mission, median in medians.items()), np.nan, np.nan)

    return read


def _leading(count: int) -> list[BoardColumn]:
    """The columns that every table begins with."""
    return [
        BoardColumn("mean rank", lambda standing: standing.rank, 2, -1, (1.0, max(2.0, float(count)))),
        BoardColumn("better than reference", lambda standing: percent(standing.improvement), 0, 1, (0.0, 100.0), unit="%"),
        BoardColumn("success", _share("success"), 1, 1, (0.0, 100.0), unit="%"),
    ]


_SAFETY_AND_COST = (
    BoardColumn("violation", _share("violated"), 1, -1, (0.0, 100.0), unit="%"),
    BoardColumn("struck", _share("struck"), 1, -1, (0.0, 100.0), unit="%"),
    BoardColumn("collided", _share("collided"), 1, -1, (0.0, 100.0), unit="%"),
    BoardColumn("not finished", _share("unfinished"), 1, -1, (0.0, 100.0), unit="%"),
    BoardColumn("switches", _median("switches"), 1, 0),
    BoardColumn("decision", _median("decision_ms"), None, 0, unit="ms"),
)


def _overall_board(flown: Mapping[str, Sequence[MissionRuns]]) -> Board:
    """Supervisors over all tracks, regardless of the controller; every track has the same weight."""
    pooled = {name: [_without_controller(each) for each in own] for name, own in flown.items()}
    standings = rank_methods([each for own in pooled.values() for each in own], Method(SUPERVISOR_REFERENCE, ""), by_track=True)
    tracks = {name: {s.method: s for s in rank_methods(own)} for name, own in pooled.items()}
    columns = (
        *_leading(len(standings)),
        *(BoardColumn(name, _on_track(own), 1, 1, (0.0, 100.0), unit="%") for name, own in tracks.items()),
        *_SAFETY_AND_COST,
    )
    note = f"Means over missions, every track with the same weight. {_REFERENCE_NOTE}"
    return Board("supervisors", "Supervisors", note, columns, board_rows(standings, columns))


def _without_controller(each: MissionRuns) -> MissionRuns:
    return each._replace(method=each.method._replace(controller=""))


def _on_track(own: Mapping[Method, Standing]) -> Callable[[Standing], Estimate]:
    """Read a method's success on one track."""
    nothing = Estimate(np.nan, np.nan, np.nan)
    return lambda standing: percent(own[standing.method].shares["success"]) if standing.method in own else nothing


def _track_board(name: str, summary: str, own: Sequence[MissionRuns]) -> Board:
    laws = dict.fromkeys(each.method.controller for each in own)
    standings = rank_methods(own, Method(SUPERVISOR_REFERENCE, next(iter(laws))))
    missions = dict.fromkeys(each.mission for each in own)
    several = (BoardColumn(mission, _on_mission(mission), 0, 1, (0.0, 100.0), mission, "%") for mission in missions)
    columns = (*_leading(len(standings)), *(several if len(missions) > 1 else ()), *_SAFETY_AND_COST)
    note = f"With {' and '.join(map(display_name, laws))}: {summary}. {_REFERENCE_NOTE}"
    return Board(name, f"Supervisors: track {name}", note, columns, board_rows(standings, columns))


def _on_mission(mission: str) -> Callable[[Standing], Estimate]:
    nothing = Estimate(np.nan, np.nan, np.nan)
    return lambda standing: percent(share_of(standing.flown[mission], "success")) if mission in standing.flown else nothing


def _control_board(summary: str, own: Sequence[MissionRuns]) -> Board:
    supervisor = own[0].method.supervisor
    standings = rank_methods(own, Method(supervisor, CONTROL_REFERENCE), merit=by_cost)
    columns = (
        *_leading(len(standings)),
        BoardColumn("violation", _share("violated"), 1, -1, (0.0, 100.0), unit="%"),
        BoardColumn("cost", _median("cost_integral_sum"), None, -1),
        BoardColumn("effort", _median("effort_integral_sum"), None, -1, unit="N s"),
        BoardColumn("‖e_p‖", _median("rms_position_error_rms"), None, -1, unit="m"),
        BoardColumn("return", _median("return"), 0, 1),
    )
    ranked = "Ranked by success, then by the control cost ∫ (‖e_p‖² + ‖e_v‖² + ‖u‖²) dt of all agents"
    note = f"{summary.capitalize()}. {ranked}. Reference: {display_name(CONTROL_REFERENCE)}."
    return Board("controllers", "Controllers", note, columns, board_rows(standings, columns, by_controller=True))


def _text(cell: BoardCell, *, with_ends: bool) -> str:
    return cell.text + (f" [{cell.ends.replace(' to ', ', ')}]" if cell.ends and with_ends else "")


def _words(name: Name) -> str:
    return name.display + (f" ({name.facts})" if name.facts else "")


def _page_facts(groups: Sequence[MissionRuns], facts: Mapping[str, Any], every: int) -> list[tuple[str, str]]:
    """Facts about the suite and its rows for the page, by name; ``every`` is the number of runs on all layouts."""
    seeds = {run.seed for each in groups for run in each.runs}
    beside, compared = facts.get("beside", ()), sum(len(each.runs) for each in groups)
    left = f"{every - compared} other episodes, on layouts that not all methods of their mission ran, are only in the CSV files"
    return [
        ("Suite", f"{facts['suite']['version']}, {facts['suite']['hash'][:16]}"),
        ("Seeds", f"{spans(sorted(seeds))}, on which nothing was tuned"),
        ("Runs", f"{compared} episodes of {len({each.method for each in groups})} methods"),
        *([("Left out", left)] if every > compared else []),
        ("Date", str(facts["date"])),
        ("Processor", str(facts["cpu"])),
        ("Code", str(facts["code"])),
        *origin_facts(facts),
        *(("Other rows", f"run {other['date']} by {other['code']}: {other['command']}") for other in beside),
    ]


def _missions(groups: Sequence[MissionRuns], tracks: Mapping[str, str]) -> list[tuple[str, str]]:
    """Every track with its missions, each with the number of layouts that have rows."""
    counts: dict[tuple[str, str], int] = {}
    for each in groups:
        key = each.track, each.mission
        counts[key] = max(counts.get(key, 0), len(each.runs))
    lists = {
        name: ", ".join(f"{mission} ({count})" for (track, mission), count in counts.items() if track == name) for name in tracks
    }
    return [(name, missions) for name, missions in lists.items() if missions]


def _details(groups: Sequence[MissionRuns], folder: Path) -> list[Detail]:
    """Failures and layouts worth watching of each method."""
    notable = notable_layouts(groups)
    details = []
    for method in dict.fromkeys(each.method for each in groups):
        own = [each for each in groups if each.method == method]
        failures = tuple(
            Failure(each.mission, reason, count, len(each.runs)) for each in own for reason, count in each.failures.items()
        )
        failed, total = sum(failure.runs for failure in failures), sum(len(each.runs) for each in own)
        looks = tuple(_look(one, folder) for one in notable if one.method == method)
        name = shown_name(method)
        with_law = name._replace(facts=", ".join(part for part in (display_name(method.controller), name.facts) if part))
        words = f"{failed} of {total} runs could not be finished" if failed else f"all {total} runs were finished"
        details.append(Detail(with_law, words, failures, looks))
    return details


def _look(one: Notable, folder: Path) -> NotableLayout:
    run = one.run
    faults = {
        "not in formation at the end": not run.reached,
        "violation": run.violated,
        "struck an obstacle": run.struck,
        "agents collided": run.collided,
    }
    ended = ", ".join(words for words, holds in faults.items() if holds) or "success"
    clip = one.clip if (folder / one.clip).is_file() else ""
    return NotableLayout(one.track, one.kind, one.mission, run.seed, f"{ended}, return {run.score('return'):.0f}", clip)
