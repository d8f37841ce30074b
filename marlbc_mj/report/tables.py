"""All tables of one run, in the order in which they are read, and the two documents made from them."""

from collections.abc import Sequence

import numpy as np

from marlbc_mj.report import findings, paper_values, printed
from marlbc_mj.report.formats import COST_SCALE, DASH, FAILED, fixed
from marlbc_mj.report.table import Column, Table, latex, to_latex, to_markdown
from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.summary import Result


def make_tables(results: Sequence[Result], scenario_name: str) -> list[Table]:
    """Every table that these results fill; printed numbers appear for the paper's own scenario only."""
    of_paper = scenario_name == paper_values.SCENARIO
    supervisors = printed.by_supervisor(results)
    controllers, supervisor = printed.by_controller(results)
    tables = [
        all_metrics(results),
        printed.switches(supervisors, of_paper),
        printed.decision_time(supervisors, of_paper),
        printed.control_cost(controllers, supervisor, of_paper),
        printed.control_input(controllers, supervisor, of_paper),
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
    r"""The content of tables.tex, for ``\input`` in a document that loads booktabs."""
    parts = ["% needs \\usepackage{booktabs}", *([latex(paragraph)] if paragraph else []), *map(to_latex, tables)]
    return "\n\n".join(parts) + "\n"


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
            *map(printed.failure_note, printed.failures(results)),
        ),
    )


def _metrics_row(result: Result, width: int) -> tuple[str, ...]:
    if result.metrics is None:
        return (result.key, FAILED, *[DASH] * (width - 2))
    metrics, team = result.metrics, result.metrics["team"]
    return (
        result.key,
        fixed(team["return"], 0),
        "/".join(str(agent["switches"]) for agent in metrics["agents"]),
        fixed(_agents(metrics, "violation_time").max(), 2),
        fixed(_agents(metrics, "clearance_min").min(), 2),
        fixed(team["agent_distance_min"], 2),
        fixed(team["formation_error"], 2),
        fixed(_agents(metrics, "effort_integral").sum(), 0),
        fixed(_agents(metrics, "cost_integral").sum() * COST_SCALE, 1),
        fixed(100 * _agents(metrics, "saturation_duty").max(), 1),
        fixed(np.sqrt((_agents(metrics, "rms_position_error") ** 2).mean()), 3),
        fixed(np.sqrt((_agents(metrics, "rms_velocity_error") ** 2).mean()), 2),
    )


def _agents(metrics: Metrics, key: str) -> np.ndarray:
    """(N,) one metric of all agents."""
    return np.array([agent[key] for agent in metrics["agents"]], dtype=float)  # type: ignore[literal-required]
