"""The figures of a run, with the paper's numbers where it has them, and the functions that write them."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from marlbc_mj.episode import Trajectory
from marlbc_mj.report import paper_values
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.arena import trajectories
from marlbc_mj.report.curves import (
    control,
    errors,
    flat_after,
    forces,
    has_weights,
    priorities,
    weight_errors,
    weight_norms,
)
from marlbc_mj.report.paper_tables import one_per_controller, one_per_supervisor
from marlbc_mj.report.pareto import pareto
from marlbc_mj.results.summary import Result
from marlbc_mj.util.method_names import source_of

FRAMEWORKS = ("sorlc", "finite-time", "fixed-time")
"""Controllers of the frameworks in Figures 8 and 9."""
_AGENT = 3  # index of the agent in Figure 9

_PATHS = "colored by the highest behavior in force; casing: inside the safe distance."
_STRIPS = (
    "color and height of a strip show the highest behavior in force (OA: avoid the obstacle, FM: keep the formation, FR: form "
    "the column); beside it the number of switches. Grey: the team's switches in each second, with their maximum."
)
_FORCES = (
    "Applied force. Left and middle: light, everything the force reaches within a pixel column; dark, its mean. "
    "Right: both axes in the two seconds in which the forces change most."
)
_PARETO = (
    "Control cost against what it achieves. Colors are supervisors, shapes are controllers. A mark that would cover another "
    "is shifted, and a line leads to a dot at its true place. Formation error: mean distance of an agent from its slot in "
    "the first formation, relative to the centroid."
)
_FLOOR = " Dashed: LQR, whose gains minimize this cost in regulation."
_CONTROL = (
    "with each framework's controller; bottom row: around the largest of all forces. One scale: linear up to SORLC's limit "
    "(dashed), logarithmic beyond."
)


class Plot(NamedTuple):
    """One figure: file name without suffix, caption, drawing function, and the method that it belongs to, if any."""

    stem: str
    caption: str
    draw: Callable[[], Figure]
    method: str | None = None
    narrow: bool = False  # whether it fills only one text column


def plots(results: Sequence[Result]) -> list[Plot]:
    """All figures that these results allow: the paper's figures, the comparison, then the figures of each method.

    Captions have the paper's figure numbers only on the paper's own scenario. Paths and priorities are drawn once per
    supervisor, with SORLC if it ran. Tracking errors and forces are drawn for every method, and weights if they still change
    in the second half of the episode.
    """
    ran = [result for result in results if result.metrics is not None]
    found = _paper(ran) + _comparison(ran) + _methods(ran)
    of_paper = all(r.trajectory is None or r.trajectory.scenario.name == paper_values.SCENARIO for r in ran)
    return found if of_paper else [plot._replace(caption=_without_number(plot.caption)) for plot in found]


def _without_number(caption: str) -> str:
    """A caption without the paper's figure number."""
    text = re.sub(r"^Figure \d+: ", "", caption)
    return text[:1].upper() + text[1:]


def _paper(results: Sequence[Result]) -> list[Plot]:
    """Figures 2 to 9. A figure of one method needs that method's run; a comparison shows the methods that ran."""
    supervisors = [r.trajectory for r in one_per_supervisor(results).values() if r.trajectory]
    under, supervisor = one_per_controller(results)
    laws = {name: r.trajectory for name, r in under.items() if r.trajectory}
    return _supervisor_figures(supervisors) + _controller_figures(laws, supervisor) + _framework_figures(laws)


def _supervisor_figures(episodes: Sequence[Trajectory]) -> list[Plot]:
    """Figures 2 and 3, if at least two supervisors ran."""
    if len(episodes) < 2:
        return []
    paths = f"Figure 2: paths under each supervisor, {_PATHS}"
    strips = f"Figure 3: behavior priorities of each supervisor; {_STRIPS}"
    return [
        Plot("figure2_trajectories_supervisors", paths, partial(trajectories, episodes)),
        Plot("figure3_priorities_supervisors", strips, partial(priorities, episodes)),
    ]


def _controller_figures(laws: Mapping[str, Trajectory], supervisor: str) -> list[Plot]:
    """Figures 4 to 7: weights of SORLC, tracking errors of SORLC and RLC."""
    found = []
    if "sorlc" in laws:
        own = laws["sorlc"]
        found.append(Plot("figure4_weights_sorlc", f"Figure 4: {weights_caption(own)}", partial(weight_norms, own)))
        text = (
            "Figure 5: distance of SORLC's weights from their values at the end (Frobenius norm), in place of ideal weights, "
            "which are unknown."
        )
        found.append(Plot("figure5_weight_errors_sorlc", text, partial(weight_errors, own)))
    for number, name in ((6, "sorlc"), (7, "rlc")):
        if name in laws:
            law, over = source_of(name).display, source_of(supervisor).display
            text = f"Figure {number}: tracking errors of {law}, supervisor: {over}. Each pixel column shows its largest error."
            found.append(Plot(f"figure{number}_tracking_{name}", text, partial(errors, laws[name]), narrow=True))
    return found


def _framework_figures(laws: Mapping[str, Trajectory]) -> list[Plot]:
    """Figures 8 and 9, if at least two frameworks ran."""
    three = [laws[name] for name in FRAMEWORKS if name in laws]
    if len(three) < 2:
        return []
    agent = min(_AGENT, three[0].scenario.agents - 1)
    paths = f"Figure 8: paths with each framework's controller, {_PATHS}"
    pulses = f"Figure 9: force of agent {agent + 1} {_CONTROL}"
    return [
        Plot("figure8_trajectories_frameworks", paths, partial(trajectories, three)),
        Plot(f"figure9_control_agent{agent + 1}_frameworks", pulses, partial(control, three, agent)),
    ]


def _comparison(results: Sequence[Result]) -> list[Plot]:
    if len(results) < 2:
        return []
    floor = _FLOOR if any(result.controller == "lqr" and result.metrics is not None for result in results) else ""
    return [Plot("pareto_all", _PARETO + floor, lambda: pareto(results))]


def _methods(results: Sequence[Result]) -> list[Plot]:
    shown = {result.key for result in one_per_supervisor(results).values()}
    found = []
    for result in results:
        if result.trajectory is not None:
            found += _method(result, result.trajectory, result.key in shown)
    return found


def _method(result: Result, trajectory: Trajectory, supervisor: bool) -> list[Plot]:
    def own(kind: str, caption: str, draw: Callable[[], Figure], narrow: bool = False) -> Plot:
        return Plot(f"{kind}_{result.key.replace('+', '_')}", caption, draw, result.key, narrow)

    found = []
    if supervisor:
        found.append(own("priorities", f"Behavior priorities; {_STRIPS}", lambda: priorities([trajectory]), narrow=True))
    found.append(own("errors", "Tracking errors; each pixel column shows its largest.", lambda: errors(trajectory), narrow=True))
    if supervisor:
        found.append(own("trajectories", f"Paths, {_PATHS}", lambda: trajectories([trajectory])))
    found.append(own("forces", _FORCES, lambda: forces(trajectory)))
    if has_weights(trajectory) and flat_after(trajectory) >= 0.5 * trajectory.scenario.duration:
        found.append(own("weights", weights_caption(trajectory), lambda: weight_norms(trajectory)))
    return found


def weights_caption(trajectory: Trajectory) -> str:
    """Caption of a figure of weights; it states when they stop changing, if that is in the first half of the episode."""
    text, flat = "Frobenius norms of the network weights.", flat_after(trajectory)
    if flat >= 0.5 * trajectory.scenario.duration:
        return text
    return (
        f"{text} From {flat:.1f} s on actor and critic do not change: the agents have left the range of the basis, and the "
        "identifier only decays (erratum 13)."
    )


def write_figures(results: Sequence[Result], folder: Path, progress: Callable[[int, int], None] | None = None) -> list[Path]:
    """Draw every figure and write it as PDF and PNG (300 dpi).

    Args:
        progress: called with the number of figures done and the total number.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = plots(results)
    paths: list[Path] = []
    for done, plot in enumerate(jobs, start=1):
        paths += save_figure(plot.draw, folder / plot.stem)
        if progress is not None:
            progress(done, len(jobs))
    return paths


def save_figure(draw: Callable[[], Figure], stem: Path) -> list[Path]:
    """Draw a figure in the common style and write ``stem``.pdf and ``stem``.png; equal figures give identical files."""
    paths = [stem.with_name(stem.name + suffix) for suffix in (".pdf", ".png")]
    with pl.style():
        figure = draw()
        figure.savefig(paths[0], metadata={"CreationDate": None})
        figure.savefig(paths[1])
    return paths
