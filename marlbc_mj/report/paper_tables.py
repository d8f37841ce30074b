"""The paper's Tables 3 to 6 with our numbers, and the published ones in extra rows, or in Table 4 in extra columns."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from marlbc_mj.report import paper_values
from marlbc_mj.report.formats import DASH, FAILED, fixed, significant
from marlbc_mj.report.paper_values import Published, order_mark
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.metrics import AgentMetrics
from marlbc_mj.results.summary import Result
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.text import one_line

SAME_ORDER = "same order"
LIMITED = "-limited"
KNOWS_DRAG = ("finite-time", "fixed-time", "lqr", "terminal-sliding", "predefined-time")
"""Controllers that receive the true drag."""
COST_SCALE = 1e-4
"""Factor from costs to the paper's unit, 10⁴."""
_ORDER_NOTE = (
    "Same order: whether the methods that have both numbers are in the published order. Published ties are not counted; "
    "in brackets the pairs that differ."
)


class Quantity(NamedTuple):
    """A quantity of one of the paper's tables, with one column per agent."""

    table: int
    label: str
    source: Published
    read: Callable[[AgentMetrics], float]
    digits: int


SWITCHES = Quantity(3, "switches", paper_values.PUBLISHED_SWITCHES, lambda agent: agent["switches"], 0)
COST_MAX = Quantity(5, "max [10⁴]", paper_values.PUBLISHED_COST_MAX, lambda agent: agent["cost_max"] * COST_SCALE, 1)
COST_TOTAL = Quantity(5, "total [10⁴]", paper_values.PUBLISHED_COST_TOTAL, lambda agent: agent["cost_sum"] * COST_SCALE, 1)
INPUT_MAX = Quantity(6, "max ‖u‖∞ [N]", paper_values.PUBLISHED_INPUT_MAX, lambda agent: agent["force_max_inf"], 0)
INPUT_TOTAL = Quantity(6, "total ‖u‖ [N]", paper_values.PUBLISHED_INPUT_TOTAL, lambda agent: agent["effort_sum"], 0)


def one_per_supervisor(results: Sequence[Result]) -> dict[str, Result]:
    """One result per supervisor: the one with SORLC, or else its first."""
    chosen: dict[str, Result] = {}
    for result in results:
        if result.supervisor not in chosen or result.controller == "sorlc":
            chosen[result.supervisor] = result
    return chosen


def one_per_controller(results: Sequence[Result]) -> tuple[dict[str, Result], str]:
    """One result per controller, all under one supervisor (scripted, or else the first), and that supervisor's name."""
    names = [result.supervisor for result in results]
    supervisor = "scripted" if "scripted" in names or not names else names[0]
    return {result.controller: result for result in results if result.supervisor == supervisor}, supervisor


def agent_values(chosen: Mapping[str, Result], quantity: Quantity, agent: int) -> dict[str, float]:
    """One agent's value of a quantity for every method that ran, by name."""
    return {name: float(quantity.read(r.metrics["agents"][agent])) for name, r in chosen.items() if r.metrics}


def switches(chosen: Mapping[str, Result], published: bool) -> Table:
    """Table 3: how often every agent's behavior priority changes."""
    return _table(
        "switches",
        f"Number of behavior priority switches of each mission supervisor{_table_number(3, published)}",
        "supervisor",
        _Comparison(chosen, (SWITCHES,), paper_values.PAPER_SUPERVISORS if published else {}),
        ("Orders that command the same motion count as equal.", "Controller: SORLC, or the one in brackets."),
    )


def control_cost(chosen: Mapping[str, Result], supervisor: str, published: bool) -> Table:
    """Table 5: maximum and total control cost; a second block has LQR and the baselines with SORLC's actuator."""
    return _table(
        "control-cost",
        _controller_caption("cost", supervisor, 5, published),
        "controller",
        _Comparison(chosen, (COST_MAX, COST_TOTAL), paper_values.PAPER_CONTROLLERS if published else {}),
        (
            "Cost: ‖e_p‖² + ‖e_v‖² + ‖u‖². Total: its integral over the mission step, a sum over samples.",
            *((f"† Erratum 16: {paper_values.ERRATA[16]}",) if published else ()),
        ),
    )


def control_input(chosen: Mapping[str, Result], supervisor: str, published: bool) -> Table:
    """Table 6: maximum and total control input; blocks as in Table 5."""
    return _table(
        "control-input",
        _controller_caption("input", supervisor, 6, published),
        "controller",
        _Comparison(chosen, (INPUT_MAX, INPUT_TOTAL), paper_values.PAPER_CONTROLLERS if published else {}),
        (
            f"max ‖u‖∞ is the infinity norm (erratum 15: {paper_values.ERRATA[15]})",
            "Total: integral of the Euclidean norm over the mission step, a sum over samples.",
        ),
    )


def _controller_caption(quantity: str, supervisor: str, number: int, published: bool) -> str:
    """The caption of Table 5 or 6."""
    given = f"with supervisor {display_name(supervisor)}"
    return f"Maximum and total control {quantity} of each controller {given}{_table_number(number, published)}"


def _table_number(number: int, published: bool) -> str:
    """The number of the corresponding table of the paper, for a caption."""
    return f" (Table {number} of the paper)" if published else ""


@dataclass(frozen=True)
class _Comparison:
    """The rows of a table that compares this run with published numbers; two quantities make it a table of controllers."""

    chosen: Mapping[str, Result]
    quantities: Sequence[Quantity]
    names: Mapping[str, str]  # our name -> published name; empty: published numbers are not shown

    @property
    def of_controllers(self) -> bool:
        """Whether rows are controllers, which come in two blocks and, if SORLC ran, have a last column relative to it."""
        return len(self.quantities) > 1

    @cached_property
    def agents(self) -> int:
        return max((len(r.metrics["agents"]) for r in self.chosen.values() if r.metrics), default=4)

    @cached_property
    def sums(self) -> dict[str, float]:
        """The last quantity of every method that ran, summed over agents."""
        each = [agent_values(self.chosen, self.quantities[-1], i) for i in range(self.agents)]
        return {name: sum(values[name] for values in each) for name in (each[0] if each else ())}

    @property
    def relative(self) -> bool:
        """Whether there is a last column relative to SORLC."""
        return self.of_controllers and "sorlc" in self.sums

    def columns(self) -> list[Column]:
        """One column per quantity and agent, and the one relative to SORLC."""
        groups = [q.label if self.of_controllers else "" for q in self.quantities]
        columns = [Column(group, f"agent {i + 1}") for group in groups for i in range(self.agents)]
        return columns + ([Column("total", "over SORLC's")] if self.relative else [])

    def block(self, keys: Sequence[str]) -> list[tuple[str, ...]]:
        """Rows of these methods, each followed by a row of published numbers if there are any."""
        rows = []
        for key in keys:
            rows.append(self._row(key))
            if key in self.names:
                rows.append((f"{self.names[key]}, published", *self._published(key), *([""] if self.relative else [])))
        return rows

    def order_row(self) -> tuple[str, ...] | None:
        """Row that says whether each column has the published order; None if no two methods can be compared."""
        marks = [
            order_mark(agent_values(self.chosen, q, i), {n: v[i] for n, v in q.source.values.items() if i < len(v)})
            for q in self.quantities
            for i in range(self.agents)
        ]
        if not self.names or all(mark == DASH for mark in marks):
            return None
        return (SAME_ORDER, *marks, *([""] if self.relative else []))

    def notes(self) -> list[str]:
        """Notes on columns, on published methods that did not run here, and on failures."""
        told = [n for n in KNOWS_DRAG if n in self.chosen or f"{n}{LIMITED}" in self.chosen] if self.of_controllers else []
        notes = (
            [f"Given the true drag, which the others have to identify or ignore: {', '.join(map(display_name, told))}."]
            if told
            else []
        )
        notes += ["Last column: sum of the totals over agents, relative to SORLC."] if self.relative else []
        return [*notes, *_missing(self.chosen, self.quantities, self.names), *map(failure_note, failures(self.chosen.values()))]

    def _row(self, key: str) -> tuple[str, ...]:
        result, metrics = self.chosen[key], self.chosen[key].metrics
        usual = self.of_controllers or result.controller == "sorlc"
        title = display_name(key) + ("" if usual else f" ({display_name(result.controller)})")
        if metrics is None:
            cells = [FAILED, *[DASH] * (self.agents * len(self.quantities) - 1)]
        else:
            cells = [fixed(q.read(metrics["agents"][i]), q.digits) for q in self.quantities for i in range(self.agents)]
        if self.relative:
            cells.append(fixed(self.sums[key] / self.sums["sorlc"], 2) if key in self.sums else DASH)
        return (title, *cells)

    def _published(self, key: str) -> list[str]:
        cells = []
        for q in self.quantities:
            values = [f"{value:g}" + ("" if q.source.comparable else "†") for value in q.source.values[key]]
            cells += [values[i] if i < len(values) else DASH for i in range(self.agents)]
        return cells


def _table(name: str, caption: str, kind: str, comparison: _Comparison, notes: Sequence[str]) -> Table:
    """Table of the methods, the row on the published order, and a second block of baselines with SORLC's actuator."""
    second = [n for n in comparison.chosen if _same_actuator(n)] if comparison.of_controllers else []
    rows = comparison.block([n for n in comparison.chosen if n not in second])
    rules = []
    order = comparison.order_row()
    if order is not None:
        rules.append(len(rows))
        rows.append(order)
        notes = (*notes, _ORDER_NOTE)
    if second:
        rules.append(len(rows))
        rows += comparison.block(second)
        notes = (*notes, "Last block: the same baselines with SORLC's actuator limit, and LQR, which stays below it.")
    columns = (Column("", kind), *comparison.columns())
    return Table(name, caption, columns, tuple(rows), (*notes, *comparison.notes()), tuple(rules))


def _same_actuator(controller: str) -> bool:
    """Whether this controller belongs to the second block of Tables 5 and 6."""
    return controller.endswith(LIMITED) or controller == "lqr"


def decision_time(chosen: Mapping[str, Result], published: bool) -> Table:
    """Table 4: time for one decision, and the share of a network or solver if a supervisor reports it."""
    source = paper_values.PUBLISHED_DECISION_MS.values if published else {}
    sums = {name: sum(values) for name, values in source.items() if name in chosen}
    medians = {name: r.metrics["team"]["decision_ms_median"] for name, r in chosen.items() if r.metrics}
    shares = any(r.solver_share is not None for r in chosen.values())
    columns = _decision_columns(shares, bool(sums))
    rows = [
        (display_name(name), *_measured(r, shares), *(_beside(source.get(name), medians.get(name)) if sums else []))
        for name, r in chosen.items()
    ]
    notes = ["Here: one call that decides for all agents, every method in the same process."]
    notes += ["Published: on another machine."] if sums else []
    notes += ["Orders are not compared: they would depend on the machine and on the hour."] if sums else []
    if shares:
        notes.append("Network or solver: its share of the decision time, where the supervisor measures it.")
    quantity = Quantity(4, "", paper_values.PUBLISHED_DECISION_MS, lambda agent: 0.0, 1)
    notes += _missing(chosen, (quantity,), paper_values.PAPER_SUPERVISORS if published else {})
    notes += map(failure_note, failures(chosen.values()))
    caption = f"Time for one decision of each mission supervisor{_table_number(4, published)}"
    return Table("decision-time", caption, tuple(columns), tuple(rows), tuple(notes))


def _decision_columns(shares: bool, published: bool) -> list[Column]:
    columns = [Column("", "supervisor"), Column("all agents, here [ms]", "median"), Column("all agents, here [ms]", "p99")]
    if shares:
        columns.append(Column("network or solver", "share", "%"))
    if published:
        columns += [Column("published, one agent at a time [ms]", f"agent {i + 1}") for i in range(4)]
        columns.append(Column("published sum", "over our median"))
    return columns


def _measured(result: Result, shares: bool) -> list[str]:
    """Times of this run: median, 99th percentile and, with ``shares``, the share of the network or solver."""
    team, share = (result.metrics["team"] if result.metrics else None), result.solver_share
    cells = [significant(team["decision_ms_median"]), significant(team["decision_ms_p99"])] if team else [FAILED, DASH]
    return cells + ([DASH if share is None else fixed(100 * share, 0)] if shares else [])


def _beside(values: Sequence[float] | None, median: float | None) -> list[str]:
    """Published times of the four agents, and their sum over our median."""
    if values is None:
        return [DASH] * 5
    return [*(f"{value:.1f}" for value in values), significant(sum(values) / median, 2) if median else DASH]


def _missing(chosen: Mapping[str, Result], quantities: Sequence[Quantity], names: Mapping[str, str]) -> list[str]:
    """Note on the published numbers of methods that did not run here."""
    absent = [
        f"{published} " + ", total ".join("/".join(f"{v:g}" for v in q.source.values[name]) for q in quantities)
        for name, published in names.items()
        if name not in chosen
    ]
    return [f"Published, but not run here (agents 1 to 4): {'; '.join(absent)}."] if absent else []


def failures(results: Iterable[Result]) -> list[Result]:
    """The results of methods that failed."""
    return [result for result in results if result.metrics is None]


def failure_note(result: Result) -> str:
    """Which method failed and why, in one line."""
    return f"{result.display} failed: {one_line(result.failure).rstrip('.')}."
