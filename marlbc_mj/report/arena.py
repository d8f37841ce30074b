"""Figure of the agents' paths through the arena, colored by the active command."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from marlbc_mj.core.motion import moved, nearest_places
from marlbc_mj.core.orders import SEPARATOR
from marlbc_mj.core.safety import violates
from marlbc_mj.episode import Trajectory
from marlbc_mj.report import plotting as pl
from marlbc_mj.util.method_names import source_of
from marlbc_mj.util.palette import command_color
from marlbc_mj.util.stretches import stretches

_MARGIN = (0.16, 0.06)  # horizontal and vertical margin around everything drawn: room for the agents' numbers [in]
_POINT = 0.35  # least drawn radius of an obstacle [m]
_VIOLATION = "#1A1A1A"  # color of the casing around parts of a path in violation


def trajectories(episodes: Sequence[Trajectory]) -> Figure:
    """Draw the paths of all agents: one episode spans both text columns, several are panels of one column, two per row.

    The legend is above the panels. If there are several episodes and their number is odd, it fills the empty last panel.
    """
    columns = 1 if len(episodes) == 1 else 2
    rows = -(-len(episodes) // columns)
    odd = columns == 2 and len(episodes) % 2 == 1
    margins = pl.Margins(left=0.5, right=0.05, top=0.3 if columns == 1 else 0.18 if odd else 0.42, across=0.12, between=0.3)
    panel_width = (pl.DOUBLE - margins.left - margins.right - (columns - 1) * margins.across) / columns
    box = _extent(episodes, panel_width)
    panel_height = panel_width * (box[3] - box[2]) / (box[1] - box[0])
    height = margins.top + margins.bottom + rows * panel_height + (rows - 1) * margins.between
    figure, panels = pl.panels(pl.DOUBLE, height, rows, columns, margins, sharex=True, sharey=True)
    for axes, episode in zip(panels.flat, episodes, strict=False):
        _draw_arena(axes, episode)
        _draw_paths(axes, episode, 1.2 if columns == 1 else 0.8)
        if columns > 1:
            pl.panel_label(axes, label_of(episode, episodes))
    panels[0, 0].set(xlim=box[:2], ylim=box[2:])
    for axes in panels[:, 0]:
        axes.set_ylabel("y [m]")
    for column in range(columns):
        axes = panels[(len(episodes) - 1 - column) // columns, column]
        axes.set_xlabel("x [m]")
        axes.tick_params(labelbottom=True)
    handles = _legend(episodes)
    if odd:
        pl.legend_in(panels.flat[-1], handles)
    else:
        pl.legend_above(figure, handles)
    return figure


def label_of(episode: Trajectory, episodes: Sequence[Trajectory]) -> str:
    """Label that distinguishes an episode from the others in a figure: its supervisor, its controller, or both."""
    names = [source_of(name).display for name in (episode.supervisor, episode.controller)]
    differ = [len({one.supervisor for one in episodes}) > 1, len({one.controller for one in episodes}) > 1]
    return ", ".join(name for name, kept in zip(names, differ, strict=True) if kept) or ", ".join(names)


def _extent(episodes: Sequence[Trajectory], width: float) -> tuple[float, float, float, float]:
    """x and y limits [m] that contain every path and every safe-distance ring, for a panel ``width`` [in] wide."""
    points = np.concatenate([e.position.reshape(-1, 2) for e in episodes])
    rings = np.concatenate([_discs(e) for e in episodes])
    reach = rings[:, 2:] + episodes[0].scenario.safe_distance
    low = np.concatenate([points, rings[:, :2] - reach]).min(axis=0)
    high = np.concatenate([points, rings[:, :2] + reach]).max(axis=0)
    margin = np.array(_MARGIN) * (high[0] - low[0]) / width
    low, high = low - margin, high + margin
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _discs(episode: Trajectory) -> np.ndarray:
    """Obstacles to draw (K, 3); a moving one is placed where it comes nearest to an agent."""
    every = episode.scenario.substeps
    return nearest_places(episode.time[::every], episode.position[:-1:every], episode.obstacles, episode.motions)


def _draw_arena(axes: Axes, episode: Trajectory) -> None:
    if len(episode.motions):
        tracks = moved(episode.time[:: episode.scenario.substeps], episode.obstacles, episode.motions)
        axes.add_collection(LineCollection(list(tracks[..., :2].swapaxes(0, 1)), colors=pl.GREY, linewidths=0.5, zorder=0.5))
    for x, y, radius in _discs(episode):
        ring = radius + episode.scenario.safe_distance
        axes.add_patch(Circle((x, y), ring, fill=False, edgecolor=pl.GREY, linewidth=0.5, linestyle=(0, (3, 2))))
        axes.add_patch(Circle((x, y), max(radius, _POINT), facecolor="#D4D4D4", edgecolor=pl.GREY, linewidth=0.5))
    axes.set_aspect("equal")


def _draw_paths(axes: Axes, episode: Trajectory, width: float) -> None:
    commands, every = episode.scenario.orders.commands, episode.scenario.substeps
    points = episode.position[::every]  # (M + 1, N, 2)
    for i in range(points.shape[1]):
        _draw_violation(axes, episode, i, 2.4 * width)
        bands = list(stretches(episode.command[:, i]))
        axes.add_collection(
            LineCollection(
                [points[start : end + 1, i] for start, end, _ in bands],
                colors=[command_color(commands[value]) for _, _, value in bands],
                linewidths=width,
                capstyle="round",
            )
        )
        axes.plot(*points[0, i], "o", color="white", markeredgecolor="#1A1A1A", markeredgewidth=0.5, markersize=2.4, zorder=4)
        for at, offset, side in ((0, -5, "right"), (-1, 3, "left")):
            axes.annotate(f"{i + 1}", points[at, i], (offset, 0), textcoords="offset points", fontsize=7, ha=side, va="center")


def _draw_violation(axes: Axes, episode: Trajectory, agent: int, width: float) -> None:
    """Draw a dark casing around the parts of a path that violate the safe distance."""
    path = episode.position[1:, agent]
    violated = violates(episode.clearances()[:, agent], episode.scenario.safe_distance)
    every = max(1, episode.scenario.substeps // 2)
    bands = [path[start : end + every : every] for start, end, value in stretches(violated.astype(int)) if value]
    axes.add_collection(LineCollection(bands, colors=_VIOLATION, linewidths=width, zorder=1.5))


def _legend(episodes: Sequence[Trajectory]) -> list[Line2D]:
    """Legend entries for the colors and lines."""
    handles = pl.command_handles(episodes[0].scenario.orders.commands)
    commands = {c for e in episodes for c in e.scenario.orders.commands if SEPARATOR in c}
    for handle in handles:
        if any(c.startswith(str(handle.get_label()) + SEPARATOR) for c in commands):
            handle.set_label(f"{handle.get_label()} on top")
    distance = episodes[0].scenario.safe_distance
    handles.append(Line2D([], [], color=pl.GREY, linewidth=0.5, linestyle=(0, (3, 2)), label=f"safe distance {distance:g} m"))
    if any(len(e.motions) for e in episodes):
        handles.append(Line2D([], [], color=pl.GREY, linewidth=0.5, label="path of an obstacle (disc: at its closest approach)"))
    if any(violates(e.clearances(), distance).any() for e in episodes):
        handles.append(Line2D([], [], color=_VIOLATION, linewidth=2.6, label="inside the safe distance"))
    return handles
