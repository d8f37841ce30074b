"""The paper's Tables 3 to 6 with our numbers beside the printed ones, and one table of all metrics."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from marlbc_mj.metrics import AgentMetrics, Metrics
from marlbc_mj.report import paper_values
from marlbc_mj.report.paper_values import Printed, order_mark
from marlbc_mj.report.results import Result
from marlbc_mj.report.table import Column, Table, to_latex, to_markdown

ORDER = Column("same order", "as printed")
DASH = "–"
_ORDER_NOTE = (
    "Same order as printed: whether the methods that have both numbers stand in the printed order; "
    "printed ties are not counted, in brackets the pairs that differ."
)
_SCALE = 1e-4  # costs are tabulated in units of 1e4


def make_tables(results: Sequence[Result], scenario_name: str) -> list[Table]:
    """Every table that these results fill; printed numbers appear for the paper's own scenario only."""
    printed = scenario_name == paper_values.SCENARIO
    supervisors = by_supervisor(results)
    controllers, supervisor = by_controller(results)
    return [
        all_metrics(results),
        switches(supervisors, printed),
        decision_time(supervisors, printed),
        control_cost(controllers, supervisor, printed),
        control_input(controllers, supervisor, printed),
    ]


def markdown(tables: Sequence[Table]) -> str:
    """The content of tables.md."""
    return "\n".join(to_markdown(table) for table in tables)


def latex_document(tables: Sequence[Table]) -> str:
    r"""The content of tables.tex, for ``\input`` in a document that loads booktabs."""
    return "% needs \\usepackage{booktabs}\n" + "\n\n".join(to_latex(table) for table in tables) + "\n"


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


def switches(chosen: Mapping[str, Result], printed: bool) -> Table:
    """Table 3: how often every agent's behavior priority changes."""
    source = paper_values.SWITCHES if printed else Printed({})
    rows = _agent_rows(chosen, source, lambda agent: agent["switches"], "agent {}", 0)
    return Table(
        "switches",
        "Number of behavior priority switches of each mission supervisor (Table 3 of the paper)",
        _columns(chosen, source, lambda r: r.supervisor if r.controller == "sorlc" else f"{r.supervisor} ({r.controller})"),
        tuple(rows),
        (
            "Orders that command the same motion count as equal.",
            "Controller: sorlc, or the one in brackets.",
            *_notes(chosen, source, paper_values.SUPERVISORS),
        ),
    )


def decision_time(chosen: Mapping[str, Result], printed: bool) -> Table:
    """Table 4: time for one decision."""
    source = paper_values.DECISION_MS.values if printed else {}
    medians = {name: r.metrics["team"]["decision_ms_median"] for name, r in chosen.items() if r.metrics}
    sums = {name: sum(values) for name, values in source.items() if name in chosen}
    rows = [
        ("all agents, median [ms]", *(_team_ms(r, "decision_ms_median") for r in chosen.values())),
        ("all agents, p99 [ms]", *(_team_ms(r, "decision_ms_p99") for r in chosen.values())),
    ]
    if sums:
        rows += [
            (f"paper, agent {i + 1} [ms]", *(f"{source[n][i]:.1f}" if n in sums else DASH for n in chosen)) for i in range(4)
        ]
        rows.append(("paper's sum / our median", *(_ratio(sums.get(n), medians.get(n)) for n in chosen)))
        marks = [order_mark(medians, sums), *[""] * (len(rows) - 1)]
        rows = [(*row, mark) for row, mark in zip(rows, marks, strict=True)]
    return Table(
        "decision-time",
        "Time for one decision of each mission supervisor (Table 4 of the paper)",
        (Column("", ""), *(Column("", name) for name in chosen), *([Column("", "same order as printed")] if sums else [])),
        tuple(rows),
        (
            "Here: one call that decides for all agents; printed: every agent by itself, on another machine.",
            *_notes(chosen, Printed(source), paper_values.SUPERVISORS),
        ),
        rules=(2,) if sums else (),
    )


def control_cost(chosen: Mapping[str, Result], supervisor: str, printed: bool) -> Table:
    """Table 5: maximum and total control cost."""
    highest, total = (paper_values.COST_MAX, paper_values.COST_TOTAL) if printed else (Printed({}), Printed({}))
    rows = _agent_rows(chosen, highest, lambda a: a["cost_max"] * _SCALE, "max, agent {} [10⁴]", 1)
    rows += _agent_rows(chosen, total, lambda a: a["cost_sum"] * _SCALE, "total, agent {} [10⁴]", 1)
    return Table(
        "control-cost",
        f"Maximum and total control cost of each controller under the {supervisor} supervisor (Table 5 of the paper)",
        _columns(chosen, highest, lambda r: r.controller),
        tuple(rows),
        (
            "Cost: ‖e_p‖² + ‖e_v‖² + ‖u‖². Total: its integral over the mission step, a sum over samples as in Table 6.",
            *((f"† Erratum 16: {paper_values.ERRATA[16]}",) if total.values else ()),
            *_notes(chosen, highest, paper_values.CONTROLLERS, total),
        ),
        rules=(len(rows) // 2,),
    )


def control_input(chosen: Mapping[str, Result], supervisor: str, printed: bool) -> Table:
    """Table 6: maximum and total control input."""
    highest, total = (paper_values.INPUT_MAX, paper_values.INPUT_TOTAL) if printed else (Printed({}), Printed({}))
    rows = _agent_rows(chosen, highest, lambda a: a["force_max_inf"], "max ‖u‖∞, agent {} [N]", 0)
    rows += _agent_rows(chosen, total, lambda a: a["effort_sum"], "total ‖u‖, agent {} [N]", 0)
    return Table(
        "control-input",
        f"Maximum and total control input of each controller under the {supervisor} supervisor (Table 6 of the paper)",
        _columns(chosen, highest, lambda r: r.controller),
        tuple(rows),
        (
            f"max ‖u‖∞ is the infinity norm (erratum 15: {paper_values.ERRATA[15]})",
            "Total: integral of the Euclidean norm over the mission step, a sum over samples.",
            *_notes(chosen, highest, paper_values.CONTROLLERS, total),
        ),
        rules=(len(rows) // 2,),
    )


def all_metrics(results: Sequence[Result]) -> Table:
    """Every method in one row, agents gathered as the second line of the header says."""
    columns = (
        Column("", "method"),
        Column("return", "sum"),
        Column("switches", "each agent"),
        Column("violation", "worst [s]"),
        Column("clearance", "least [m]"),
        Column("distance", "least [m]"),
        Column("formation", "mean [m]"),
        Column("effort", "sum [N s]"),
        Column("cost", "sum [10⁴]"),
        Column("at limit", "worst [%]"),
        Column("‖e_p‖", "RMS [m]"),
        Column("‖e_v‖", "RMS [m/s]"),
    )
    return Table(
        "all-metrics",
        "All metrics of each method (supervisor + controller)",
        columns,
        tuple(_metrics_row(result, len(columns)) for result in results),
        (
            "Effort and cost: integrals over the episode, ∫ ‖u‖ dt and ∫ (‖e_p‖² + ‖e_v‖² + ‖u‖²) dt, summed over agents.",
            "Violation: time with a clearance of at most the safe distance d_OA; a negative clearance is inside an obstacle.",
            "Distance: between two agents, which no behavior guards. Formation: distance from the slot relative to the centroid.",
            "At limit: share of time with an axis of the force at its limit. Worst, least, mean and sum are over agents.",
            *(_failure_note(result) for result in results if result.metrics is None),
        ),
    )


def _metrics_row(result: Result, width: int) -> tuple[str, ...]:
    if result.metrics is None:
        return (result.key, "failed", *[DASH] * (width - 2))
    metrics, team = result.metrics, result.metrics["team"]
    return (
        result.key,
        _fixed(team["return"], 0),
        "/".join(str(agent["switches"]) for agent in metrics["agents"]),
        _fixed(_agents(metrics, "violation_time").max(), 2),
        _fixed(_agents(metrics, "clearance_min").min(), 2),
        _fixed(team["agent_distance_min"], 2),
        _fixed(team["formation_error"], 2),
        _fixed(_agents(metrics, "effort_integral").sum(), 0),
        _fixed(_agents(metrics, "cost_integral").sum() * _SCALE, 1),
        _fixed(100 * _agents(metrics, "saturation_duty").max(), 1),
        _fixed(np.sqrt((_agents(metrics, "rms_position_error") ** 2).mean()), 3),
        _fixed(np.sqrt((_agents(metrics, "rms_velocity_error") ** 2).mean()), 2),
    )


def _agents(metrics: Metrics, key: str) -> np.ndarray:
    """(N,) one metric of all agents."""
    return np.array([agent[key] for agent in metrics["agents"]], dtype=float)  # type: ignore[literal-required]


def _columns(chosen: Mapping[str, Result], source: Printed, title: Callable[[Result], str]) -> tuple[Column, ...]:
    columns = [Column("", "")]
    for name, result in chosen.items():
        columns.append(Column(title(result), "here" if source.values else ""))
        if name in source.values:
            columns.append(Column(title(result), "paper"))
    return (*columns, ORDER) if source.values else tuple(columns)


def _agent_rows(
    chosen: Mapping[str, Result], source: Printed, read: Callable[[AgentMetrics], float], label: str, digits: int
) -> list[tuple[str, ...]]:
    """One row an agent: our value and the printed one for every method, and the mark of their order."""
    count = max((len(r.metrics["agents"]) for r in chosen.values() if r.metrics), default=4)
    rows = []
    for i in range(count):
        ours = {name: float(read(r.metrics["agents"][i])) for name, r in chosen.items() if r.metrics}
        printed = {name: float(values[i]) for name, values in source.values.items() if i < len(values)}
        cells = [label.format(i + 1)]
        for name in chosen:
            cells.append(_fixed(ours[name], digits) if name in ours else "failed")
            if name in source.values:
                cells.append((f"{printed[name]:g}" if name in printed else DASH) + ("" if source.comparable else "†"))
        rows.append((*cells, order_mark(ours, printed)) if source.values else tuple(cells))
    return rows


def _notes(chosen: Mapping[str, Result], source: Printed, names: Mapping[str, str], total: Printed | None = None) -> list[str]:
    """Notes on printed methods: the key to the mark, which name is whose, what was not run, and what failed."""
    notes = [_ORDER_NOTE] if source.values else []
    renamed = [f"{name} is the paper's {names[name]}" for name in source.values if name in chosen and names[name].lower() != name]
    notes += ["; ".join(renamed) + "."] if renamed else []
    missing = [f"{names[name]} {_slashed(source, name)}" for name in source.values if name not in chosen]
    if total is not None:
        totals = [f", total {_slashed(total, name)}" for name in source.values if name not in chosen]
        missing = [a + b for a, b in zip(missing, totals, strict=True)]
    notes += [f"Printed, but not run here (agents 1 to 4): {'; '.join(missing)}."] if missing else []
    return notes + [_failure_note(result) for result in chosen.values() if result.metrics is None]


def _slashed(source: Printed, name: str) -> str:
    return "/".join(f"{value:g}" for value in source.values[name])


def _failure_note(result: Result) -> str:
    return f"{result.key} failed: {' '.join(str(result.failure).split()).rstrip('.')}."


def _team_ms(result: Result, key: str) -> str:
    return "failed" if result.metrics is None else significant(result.metrics["team"][key])  # type: ignore[literal-required]


def _ratio(printed: float | None, ours: float | None) -> str:
    return DASH if not printed or not ours else significant(printed / ours, 2)


def _fixed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else DASH


def significant(value: float, digits: int = 3) -> str:
    """A number with this many significant digits, never in exponent notation."""
    if not math.isfinite(value) or value == 0:
        return DASH if value else "0"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):.{max(0, decimals)}f}"
