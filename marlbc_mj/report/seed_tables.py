"""Tables of many draws: medians, interquartile means and intervals of every method."""

from collections.abc import Sequence
from dataclasses import replace

from marlbc_mj.report.formats import DASH, FAILED, interval, percent, score_column, score_interval, spans
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.outcomes import outcome_rates
from marlbc_mj.results.seed_statistics import GroupStatistics, MethodStatistics, controller_of, group, supervisor_of
from marlbc_mj.results.seeds import MethodRuns, SeedResults
from marlbc_mj.robots import make_robot
from marlbc_mj.util.text import one_line

_SAFETY = ("violation_time_worst", "clearance_min_worst", "agent_distance_min")
_COSTS = ("effort_integral_sum", "cost_integral_sum", "formation_error_mean", "saturation_duty_worst")
ENOUGH = 10
"""Draws from which on a bootstrap interval is shown without a warning."""


def make_seed_tables(results: SeedResults, methods: Sequence[MethodStatistics]) -> list[Table]:
    """All tables, the outcomes first where a scenario draws layouts.

    The table of groups is there where two or more can be compared, the table of failures where there are some.
    """
    groups = [rows if len(rows) > 1 else [] for rows in (group(results, supervisor_of), group(results, controller_of))]
    failing = [statistics.runs for statistics in methods if statistics.runs.failed]
    first = [_return_table(results, methods), _safety_table(methods)]
    first.insert(len(first) if results.scenario.layout is None else 0, outcome_table(results))
    tables = [
        *first,
        _score_table("costs", "What each method costs", _COSTS, methods),
        _switch_table(methods, results.scenario.agents),
        *([_group_table(groups)] if any(groups) else []),
        *([_failure_table(failing)] if failing else []),
    ]
    few = caution(len(results.seeds))
    return [replace(table, caption=table.caption + few) if table.name != "seeds-failures" else table for table in tables]


def caution(draws: int) -> str:
    """What is added to a caption where there are too few draws for intervals; empty where there are enough."""
    if draws == 1:
        return " (a single draw: no intervals)"
    return f" (only {draws} draws: intervals are too narrow)" if draws < ENOUGH else ""


def _return_table(results: SeedResults, methods: Sequence[MethodStatistics]) -> Table:
    spread = results.scenario.perturbation
    columns = (
        Column("", "method"),
        Column("return", "team, median"),
        Column("return", "team, IQM"),
        Column("better than reference", "chance", "%"),
    )
    rows = [
        (
            s.runs.key,
            FAILED if _never_ran(s) else score_interval("return", s.medians["return"]),
            score_interval("return", s.iqms["return"]),
            DASH if _never_ran(s) else "reference" if s.runs.key == results.reference else interval(percent(s.improvement), 0),
        )
        for s in methods
    ]
    layouts = "" if results.scenario.layout is None else f"one layout of the {results.scenario.split} split each; "
    notes = (
        f"{len(results.seeds)} draws, the same for every method: {layouts}starts within {spread.start_spread:g} m and obstacles "
        f"within {spread.obstacle_spread:g} m per axis, drag × {spread.drag_scale[0]:g} to {spread.drag_scale[1]:g}, uniformly.",
        "In brackets: 95 % percentile-bootstrap interval over draws. IQM: interquartile mean.",
        f"Better: probability of a higher return than {results.reference} on the same draw, ties counted half; "
        "a run that failed loses. 50 % is no difference.",
    )
    return Table("seeds-return", "Return of each method over draws of the scenario", columns, tuple(rows), notes)


def outcome_table(results: SeedResults) -> Table:
    """Success rate of each method, and the rates of what prevents success."""
    columns = (
        Column("", "method"),
        Column("success", "rate", "%"),
        Column("reached the end", "rate", "%"),
        Column("violation", "rate", "%"),
        Column("struck an obstacle", "rate", "%"),
        Column("agents collided", "rate", "%"),
    )
    rows = []
    for method in results.methods:
        if len(method.failed) == len(method.runs):
            rows.append((method.key, FAILED, *[DASH] * 4))
            continue
        rates = outcome_rates([run.metrics for run in method.runs], results.scenario)
        parts = ("success", "reached", "violation", "struck", "collided")
        rows.append((method.key, *(interval(percent(rates[part]), 0) for part in parts)))
    scenario, radius = results.scenario, make_robot(results.scenario.robot).radius
    notes = (
        f"Success: at the end every agent is within {scenario.formation_tolerance:g} m of its slot around the desired centroid, "
        "and on the way there was no violation and no collision. In brackets: Wilson's 95 % interval.",
        f"Violation: a clearance of at most {scenario.safe_distance:g} m. Struck: of at most {radius:g} m, the agent's radius. "
        f"Collided: two agents within {2 * radius:g} m. A run that failed counts against its method in every column.",
    )
    return Table("seeds-outcome", "Outcome of the mission over draws of the scenario", columns, tuple(rows), notes)


def _never_ran(statistics: MethodStatistics) -> bool:
    """Whether no run finished, so that rates and comparisons mean nothing."""
    return len(statistics.runs.failed) == len(statistics.runs.runs)


def _safety_table(methods: Sequence[MethodStatistics]) -> Table:
    columns = (
        Column("", "method"),
        Column("runs", "finished"),
        Column("violation", "rate", "%"),
        *map(score_column, _SAFETY),
    )
    rows = [
        (
            s.runs.key,
            f"{len(s.runs.runs) - len(s.runs.failed)}/{len(s.runs.runs)}",
            DASH if _never_ran(s) else interval(percent(s.violation), 0),
            *(score_interval(name, s.medians[name]) for name in _SAFETY),
        )
        for s in methods
    ]
    notes = (
        "Violation rate: share of draws in which an agent came within the safe distance or the run failed; Wilson's interval.",
        "The others: medians over the runs that finished.",
    )
    return Table("seeds-safety", "Safety of each method over draws of the scenario", columns, tuple(rows), notes)


def _score_table(name: str, caption: str, scores: Sequence[str], methods: Sequence[MethodStatistics]) -> Table:
    columns = (Column("", "method"), *map(score_column, scores))
    rows = tuple((s.runs.key, *(score_interval(name, s.medians[name]) for name in scores)) for s in methods)
    notes = (
        "Medians over the runs that finished. Effort and cost: integrals over the episode. Sum and mean are over all agents.",
        "At limit: share of time with an axis of the force at its limit.",
    )
    return Table(f"seeds-{name}", f"{caption}, over draws of the scenario", columns, rows, notes)


def _switch_table(methods: Sequence[MethodStatistics], agents: int) -> Table:
    columns = (Column("", "method"), *(Column("", f"agent {i + 1}") for i in range(agents)))
    rows = tuple((s.runs.key, *(interval(agent["switches"], 1) for agent in s.agents)) for s in methods)
    return Table("seeds-switches", "Behavior priority switches over draws of the scenario, medians", columns, rows)


def _group_table(groups: Sequence[Sequence[GroupStatistics]]) -> Table:
    columns = (
        Column("", "group"),
        Column("return", "team, IQM"),
        Column("violation", "worst agent, IQM", "s"),
        Column("violation", "rate", "%"),
        Column("draws", "all finished"),
    )
    rows = [
        (
            f"{g.name} ({g.methods} methods)",
            *(score_interval(name, g.iqms[name]) for name in ("return", "violation_time_worst")),
            interval(percent(g.violation), 0),
            str(g.draws),
        )
        for each in groups
        for g in each
    ]
    notes = (
        "Stratified bootstrap: each method is a stratum of equal weight; draws are common to all methods and resampled together.",
        "IQMs are over the draws on which all methods of the group finished, rates over all draws.",
    )
    caption = "Each supervisor over its controllers and each controller over its supervisors"
    return Table("seeds-groups", caption, columns, tuple(rows), notes, (len(groups[0]),) if all(groups) else ())


def _failure_table(methods: Sequence[MethodRuns]) -> Table:
    columns = (Column("", "method"), Column("", "failed"), Column("", "seeds"))
    rows = [(m.key, f"{len(m.failed)}/{len(m.runs)}", spans([run.seed for run in m.failed])) for m in methods]
    reasons = [f"{m.key} on seed {m.failed[0].seed}: {one_line(m.failed[0].failure).rstrip('.')}." for m in methods]
    note = "Every reason is in episodes.csv and summary.json; the first of each method is below."
    return Table("seeds-failures", "Runs that failed", columns, tuple(rows), (note, *reasons))
