"""Figure of control cost against return, safety and formation error."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from marlbc_mj.report import plotting as pl
from marlbc_mj.report.paper_tables import LIMITED, one_per_controller, one_per_supervisor
from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.summary import Result
from marlbc_mj.util.method_names import source_of
from marlbc_mj.util.palette import METHOD_COLORS

_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "p")

_INK, _PAPER = "#1A1A1A", "#FFFFFF"
_LEADER = "#777777"
_COST_UNIT = "[(SI units)² s]"  # the cost adds m^2, (m/s)^2 and N^2
_MARK = 5.0  # size of a mark [pt]
_APART = 6.5  # approximate least distance between marks [pt]
_PANELS = {
    "return": "upper left is better",
    "violation_time_worst": "lower left is better",
    "formation_error_mean": "lower left is better",
}
"""Scores on the vertical axes, and the corner in which better methods are."""


class Group(NamedTuple):
    """Methods that share a row of panels and a legend."""

    results: Sequence[Result]
    handles: Sequence[Line2D]
    style: Callable[[Result], dict[str, Any]]


def pareto(results: Sequence[Result]) -> Figure:
    """Plot the cost summed over agents against return, violation time and formation error; one mark per method that ran.

    If the methods are supervisors with one controller and controllers under one supervisor, each of the two kinds has its own
    row, since their ranges differ. Otherwise all share one row. A control law has the same marker with and without a force
    limit, open if without. A mark that would cover another is shifted, and a line leads to a dot at its true position.
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


def _groups(ran: Sequence[Result]) -> list[Group]:
    supervisors, controllers = list(one_per_supervisor(ran).values()), list(one_per_controller(ran)[0].values())
    laws = list(dict.fromkeys(map(_law, ran)))
    names = {result.controller for result in ran}
    twins = {law for law in laws if f"{law}{LIMITED}" in names}
    supervisor_names = list(dict.fromkeys(result.supervisor for result in ran))

    def of_supervisor(result: Result) -> dict[str, Any]:
        return _style(supervisor_names.index(result.supervisor), 0, False)

    def of_law(result: Result) -> dict[str, Any]:  # without color, since colors are supervisors
        k = laws.index(_law(result))
        face = _PAPER if result.controller in twins else _INK
        return {**_style(0, k, False), "markerfacecolor": face}

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


def _draw_group(row: np.ndarray, group: Group) -> None:
    costs = [_cost(result) for result in group.results]
    limits = min(costs) / 1.6, max(costs) * 1.6
    if limits[1] < 30 * limits[0]:  # so that the axis has at least two labels
        limits = (10 ** np.floor(np.log10(limits[0])), 10 ** np.ceil(np.log10(limits[1])))
    cost = SCORES["cost_integral_sum"]
    floor = [_cost(result) for result in group.results if result.controller == "lqr"]
    for axes, (name, better) in zip(row, _PANELS.items(), strict=True):
        values = np.array([SCORES[name].read(_metrics(result)) for result in group.results])
        room = 0.12 * (float(np.ptp(values)) or 1.0)
        axes.set(xscale="log", xlim=limits, xlabel=f"{cost.quantity}, {cost.aggregation} {_COST_UNIT}", ylabel=SCORES[name].label)
        axes.set_ylim(values.min() - room, values.max() + room)
        if values.min() >= 0.0:  # marks that are shifted below zero must not look like negative values
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}" if value >= 0.0 else "")
        axes.set_title(better, loc="left", fontsize=7, color=pl.GREY)
        _draw_marks(axes, np.column_stack([costs, values]), [group.style(result) for result in group.results])
        axes.grid(color="#E4E4E4", linewidth=0.4)
        axes.set_axisbelow(True)
        if floor:
            _draw_floor(axes, min(floor))


def _draw_marks(axes: Axes, points: np.ndarray, styles: Sequence[Mapping[str, Any]]) -> None:
    """Draw marks at points (P, 2) after the axes have their limits; shift marks that would cover others, on a thin line."""
    inch = axes.figure.dpi_scale_trans
    shifts = _shifts(72.0 * inch.inverted().transform(axes.transData.transform(points)))
    for point, shift, style in zip(points, shifts, styles, strict=True):
        aside = axes.transData + ScaledTranslation(shift[0] / 72.0, shift[1] / 72.0, inch)
        if shift.any():
            line = {"arrowstyle": "-", "linewidth": 0.7, "color": _LEADER, "shrinkA": 0.0, "shrinkB": 0.0, "zorder": 4}
            axes.annotate("", point, tuple(shift), textcoords="offset points", arrowprops=line, annotation_clip=False)
            axes.plot(*point, marker="o", markersize=1.8, color=_LEADER, linestyle="none", clip_on=False, zorder=5)
        axes.plot(*point, linestyle="none", clip_on=False, transform=aside, **style)


def _shifts(places: np.ndarray) -> np.ndarray:
    """Shifts (P, 2) of marks at places (P, 2), all in pt: the smallest candidates that keep marks about ``_APART`` apart."""
    rings = [(k, 6 * k) for k in range(1, 1 + len(places))]
    turns = [(_APART * k, 0.5 * np.pi + 2.0 * np.pi * j / count) for k, count in rings for j in range(count)]
    offsets = np.array([(0.0, 0.0), *((r * np.cos(angle), r * np.sin(angle)) for r, angle in turns)])
    shown: list[np.ndarray] = []
    for place in places:
        free = [o for o in offsets if all(np.hypot(*(place + o - other)) > 0.97 * _APART for other in shown)]
        shown.append(place + free[0])
    return np.asarray(np.array(shown) - places)


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
    """Cost integral summed over agents, kept above zero for the logarithmic axis."""
    return max(SCORES["cost_integral_sum"].read(_metrics(result)), 1e-9)


def _law(result: Result) -> str:
    return result.controller.removesuffix(LIMITED)


def _style(supervisor: int, law: int, hollow: bool) -> dict[str, Any]:
    color = METHOD_COLORS[supervisor % len(METHOD_COLORS)]
    return {
        "marker": _MARKERS[law % len(_MARKERS)],
        "markerfacecolor": "white" if hollow else color,
        "markeredgecolor": color if hollow else _INK,
        "markeredgewidth": 0.9 if hollow else 0.4,
        "markersize": _MARK,
        "zorder": 3,
    }


def _entry(label: str, **style: Any) -> Line2D:
    return Line2D([], [], linestyle="none", label=label, **style)
