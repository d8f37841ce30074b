"""The report of many draws: its files, its figure and its page."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from marlbc_mj.report import plotting as pl
from marlbc_mj.report.bundle import files_beside
from marlbc_mj.report.formats import interval, loose_interval, spans
from marlbc_mj.report.page import fill_page, plot
from marlbc_mj.report.seed_files import summary, write_csv
from marlbc_mj.report.seed_tables import caution, make_tables
from marlbc_mj.report.table import Column, Table, to_html
from marlbc_mj.report.tables import latex_document, markdown
from marlbc_mj.results.seed_statistics import SCORES, MethodStatistics, analyse
from marlbc_mj.results.seeds import SeedResults
from marlbc_mj.results.summary import AGENT_KEYS
from marlbc_mj.util.files import write_json
from marlbc_mj.util.palette import AGENT_COLORS
from marlbc_mj.util.progress import Progress

FIGURE = "intervals"


def intervals(methods: Sequence[MethodStatistics]) -> Figure:
    """Median and 95 % interval of return, violation time and effort; one line a method, that says so where all runs failed."""
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
            if np.isnan(estimate.value) and name == names[0]:
                axes.annotate(
                    "failed", (0, k), (4, 0), xycoords=("axes fraction", "data"), textcoords="offset points", va="center"
                )
        if name == "violation_time":
            most = max((s.medians[name].high for s in methods if s.medians[name].high > 0), default=1.0)
            axes.set_xlim(-0.04 * most, 1.04 * most)
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


_PAPER = "<p>The paper prints single runs without perturbation; without --seeds the same command shows them.</p>"
_NO_PAPER = "<p>The paper has no mission like this one.</p>"


def _write_page(
    path: Path, results: SeedResults, methods: Sequence[MethodStatistics], tables: Sequence[Table], config: Mapping[str, Any]
) -> Path:
    scenario = results.scenario
    failed = sum(len(s.runs.failed) for s in methods)
    facts = (
        ("Scenario", f"{scenario.name}: {scenario.agents} agents, {scenario.duration:g} s, reference mode {scenario.reference}"),
        ("Clocks", f"mission step {scenario.mission_step:g} s, physics and control {scenario.substep:g} s"),
        ("Runs", f"{len(methods)} methods on {len(results.seeds)} draws, {failed} of {len(methods) * len(results.seeds)} failed"),
        ("Seeds", spans(results.seeds)),
        ("Revision", str(config["git_revision"])),
        ("Versions", ", ".join(f"{name} {version}" for name, version in config["versions"].items())),
    )
    figure = plot(
        path.parent / "figures" / f"{FIGURE}.png",
        f"Median and 95 % interval of each method over draws{caution(len(results.seeds))}.",
    )
    return fill_page(
        path,
        title=f"Behavioral control benchmark: {scenario.name}, {len(results.seeds)} draws",
        lead=f"{len(methods)} methods on the same {len(results.seeds)} draws around {scenario.description or scenario.name}.",
        facts=facts,
        command=str(config["command"]),
        overview="".join(map(to_html, tables)),
        paper=_PAPER if scenario.layout is None else _NO_PAPER,
        comparisons=figure or "<p>Not drawn.</p>",
        methods="".join(map(_method_section, methods)),
        reading=_READING,
        links=files_beside(path.parent),
    )


def _method_section(statistics: MethodStatistics) -> str:
    """A folding section with every metric of every agent."""
    key, failed = statistics.runs.key, statistics.runs.failed
    state = (
        f"{len(failed)} of {len(statistics.runs.runs)} runs failed"
        if failed
        else f"return {interval(statistics.medians['return'], 0)}"
    )
    columns = (Column("", "median"), *(Column("", f"agent {i + 1}") for i in range(len(statistics.agents))))
    rows = tuple((name, *(loose_interval(agent[name]) for agent in statistics.agents)) for name in AGENT_KEYS)
    table = Table(f"agents-{key}", "Every metric of every agent, median and interval", columns, rows)
    return f"<details><summary>{html.escape(key)}<span>{html.escape(state)}</span></summary>{to_html(table)}</details>"
