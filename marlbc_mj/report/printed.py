"""The paper's Tables 3 to 6: our numbers in rows of methods, the printed ones in a row below each method that has them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from marlbc_mj.report import paper_values
from marlbc_mj.report.formats import COST_SCALE, DASH, FAILED, fixed, significant
from marlbc_mj.report.paper_values import Printed, order_mark
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.metrics import AgentMetrics
from marlbc_mj.results.summary import Result
from marlbc_mj.util.text import one_line

SAME_ORDER = "same order"
LIMITED = "-limited"
TOLD = ("finite-time", "fixed-time", "lqr", "terminal-sliding", "predefined-time")
"""Controllers that are told the true drag."""
_ORDER_NOTE = (
    "Same order: whether the methods that have both numbers stand in the printed order; "
    "printed ties are not counted, in brackets the pairs that differ."
)


class Quantity(NamedTuple):
    """Four columns of a printed table: one number an agent."""

    table: int
    label: str
    source: Printed
    read: Callable[[AgentMetrics], float]
    digits: int


SWITCHES = Quantity(3, "switches", paper_values.SWITCHES, lambda agent: agent["switches"], 0)
COST_MAX = Quantity(5, "max [10⁴]", paper_values.COST_MAX, lambda agent: agent["cost_max"] * COST_SCALE, 1)
COST_TOTAL = Quantity(5, "total [10⁴]", paper_values.COST_TOTAL, lambda agent: agent["cost_sum"] * COST_SCALE, 1)
INPUT_MAX = Quantity(6, "max ‖u‖∞ [N]", paper_values.INPUT_MAX, lambda agent: agent["force_max_inf"], 0)
INPUT_TOTAL = Quantity(6, "total ‖u‖ [N]", paper_values.INPUT_TOTAL, lambda agent: agent["effort_sum"], 0)


def by_supervisor(results: Sequence[Result]) -> dict[str, Result]:
    """One result per supervisor: the one with SORLC, else its first."""
    chosen: dict[str, Result] = {}
    for result in results:
        if result.supervisor not in chosen or result.controller == "sorlc":
            chosen[result.supervisor] = result
    return chosen


def by_controller(results: Sequence[Result]) -> tuple[dict[str, Result], str]:
    """One result per controller, all under one supervisor (scripted, else the first), and that supervisor's name."""
    names = [result.supervisor for result in results]
    supervisor = "scripted" if "scripted" in names or not names else names[0]
    return {result.controller: result for result in results if result.supervisor == supervisor}, supervisor


def agent_values(chosen: Mapping[str, Result], quantity: Quantity, agent: int) -> dict[str, float]:
    """One agent's number of every method that ran, by name."""
    return {name: float(quantity.read(r.metrics["agents"][agent])) for name, r in chosen.items() if r.metrics}


def switches(chosen: Mapping[str, Result], printed: bool) -> Table:
    """Table 3: how often every agent's behavior priority changes."""
    return _table(
        "switches",
        "Number of behavior priority switches of each mission supervisor (Table 3 of the paper)",
        "supervisor",
        chosen,
        (SWITCHES,),
        paper_values.SUPERVISORS if printed else {},
        ("Orders that command the same motion count as equal.", "Controller: sorlc, or the one in brackets."),
        title=lambda r: r.supervisor if r.controller == "sorlc" else f"{r.supervisor} ({r.controller})",
    )


def control_cost(chosen: Mapping[str, Result], supervisor: str, printed: bool) -> Table:
    """Table 5: maximum and total control cost; below, the rivals with SORLC's actuator, and LQR."""
    return _table(
        "control-cost",
        f"Maximum and total control cost of each controller under the {supervisor} supervisor (Table 5 of the paper)",
        "controller",
        chosen,
        (COST_MAX, COST_TOTAL),
        paper_values.CONTROLLERS if printed else {},
        (
            "Cost: ‖e_p‖² + ‖e_v‖² + ‖u‖². Total: its integral over the mission step, a sum over samples as in Table 6.",
            *((f"† Erratum 16: {paper_values.ERRATA[16]}",) if printed else ()),
        ),
    )


def control_input(chosen: Mapping[str, Result], supervisor: str, printed: bool) -> Table:
    """Table 6: maximum and total control input; blocks as in Table 5."""
    return _table(
        "control-input",
        f"Maximum and total control input of each controller under the {supervisor} supervisor (Table 6 of the paper)",
        "controller",
        chosen,
        (INPUT_MAX, INPUT_TOTAL),
        paper_values.CONTROLLERS if printed else {},
        (
            f"max ‖u‖∞ is the infinity norm (erratum 15: {paper_values.ERRATA[15]})",
            "Total: integral of the Euclidean norm over the mission step, a sum over samples.",
        ),
    )


def _table(
    name: str,
    caption: str,
    kind: str,
    chosen: Mapping[str, Result],
    quantities: Sequence[Quantity],
    names: Mapping[str, str],  # ours -> printed; empty: no printed numbers
    notes: Sequence[str],
    title: Callable[[Result], str] = lambda r: r.controller,
) -> Table:
    agents = max((len(r.metrics["agents"]) for r in chosen.values() if r.metrics), default=4)
    relative = len(quantities) > 1 and "sorlc" in chosen and chosen["sorlc"].metrics is not None
    sums = {n: sum(agent_values(chosen, quantities[-1], i)[n] for i in range(agents)) for n, r in chosen.items() if r.metrics}
    second = [n for n in chosen if same_actuator(n)] if len(quantities) > 1 else []

    def block(keys: Sequence[str]) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = []
        for key in keys:
            metrics = chosen[key].metrics
            cells = (
                [fixed(q.read(metrics["agents"][i]), q.digits) for q in quantities for i in range(agents)]
                if metrics
                else [FAILED, *[DASH] * (agents * len(quantities) - 1)]
            )
            times = [fixed(sums[key] / sums["sorlc"], 2) if key in sums else DASH] if relative else []
            rows.append((title(chosen[key]), *cells, *times))
            if key in names:
                rows.append((f"{names[key]}, printed", *_printed(key, quantities, agents), *([""] if relative else [])))
        return rows

    rows = block([n for n in chosen if n not in second])
    marks = [
        order_mark(agent_values(chosen, q, i), {n: v[i] for n, v in q.source.values.items() if i < len(v)})
        for q in quantities
        for i in range(agents)
    ]
    rules = []
    if names and any(mark != DASH for mark in marks):
        rules.append(len(rows))
        rows.append((SAME_ORDER, *marks, *([""] if relative else [])))
        notes = (*notes, _ORDER_NOTE)
    if second:
        rules.append(len(rows))
        rows += block(second)
        notes = (*notes, "Last block: the same rivals with SORLC's actuator limit, and LQR, which stays below it.")
    told = [name for name in TOLD if name in chosen or f"{name}{LIMITED}" in chosen] if len(quantities) > 1 else []
    if told:
        notes = (*notes, f"Told the true drag, which the others have to identify or ignore: {', '.join(told)}.")
    if relative:
        notes = (*notes, "Last column: sum of the totals over agents, relative to sorlc.")
    columns = [Column(q.label if len(quantities) > 1 else "", f"agent {i + 1}") for q in quantities for i in range(agents)]
    columns += [Column("total", "over sorlc's")] if relative else []
    notes = (*notes, *_missing(chosen, quantities, names), *map(failure_note, failures(chosen.values())))
    return Table(name, caption, (Column("", kind), *columns), tuple(rows), notes, tuple(rules))


def same_actuator(controller: str) -> bool:
    """Whether this controller belongs to the second block of Tables 5 and 6."""
    return controller.endswith(LIMITED) or controller == "lqr"


def _printed(name: str, quantities: Sequence[Quantity], agents: int) -> list[str]:
    cells = []
    for q in quantities:
        values = [f"{value:g}" + ("" if q.source.comparable else "†") for value in q.source.values[name]]
        cells += [values[i] if i < len(values) else DASH for i in range(agents)]
    return cells


def decision_time(chosen: Mapping[str, Result], printed: bool) -> Table:
    """Table 4: time for one decision, and how much of it a network or a solver takes where a supervisor tells."""
    source = paper_values.DECISION_MS.values if printed else {}
    sums = {name: sum(values) for name, values in source.items() if name in chosen}
    medians = {name: r.metrics["team"]["decision_ms_median"] for name, r in chosen.items() if r.metrics}
    shares = any(r.solver_share is not None for r in chosen.values())
    columns = [Column("", "supervisor"), Column("all agents, here [ms]", "median"), Column("all agents, here [ms]", "p99")]
    columns += [Column("network or solver", "share [%]")] if shares else []
    columns += [Column("printed, each by itself [ms]", f"agent {i + 1}") for i in range(4)] if sums else []
    columns += [Column("printed sum", "over our median")] if sums else []
    rows = []
    for name, result in chosen.items():
        team = result.metrics["team"] if result.metrics else None
        cells = [significant(team["decision_ms_median"]), significant(team["decision_ms_p99"])] if team else [FAILED, DASH]
        share = result.solver_share
        cells += [DASH if share is None else fixed(100 * share, 0)] if shares else []
        if sums:
            cells += [f"{value:.1f}" for value in source[name]] if name in sums else [DASH] * 4
            cells.append(significant(sums[name] / medians[name], 2) if name in sums and medians.get(name) else DASH)
        rows.append((name, *cells))
    rules: tuple[int, ...] = ()
    mark = order_mark(medians, sums)
    notes: tuple[str, ...] = (
        "Here: one call that decides for all agents, every method in the same process; printed: on another machine.",
    )
    if mark != DASH:
        rules = (len(rows),)
        rows.append((SAME_ORDER, mark, *[""] * (len(columns) - 2)))
        notes = (*notes, _ORDER_NOTE)
    if shares:
        notes = (*notes, "Network or solver: its share of the decision time, where the supervisor measures it.")
    names = paper_values.SUPERVISORS if printed else {}
    notes += (*_missing(chosen, (Quantity(4, "", paper_values.DECISION_MS, lambda a: 0.0, 1),), names),)
    notes += tuple(map(failure_note, failures(chosen.values())))
    return Table(
        "decision-time",
        "Time for one decision of each mission supervisor (Table 4 of the paper)",
        tuple(columns),
        tuple(rows),
        notes,
        rules,
    )


def _missing(chosen: Mapping[str, Result], quantities: Sequence[Quantity], names: Mapping[str, str]) -> list[str]:
    """What is printed for methods that are not run here."""
    absent = [
        f"{printed} " + ", total ".join("/".join(f"{v:g}" for v in q.source.values[name]) for q in quantities)
        for name, printed in names.items()
        if name not in chosen
    ]
    return [f"Printed, but not run here (agents 1 to 4): {'; '.join(absent)}."] if absent else []


def failures(results: Iterable[Result]) -> list[Result]:
    """The results of methods that failed."""
    return [result for result in results if result.metrics is None]


def failure_note(result: Result) -> str:
    """Which method failed and why, in one line."""
    return f"{result.key} failed: {one_line(result.failure).rstrip('.')}."
