"""Tables of a run on many draws: medians, interquartile means and intervals of every method."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

from marlbc_mj.report.formats import DASH, FAILED, interval, percent, score_column, score_interval, spans
from marlbc_mj.report.method_groups import MethodGroup, method_groups
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.outcomes import outcome_rates
from marlbc_mj.results.seed_statistics import GroupStatistics, MethodStatistics, controller_of, group, supervisor_of
from marlbc_mj.results.seeds import MethodRuns, SeedResults
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.text import one_line

_SAFETY = ("violation_time_worst", "clearance_min_worst", "agent_distance_min")
_COSTS = ("effort_integral_sum", "cost_integral_sum", "formation_error_mean", "saturation_duty_worst")
ENOUGH = 10
"""Number of draws from which on bootstrap intervals are shown without a warning."""


def make_seed_tables(results: SeedResults, methods: Sequence[MethodStatistics]) -> list[Table]:
    """All tables; the outcomes come first if the scenario draws layouts.

    There is a table of groups if two or more can be compared, and a table of failures if there were any.
    """
    pooled = [rows if len(rows) > 1 else [] for rows in (group(results, supervisor_of), group(results, controller_of))]
    failing = [statistics.runs for statistics in methods if statistics.runs.failed]
    groups = method_groups(methods, lambda statistics: (statistics.runs.supervisor, statistics.runs.controller))
    first = [[_return_table(results, each) for each in groups], list(map(_safety_table, groups))]
    first.insert(len(first) if results.scenario.layout is None else 0, outcome_tables(results))
    tables = [
        *chain.from_iterable(first),
        *map(_cost_table, groups),
        *(_switch_table(each, results.scenario.agents) for each in groups),
        *([_group_table(pooled)] if any(pooled) else []),
        *([_failure_table(failing)] if failing else []),
    ]
    few = caution(len(results.seeds))
    return [replace(table, caption=table.caption + few) if table.name != "seeds-failures" else table for table in tables]


def caution(draws: int) -> str:
    """Warning to append to a caption if there are too few draws for intervals; empty otherwise."""
    if draws == 1:
        return " (a single draw: no intervals)"
    return f" (only {draws} draws: intervals are too narrow)" if draws < ENOUGH else ""


def _return_table(results: SeedResults, methods: MethodGroup[MethodStatistics]) -> Table:
    spread = results.scenario.perturbation
    columns = (
        Column("", methods.kind),
        Column("return", "team, median"),
        Column("return", "team, IQM"),
        Column("better than reference", "chance", "%"),
    )
    rows = [
        (
            name,
            FAILED if _never_ran(s) else score_interval("return", s.medians["return"]),
            score_interval("return", s.iqms["return"]),
            DASH if _never_ran(s) else "reference" if s.runs.key == results.reference else interval(percent(s.improvement), 0),
        )
        for name, s in methods.rows
    ]
    reference = next(method for method in results.methods if method.key == results.reference)
    layouts = "" if results.scenario.layout is None else f"one layout of the {results.scenario.split} split each; "
    notes = (
        f"{len(results.seeds)} draws, the same for every method: {layouts}starts within {spread.start_spread:g} m and obstacles "
        f"within {spread.obstacle_spread:g} m per axis, drag × {spread.drag_scale[0]:g} to {spread.drag_scale[1]:g}, uniformly.",
        "In brackets: 95 % percentile-bootstrap interval over draws. IQM: interquartile mean.",
        f"Better: probability of a higher return than {reference.display} on the same draw, ties counted half; "
        "a run that failed loses. 50 % is no difference.",
    )
    caption = f"Return of each {methods.kind} {methods.words}, over draws of the scenario"
    return Table(f"seeds-return-{methods.suffix}", caption, columns, tuple(rows), notes)


def outcome_tables(results: SeedResults) -> list[Table]:
    """Tables of the success rate of each supervisor or controller, and of the rates of its parts."""
    groups = method_groups(results.methods, lambda method: (method.supervisor, method.controller))
    return [_outcome_table(results, each) for each in groups]


def _outcome_table(results: SeedResults, methods: MethodGroup[MethodRuns]) -> Table:
    columns = (
        Column("", methods.kind),
        Column("success", "rate", "%"),
        Column("reached the end", "rate", "%"),
        Column("violation", "rate", "%"),
        Column("struck an obstacle", "rate", "%"),
        Column("agents collided", "rate", "%"),
    )
    rows = []
    for name, method in methods.rows:
        if len(method.failed) == len(method.runs):
            rows.append((name, FAILED, *[DASH] * 4))
            continue
        rates = outcome_rates([run.metrics for run in method.runs], results.scenario)
        parts = ("success", "reached", "violation", "struck", "collided")
        rows.append((name, *(interval(percent(rates[part]), 0) for part in parts)))
    scenario, fleet = results.scenario, results.scenario.fleet
    radii = " or ".join(f"{robot.radius:g}" for robot in fleet.kinds)
    notes = (
        f"Success: at the end every agent is within {scenario.formation_tolerance:g} m of its slot around the desired centroid, "
        "and on the way there was no violation and no collision. In brackets: Wilson's 95 % interval.",
        f"Violation: a clearance of at most {scenario.safe_distance:g} m. Struck: of at most {radii} m, the agent's radius. "
        f"Collided: two agents within {2 * fleet.radius:g} m. A run that failed counts against its method in every column.",
    )
    caption = f"Outcome of the mission for each {methods.kind} {methods.words}, over draws of the scenario"
    return Table(f"seeds-outcome-{methods.suffix}", caption, columns, tuple(rows), notes)


def _never_ran(statistics: MethodStatistics) -> bool:
    """Whether no run finished, so that rates and comparisons mean nothing."""
    return len(statistics.runs.failed) == len(statistics.runs.runs)


def _safety_table(methods: MethodGroup[MethodStatistics]) -> Table:
    columns = (
        Column("", methods.kind),
        Column("runs", "finished"),
        Column("violation", "rate", "%"),
        *map(score_column, _SAFETY),
    )
    rows = [
        (
            name,
            f"{len(s.runs.runs) - len(s.runs.failed)}/{len(s.runs.runs)}",
            DASH if _never_ran(s) else interval(percent(s.violation), 0),
            *(score_interval(score, s.medians[score]) for score in _SAFETY),
        )
        for name, s in methods.rows
    ]
    notes = (
        "Violation rate: share of draws in which an agent came within the safe distance or the run failed; Wilson's interval.",
        "The others: medians over the runs that finished.",
    )
    caption = f"Safety of each {methods.kind} {methods.words}, over draws of the scenario"
    return Table(f"seeds-safety-{methods.suffix}", caption, columns, tuple(rows), notes)


def _cost_table(methods: MethodGroup[MethodStatistics]) -> Table:
    columns = (Column("", methods.kind), *map(score_column, _COSTS))
    rows = tuple((name, *(score_interval(score, s.medians[score]) for score in _COSTS)) for name, s in methods.rows)
    notes = (
        "Medians over the runs that finished. Effort and cost: integrals over the episode. Sum and mean are over all agents.",
        "At limit: share of time with an axis of the force at its limit.",
    )
    caption = f"What each {methods.kind} costs {methods.words}, over draws of the scenario"
    return Table(f"seeds-costs-{methods.suffix}", caption, columns, rows, notes)


def _switch_table(methods: MethodGroup[MethodStatistics], agents: int) -> Table:
    columns = (Column("", methods.kind), *(Column("", f"agent {i + 1}") for i in range(agents)))
    rows = tuple((name, *(interval(agent["switches"], 1) for agent in s.agents)) for name, s in methods.rows)
    caption = f"Behavior priority switches of each {methods.kind} {methods.words}, medians over draws of the scenario"
    return Table(f"seeds-switches-{methods.suffix}", caption, columns, rows)


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
            f"{display_name(g.name)} ({g.methods} methods)",
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
    rows = [(m.display, f"{len(m.failed)}/{len(m.runs)}", spans([run.seed for run in m.failed])) for m in methods]
    reasons = [f"{m.display} on seed {m.failed[0].seed}: {one_line(m.failed[0].failure).rstrip('.')}." for m in methods]
    note = "Every reason is in episodes.csv and summary.json; the first of each method is below."
    return Table("seeds-failures", "Runs that failed", columns, tuple(rows), (note, *reasons))
