"""Shared parts of all figures: style, sizes, and decimation that keeps every peak."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from marlbc_mj.core.orders import SEPARATOR
from marlbc_mj.util.palette import AGENT_COLORS, command_color

SINGLE = 3.5  # width of a text column [in]
DOUBLE = 7.16  # width of two text columns and the gap between them [in]
GREY = "#6E6E6E"
LINE_STYLES = ("-", (0, (5, 1.2)), (0, (3, 1, 1, 1)), (0, (1.2, 1)))
BINS = 500  # bins per curve: more than a printed column resolves

_STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "axes.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelpad": 2,
    "axes.titlepad": 3,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.linewidth": 0.8,
    "lines.solid_capstyle": "butt",
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "savefig.dpi": 300,
}


def style() -> AbstractContextManager[None]:
    """A context with Matplotlib's settings, for drawing and saving; fonts are embedded as TrueType."""
    return matplotlib.rc_context(_STYLE)


Share = bool | Literal["none", "all", "row", "col"]
"""Which panels share an axis."""


class Margins(NamedTuple):
    """Space around and between panels [in]; fixed, so that a kind of figure has the same layout for every method."""

    left: float = 0.5
    right: float = 0.14
    bottom: float = 0.36
    top: float = 0.3
    across: float = 0.2
    between: float = 0.27


def panels(
    width: float, height: float, rows: int, columns: int, margins: Margins, *, sharex: Share = False, sharey: Share = False
) -> tuple[Figure, np.ndarray]:
    """A figure of exactly this size [in] and its (rows, columns) panels."""
    figure = Figure(figsize=(width, height))
    m = margins
    each_width = (width - m.left - m.right - (columns - 1) * m.across) / columns
    each_height = (height - m.bottom - m.top - (rows - 1) * m.between) / rows
    grid = {
        "left": m.left / width,
        "right": 1 - m.right / width,
        "bottom": m.bottom / height,
        "top": 1 - m.top / height,
        "wspace": m.across / each_width,
        "hspace": m.between / each_height,
    }
    return figure, np.asarray(figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey, gridspec_kw=grid))


def legend_above(figure: Figure, handles: Sequence[Artist], **options: Any) -> None:
    """Add a legend at the figure's top edge, in one row by default."""
    options = {"ncols": len(handles), "columnspacing": 1.3, "borderaxespad": 0.25, "borderpad": 0.2, **options}
    figure.legend(handles=list(handles), loc="upper center", **options)


def legend_in(axes: Axes, handles: Sequence[Artist]) -> None:
    """Fill an empty panel with a legend, one entry per line."""
    axes.set_axis_off()
    axes.legend(handles=list(handles), loc="center left", borderaxespad=0.0, labelspacing=0.6)


def agent_line(agent: int) -> dict[str, Any]:
    """Color, line style and label of an agent's curve."""
    return {
        "color": AGENT_COLORS[agent % len(AGENT_COLORS)],
        "linestyle": LINE_STYLES[agent % len(LINE_STYLES)],
        "label": f"agent {agent + 1}",
    }


def envelope(time: np.ndarray, values: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Decimate a curve to at most ``2 bins + 2`` of its samples, in order: both ends, and each bin's smallest and largest.

    Args:
        time: (T,) abscissa.
        values: (T,) ordinate.
    """
    size = -(-len(values) // bins)
    if size <= 2:
        return time, values
    starts = np.arange(0, len(values), size)
    padded = np.pad(values, (0, len(starts) * size - len(values)), mode="edge").reshape(len(starts), size)
    picked = np.concatenate([starts + padded.argmin(axis=1), starts + padded.argmax(axis=1), [0, len(values) - 1]])
    keep = np.unique(np.minimum(picked, len(values) - 1))
    return time[keep], values[keep]


def bin_maxima(time: np.ndarray, values: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Decimate a curve (T,) to the largest value of each bin, placed at the bin's start."""
    size = -(-len(values) // bins)
    starts = np.arange(0, len(values), size)
    return time[starts], np.maximum.reduceat(values, starts)


def bands(time: np.ndarray, values: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Decimate a curve (T,) to the start of each bin and its smallest, mean and largest value."""
    size = -(-len(values) // bins)
    starts = np.arange(0, len(values), size)
    counts = np.diff(np.append(starts, len(values)))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    return time[starts], low, np.add.reduceat(values, starts) / counts, high


def command_handles(commands: tuple[str, ...], width: float = 2.0) -> list[Line2D]:
    """Legend entries, one per behavior that is the highest in some command."""
    heads = list(dict.fromkeys(command.split(SEPARATOR)[0] for command in commands))
    return [Line2D([], [], color=command_color(head), linewidth=width, label=head) for head in heads]


def panel_label(axes: Axes, text: str) -> None:
    """Add a title at the panel's left edge."""
    axes.set_title(text, loc="left")
