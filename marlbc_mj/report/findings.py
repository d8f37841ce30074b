"""Findings of a run: which published orders hold, and what an equal actuator changes."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

from marlbc_mj.report import paper_tables, paper_values
from marlbc_mj.report.formats import DASH, FAILED, fixed, grouped, listed, score_cell, score_column, significant, spans
from marlbc_mj.report.paper_tables import LIMITED, Quantity, agent_values
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.metrics import convergence_time
from marlbc_mj.results.scores import SCORES, switches_text
from marlbc_mj.results.summary import Result
from marlbc_mj.util.method_names import display_name

WHY = {
    3: "the supervisors are reconstructed and learned ones depend on their training; in the gate the clearance equals the "
    "automaton's upper threshold, so that its count depends on rounding (erratum 8).",
    5: "a maximum is set by the jump of the reference at a switch, and the actuator's limit caps it. A total also depends "
    "on how long a law presses, and on offsets whose sign had to be chosen (erratum 4); the published totals contradict "
    "those of Table 6 if they share a unit, so that only their order is compared (erratum 16).",
    6: "maxima are a gain times the jump of the reference, in the infinity norm (erratum 15). Totals depend on the offsets' "
    "sign (erratum 4) and on the compensator's, which pushes further into the limit while the force is saturated (erratum 2).",
}
"""Why a published order may not hold, by table."""


class Claim(NamedTuple):
    """A published order of two methods, and the agents for which it holds here."""

    table: int
    quantity: str
    lower: str  # our name of the method with the smaller published value
    higher: str  # our name of the other method
    holds: tuple[int, ...]  # agents, from 1
    differs: tuple[int, ...]  # agents, from 1


def claims(results: Sequence[Result]) -> list[Claim]:
    """Every published order of two methods that both have results in this run.

    Table 4 is left out: decision times depend on the machine and its load, and the number of reproduced orders must not.
    :func:`~marlbc_mj.report.paper_tables.decision_time` shows our times beside the published ones.
    """
    supervisors, (controllers, _) = paper_tables.one_per_supervisor(results), paper_tables.one_per_controller(results)
    found = _claims(supervisors, paper_tables.SWITCHES)
    for quantity in (paper_tables.COST_MAX, paper_tables.COST_TOTAL, paper_tables.INPUT_MAX, paper_tables.INPUT_TOTAL):
        found += _claims(controllers, quantity)
    return found


def _claims(chosen: Mapping[str, Result], quantity: Quantity) -> list[Claim]:
    agents = min((len(r.metrics["agents"]) for r in chosen.values() if r.metrics), default=0)
    each = [agent_values(chosen, quantity, i) for i in range(min(agents, 4))]
    ours = {name: [values[name] for values in each] for name in (each[0] if each else ())}
    label = {5: " cost", 6: " input"}.get(quantity.table, "")
    return _pairs(quantity.table, f"{quantity.label.split()[0]}{label}", ours, quantity.source.values)


def _pairs(table: int, label: str, ours: Mapping[str, Sequence[float]], source: Mapping[str, Sequence[float]]) -> list[Claim]:
    """Claims on every pair of methods: two if the published order differs between agents; published ties give none."""
    found = []
    for a, b in combinations([name for name in source if name in ours], 2):
        for low, high in ((a, b), (b, a)):
            agents = [i for i in range(len(ours[a])) if source[low][i] < source[high][i]]
            holds = tuple(i + 1 for i in agents if ours[low][i] < ours[high][i])
            differs = tuple(i + 1 for i in agents if ours[low][i] >= ours[high][i])
            if agents:
                found.append(Claim(table, label, low, high, holds, differs))
    return found


def orderings(results: Sequence[Result]) -> Table | None:
    """Table of the published orders, one per row; None if no two published methods ran."""
    found = claims(results)
    if not found:
        return None
    names = paper_values.PAPER_SUPERVISORS | paper_values.PAPER_CONTROLLERS
    rows = tuple(
        (
            f"Table {c.table}, {c.quantity}: {names[c.lower]} < {names[c.higher]}",
            "no" if not c.holds else "in part" if c.differs else "yes",
            _agents(c.holds),
            _agents(c.differs),
        )
        for c in found
    )
    rules = tuple(k for k in range(1, len(found)) if found[k].table != found[k - 1].table)
    whole = sum(not c.differs for c in found)
    uncounted = "Published ties are not counted, nor is Table 4, whose times depend on the machine."
    notes = [f"{whole} of {len(found)} published orders hold for every agent. {uncounted}"]
    notes += [f"Why they may differ in Table {table}: {WHY[table]}" for table in sorted({c.table for c in found if c.differs})]
    columns = (Column("", "published order"), Column("", "holds"), Column("", "holds for"), Column("", "differs for"))
    return Table("orderings", "Which of the published orders hold here", columns, rows, tuple(notes), rules)


def _agents(agents: tuple[int, ...]) -> str:
    return f"agent{'s' * (len(agents) > 1)} {listed(spans(agents).split(', '))}" if agents else DASH


def same_actuator(results: Sequence[Result]) -> str:
    """One paragraph on the costs of LQR and of baselines with SORLC's actuator; empty if SORLC or these baselines did not run."""
    chosen, supervisor = paper_tables.one_per_controller(results)
    costs = {name: SCORES["cost_integral_sum"].read(r.metrics) for name, r in chosen.items() if r.metrics}
    limited = {n.removesuffix(LIMITED): costs[n] for n in costs if n.endswith(LIMITED) and not n.startswith("lqr")}
    if "sorlc" not in costs or not limited:
        return ""
    ours = costs["sorlc"]
    first = f"With supervisor {display_name(supervisor)} the {_count(chosen)} agents cost {grouped(ours)} with SORLC. "
    found = first + _compare_limited(chosen, limited, ours) + _floor(chosen, costs, ours)
    of_paper = all(r.trajectory is None or r.trajectory.scenario.name == paper_values.SCENARIO for r in chosen.values())
    return found + _conclusion(costs, limited, ours) if of_paper else found.rstrip()


def _compare_limited(chosen: Mapping[str, Result], limited: Mapping[str, float], ours: float) -> str:
    """Sentences on which baselines are cheaper than SORLC with the same actuator, and which are not."""
    limit = next(iter(chosen.values())).trajectory
    force = "same actuator" if limit is None else f"same actuator of {limit.scenario.force_limit:g} N"
    said = {name: f"{display_name(name)} {grouped(cost)} ({cost / ours:.2f} times)" for name, cost in limited.items()}
    cheaper = [said[name] for name, cost in limited.items() if cost < ours]
    costlier = [said[name] for name, cost in limited.items() if cost >= ours]
    if not cheaper:
        return f"Given the {force}, no baseline is cheaper: {listed(costlier)}. "
    which = "every baseline is" if not costlier else f"{len(cheaper)} of {len(limited)} baselines are"
    text = f"Given the {force}, {which} cheaper: {listed(cheaper)}. "
    return text + (f"Not cheaper: {listed(costlier)}. " if costlier else "")


def _floor(chosen: Mapping[str, Result], costs: Mapping[str, float], ours: float) -> str:
    """Sentence on the cost and safety of LQR; empty if it did not run."""
    metrics = chosen["lqr"].metrics if "lqr" in chosen else None
    if metrics is None:
        return ""
    least = "LQR is the floor with" if costs["lqr"] <= min(costs.values()) else "LQR costs"
    time = SCORES["violation_time_worst"].read(metrics)
    safety = f"but its worst agent violates the safe distance for {time:.2f} s" if time > 0 else "and keeps the safe distance"
    return f"{least} {grouped(costs['lqr'])} ({costs['lqr'] / ours:.2f} times), {safety}. "


def _conclusion(costs: Mapping[str, float], limited: Mapping[str, float], ours: float) -> str:
    """Sentences on whether the published conclusion still holds for the published baselines."""
    baselines = [name for name in paper_values.PAPER_CONTROLLERS if name in costs and name in limited]
    reversed_for = [name for name in baselines if limited[name] < ours < costs[name]]
    before = [name for name in baselines if limited[name] < ours and costs[name] <= ours]
    text = ""
    if reversed_for:
        text = f"The published conclusion that SORLC costs less is reversed for {listed(list(map(display_name, reversed_for)))}: "
        text += "summed over agents, it holds only without a limit. "
    if before:
        cheaper = listed(list(map(display_name, before)))
        text += f"{cheaper}, summed over agents, {'costs' if len(before) == 1 else 'cost'} less even without one. "
    if not text and baselines:
        text = "The published conclusion that SORLC costs less stands. "
    return text.strip()


def _count(chosen: Mapping[str, Result]) -> str:
    agents = next((len(r.metrics["agents"]) for r in chosen.values() if r.metrics), 4)
    return {2: "two", 3: "three", 4: "four"}.get(agents, str(agents))


def oracle_gap(results: Sequence[Result]) -> Table | None:
    """Table of the gap between every method's return and the oracle's with the same controller; None if no oracle ran."""
    best = {r.controller: r.metrics["team"]["return"] for r in results if r.supervisor == "oracle" and r.metrics}
    rows = [_gap_row(r, best[r.controller]) for r in results if r.controller in best and r.supervisor != "oracle"]
    if not rows:
        return None
    tops = listed([f"{fixed(value, 0)} with {display_name(name)}" for name, value in best.items()])
    columns = (
        Column("", "method"),
        score_column("return"),
        Column("gap to the oracle", "return"),
        Column("gap to the oracle", "share", "%"),
        score_column("violation_time_worst"),
    )
    notes = (
        f"The oracle's return: {tops}. Its schedule is the best found that never violates, not a proven optimum.",
        "A supervisor that grazes an obstacle may score above the oracle, because the published reward allows it: "
        "read the gap together with the violation.",
    )
    return Table("oracle-gap", "Gap of each return to the oracle's with the same controller", columns, tuple(rows), notes)


def _gap_row(result: Result, top: float) -> tuple[str, ...]:
    """Row of one method, with the gap to the oracle's return ``top``."""
    metrics = result.metrics
    if metrics is None:
        return (result.display, FAILED, DASH, DASH, DASH)
    gap = top - metrics["team"]["return"]
    share = fixed(100 * gap / abs(top), 1) if top else DASH
    return (result.display, score_cell("return", metrics), fixed(gap, 0), share, score_cell("violation_time_worst", metrics))


def convergence(results: Sequence[Result]) -> Table | None:
    """Table of the time in which the initial velocity error of SORLC and RLC decays; None if neither ran."""
    chosen, supervisor = paper_tables.one_per_controller(results)
    published = paper_values.PUBLISHED_CONVERGENCE
    times = {n: convergence_time(r.trajectory) for n, r in chosen.items() if n in published and r.trajectory}
    if not times:
        return None
    with_paper = next(iter(chosen.values())).trajectory
    of_paper = with_paper is not None and with_paper.scenario.name == paper_values.SCENARIO
    agents = len(next(iter(times.values())))
    columns = [Column("", "controller"), *(Column("", f"agent {i + 1}") for i in range(agents))]
    columns += [Column("", "published")] if of_paper else []
    rows = tuple(
        (display_name(name), *(fixed(t, 2) for t in each), *([significant(published[name], 2)] if of_paper else []))
        for name, each in times.items()
    )
    notes = (
        "Time after which the norm of the velocity error stays below 2 % of its largest value in the first 15 s; "
        f"supervisor: {display_name(supervisor)}.",
    )
    caption = f"Convergence of the velocity error at the start [s]{' (Figures 6c and 7c of the paper)' if of_paper else ''}"
    return Table("convergence", caption, tuple(columns), rows, notes)


def predictions(results: Sequence[Result]) -> Table | None:
    """Table of the MPCMS variants, which differ in their prediction; None unless at least two of them ran."""
    kinds = [r for r in results if r.supervisor.startswith("mpcms") and r.metrics]
    if len({r.supervisor for r in kinds}) < 2:
        return None
    columns = (
        *(Column("", "method"), score_column("return"), Column("switches", "each agent")),
        *(score_column("violation_time_worst"), Column("decision", "median", "ms"), Column("decision", "p99", "ms")),
    )
    rows = tuple(
        (
            r.display,
            score_cell("return", r.metrics),
            switches_text(r.metrics),
            score_cell("violation_time_worst", r.metrics),
            significant(r.metrics["team"]["decision_ms_median"]),
            significant(r.metrics["team"]["decision_ms_p99"]),
        )
        for r in kinds
        if r.metrics
    )
    return Table("predictions", "MPCMS by its prediction", columns, rows)
