"""Figures for a two-column paper: one function a figure, each returning a Matplotlib figure of its final size."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from marlbc_mj.controllers.sorlc import STATE_SIZE, weights
from marlbc_mj.episode import Trajectory
from marlbc_mj.orders import SEPARATOR
from marlbc_mj.palette import command_color
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.arena import trajectories
from marlbc_mj.report.pareto import pareto
from marlbc_mj.report.results import Result

KINDS = ("trajectories", "priorities", "forces", "errors", "weights")
"""Figures of one method; ``weights`` for SORLC only."""
COMPARISONS = ("trajectories", "pareto")
"""Figures of all methods together."""
_LANE = 1.25  # distance of two agents' strips, in strip heights
_SMALLEST_ERROR = 1e-6  # what a logarithmic axis shows of a vanishing error [m or m/s]

_SMALL: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7, "va": "center_baseline", "annotation_clip": False}
"""Text beside a strip."""


def file_stem(kind: str, result: Result | None = None) -> str:
    """Name of a figure's files without suffix; without a result, of the one that compares all methods."""
    return f"{kind}_{result.supervisor}_{result.controller}" if result else f"{kind}_all"


def priorities(trajectory: Trajectory) -> Figure:
    """Each agent's command over time: color and height of the strip are those of its highest behavior."""
    agents, commands = trajectory.scenario.agents, trajectory.scenario.orders.commands
    heads = sorted({c.split(SEPARATOR)[0] for c in commands}, key=_rank(trajectory))
    height = {head: (k + 1) / len(heads) for k, head in enumerate(heads)}
    margins = pl.Margins(left=0.52, right=0.52, top=0.4)
    figure, ((axes,),) = pl.panels(pl.SINGLE, margins.top + margins.bottom + 0.28 * agents, 1, 1, margins)
    step = trajectory.scenario.mission_step
    for i in range(agents):
        base = (agents - 1 - i) * _LANE
        bars: dict[str, list[tuple[float, float]]] = {head: [] for head in heads}
        for start, end, value in pl.runs(trajectory.command[:, i]):
            bars[commands[value].split(SEPARATOR)[0]].append((start * step, (end - start) * step))
        for head, spans in bars.items():
            axes.broken_barh(spans, (base, height[head]), color=command_color(head), linewidth=0.2, snap=False)
        count = int((np.diff(trajectory.command[:, i]) != 0).sum())
        axes.annotate(f"{count}", (1, base + 0.35), xycoords=("axes fraction", "data"), xytext=(4, 0), **_SMALL)
    axes.annotate("switches", (1, agents * _LANE - 0.1), xycoords=("axes fraction", "data"), xytext=(4, 0), **_SMALL)
    axes.set(xlim=(0, trajectory.scenario.duration), ylim=(0, agents * _LANE - 0.25), xlabel="time [s]")
    axes.set_yticks([(agents - 1 - i) * _LANE + 0.35 for i in range(agents)], [f"agent {i + 1}" for i in range(agents)])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    handles = {h.get_label(): h for h in pl.command_handles(commands, 4)}
    pl.legend_above(figure, [handles[head] for head in heads])
    return figure


def _rank(trajectory: Trajectory) -> Callable[[str], int]:
    """Formation first, then column, then whatever else, so that avoidance stands highest."""
    known = trajectory.scenario.formation_names
    return lambda head: known.index(head) if head in known else len(known)


def forces(trajectory: Trajectory) -> Figure:
    """The applied force on both axes, one row an agent, with the limit; decimated to each bin's extremes."""
    agents, limit = trajectory.scenario.agents, trajectory.scenario.force_limit
    margins = pl.Margins(left=0.56, top=0.2)
    figure, panels = pl.panels(pl.DOUBLE, 0.4 + 0.75 * agents, agents, 2, margins, sharex=True, sharey=True)
    for i in range(agents):
        for axis in range(2):
            axes = panels[i, axis]
            axes.plot(*pl.envelope(trajectory.time, trajectory.force[:, i, axis]), color=pl.agent_line(i)["color"], linewidth=0.7)
            for bound in (-limit, limit):
                axes.axhline(bound, color=pl.GREY, linewidth=0.5, linestyle=(0, (4, 2)))
            pl.panel_label(axes, f"agent {i + 1}, $u_{'xy'[axis]}$")
    reach = 1.12 * max(limit, float(np.abs(trajectory.force).max()))
    panels[0, 0].set(xlim=(0, trajectory.scenario.duration), ylim=(-reach, reach))
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    figure.supylabel("force [N] (dashed: limit)", fontsize=8, x=0.05 / pl.DOUBLE)
    return figure


def errors(trajectory: Trajectory) -> Figure:
    """Tracking errors of every agent on logarithmic axes, cut off where they vanish; decimated to each bin's largest."""
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
        ValueError: the controller's state is not SORLC's.
    """
    if not has_weights(trajectory):
        raise ValueError(f"controller {trajectory.controller!r} has no network weights")
    figure, panels = pl.panels(pl.DOUBLE, 2.0, 1, 3, pl.Margins(left=0.46, top=0.42, across=0.55), sharex=True)
    time = np.arange(len(trajectory.controller_state)) * trajectory.scenario.mission_step
    read = weights(trajectory.controller_state)
    named = (("identifier", "f", read.identifier), ("actor", "a", read.actor), ("critic", "c", read.critic))
    for axes, (name, symbol, matrix) in zip(panels[0], named, strict=True):
        norms = np.linalg.norm(matrix, axis=(-2, -1))  # (M, N)
        for i in range(norms.shape[1]):
            axes.plot(*pl.envelope(time, norms[:, i]), **pl.agent_line(i))
        axes.set(xlabel="time [s]", ylabel=rf"$\|\omega_{symbol}\|_F$", xlim=(0, trajectory.scenario.duration))
        axes.set_ylim(0, 1.08 * float(norms.max()) or 1.0)
        pl.panel_label(axes, name)
    pl.legend_above(figure, panels[0, 0].lines)
    return figure


def has_weights(trajectory: Trajectory) -> bool:
    """Whether this controller's state is that of SORLC with networks."""
    name, state = trajectory.controller, trajectory.controller_state
    return name.startswith("sorlc") and name != "sorlc-off" and state.shape[-1] == STATE_SIZE


def write_figures(results: Sequence[Result], folder: Path, progress: Callable[[int, int], None] | None = None) -> list[Path]:
    """Draw every figure and write it as PDF and PNG (300 dpi).

    Args:
        progress: called with the number of figures done and of all of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = list(_jobs(results))
    paths: list[Path] = []
    for done, (stem, draw) in enumerate(jobs, start=1):
        paths += save(draw, folder / stem)
        if progress is not None:
            progress(done, len(jobs))
    return paths


def save(draw: Callable[[], Figure], stem: Path) -> list[Path]:
    """Draw a figure in the common style and write ``stem``.pdf and .png; the same figure gives the same bytes."""
    paths = [stem.with_name(stem.name + suffix) for suffix in (".pdf", ".png")]
    with pl.style():
        figure = draw()
        figure.savefig(paths[0], metadata={"CreationDate": None})
        figure.savefig(paths[1])
    return paths


def _jobs(results: Sequence[Result]) -> Iterable[tuple[str, Callable[[], Figure]]]:
    """File stem and drawing function of every figure that these results allow."""
    ran = [result for result in results if result.trajectory is not None]
    if len(ran) > 1:
        yield file_stem("trajectories"), lambda: trajectories([r.trajectory for r in ran if r.trajectory])
    measured = [result for result in results if result.metrics is not None]
    if len(measured) > 1:
        yield file_stem("pareto"), lambda: pareto(measured)
    for result in ran:
        yield from _method_jobs(result)


def _method_jobs(result: Result) -> Iterable[tuple[str, Callable[[], Figure]]]:
    trajectory = result.trajectory
    assert trajectory is not None
    yield file_stem("trajectories", result), lambda: trajectories([trajectory])
    yield file_stem("priorities", result), lambda: priorities(trajectory)
    yield file_stem("forces", result), lambda: forces(trajectory)
    yield file_stem("errors", result), lambda: errors(trajectory)
    if has_weights(trajectory):
        yield file_stem("weights", result), lambda: weight_norms(trajectory)
