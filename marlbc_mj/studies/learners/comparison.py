"""Table and figure of a learner study, made from the lines of its CSV files."""

from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from marlbc_mj.report import plotting as pl
from marlbc_mj.report.formats import DASH, fixed, grouped, interval
from marlbc_mj.report.table import Column, Table, to_latex, to_markdown
from marlbc_mj.results.statistics import Estimate, Statistic, bootstrap, iqm, median
from marlbc_mj.studies.learners.records import GOAL_SWITCHES, UNFINISHED, CsvLine, lines_by
from marlbc_mj.studies.learners.variants import VARIANTS
from marlbc_mj.util.files import staged_file
from marlbc_mj.util.palette import METHOD_COLORS

WIDE = 6
"""Most variants in a group, and number of panels side by side in the figure."""
REFERENCE_VARIANT = "marlms"
"""The variant that every panel shows for comparison."""
COLOR, REFERENCE_COLOR, FAILED_COLOR = METHOD_COLORS[0], "#9A9A9A", "#C8102E"
_GOAL: dict[str, Any] = {"color": METHOD_COLORS[1], "marker": "v", "markersize": 3, "linestyle": "none"}
_END: dict[str, Any] = {"color": FAILED_COLOR, "marker": "x", "markersize": 4, "linestyle": "none"}


def write_comparison(folder: Path, rows: Sequence[CsvLine], curves: Sequence[CsvLine]) -> None:
    """Write study.md, study.tex, curves.pdf and curves.png, made from the lines of the CSV files alone."""
    table = learners_table(rows)
    figure_note = (
        "`curves.pdf`: median and range over the runs that got that far; violation is the worst agent's, linear below 0.1 s.\n"
    )
    named = "".join(f"- `{name}`: {VARIANTS[name].line}\n" for name in by_variant(rows))
    for name, text in (("study.md", f"{to_markdown(table)}\n{named}\n{figure_note}"), ("study.tex", to_latex(table) + "\n")):
        with staged_file(folder / name, overwrite=True) as staging:
            staging.write_text(text, encoding="utf-8")
    with pl.style():
        figure = draw_curves(rows, curves)
        for name, metadata in (("curves.pdf", {"CreationDate": None}), ("curves.png", {})):
            with staged_file(folder / name, overwrite=True) as staging:
                figure.savefig(staging, metadata=metadata)


def by_variant(lines: Sequence[CsvLine]) -> dict[str, list[CsvLine]]:
    """Lines by variant, in the order of VARIANTS."""
    return lines_by("variant", VARIANTS, lines)


def learners_table(rows: Sequence[CsvLine]) -> Table:
    """A table with a row per variant: how many runs met the goal and when, and their best and last evaluations."""
    labels: tuple[tuple[str, str], ...] = (
        ("", "runs"),
        ("goal", "met"),
        ("goal", "steps [10⁶]"),
        ("goal", "time [min]"),
        ("best", "return, median"),
    )
    labels += ("best", "return, IQM"), ("best", "violation, worst agent [s]"), ("best", "switches"), ("last", "return, IQM")
    runs = by_variant(rows)
    groups = [VARIANTS[name].group for name in runs]
    budgets = " and ".join(grouped(b) for b in sorted({int(row["budget"]) for row in rows}))
    goals = " and ".join(f"{g:.0f}" for g in sorted({float(row["goal_return"]) for row in rows}))
    notes = [
        f"Goal: no violation, at most {'/'.join(map(str, GOAL_SWITCHES))} switches, and at least the scripted supervisor's "
        f"return, {goals}; a run that never meets it counts as ∞. Budget: {budgets} mission steps, one thread a run.",
        "Medians and interquartile means (IQM) over runs, with 95 % bootstrap intervals, too narrow for so few runs. Best and "
        "last evaluation: of runs that ended well. Violation of the worst agent, switches of the team.",
        *(f"{row['variant']} seed {row['seed']}: {row['failure']}" for row in rows if row["failure"]),
    ]
    return Table(
        "study",
        "Learners of mission supervisors on the case study",
        (Column("", "variant"), *(Column(*label) for label in labels)),
        tuple((name, *_cells(lines)) for name, lines in runs.items()),
        tuple(notes),
        tuple(k for k in range(1, len(groups)) if groups[k] != groups[k - 1]),
    )


def _cells(rows: Sequence[CsvLine]) -> tuple[str, ...]:
    ended = [row for row in rows if row["failure"] != UNFINISHED]
    well = [row for row in rows if not row["failure"]]

    def of(column: str, statistic: Statistic = median) -> Estimate:
        return bootstrap([np.array([float(row[column]) for row in well])], statistic)

    def until(column: str, unit: float) -> Estimate:
        return bootstrap([np.array([float(row[column] or inf) for row in ended]) / unit])

    switches = bootstrap([np.array([sum(map(float, row["best_switches"].split("/"))) for row in well])])
    return (
        str(len(ended)) if len(ended) == len(well) else f"{len(ended)}, {len(ended) - len(well)} failed",
        f"{sum(bool(row['goal_mission_steps']) for row in ended)} of {len(ended)}",
        _until(until("goal_mission_steps", 1e6), 2),
        _until(until("goal_wall_s", 60.0), 1),
        interval(of("best_return"), 0),
        interval(of("best_return", iqm), 0),
        interval(of("best_violation_time"), 2),
        fixed(switches.value, 0),
        interval(of("final_return", iqm), 0),
    )


def _until(estimate: Estimate, digits: int) -> str:
    """An estimate as ``value [low, high]``; each number may be infinite."""
    if np.isnan(estimate.value):
        return DASH
    value, low, high = ("∞" if number == inf else fixed(number, digits) for number in estimate)
    return value if np.isnan(estimate.low) or value == low == high else f"{value} [{low}, {high}]"


def draw_curves(rows: Sequence[CsvLine], curves: Sequence[CsvLine]) -> Figure:
    """Figure of return and violation time over mission steps, two panels per variant, placed by :func:`rows_of_panels`."""
    runs, evaluations = by_variant(rows), by_variant(curves)
    blocks = rows_of_panels(list(runs))
    columns = max(map(len, blocks))
    left, right, top, bottom, gap, inner, between = 0.48, 0.1, 0.42, 0.36, 0.1, 0.09, 0.46
    heights = 0.85, 0.6
    width = (pl.DOUBLE - left - right - (columns - 1) * gap) / columns
    block = sum(heights) + inner
    total = top + bottom + len(blocks) * block + (len(blocks) - 1) * between
    figure = Figure(figsize=(pl.DOUBLE, total))
    returns = [float(line["return"]) / 1e3 for line in curves] + [float(row["goal_return"]) / 1e3 for row in rows]
    high = max(1.0, *returns)
    limits = {
        "return": (max(min(*returns, 0.0), -high) - 0.3 * high, 1.16 * high),
        "violation_time": (-0.012, 1.6 * max([1.0, *(float(line["violation_time"]) for line in curves)])),
    }
    steps = max([float(line["mission_steps"]) for line in curves] + [max(float(row["budget"]) for row in rows)]) / 1e6
    for b, names in enumerate(blocks):
        for c, name in enumerate(names):
            corner = total - top - b * (block + between)
            for key, height in zip(limits, heights, strict=True):
                corner -= height
                at = ((left + c * (width + gap)) / pl.DOUBLE, corner / total, width / pl.DOUBLE, height / total)
                axes = figure.add_axes(at, xlim=(0, 1.03 * steps), ylim=limits[key])
                corner -= inner
                _draw_panel(
                    axes,
                    key,
                    runs[name],
                    evaluations.get(name, []),
                    [] if name == REFERENCE_VARIANT else evaluations.get(REFERENCE_VARIANT, []),
                )
                axes.tick_params(labelleft=c == 0, labelbottom=key == "violation_time")
                axes.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
                if key == "return":
                    axes.set_title(VARIANTS[name].title, loc="left", fontsize=6.5)
                if c == 0:
                    axes.set_ylabel({"return": "return [10³]", "violation_time": "worst violation [s]"}[key])
                    axes.yaxis.set_label_coords(-0.34 / width, 0.5, transform=axes.transAxes)
    figure.supxlabel("mission steps [10⁶]", fontsize=8, y=0.0, va="bottom")
    pl.legend_above(figure, _handles(compared=set(runs) != {REFERENCE_VARIANT}), columnspacing=1.0)
    return figure


def rows_of_panels(names: Sequence[str]) -> list[list[str]]:
    """Variants row by row. A group is never split; it joins the row before it if the whole group fits there."""
    blocks: list[list[str]] = [[]]
    for group in dict.fromkeys(VARIANTS[name].group for name in names):
        members = [name for name in names if VARIANTS[name].group == group]
        if len(blocks[-1]) + len(members) > WIDE:
            blocks.append([])
        blocks[-1] += members
    return blocks


def _draw_panel(axes: Axes, key: str, rows: Sequence[CsvLine], curves: Sequence[CsvLine], reference: Sequence[CsvLine]) -> None:
    unit = 1e3 if key == "return" else 1.0
    for lines, color, span in ((reference, REFERENCE_COLOR, False), (curves, COLOR, True)):
        at = sorted({float(line["mission_steps"]) for line in lines})
        values = [[float(line[key]) / unit for line in lines if float(line["mission_steps"]) == step] for step in at]
        x = np.array(at) / 1e6
        if span and values:
            axes.fill_between(x, [min(v) for v in values], [max(v) for v in values], color=color, alpha=0.25, linewidth=0)
        axes.plot(x, [np.median(v) for v in values], color=color, linewidth=1.0 if span else 0.8)
    if key == "return":
        axes.axhline(float(rows[0]["goal_return"]) / unit, color=pl.GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
        met = [float(row["goal_mission_steps"]) / 1e6 for row in rows if row["goal_mission_steps"]]
        axes.plot(met, [0.97] * len(met), **_GOAL, transform=axes.get_xaxis_transform(), clip_on=False)
        failed = sum(row["failure"] not in ("", UNFINISHED) for row in rows)
        ended = [row for row in rows if row["failure"] != UNFINISHED]
        reached = sum(bool(row["goal_mission_steps"]) for row in ended)
        axes.text(0.97, 0.04, f"goal {reached} of {len(ended)}", transform=axes.transAxes, ha="right", fontsize=6.5)
        if failed:
            axes.text(0.97, 0.2, f"{failed} failed", transform=axes.transAxes, ha="right", fontsize=6.5, color=FAILED_COLOR)
    else:
        axes.set_yscale("symlog", linthresh=0.1, linscale=0.8)
        axes.set_yticks([0, 0.1, 1, 10], ["0", "0.1", "1", "10"])
    for row in rows:
        if row["failure"] not in ("", UNFINISHED) and row["final_mission_steps"]:
            value = float(row[f"final_{key}"]) / unit
            axes.plot(float(row["final_mission_steps"]) / 1e6, np.clip(value, *axes.get_ylim()), **_END, clip_on=False)


def _handles(*, compared: bool) -> list[Line2D | Patch]:
    """Entries of the legend, with the median of the reference variant if variants are ``compared``."""
    reference = Line2D([], [], color=REFERENCE_COLOR, label=f"median of {VARIANTS[REFERENCE_VARIANT].title}")
    return [
        Line2D([], [], color=COLOR, label="median"),
        Patch(color=COLOR, alpha=0.25, linewidth=0, label="range of runs"),
        *([reference] if compared else []),
        Line2D([], [], color=pl.GREY, linewidth=0.6, linestyle=(0, (3, 2)), label="scripted supervisor"),
        Line2D([], [], **_GOAL, label="a run meets the goal"),
        Line2D([], [], **_END, label="a run fails"),
    ]
