"""Figure of control cost against what it buys: return, safety and formation error."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from marlbc_mj.report import plotting as pl
from marlbc_mj.report.paper_tables import LIMITED, one_per_controller, one_per_supervisor
from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.summary import Result
from marlbc_mj.util.method_names import source_of
from marlbc_mj.util.palette import AGENT_COLORS

_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "p")
_COLORS = (*AGENT_COLORS[:7], "#8C564B", "#17BECF", "#B5BD00", "#000000", "#A0A0A0", "#1B9E77", "#9467BD")

_INK, _PAPER = "#1A1A1A", "#FFFFFF"
_COST_UNIT = "[s, SI squared]"  # the paper adds m^2, (m/s)^2 and N^2
_TOGETHER = 0.01  # marks closer than this share of every axis are one
_PANELS = {
    "return": "upper left is better",
    "violation_time_worst": "lower left is better",
    "formation_error_mean": "lower left is better",
}
"""Scores on the ordinates, and where the better methods are."""


class Group(NamedTuple):
    """Methods that share a row of panels and a legend."""

    results: Sequence[Result]
    handles: Sequence[Line2D]
    style: Callable[[Result], dict[str, Any]]


def pareto(results: Sequence[Result]) -> Figure:
    """Cost summed over agents against return, violation time and formation error; one mark per method that ran.

    Where the methods are supervisors with one controller and controllers under one supervisor, each of the two kinds has its own
    row, since their ranges differ; else all share one row. A law with and without force limit has one marker, open without.
    """
    ran = [result for result in results if result.metrics is not None]
    groups = _groups(ran)
    margins = pl.Margins(left=0.62, right=1.42, top=0.24, across=0.56, between=0.62)
    height = max(1.9, 0.15 * max(len(group.handles) for group in groups))
    total = margins.top + margins.bottom + len(groups) * height + (len(groups) - 1) * margins.between
    figure, panels = pl.panels(pl.DOUBLE, total, len(groups), len(_PANELS), margins)
    for row, group in zip(panels, groups, strict=True):
        _draw_group(row, group)
        row[-1].legend(
            handles=group.handles,
            loc="center left",
            bbox_to_anchor=(1.04, 0.5),
            handletextpad=0.2,
            labelspacing=0.28,
            fontsize=6.5,
        )
    return figure


def coincident(results: Sequence[Result]) -> list[list[str]]:
    """Methods whose marks a reader cannot tell apart in any panel, named by their controllers where these are enough."""
    found = []
    for group in _groups([result for result in results if result.metrics is not None]):
        named = len({result.supervisor for result in group.results}) == 1
        points = np.array([[np.log10(_cost(r)), *(SCORES[name].read(_metrics(r)) for name in _PANELS)] for r in group.results])
        close = _TOGETHER * np.maximum(np.ptp(points, axis=0), 1e-12)
        rest = list(range(len(points)))
        while rest:
            together = [k for k in rest if (np.abs(points[k] - points[rest[0]]) <= close).all()]
            if len(together) > 1:
                found.append([group.results[k].controller if named else group.results[k].key for k in together])
            rest = [k for k in rest if k not in together]
    return found


def _groups(ran: Sequence[Result]) -> list[Group]:
    supervisors, controllers = list(one_per_supervisor(ran).values()), list(one_per_controller(ran)[0].values())
    laws = list(dict.fromkeys(map(_law, ran)))
    names = {result.controller for result in ran}
    twins = {law for law in laws if f"{law}{LIMITED}" in names}
    supervisor_names = list(dict.fromkeys(result.supervisor for result in ran))

    def of_supervisor(result: Result) -> dict[str, Any]:
        k = supervisor_names.index(result.supervisor)
        return {**_style(k, 0, False), "markersize": _sizes(len(supervisor_names))[k]}

    def of_law(result: Result) -> dict[str, Any]:  # without color, which means a supervisor
        k = laws.index(_law(result))
        face = _PAPER if result.controller in twins else _INK
        return {**_style(0, k, False), "markerfacecolor": face, "markersize": _sizes(len(laws))[k], "alpha": 0.75}

    def of_both(result: Result) -> dict[str, Any]:
        return _style(supervisor_names.index(result.supervisor), laws.index(_law(result)), result.controller in twins)

    named = [_entry(source_of(name).display, **_style(k, 0, False)) for k, name in enumerate(supervisor_names)]
    marked = [_entry(source_of(law).display, **{**_style(0, k, False), "markerfacecolor": _INK}) for k, law in enumerate(laws)]
    plain = [
        _entry(source_of(law).display, **{**_style(0, k, False), "markerfacecolor": "#D0D0D0"}) for k, law in enumerate(laws)
    ]
    limit = [_entry("open: no force limit", **{**_style(0, 0, True), "markeredgecolor": _INK})] if twins else []
    title = [_entry("supervisor:", marker="none")], [_entry("controller:", marker="none")]
    if len(ran) == len(supervisors) + len(controllers) - 1 and min(len(supervisors), len(controllers)) > 1:
        return [
            Group(supervisors, title[0] + named, of_supervisor),
            Group(controllers, title[1] + marked + limit, of_law),
        ]
    return [Group(ran, title[0] + named + title[1] + plain + limit, of_both)]


def _sizes(count: int) -> np.ndarray:
    """Sizes of marks from the first, drawn below, to the last, drawn above: those that coincide stay visible as rings."""
    return np.linspace(8.0, 4.0, count)


def _draw_group(row: np.ndarray, group: Group) -> None:
    costs = [_cost(result) for result in group.results]
    limits = min(costs) / 1.6, max(costs) * 1.6
    if limits[1] < 30 * limits[0]:  # an axis with at least two labels
        limits = (10 ** np.floor(np.log10(limits[0])), 10 ** np.ceil(np.log10(limits[1])))
    cost = SCORES["cost_integral_sum"]
    floor = [_cost(result) for result in group.results if result.controller == "lqr"]
    for axes, (name, better) in zip(row, _PANELS.items(), strict=True):
        for result in group.results:
            axes.plot(_cost(result), SCORES[name].read(_metrics(result)), linestyle="none", clip_on=False, **group.style(result))
        axes.set(xscale="log", xlim=limits, xlabel=f"{cost.quantity}, {cost.aggregation} {_COST_UNIT}", ylabel=SCORES[name].label)
        axes.set_title(better, loc="left", fontsize=7, color=pl.GREY)
        axes.margins(y=0.12)
        axes.grid(color="#E4E4E4", linewidth=0.4)
        axes.set_axisbelow(True)
        if floor:
            _draw_floor(axes, min(floor))


def _draw_floor(axes: Axes, cost: float) -> None:
    axes.axvline(cost, color=pl.GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
    axes.annotate(
        "LQR",
        (cost, 1.0),
        (2, -2),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        fontsize=6.5,
        color=pl.GREY,
        va="top",
    )


def _metrics(result: Result) -> Metrics:
    assert result.metrics is not None
    return result.metrics


def _cost(result: Result) -> float:
    """Cost integral summed over agents, kept off zero for the logarithmic axis."""
    return max(SCORES["cost_integral_sum"].read(_metrics(result)), 1e-9)


def _law(result: Result) -> str:
    return result.controller.removesuffix(LIMITED)


def _style(supervisor: int, law: int, hollow: bool) -> dict[str, Any]:
    color = _COLORS[supervisor % len(_COLORS)]
    return {
        "marker": _MARKERS[law % len(_MARKERS)],
        "markerfacecolor": "white" if hollow else color,
        "markeredgecolor": color if hollow else _INK,
        "markeredgewidth": 0.9 if hollow else 0.4,
        "markersize": 5,
        "zorder": 3,
    }


def _entry(label: str, **style: Any) -> Line2D:
    return Line2D([], [], linestyle="none", label=label, **style)
