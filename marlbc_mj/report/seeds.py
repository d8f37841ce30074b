"""The report of many draws: medians, interquartile means and intervals of every method, as tables, files, a figure and a page."""

import csv
import html
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from marlbc_mj.files import write_json
from marlbc_mj.palette import AGENT_COLORS
from marlbc_mj.report import paper_values
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.bundle import _links as _files_beside
from marlbc_mj.report.page import _links, _pairs, _plot
from marlbc_mj.report.results import AGENT_KEYS, SCHEMA, TEAM_KEYS, _plain
from marlbc_mj.report.table import Column, Table, to_html
from marlbc_mj.report.tables import DASH, _fixed, latex_document, markdown, significant
from marlbc_mj.seeds import (
    SCORES,
    GroupStatistics,
    MethodRuns,
    MethodStatistics,
    Progress,
    SeedResults,
    SeedRun,
    analyse,
    by_controller,
    by_supervisor,
    group,
)
from marlbc_mj.statistics import Estimate

FIGURE = "intervals"


def summary(results: SeedResults, methods: Sequence[MethodStatistics], versions: Mapping[str, str]) -> dict[str, Any]:
    """The content of summary.json: schema 1 with medians, ``<key>_ci`` beside them, and what only draws can tell."""
    groups = {"supervisors": by_supervisor, "controllers": by_controller}
    content = {
        "schema": SCHEMA,
        "scenario": results.scenario.name,
        "versions": dict(versions),
        "seeds": list(results.seeds),
        "perturbation": vars(results.scenario.perturbation),
        "reference": results.reference,
        "methods": {statistics.runs.key: _summary_entry(statistics) for statistics in methods},
        "groups": {key: {g.name: _group_entry(g) for g in group(results, by)} for key, by in groups.items()},
    }
    return dict(_plain(content))


def _summary_entry(statistics: MethodStatistics) -> dict[str, Any]:
    failed = statistics.runs.failed
    scores = {name: {**_with_ci("median", statistics.medians[name]), **_with_ci("iqm", statistics.iqms[name])} for name in SCORES}
    entry: dict[str, Any] = {
        "runs": len(statistics.runs.runs),
        "failures": {str(run.seed): run.failure for run in failed},
        **_with_ci("violation_rate", statistics.violation),
        **_with_ci("improvement", statistics.improvement),
    }
    if len(failed) == len(statistics.runs.runs):
        return {"failure": failed[0].failure, **entry}
    agents = [_all_with_ci(agent) for agent in statistics.agents]
    return {"agents": agents, "team": _all_with_ci(statistics.team), "scores": scores, **entry}


def _group_entry(statistics: GroupStatistics) -> dict[str, Any]:
    iqms = {f"{key}_iqm": value for key, value in statistics.iqms.items()}
    counts = {"methods": statistics.methods, "draws": statistics.draws}
    return {**counts, **_all_with_ci(iqms), **_with_ci("violation_rate", statistics.violation)}


def _with_ci(key: str, estimate: Estimate) -> dict[str, Any]:
    return {key: estimate.value, f"{key}_ci": [estimate.low, estimate.high]}


def _all_with_ci(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {name: value for key, estimate in estimates.items() for name, value in _with_ci(key, estimate).items()}


def write_csv(results: SeedResults, path: Path) -> Path:
    """episodes.csv: one row per method, seed and agent, the team's columns repeated; a failed run has its reason in each."""
    drawn = ("disturbance_scale", "start_x", "start_y")
    columns = ("supervisor", "controller", "seed", "agent", "failure", *drawn, *AGENT_KEYS, *(f"team_{k}" for k in TEAM_KEYS))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        for method in results.methods:
            for run in method.runs:
                names = {"supervisor": method.supervisor, "controller": method.controller, "seed": run.seed}
                writer.writerows({**names, **row} for row in _csv_rows(run))
    return path


def _csv_rows(run: SeedRun) -> list[dict[str, Any]]:
    scale, starts = run.instance.disturbance_scale, run.instance.starts.tolist()
    rows = [{"agent": i + 1, "disturbance_scale": scale, "start_x": x, "start_y": y} for i, (x, y) in enumerate(starts)]
    if run.metrics is None:
        return [{**row, "failure": _one_line(run.failure)} for row in rows]
    plain = _plain(run.metrics)
    team = {f"team_{key}": value for key, value in plain["team"].items()}
    return [{**row, **agent, **team} for row, agent in zip(rows, plain["agents"], strict=True)]


def make_tables(results: SeedResults, methods: Sequence[MethodStatistics]) -> list[Table]:
    """All tables; the ones of groups and of failures only where there are some."""
    groups = [group(results, by_supervisor), group(results, by_controller)]
    failing = [statistics.runs for statistics in methods if statistics.runs.failed]
    return [
        _return_table(results, methods),
        _safety_table(methods),
        _score_table("costs", "What each method costs", ("effort", "cost", "formation_error", "saturation_duty"), methods),
        _switch_table(methods, results.scenario.agents),
        *([_group_table(groups)] if any(groups) else []),
        *([_failure_table(failing)] if failing else []),
    ]


def _return_table(results: SeedResults, methods: Sequence[MethodStatistics]) -> Table:
    spread = results.scenario.perturbation
    columns = (Column("", "method"), Column("return", "median"), Column("return", "IQM"), Column("better", "than reference [%]"))
    rows = [
        (
            s.runs.key,
            _cell(s.medians["return"], 0),
            _cell(s.iqms["return"], 0),
            "reference" if s.runs.key == results.reference else _cell(_percent(s.improvement), 0),
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
            _cell(_percent(s.violation), 0),
            *(_cell(s.medians[name], SCORES[name].digits) for name in names),
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
    rows = tuple((s.runs.key, *(_cell(s.medians[key], SCORES[key].digits) for key in scores)) for s in methods)
    notes = (
        "Medians over the runs that finished. Effort and cost: integrals over the episode, summed over agents.",
        "At limit: share of time with an axis of the force at its limit, of the agent with the most.",
    )
    return Table(f"seeds-{name}", f"{caption}, over draws of the scenario", columns, rows, notes)


def _switch_table(methods: Sequence[MethodStatistics], agents: int) -> Table:
    columns = (Column("", "method"), *(Column("", f"agent {i + 1}") for i in range(agents)))
    rows = tuple((s.runs.key, *(_cell(agent["switches"], 1) for agent in s.agents)) for s in methods)
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
            _cell(g.iqms["return"], 0),
            _cell(g.iqms["violation_time"], 2),
            _cell(_percent(g.violation), 0),
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
    rows = [(m.key, f"{len(m.failed)}/{len(m.runs)}", _spans([run.seed for run in m.failed])) for m in methods]
    reasons = [f"{m.key} on seed {m.failed[0].seed}: {_one_line(m.failed[0].failure).rstrip('.')}." for m in methods]
    note = "Every reason is in episodes.csv and summary.json; the first of each method is"
    return Table("seeds-failures", "Runs that failed", columns, tuple(rows), (f"{note} below.", *reasons))


def _one_line(text: str | None) -> str:
    return " ".join(str(text).split())


def _spans(numbers: Sequence[int]) -> str:
    """Numbers as spans, 0, 2, 3, 4 as ``0, 2 to 4``."""
    numbers = sorted(numbers)
    starts = [k for k, n in enumerate(numbers) if k == 0 or n != numbers[k - 1] + 1]
    spans = [numbers[a:b] for a, b in zip(starts, [*starts[1:], len(numbers)], strict=True)]
    return ", ".join(f"{span[0]} to {span[-1]}" if len(span) > 1 else str(span[0]) for span in spans)


def _percent(estimate: Estimate) -> Estimate:
    return Estimate(*(100.0 * value for value in estimate))


def _cell(estimate: Estimate, digits: int) -> str:
    """``value [low, high]``; a dash where no run finished, no interval for a single run."""
    if not np.isfinite(estimate.value):
        return DASH
    value, low, high = (_fixed(number, digits) for number in estimate)
    return value if np.isnan(estimate.low) else f"{value} [{low}, {high}]"


def intervals(methods: Sequence[MethodStatistics]) -> Figure:
    """Median and 95 % interval of return, violation time and effort; one line a method, an empty one where all runs failed."""
    names = ("return", "violation_time", "effort")
    margins = pl.Margins(left=0.2 + 0.054 * max(len(s.runs.key) for s in methods), top=0.12, across=0.22)  # room for the names
    figure, panels = pl.panels(pl.DOUBLE, 0.65 + 0.16 * len(methods), 1, len(names), margins, sharey=True)
    supervisors = list(dict.fromkeys(s.runs.supervisor for s in methods))
    for axes, name in zip(panels[0], names, strict=True):
        for k, s in enumerate(methods):
            color = AGENT_COLORS[supervisors.index(s.runs.supervisor) % len(AGENT_COLORS)]
            estimate = s.medians[name]
            axes.plot([estimate.low, estimate.high], [k, k], color=color, linewidth=2.0, alpha=0.45)
            axes.plot(estimate.value, k, "o", color=color, markersize=3.5)
        axes.set_xlabel(f"{SCORES[name].group}, {SCORES[name].label}")
        axes.grid(axis="x", color="#E4E4E4", linewidth=0.4)
        axes.set_axisbelow(True)
    ours = [s.medians["effort"].value for s in methods if s.medians["effort"].value > 0]
    if ours and max(ours) > 30 * min(ours):
        panels[0, -1].set_xscale("log")
    panels[0, 0].set_yticks(range(len(methods)), [s.runs.key for s in methods])
    panels[0, 0].set_ylim(len(methods) - 0.4, -0.6)
    return figure


def write_seed_report(
    results: SeedResults,
    folder: Path,
    *,
    config: Mapping[str, Any],
    figures: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Write summary.json, episodes.csv, tables.md, tables.tex, figures/intervals.{pdf,png} and index.html; returns its path.

    Args:
        config: of the run: ``versions``, ``git_revision`` and ``command``, as config.json has them.
        figures: False leaves the figure out.
        progress: called with what is being done, how much of it is done and how much there is.
    """
    methods = analyse(results)
    tables = make_tables(results, methods)
    write_json(folder / "summary.json", summary(results, methods, config["versions"]))
    write_csv(results, folder / "episodes.csv")
    (folder / "tables.md").write_text(markdown(tables), encoding="utf-8")
    (folder / "tables.tex").write_text(latex_document(tables), encoding="utf-8")
    if figures:
        _write_figure(methods, folder / "figures")
    if progress is not None:
        progress("report", 1, 1)
    return _write_page(folder / "index.html", results, methods, tables, config)


def _write_figure(methods: Sequence[MethodStatistics], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    with pl.style():
        figure = intervals(methods)
        for kind in ("pdf", "png"):
            figure.savefig(folder / f"{FIGURE}.{kind}")


_READING = """
<p>Every method ran on the same draws around the scenario, so differences between methods are not differences of luck.
Medians and interquartile means ignore a few odd draws; intervals say how far another set of draws might move them.</p>
<p>Look at failures and the violation rate first: a supervisor whose schedule is fixed in time does not see that an obstacle
has moved, and a median over the runs that finished flatters a method that often fails.</p>"""


def _write_page(
    path: Path, results: SeedResults, methods: Sequence[MethodStatistics], tables: Sequence[Table], config: Mapping[str, Any]
) -> Path:
    scenario = results.scenario
    failed = sum(len(s.runs.failed) for s in methods)
    facts = (
        ("Scenario", f"{scenario.name}: {scenario.agents} agents, {scenario.duration:g} s, reference mode {scenario.reference}"),
        ("Clocks", f"mission step {scenario.mission_step:g} s, physics and control {scenario.substep:g} s"),
        ("Runs", f"{len(methods)} methods on {len(results.seeds)} draws, {failed} of {len(methods) * len(results.seeds)} failed"),
        ("Seeds", _spans(results.seeds)),
        ("Revision", str(config["git_revision"])),
        ("Versions", ", ".join(f"{name} {version}" for name, version in config["versions"].items())),
    )
    plot = _plot(path.parent / "figures" / f"{FIGURE}.png", "Median and 95 % interval of each method over draws.")
    text = Template(files("marlbc_mj.report").joinpath("page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"Behavioral control benchmark: {scenario.name}, {len(results.seeds)} draws"),
        lead=html.escape(
            f"{len(methods)} methods on the same {len(results.seeds)} draws around {scenario.description or scenario.name}."
        ),
        facts=_pairs(facts),
        command=html.escape(str(config["command"])),
        failures="",
        overview="".join(map(to_html, tables)),
        paper_text="The paper prints single runs without perturbation; without --seeds the same command shows them beside ours.",
        tables="",
        comparisons=plot or "<p>Not drawn.</p>",
        video_link="",
        video="",
        methods="".join(map(_method_section, methods)),
        reading=_READING,
        errata=_pairs((str(number), text) for number, text in paper_values.ERRATA.items()),
        files=_links(_files_beside(path.parent, ()), path.parent),
        citation=f'{html.escape(paper_values.CITATION)} <a href="{paper_values.DOI}">{paper_values.DOI}</a>',
    )
    path.write_text(text, encoding="utf-8")
    return path


def _method_section(statistics: MethodStatistics) -> str:
    """A folding section with every metric of every agent."""
    key, failed = statistics.runs.key, statistics.runs.failed
    state = (
        f"{len(failed)} of {len(statistics.runs.runs)} runs failed"
        if failed
        else f"return {_cell(statistics.medians['return'], 0)}"
    )
    columns = (Column("", "median"), *(Column("", f"agent {i + 1}") for i in range(len(statistics.agents))))
    rows = tuple((name, *(_loose(agent[name]) for agent in statistics.agents)) for name in AGENT_KEYS)
    table = Table(f"agents-{key}", "Every metric of every agent, median and interval", columns, rows)
    return f"<details><summary>{html.escape(key)}<span>{html.escape(state)}</span></summary>{to_html(table)}</details>"


def _loose(estimate: Estimate) -> str:
    """An estimate with three significant digits."""
    if not np.isfinite(estimate.value):
        return DASH
    ends = f" [{significant(estimate.low)}, {significant(estimate.high)}]"
    return significant(estimate.value) + ("" if np.isnan(estimate.low) else ends)
