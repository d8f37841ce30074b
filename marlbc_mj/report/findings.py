"""What a run says about the paper's comparisons: which printed orders hold, and what the same actuator changes."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

from marlbc_mj.report import paper_values, printed
from marlbc_mj.report.formats import DASH, fixed, grouped, listed, significant, spans
from marlbc_mj.report.printed import LIMITED, Quantity, agent_values
from marlbc_mj.report.table import Column, Table
from marlbc_mj.results.metrics import Metrics, convergence_time
from marlbc_mj.results.summary import Result

WHY = {
    3: "the supervisors are reconstructed and learned ones depend on their training; in the gate the clearance equals the "
    "automaton's upper threshold, so that its count depends on rounding (erratum 8).",
    4: "another machine and other code; the printed supervisors without a solver differ by less than 0.5 ms.",
    5: "a maximum is set by the jump of the reference at a switch, and the actuator's limit caps it. A total also depends "
    "on how long a law presses, and on offsets whose sign had to be chosen (erratum 4); the printed totals contradict "
    "those of Table 6 if they share a unit, so that only their order is compared (erratum 16).",
    6: "maxima are a gain times the jump of the reference, in the infinity norm (erratum 15). Totals depend on the offsets' "
    "sign (erratum 4) and on the compensator's, which pushes further into the limit while the force is saturated (erratum 2).",
}
"""Why a printed order may not hold, by table."""
PRINTED_CONVERGENCE = {"sorlc": 0.7, "rlc": 3.4}
"""Figs. 6c and 7c [s]."""


class Claim(NamedTuple):
    """One printed order of two methods, and the agents for which it holds here; agent 0 stands for the whole team."""

    table: int
    quantity: str
    lower: str  # our names
    higher: str
    holds: tuple[int, ...]
    differs: tuple[int, ...]


def claims(results: Sequence[Result]) -> list[Claim]:
    """Every printed order among methods of this run that have a number."""
    supervisors, (controllers, _) = printed.by_supervisor(results), printed.by_controller(results)
    found = _claims(supervisors, printed.SWITCHES)
    medians = {n: [r.metrics["team"]["decision_ms_median"]] for n, r in supervisors.items() if r.metrics}
    sums = {name: [sum(values)] for name, values in paper_values.DECISION_MS.values.items()}
    found += _pairs(4, "decision time", medians, sums, first=0)
    for quantity in (printed.COST_MAX, printed.COST_TOTAL, printed.INPUT_MAX, printed.INPUT_TOTAL):
        found += _claims(controllers, quantity)
    return found


def _claims(chosen: Mapping[str, Result], quantity: Quantity) -> list[Claim]:
    agents = min((len(r.metrics["agents"]) for r in chosen.values() if r.metrics), default=0)
    each = [agent_values(chosen, quantity, i) for i in range(min(agents, 4))]
    ours = {name: [values[name] for values in each] for name in (each[0] if each else ())}
    label = {5: " cost", 6: " input"}.get(quantity.table, "")
    return _pairs(quantity.table, f"{quantity.label.split()[0]}{label}", ours, quantity.source.values)


def _pairs(
    table: int, label: str, ours: Mapping[str, Sequence[float]], source: Mapping[str, Sequence[float]], first: int = 1
) -> list[Claim]:
    """Both orders of a pair where the printed one is not the same for all agents; printed ties make none."""
    found = []
    for a, b in combinations([name for name in source if name in ours], 2):
        for low, high in ((a, b), (b, a)):
            agents = [i for i in range(len(ours[a])) if source[low][i] < source[high][i]]
            holds = tuple(i + first for i in agents if ours[low][i] < ours[high][i])
            differs = tuple(i + first for i in agents if ours[low][i] >= ours[high][i])
            if agents:
                found.append(Claim(table, label, low, high, holds, differs))
    return found


def orderings(results: Sequence[Result]) -> Table | None:
    """The printed orders one by one; None where no two printed methods ran."""
    found = claims(results)
    if not found:
        return None
    names = paper_values.SUPERVISORS | paper_values.CONTROLLERS
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
    notes = [f"{whole} of {len(found)} printed orders hold for every agent. Printed ties are not counted."]
    notes += [f"Why they may differ in Table {table}: {WHY[table]}" for table in sorted({c.table for c in found if c.differs})]
    columns = (Column("", "printed order"), Column("", "holds"), Column("", "holds for"), Column("", "differs for"))
    return Table("orderings", "Which of the printed orders hold here", columns, rows, tuple(notes), rules)


def _agents(agents: tuple[int, ...]) -> str:
    if agents == (0,):
        return "the team"
    return f"agent{'s' * (len(agents) > 1)} {listed(spans(agents).split(', '))}" if agents else DASH


def same_actuator(results: Sequence[Result]) -> str:
    """One paragraph: what the rivals cost with SORLC's actuator, and LQR; empty where SORLC or the rivals did not run."""
    chosen, supervisor = printed.by_controller(results)
    costs = {name: _cost(r.metrics) for name, r in chosen.items() if r.metrics}
    limited = {n.removesuffix(LIMITED): costs[n] for n in costs if n.endswith(LIMITED) and not n.startswith("lqr")}
    if "sorlc" not in costs or not limited:
        return ""
    ours, limit = costs["sorlc"], next(iter(chosen.values())).trajectory
    force = "same actuator" if limit is None else f"same actuator of {limit.scenario.force_limit:g} N"
    cheaper = [name for name, cost in limited.items() if cost < ours]
    dearer = [name for name in limited if name not in cheaper]
    text = f"Under the {supervisor} supervisor the {_count(chosen)} agents cost {grouped(ours)} with SORLC. "
    if cheaper:
        parts = [f"{name} {grouped(limited[name])} ({limited[name] / ours:.2f} times)" for name in cheaper]
        which = "every rival is" if not dearer else f"{len(cheaper)} of {len(limited)} rivals are"
        text += f"Given the {force}, {which} cheaper: {listed(parts)}. "
    if dearer:
        parts = [f"{name} {grouped(limited[name])} ({limited[name] / ours:.2f} times)" for name in dearer]
        text += f"Not cheaper: {listed(parts)}. " if cheaper else f"Given the {force}, no rival is cheaper: {listed(parts)}. "
    text += _floor(chosen, costs, ours)
    return text + _conclusion(costs, limited, ours)


def _floor(chosen: Mapping[str, Result], costs: Mapping[str, float], ours: float) -> str:
    """What LQR costs, and what it costs otherwise."""
    metrics = chosen["lqr"].metrics if "lqr" in chosen else None
    if metrics is None:
        return ""
    least = "LQR is the floor with" if costs["lqr"] <= min(costs.values()) else "LQR costs"
    time = max(agent["violation_time"] for agent in metrics["agents"])
    safety = f"but violates the safe distance for {time:.2f} s" if time > 0 else "and keeps the safe distance"
    return f"{least} {grouped(costs['lqr'])} ({costs['lqr'] / ours:.2f} times), {safety}. "


def _conclusion(costs: Mapping[str, float], limited: Mapping[str, float], ours: float) -> str:
    """What that does to the printed conclusion, for the printed rivals."""
    rivals = [name for name in paper_values.CONTROLLERS if name in costs and name in limited]
    turned = [name for name in rivals if limited[name] < ours < costs[name]]
    before = [name for name in rivals if limited[name] < ours and costs[name] <= ours]
    if turned:
        text = f"The printed conclusion that SORLC costs less turns round for {listed(turned)}: "
        text += "summed over agents, it holds only without a limit. "
    else:
        text = ""
    if before:
        text += f"{listed(before)}, summed over agents, {'costs' if len(before) == 1 else 'cost'} less even without one. "
    if not turned and not before and rivals:
        text += "The printed conclusion that SORLC costs less stands. "
    return text.strip()


def _count(chosen: Mapping[str, Result]) -> str:
    agents = next((len(r.metrics["agents"]) for r in chosen.values() if r.metrics), 4)
    return {2: "two", 3: "three", 4: "four"}.get(agents, str(agents))


def _cost(metrics: Metrics) -> float:
    return sum(agent["cost_integral"] for agent in metrics["agents"])


def worst_violation(metrics: Metrics) -> float:
    """Time inside the safe distance of the agent with the most [s]."""
    return max(agent["violation_time"] for agent in metrics["agents"])


def oracle_gap(results: Sequence[Result]) -> Table | None:
    """How far every method's return is from the oracle's with the same controller; None without an oracle that ran."""
    best = {r.controller: r.metrics["team"]["return"] for r in results if r.supervisor == "oracle" and r.metrics}
    rows = []
    for result in results:
        if result.controller in best and result.supervisor != "oracle":
            metrics, top = result.metrics, best[result.controller]
            if metrics is None:
                rows.append((result.key, "failed", DASH, DASH, DASH))
                continue
            gap = top - metrics["team"]["return"]
            share = fixed(100 * gap / abs(top), 1) if top else DASH
            violation = fixed(worst_violation(metrics), 2)
            rows.append((result.key, fixed(metrics["team"]["return"], 0), fixed(gap, 0), share, violation))
    if not rows:
        return None
    tops = listed([f"{fixed(value, 0)} with {name}" for name, value in best.items()])
    columns = (
        Column("", "method"),
        Column("return", "sum"),
        Column("gap to the oracle", "sum"),
        Column("gap to the oracle", "[%]"),
        Column("violation", "worst [s]"),
    )
    notes = (
        f"The oracle's return: {tops}. Its schedule is the best found that never violates, not a proven optimum.",
        "A supervisor that grazes an obstacle may score above the oracle, because the printed reward allows it: "
        "read the gap together with the violation.",
    )
    return Table("oracle-gap", "Gap of each return to the oracle's with the same controller", columns, tuple(rows), notes)


def convergence(results: Sequence[Result]) -> Table | None:
    """How fast the velocity error of SORLC and RLC decays at the start; None where neither ran."""
    chosen, supervisor = printed.by_controller(results)
    times = {n: convergence_time(r.trajectory) for n, r in chosen.items() if n in PRINTED_CONVERGENCE and r.trajectory}
    if not times:
        return None
    with_paper = next(iter(chosen.values())).trajectory
    of_paper = with_paper is not None and with_paper.scenario.name == paper_values.SCENARIO
    agents = len(next(iter(times.values())))
    columns = [Column("", "controller"), *(Column("", f"agent {i + 1}") for i in range(agents))]
    columns += [Column("", "printed")] if of_paper else []
    rows = tuple(
        (name, *(fixed(t, 2) for t in each), *([significant(PRINTED_CONVERGENCE[name], 2)] if of_paper else []))
        for name, each in times.items()
    )
    notes = (
        "Time after which the norm of the velocity error stays below 2 % of its largest value in the first 15 s, "
        f"{supervisor} supervisor.",
    )
    caption = "Convergence of the velocity error at the start [s] (Figures 6c and 7c of the paper)"
    return Table("convergence", caption, tuple(columns), rows, notes)


def predictions(results: Sequence[Result]) -> Table | None:
    """MPCMS by its prediction; None unless two of its kinds ran with one controller."""
    kinds = [r for r in results if r.supervisor.startswith("mpcms") and r.metrics]
    if len({r.supervisor for r in kinds}) < 2:
        return None
    columns = ("method", "return", "switches", "violation, worst [s]", "decision, median [ms]", "decision, p99 [ms]")
    rows = tuple(
        (
            r.key,
            fixed(r.metrics["team"]["return"], 0),
            "/".join(str(agent["switches"]) for agent in r.metrics["agents"]),
            fixed(worst_violation(r.metrics), 2),
            significant(r.metrics["team"]["decision_ms_median"]),
            significant(r.metrics["team"]["decision_ms_p99"]),
        )
        for r in kinds
        if r.metrics
    )
    return Table("predictions", "MPCMS by its prediction", tuple(Column("", name) for name in columns), rows)
