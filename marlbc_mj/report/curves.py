"""Curves over time: priorities, forces, tracking errors and network weights; decimation keeps every peak."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from marlbc_mj.controllers.sorlc import STATE, Weights, weights
from marlbc_mj.core.orders import SEPARATOR
from marlbc_mj.episode import Trajectory
from marlbc_mj.report import plotting as pl
from marlbc_mj.util.method_names import source_of
from marlbc_mj.util.palette import METHOD_COLORS, command_color
from marlbc_mj.util.stretches import stretches

_LANE = 1.25  # distance between the strips of two agents, in strip heights
_SMALLEST_ERROR = 1e-6  # least lower limit of a logarithmic error axis [m or m/s]
_ZOOM = 2.0  # width of the window that shows single force pulses [s]
_PULSE = 1.0  # width of the window around the largest force [s]
_AXIS_COLORS = METHOD_COLORS[:2]  # colors of the x and y components in a figure of a single agent
_FLAT = 1e-9  # relative change below which a weight counts as constant
_SMALLEST_NORM = 1e-6  # norms below this share of the largest are not drawn on a logarithmic axis

_SMALL: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7, "va": "center_baseline", "annotation_clip": False}
"""Options of a small text beside a strip or an axis."""


def priorities(episodes: Sequence[Trajectory]) -> Figure:
    """Draw each agent's command over time: the color and height of a strip show the highest-priority behavior.

    A grey strip below the agents shows the team's switches in each second. One episode fills one text column; several are
    panels, two per row, whose grey strips share one scale. The legend is above the panels. If there are several episodes and
    their number is odd, it fills the empty last panel.
    """
    columns = 1 if len(episodes) == 1 else 2
    rows = -(-len(episodes) // columns)
    odd = columns == 2 and len(episodes) % 2 == 1
    margins = pl.Margins(left=0.52, right=0.52, top=0.4 if columns == 1 else 0.24 if odd else 0.46, across=0.98, between=0.3)
    width = pl.SINGLE if columns == 1 else pl.DOUBLE
    lanes = episodes[0].scenario.agents + 1
    each = 0.28 * lanes if columns == 1 else 0.17 * lanes
    most = max(1, *(int(switch_rate(episode).max()) for episode in episodes))
    height = margins.top + margins.bottom + rows * each + (rows - 1) * margins.between
    figure, panels = pl.panels(width, height, rows, columns, margins, sharex=True)
    for axes, episode in zip(panels.flat, episodes, strict=False):
        _draw_priorities(axes, episode)
        _draw_switch_rate(axes, episode, most)
        if columns > 1:
            pl.panel_label(axes, source_of(episode.supervisor).display)
    _label_time(panels, len(episodes))
    handles = {h.get_label(): h for h in pl.command_handles(episodes[0].scenario.orders.commands, 4)}
    shown = [handles[head] for head in _heads(episodes[0])]
    shown.append(Line2D([], [], color=pl.GREY, linewidth=4, label=f"the team's switches per second (full height: {most})"))
    if odd:
        pl.legend_in(panels.flat[-1], shown)
    else:
        pl.legend_above(figure, shown)
    return figure


def switch_rate(trajectory: Trajectory) -> np.ndarray:
    """Number of switches of all agents in each second of the episode (S,)."""
    step, agents = trajectory.scenario.mission_step, trajectory.scenario.agents
    at = (1 + np.flatnonzero(np.diff(trajectory.command, axis=0).ravel()) // agents) * step
    return np.bincount(at.astype(int), minlength=int(np.ceil(trajectory.scenario.duration)))


def _draw_switch_rate(axes: Axes, trajectory: Trajectory, most: int) -> None:
    """Draw one bar per second below the lowest agent's strip."""
    rate = switch_rate(trajectory)
    axes.bar(np.arange(len(rate)), rate / most, width=1.0, bottom=-_LANE, align="edge", color=pl.GREY, linewidth=0)
    axes.annotate(f"{rate.max()}/s", (1, -_LANE + 0.35), xycoords=("axes fraction", "data"), xytext=(4, 0), **_SMALL)


def _label_time(panels: np.ndarray, used: int) -> None:
    """Label the time axis of the lowest panel in every column; only the first ``used`` panels count."""
    for column in range(panels.shape[1]):
        axes = panels[(used - 1 - column) // panels.shape[1], column]
        axes.set_xlabel("time [s]")
        axes.tick_params(labelbottom=True)


def _heads(trajectory: Trajectory) -> list[str]:
    return sorted({c.split(SEPARATOR)[0] for c in trajectory.scenario.orders.commands}, key=_rank(trajectory))


def _draw_priorities(axes: Axes, trajectory: Trajectory) -> None:
    agents, commands = trajectory.scenario.agents, trajectory.scenario.orders.commands
    heads = _heads(trajectory)
    height = {head: (k + 1) / len(heads) for k, head in enumerate(heads)}
    step = trajectory.scenario.mission_step
    for i in range(agents):
        base = (agents - 1 - i) * _LANE
        bars: dict[str, list[tuple[float, float]]] = {head: [] for head in heads}
        for start, end, value in stretches(trajectory.command[:, i]):
            bars[commands[value].split(SEPARATOR)[0]].append((start * step, (end - start) * step))
        for head, spans in bars.items():
            axes.broken_barh(spans, (base, height[head]), color=command_color(head), linewidth=0.2, snap=False)
        count = int((np.diff(trajectory.command[:, i]) != 0).sum())
        axes.annotate(f"{count}", (1, base + 0.35), xycoords=("axes fraction", "data"), xytext=(4, 0), **_SMALL)
    axes.annotate("switches", (1, agents * _LANE - 0.1), xycoords=("axes fraction", "data"), xytext=(4, 0), **_SMALL)
    axes.set(xlim=(0, trajectory.scenario.duration), ylim=(-_LANE, agents * _LANE - 0.25))
    rows = [f"agent {i + 1}" for i in range(agents)]
    axes.set_yticks([(agents - 1 - i) * _LANE + 0.35 for i in range(agents + 1)], [*rows, "rate"])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def _rank(trajectory: Trajectory) -> Callable[[str], int]:
    """Sort key for the strip heights: formation is lowest, then column, then the others, so that avoidance is highest."""
    known = trajectory.scenario.formation_names
    return lambda head: known.index(head) if head in known else len(known)


def forces(trajectory: Trajectory) -> Figure:
    """Draw the applied force, one row per agent: x and y over the episode, and both in the two seconds of largest variation.

    Over the episode, light bands cover every sample and dark lines are the means of up to 500 bins, so that the mean of a
    chattering force is visible. The limit is dashed.
    """
    agents, limits = trajectory.scenario.agents, trajectory.scenario.force_limits
    margins = pl.Margins(left=0.56, top=0.24, bottom=0.36)
    figure, panels = pl.panels(pl.DOUBLE, 0.4 + 0.75 * agents, agents, 3, margins, sharex="col", sharey=True)
    window = busiest(trajectory)
    for i in range(agents):
        color = pl.agent_line(i)["color"]
        for axis in range(2):
            axes = panels[i, axis]
            time, low, mean, high = pl.bands(trajectory.time, trajectory.force[:, i, axis])
            axes.fill_between(time, low, high, color=color, alpha=0.3, linewidth=0.4)
            axes.plot(time, mean, color=color, linewidth=0.8)
            pl.panel_label(axes, f"agent {i + 1}, $u_{'xy'[axis]}$")
            style = {"linestyle": ("-", (0, (2.5, 1)))[axis], "label": f"$u_{'xy'[axis]}$"}
            panels[i, 2].plot(trajectory.time[window], trajectory.force[window, i, axis], color=color, linewidth=0.7, **style)
        pl.panel_label(panels[i, 2], f"agent {i + 1}, {_ZOOM:g} s")
        for axes in panels[i]:
            for bound in (-limits[i], limits[i]):
                axes.axhline(bound, color=pl.GREY, linewidth=0.5, linestyle=(0, (4, 2)))
    reach = 1.12 * max(float(limits.max()), float(np.abs(trajectory.force).max()))
    panels[0, 0].set(ylim=(-reach, reach))
    whole, part = (0.0, trajectory.scenario.duration), (trajectory.time[window][0], trajectory.time[window][-1])
    for axes, shown in zip(panels[-1], (whole, whole, part), strict=True):
        axes.set(xlabel="time [s]", xlim=shown)
    panels[0, 2].legend(loc="lower right", bbox_to_anchor=(1.0, 0.93), ncols=2, borderpad=0.0, columnspacing=1.0)
    figure.supylabel("force [N] (dashed: limit)", fontsize=8, x=0.05 / pl.DOUBLE)
    return figure


def busiest(trajectory: Trajectory) -> slice:
    """The window of two seconds in which the total variation of all agents' forces is largest."""
    size = min(len(trajectory.time), max(2, round(_ZOOM / trajectory.scenario.substep)))
    change = np.abs(np.diff(trajectory.force, axis=0)).sum(axis=(1, 2))
    total = np.concatenate([[0.0], np.cumsum(change)])
    start = int((total[size - 1 :] - total[: len(total) - size + 1]).argmax())
    start = max(0, start - size // 20)  # a little earlier, so that the first edge is visible
    return slice(start, start + size)


def control(episodes: Sequence[Trajectory], agent: int) -> Figure:
    """Draw one agent's force, one column per framework: over the episode, and around the largest force of all frameworks.

    All panels share one scale. It is linear up to the limit and logarithmic beyond, so that forces within the limit and far
    above it are both visible.
    """
    limit = float(episodes[0].scenario.force_limits[agent])
    margins = pl.Margins(left=0.56, right=0.42, top=0.42, across=0.24, between=0.42)
    figure, panels = pl.panels(pl.DOUBLE, 3.4, 2, len(episodes), margins, sharex="row", sharey=True)
    wildest = max(episodes, key=lambda episode: float(np.abs(episode.force[:, agent]).max()))
    largest = np.abs(wildest.force[:, agent]).max(axis=1)
    peak = wildest.time[largest.argmax()]
    for column, episode in enumerate(episodes):
        name = source_of(episode.controller).display
        everything = episode.time >= 0.0
        window = (episode.time >= peak - 0.2 * _PULSE) & (episode.time <= peak + 0.8 * _PULSE)
        for row, (shown, suffix) in enumerate(((everything, ""), (window, f", {_PULSE:g} s"))):
            _draw_both_axes(panels[row, column], episode, agent, shown)
            pl.panel_label(panels[row, column], name + suffix)
    reach = 1.5 * max(limit, float(largest.max()))
    panels[0, 0].set_yscale("symlog", linthresh=limit, linscale=1.5)
    panels[0, 0].set(ylim=(-reach, reach), yticks=_force_ticks(limit, reach))
    panels[0, 0].yaxis.set_major_formatter("{x:g}")
    for axes in panels[:, -1]:
        axes.annotate(f"limit\n{limit:g} N", (1.0, limit), (3, 0), xycoords=("axes fraction", "data"), **_SMALL)
    for axes in panels[:, 0]:
        axes.set_ylabel("force [N]")
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    pl.legend_above(figure, panels[-1, 0].lines[:2])
    return figure


def _force_ticks(limit: float, reach: float) -> list[float]:
    """Tick positions: 0, and the limit times powers of ten up to ``reach``, with both signs."""
    sizes = [limit * 10.0**k for k in range(1 + int(np.log10(reach / limit)))]
    return [-size for size in reversed(sizes)] + [0.0, *sizes]


def _draw_both_axes(axes: Axes, episode: Trajectory, agent: int, shown: np.ndarray) -> None:
    """Draw both components of the force at the samples that ``shown`` (T,) selects, and the limit."""
    time, force = episode.time[shown], episode.force[shown, agent]
    for axis in range(2):
        axes.plot(*pl.envelope(time, force[:, axis]), color=_AXIS_COLORS[axis], linewidth=0.8, label=f"$u_{'xy'[axis]}$")
    limit = episode.scenario.force_limits[agent]
    for bound in (-limit, limit):
        axes.axhline(bound, color=pl.GREY, linewidth=0.5, linestyle=(0, (4, 2)))
    axes.set_xlim(time[0], time[-1] + episode.scenario.substep)


def errors(trajectory: Trajectory) -> Figure:
    """Draw every agent's tracking errors, each bin's largest value, on logarithmic axes that cut off vanishing errors."""
    figure, panels = pl.panels(pl.SINGLE, 3.1, 2, 1, pl.Margins(left=0.56, between=0.12), sharex=True)
    pairs = (
        (trajectory.position[:-1] - trajectory.reference, r"$\|e_p\|$ [m]"),
        (trajectory.velocity[:-1] - trajectory.reference_velocity, r"$\|e_v\|$ [m/s]"),
    )
    for axes, (error, label) in zip(panels[:, 0], pairs, strict=True):
        size = np.maximum(np.linalg.norm(error, axis=-1), 1e-300)  # (T, N)
        for i in range(size.shape[1]):
            axes.plot(*pl.bin_maxima(trajectory.time, size[:, i]), **pl.agent_line(i))
        axes.set(yscale="log", ylabel=label, xlim=(0, trajectory.scenario.duration))
        axes.set_ylim(max(_SMALLEST_ERROR, 0.5 * float(size[1:].min())), 2 * max(float(size.max()), 10 * _SMALLEST_ERROR))
        axes.grid(axis="y", color="#E4E4E4", linewidth=0.4)
    panels[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels(panels)
    pl.legend_above(figure, panels[0, 0].lines[:4], columnspacing=1.0)
    return figure


def weight_norms(trajectory: Trajectory) -> Figure:
    """Frobenius norms of SORLC's weight matrices over time.

    Raises:
        ValueError: the controller is not SORLC with networks.
    """
    return _weight_figure(trajectory, lambda matrix: matrix, r"$\|\omega_{}\|_F$")


def weight_errors(trajectory: Trajectory) -> Figure:
    """Frobenius norms of the differences between SORLC's weights and their final values.

    The publication subtracts the ideal weights instead, which are unknown.

    Raises:
        ValueError: the controller is not SORLC with networks.
    """
    return _weight_figure(trajectory, lambda matrix: matrix - matrix[-1], r"$\|\omega_{0} - \omega_{0}(T)\|_F$")


def _weight_figure(trajectory: Trajectory, change: Callable[[np.ndarray], np.ndarray], label: str) -> Figure:
    read = network_weights(trajectory)
    figure, panels = pl.panels(pl.DOUBLE, 2.0, 1, 3, pl.Margins(left=0.6, top=0.42, across=0.66))
    time = np.arange(len(trajectory.controller_state)) * trajectory.scenario.mission_step
    named = (("identifier", "f", read.identifier), ("actor", "a", read.actor), ("critic", "c", read.critic))
    for axes, (name, symbol, matrix) in zip(panels[0], named, strict=True):
        norms = np.maximum(np.linalg.norm(change(matrix), axis=(-2, -1)), 1e-300)  # (M, N)
        for i in range(norms.shape[1]):
            axes.plot(*pl.envelope(time, norms[:, i]), **pl.agent_line(i))
        axes.set(xlabel="time [s]", ylabel=label.replace("{0}", symbol).replace("{}", symbol))
        _scale_norms(axes, time, norms)
        pl.panel_label(axes, name)
    pl.legend_above(figure, panels[0, 0].lines)
    return figure


def _scale_norms(axes: Axes, time: np.ndarray, norms: np.ndarray) -> None:
    """Limit the axes to the part of the episode in which the norms change; use a log scale if they span decades."""
    last = norms[-1] if norms[-1].max() > 1e-12 * norms.max() else np.zeros_like(norms[-1])
    moving = np.flatnonzero((np.abs(norms - last) > 1e-3 * np.abs(norms - last).max()).any(axis=1))
    end = time[min(len(time) - 1, int(1.1 * moving[-1]) + 1)] if len(moving) else time[-1]
    axes.set_xlim(0, end)
    positive = norms[(time <= end)[:, np.newaxis] & (norms > _SMALLEST_NORM * norms.max())]
    low, high = float(positive.min()), float(norms.max())
    if high > 30.0 * low:
        axes.set(yscale="log", ylim=(0.7 * low, 1.5 * high))
        _name_hidden(axes, norms[time <= end].max(axis=0) < 0.7 * low, 0.7 * low)
    else:
        room = 0.08 * (high - low) or 0.1 * high
        axes.set_ylim(low - room, high + room)


def _name_hidden(axes: Axes, hidden: np.ndarray, least: float) -> None:
    """Name the agents that are below the axis throughout; ``hidden`` is (N,) bool."""
    agents = [str(i + 1) for i in np.flatnonzero(hidden)]
    if agents:
        text = f"{'agents' if len(agents) > 1 else 'agent'} {', '.join(agents)}: < {least:.0e}"
        axes.annotate(text, (0.02, 0.02), xycoords="axes fraction", fontsize=7, color=pl.GREY)


def network_weights(trajectory: Trajectory) -> Weights:
    """SORLC's weight matrices (M, N, 12, 2) at the start of every mission step.

    Raises:
        ValueError: the controller is not SORLC with networks.
    """
    if not has_weights(trajectory):
        raise ValueError(f"controller {trajectory.controller!r} has no network weights")
    return weights(trajectory.controller_state)


def has_weights(trajectory: Trajectory) -> bool:
    """Whether the controller is SORLC with networks, so that its state contains their weights."""
    name, state = trajectory.controller, trajectory.controller_state
    return name.startswith("sorlc") and name != "sorlc-off" and state.shape[-1] == STATE.size


def flat_after(trajectory: Trajectory) -> float:
    """Time after which the actor and critic weights are constant up to rounding [s]; about the duration if they never settle."""
    read, last = network_weights(trajectory), 0
    for matrix in (read.actor, read.critic):
        norms = np.linalg.norm(matrix, axis=(-2, -1))
        moving = np.abs(norms - norms[-1]) > _FLAT * np.abs(norms).max()
        if moving.any():
            last = max(last, int(np.flatnonzero(moving.any(axis=1))[-1]) + 1)
    return last * trajectory.scenario.mission_step
