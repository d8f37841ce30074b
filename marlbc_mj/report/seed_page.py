"""The report of a run on many draws: its files, its figure and its page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from marlbc_mj.report import paper_values
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.figures import save_figure
from marlbc_mj.report.formats import loose_interval, score_interval, spans
from marlbc_mj.report.page import files_beside, fill_page, origin_facts, picture, scenario_facts
from marlbc_mj.report.seed_files import seed_summary, write_seed_csv
from marlbc_mj.report.seed_tables import caution, make_seed_tables
from marlbc_mj.report.table import Column, Table
from marlbc_mj.report.tables import latex_document, markdown
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seed_statistics import MethodStatistics, analyse
from marlbc_mj.results.seeds import SeedResults
from marlbc_mj.results.summary import AGENT_KEYS
from marlbc_mj.scenarios.titles import mission_title
from marlbc_mj.util.files import write_json
from marlbc_mj.util.palette import METHOD_COLORS
from marlbc_mj.util.progress import Progress

FIGURE = "intervals"


def intervals(methods: Sequence[MethodStatistics]) -> Figure:
    """Draw median and 95 % interval of return, violation time and effort, one line per method; "failed" if all runs failed."""
    names = ("return", "violation_time_worst", "effort_integral_sum")
    margins = pl.Margins(
        left=0.2 + 0.054 * max(len(s.runs.display) for s in methods), top=0.12, across=0.22
    )  # room for the names
    figure, panels = pl.panels(pl.DOUBLE, 0.65 + 0.16 * len(methods), 1, len(names), margins, sharey=True)
    supervisors = list(dict.fromkeys(s.runs.supervisor for s in methods))
    for axes, name in zip(panels[0], names, strict=True):
        for k, s in enumerate(methods):
            color = METHOD_COLORS[supervisors.index(s.runs.supervisor) % len(METHOD_COLORS)]
            estimate = s.medians[name]
            axes.plot([estimate.low, estimate.high], [k, k], color=color, linewidth=2.0, alpha=0.45)
            axes.plot(estimate.value, k, "o", color=color, markersize=3.5)
            if np.isnan(estimate.value) and name == names[0]:
                axes.annotate(
                    "failed", (0, k), (4, 0), xycoords=("axes fraction", "data"), textcoords="offset points", va="center"
                )
        if name == "violation_time_worst":
            most = max((s.medians[name].high for s in methods if s.medians[name].high > 0), default=1.0)
            axes.set_xlim(-0.04 * most, 1.04 * most)
        axes.set_xlabel(SCORES[name].label)
        axes.grid(axis="x", color="#E4E4E4", linewidth=0.4)
        axes.set_axisbelow(True)
    ours = [s.medians[names[-1]].value for s in methods if s.medians[names[-1]].value > 0]
    if ours and max(ours) > 30 * min(ours):
        panels[0, -1].set_xscale("log")
    panels[0, 0].set_yticks(range(len(methods)), [s.runs.display for s in methods])
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
    """Write summary.json, episodes.csv, tables.{md,tex}, figures/intervals.{pdf,png} and index.html; returns the page's path.

    Args:
        config: content of config.json: ``versions``, ``git_revision`` and ``command``.
        figures: whether to draw the figure.
        progress: called with the name of the stage, the amount done and the total amount.
    """
    methods = analyse(results)
    tables = make_seed_tables(results, methods)
    write_json(folder / "summary.json", seed_summary(results, methods, config["versions"]))
    write_seed_csv(results, folder / "episodes.csv")
    (folder / "tables.md").write_text(markdown(tables), encoding="utf-8")
    (folder / "tables.tex").write_text(latex_document(tables), encoding="utf-8")
    if figures:
        _write_figure(methods, folder / "figures")
    if progress is not None:
        progress("report", 1, 1)
    return write_seed_page(folder / "index.html", results, methods, tables=tables, config=config)


def _write_figure(methods: Sequence[MethodStatistics], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    save_figure(lambda: intervals(methods), folder / FIGURE)


def write_seed_page(
    path: Path,
    results: SeedResults,
    methods: Sequence[MethodStatistics],
    *,
    tables: Sequence[Table],
    config: Mapping[str, Any],
    awaited: int = 0,
) -> Path:
    """Write the page of a run on many draws; ``awaited`` is the total number of methods, see :func:`write_benchmark_page`."""
    scenario, draws = results.scenario, len(results.seeds)
    of_paper = scenario.name == paper_values.SCENARIO
    failed = sum(len(s.runs.failed) for s in methods)
    caption = f"Median and 95 % interval of each method over draws{caution(draws)}."
    figure = picture(path.parent / "figures" / f"{FIGURE}.png", caption)
    return fill_page(
        path,
        "seed_page.html",
        files_beside(path.parent),
        title=f"Behavioral control benchmark: {mission_title(scenario.name)}, {draws} draws",
        lead=f"{len(methods)} methods on the same {draws} draws around {scenario.description or scenario.name}.",
        facts=[
            *scenario_facts(scenario),
            ("Runs", f"{len(methods)} methods on {draws} draws, {failed} of {len(methods) * draws} failed"),
            ("Seeds", spans(results.seeds)),
            *origin_facts(config),
        ],
        command=str(config["command"]),
        tables=tables,
        of_paper=of_paper,
        has_details=of_paper,
        pictures=[figure] if figure else [],
        video=None,
        methods=list(map(_method_section, methods)),
        awaited=awaited,
    )


class _MethodTable(NamedTuple):
    """A collapsible section with every metric of every agent."""

    name: str
    facts: str
    table: Table


def _method_section(statistics: MethodStatistics) -> _MethodTable:
    key, failed = statistics.runs.key, statistics.runs.failed
    if failed:
        facts = f"{len(failed)} of {len(statistics.runs.runs)} runs failed"
    else:
        facts = f"return {score_interval('return', statistics.medians['return'])}"
    columns = (Column("", "median"), *(Column("", f"agent {i + 1}") for i in range(len(statistics.agents))))
    rows = tuple((name, *(loose_interval(agent[name]) for agent in statistics.agents)) for name in AGENT_KEYS)
    return _MethodTable(
        statistics.runs.display, facts, Table(f"agents-{key}", "Every metric of every agent, median and interval", columns, rows)
    )
