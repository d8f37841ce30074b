"""Tables of many draws: medians, interquartile means and intervals of every method."""

from collections.abc import Sequence
from dataclasses import replace

from marlbc_mj.report.formats import DASH, FAILED, interval, one_line, percent, spans
from marlbc_mj.report.seed_statistics import (
    SCORES,
    GroupStatistics,
    MethodStatistics,
    by_controller,
    by_supervisor,
    group,
)
from marlbc_mj.report.table import Column, Table
from marlbc_mj.seeds import MethodRuns, SeedResults

ENOUGH = 10
"""Draws from which a bootstrap interval is taken at its word."""


def make_tables(results: SeedResults, methods: Sequence[MethodStatistics]) -> list[Table]:
    """All tables; the ones of groups (two or more that can be compared) and of failures only where there are some."""
    groups = [rows if len(rows) > 1 else [] for rows in (group(results, by_supervisor), group(results, by_controller))]
    failing = [statistics.runs for statistics in methods if statistics.runs.failed]
    tables = [
        _return_table(results, methods),
        _safety_table(methods),
        _score_table("costs", "What each method costs", ("effort", "cost", "formation_error", "saturation_duty"), methods),
        _switch_table(methods, results.scenario.agents),
        *([_group_table(groups)] if any(groups) else []),
        *([_failure_table(failing)] if failing else []),
    ]
    few = caution(len(results.seeds))
    return [replace(table, caption=table.caption + few) if table.name != "seeds-failures" else table for table in tables]


def caution(draws: int) -> str:
    """What a caption adds where there are too few draws for their intervals; empty where there are enough."""
    if draws == 1:
        return " (a single draw: no intervals)"
    return f" (only {draws} draws: intervals are too narrow)" if draws < ENOUGH else ""


def _return_table(results: SeedResults, methods: Sequence[MethodStatistics]) -> Table:
    spread = results.scenario.perturbation
    columns = (
        Column("", "method"),
        Column("return", "median"),
        Column("return", "IQM"),
        Column("better than reference", "chance [%]"),
    )
    rows = [
        (
            s.runs.key,
            FAILED if _never_ran(s) else interval(s.medians["return"], 0),
            interval(s.iqms["return"], 0),
            DASH if _never_ran(s) else "reference" if s.runs.key == results.reference else interval(percent(s.improvement), 0),
        )
        for s in methods
    ]
    notes = (
        f"{len(results.seeds)} draws, the same for every method: starts within {spread.start_spread:g} m and obstacles within "
        f"{spread.obstacle_spread:g} m per axis, drag × {spread.drag_scale[0]:g} to {spread.drag_scale[1]:g}, uniformly.",
        "In brackets: 95 % percentile-bootstrap interval over draws. IQM: interquartile mean.",
        f"Better: probability of a higher return than {results.reference} on the same draw, ties counted half; "
        "a run that failed loses. 50 % is no difference.",
    )
    return Table("seeds-return", "Return of each method over draws of the scenario", columns, tuple(rows), notes)


def _never_ran(statistics: MethodStatistics) -> bool:
    """Whether no run finished, so that rates and comparisons would say nothing about safety or return."""
    return len(statistics.runs.failed) == len(statistics.runs.runs)


def _safety_table(methods: Sequence[MethodStatistics]) -> Table:
    names = ("violation_time", "clearance", "agent_distance")
    columns = (
        Column("", "method"),
        Column("runs", "finished"),
        Column("violation", "rate [%]"),
        *(Column(SCORES[name].group, SCORES[name].label) for name in names),
    )
    rows = [
        (
            s.runs.key,
            f"{len(s.runs.runs) - len(s.runs.failed)}/{len(s.runs.runs)}",
            DASH if _never_ran(s) else interval(percent(s.violation), 0),
            *(interval(s.medians[name], SCORES[name].digits) for name in names),
        )
        for s in methods
    ]
    notes = (
        "Violation rate: share of draws on which an agent came within the safe distance, or the run failed; Wilson's interval.",
        "The others: medians over the runs that finished. Worst and least are over agents.",
    )
    return Table("seeds-safety", "Safety of each method over draws of the scenario", columns, tuple(rows), notes)


def _score_table(name: str, caption: str, scores: Sequence[str], methods: Sequence[MethodStatistics]) -> Table:
    columns = (Column("", "method"), *(Column(SCORES[key].group, SCORES[key].label) for key in scores))
    rows = tuple((s.runs.key, *(interval(s.medians[key], SCORES[key].digits) for key in scores)) for s in methods)
    notes = (
        "Medians over the runs that finished. Effort and cost: integrals over the episode, summed over agents.",
        "At limit: share of time with an axis of the force at its limit, of the agent with the most.",
    )
    return Table(f"seeds-{name}", f"{caption}, over draws of the scenario", columns, rows, notes)


def _switch_table(methods: Sequence[MethodStatistics], agents: int) -> Table:
    columns = (Column("", "method"), *(Column("", f"agent {i + 1}") for i in range(agents)))
    rows = tuple((s.runs.key, *(interval(agent["switches"], 1) for agent in s.agents)) for s in methods)
    return Table("seeds-switches", "Behavior priority switches over draws of the scenario, medians", columns, rows)


def _group_table(groups: Sequence[Sequence[GroupStatistics]]) -> Table:
    columns = (
        Column("", "group"),
        Column("return", "IQM"),
        Column("violation", "worst [s], IQM"),
        Column("violation", "rate [%]"),
        Column("draws", "all finished"),
    )
    rows = [
        (
            f"{g.name} ({g.methods} methods)",
            interval(g.iqms["return"], 0),
            interval(g.iqms["violation_time"], 2),
            interval(percent(g.violation), 0),
            str(g.draws),
        )
        for each in groups
        for g in each
    ]
    notes = (
        "Stratified bootstrap: each method is a stratum of equal weight; draws are common to all and resampled together.",
        "IQMs are over the draws on which all methods of the group finished, rates over all draws.",
    )
    caption = "Each supervisor over its controllers and each controller over its supervisors"
    return Table("seeds-groups", caption, columns, tuple(rows), notes, (len(groups[0]),) if all(groups) else ())


def _failure_table(methods: Sequence[MethodRuns]) -> Table:
    columns = (Column("", "method"), Column("", "failed"), Column("", "seeds"))
    rows = [(m.key, f"{len(m.failed)}/{len(m.runs)}", spans([run.seed for run in m.failed])) for m in methods]
    reasons = [f"{m.key} on seed {m.failed[0].seed}: {one_line(m.failed[0].failure).rstrip('.')}." for m in methods]
    note = "Every reason is in episodes.csv and summary.json; the first of each method is"
    return Table("seeds-failures", "Runs that failed", columns, tuple(rows), (f"{note} below.", *reasons))
