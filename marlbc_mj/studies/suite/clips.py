"""Videos of selected layouts: the worst and the median layout of every method in a track."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from marlbc_mj.controllers import CONTROLLERS, make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.log import from_trajectory
from marlbc_mj.recording.video import VideoStyle, render_video
from marlbc_mj.results.layout_runs import Method, MissionRuns
from marlbc_mj.results.standings import Notable, notable_layouts
from marlbc_mj.scenarios import Scenario
from marlbc_mj.studies.suite.definition import missions_of
from marlbc_mj.studies.suite.entries import Entrant
from marlbc_mj.studies.suite.flights import under
from marlbc_mj.supervisors import SUPERVISORS, make_supervisor
from marlbc_mj.util.errors import MarlbcError
from marlbc_mj.util.progress import Progress, silent

CLIP_STYLE = VideoStyle(speed=8.0, size=(640, 360))


def render_clips(
    groups: Sequence[MissionRuns], flown: Mapping[Method, Entrant], folder: Path, progress: Progress = silent
) -> list[str]:
    """Fly the worst and the median layout of every method again and render them; returns a line per clip that failed.

    Args:
        groups: all results.
        flown: entrants of the methods that this study flies; the only way to make those from a user's files.
        folder: folder of the page; clips are written into its subfolder ``clips``.
        progress: called with the number of clips done and the total.
    """
    problems, chosen = [], notable_layouts(groups)
    for done, one in enumerate(chosen):
        progress("clips", done, len(chosen))
        try:
            _render(one, flown.get(one.method) or _registered(one.method), folder)
        except MarlbcError as error:
            problems.append(f"no clip of {one.method.key} on {one.mission}: {error}")
    progress("clips", len(chosen), len(chosen))
    return list(dict.fromkeys(problems))


def _registered(method: Method) -> Entrant | None:
    """The entrant of a method with names of this package; None for other methods."""
    known = method.supervisor in SUPERVISORS and method.controller in CONTROLLERS
    return Entrant(method.supervisor, method.controller, method) if known else None


def _render(one: Notable, entrant: Entrant | None, folder: Path) -> None:
    """Render one clip; nothing is done if the entrant is unknown."""
    if entrant is None:
        return
    law = make_controller(entrant.controller)
    world = World(_scenario(one), law, record=True, shield=one.method.shield)
    supervisor = make_supervisor(entrant.supervisor, entrant.controller)
    trajectory = run_episode(world, supervisor, seed=one.run.seed, names=one.method[:2])
    render_video(from_trajectory(trajectory, law), folder / one.clip, CLIP_STYLE, overwrite=True)


def _scenario(one: Notable) -> Scenario:
    mission = next(each for each in missions_of(one.track) if each.name == one.mission)
    return under(mission.scenario, one.method.composition)
