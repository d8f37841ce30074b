"""All tables of one run in reading order, and the two documents made from them."""

from collections.abc import Sequence

from marlbc_mj.report import findings, paper_tables, paper_values
from marlbc_mj.report.formats import DASH, FAILED, score_cell, score_column
from marlbc_mj.report.method_groups import MethodGroup, method_groups
from marlbc_mj.report.paper_tables import failure_note, failures
from marlbc_mj.report.table import Column, Table, latex, to_latex, to_markdown
from marlbc_mj.results.scores import switches_text
from marlbc_mj.results.summary import Result

METRICS_TABLES = "metrics-"
"""Prefix of the names of the tables of all metrics."""


def make_tables(results: Sequence[Result], scenario_name: str) -> list[Table]:
    """All tables for which these results have data; published numbers appear only for the paper's own scenario."""
    of_paper = scenario_name == paper_values.SCENARIO
    supervisors = paper_tables.one_per_supervisor(results)
    controllers, supervisor = paper_tables.one_per_controller(results)
    tables = [
        *metrics_tables(results),
        paper_tables.switches(supervisors, of_paper),
        paper_tables.decision_time(supervisors, of_paper),
        paper_tables.control_cost(controllers, supervisor, of_paper),
        paper_tables.control_input(controllers, supervisor, of_paper),
        findings.orderings(results) if of_paper else None,
        findings.oracle_gap(results),
        findings.convergence(results),
        findings.predictions(results),
    ]
    return [table for table in tables if table is not None]


def markdown(tables: Sequence[Table], paragraph: str = "") -> str:
    """The content of tables.md: the paragraph, if there is one, and the tables."""
    return "\n".join([*([paragraph + "\n"] if paragraph else []), *map(to_markdown, tables)])


def latex_document(tables: Sequence[Table], paragraph: str = "") -> str:
    r"""The content of tables.tex, for ``\input`` in a document that loads booktabs and graphicx."""
    parts = ["% needs \\usepackage{booktabs,graphicx}", *([latex(paragraph)] if paragraph else []), *map(to_latex, tables)]
    return "\n\n".join(parts) + "\n"


_COLUMNS = (
    *("violation_time_worst", "clearance_min_worst", "agent_distance_min", "formation_error_mean", "effort_integral_sum"),
    *("cost_integral_sum", "saturation_duty_worst", "rms_position_error_rms", "rms_velocity_error_rms"),
)


def metrics_tables(results: Sequence[Result]) -> list[Table]:
    """All metrics, one row per supervisor or controller; the second line of the header says how agents are aggregated."""
    groups = method_groups(results, lambda result: (result.supervisor, result.controller))
    return [_metrics_table(group) for group in groups]


def _metrics_table(group: MethodGroup[Result]) -> Table:
    columns = (Column("", group.kind), score_column("return"), Column("switches", "each agent"), *map(score_column, _COLUMNS))
    return Table(
        f"{METRICS_TABLES}{group.suffix}",
        f"All metrics of each {group.kind}, {group.words}",
        columns,
        tuple(_metrics_row(name, result, len(columns)) for name, result in group.rows),
        (
            "Worst agent: the one with the longest violation, the least clearance, the most time at the limit. Sum, mean and RMS "
            "are over all agents.",
            "Effort and cost: integrals over the episode, ∫ ‖u‖ dt and ∫ (‖e_p‖² + ‖e_v‖² + ‖u‖²) dt.",
            "Violation: time with a clearance of at most the safe distance d_OA; a negative clearance is inside an obstacle.",
            "Distance: between two agents, which no behavior guards. Formation error: distance from the slot relative to the "
            "centroid.",
            "At limit: share of time with an axis of the force at its limit.",
            *map(failure_note, failures([result for _, result in group.rows])),
        ),
    )


def _metrics_row(name: str, result: Result, width: int) -> tuple[str, ...]:
    metrics = result.metrics
    if metrics is None:
        return (name, FAILED, *[DASH] * (width - 2))
    cells = (score_cell(column, metrics) for column in _COLUMNS)
    return (name, score_cell("return", metrics), switches_text(metrics), *cells)
