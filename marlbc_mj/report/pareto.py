"""Figure of control cost against what it buys: return, safety and formation error."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from marlbc_mj.metrics import Metrics
from marlbc_mj.palette import AGENT_COLORS
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.results import Result

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "p")

_PANELS: tuple[tuple[str, str, Callable[[Metrics], float]], ...] = (
    ("return", "upper left is better", lambda m: m["team"]["return"]),
    ("violation, worst agent [s]", "lower left is better", lambda m: max(agent["violation_time"] for agent in m["agents"])),
    ("formation error [m]", "lower left is better", lambda m: m["team"]["formation_error"]),
)


def pareto(results: Sequence[Result]) -> Figure:
    """Cost summed over agents against return, violation time and formation error; one mark a method that ran."""
    ran = [result for result in results if result.metrics is not None]
    supervisors = list(dict.fromkeys(result.supervisor for result in ran))
    controllers = list(dict.fromkeys(result.controller for result in ran))
    entries = len(supervisors) + len(controllers)
    margins = pl.Margins(left=0.62, right=1.3, top=0.22, across=0.52)
    figure, panels = pl.panels(pl.DOUBLE, max(2.2, 0.4 + 0.15 * entries), 1, len(_PANELS), margins)
    costs = [_cost(result) for result in ran]
    decades = 10.0 ** np.array([np.floor(np.log10(min(costs) / 1.1)), np.ceil(np.log10(1.1 * max(costs)))])
    for axes, (label, better, read) in zip(panels[0], _PANELS, strict=True):
        for result in ran:
            _draw(axes, result, read, supervisors.index(result.supervisor), controllers.index(result.controller))
        axes.set(xscale="log", xlim=decades, xlabel="cost, sum of agents", ylabel=label)
        axes.set_title(better, loc="left", fontsize=7, color=pl.GREY)
        axes.margins(y=0.12)
        axes.grid(color="#E4E4E4", linewidth=0.4)
        axes.set_axisbelow(True)
    handles = [_mark("o", _color(k), name) for k, name in enumerate(supervisors)]
    handles += [_mark(MARKERS[k % len(MARKERS)], "white", name) for k, name in enumerate(controllers)]
    figure.legend(handles=handles, loc="center right", handletextpad=0.3, borderaxespad=0.1)
    return figure


def _cost(result: Result) -> float:
    """Cost integral summed over agents, kept off zero for the logarithmic axis."""
    assert result.metrics is not None
    return max(sum(agent["cost_integral"] for agent in result.metrics["agents"]), 1e-9)


def _draw(axes: Axes, result: Result, read: Callable[[Metrics], float], supervisor: int, controller: int) -> None:
    assert result.metrics is not None
    axes.plot(
        _cost(result),
        read(result.metrics),
        MARKERS[controller % len(MARKERS)],
        color=_color(supervisor),
        markeredgecolor="#1A1A1A",
        markeredgewidth=0.4,
        markersize=5,
        alpha=0.9,
    )


def _color(supervisor: int) -> str:
    return AGENT_COLORS[supervisor % len(AGENT_COLORS)]


def _mark(marker: str, color: str, label: str) -> Line2D:
    return Line2D(
        [], [], marker=marker, color="none", markerfacecolor=color, markeredgecolor="#1A1A1A", markeredgewidth=0.5, label=label
    )
