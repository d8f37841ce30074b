"""Studies and their rows: one episode a case, or the reason why there is none."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from marlbc_mj.controllers import Controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Trajectory, run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.scores import team_scores
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors import Scripted
from marlbc_mj.util.errors import ConfigurationError, SimulationError

Progress = Callable[[str, float, float], None]


class Case(NamedTuple):
    """One row to be: what is set, and how to run it."""

    settings: tuple[str, ...]  # one value for each of the study's parameters
    scenario: Scenario
    controller: Controller


class Figures(NamedTuple):
    """One episode in numbers."""

    total: float  # return: sum of rewards over the episode
    switches: tuple[int, ...]  # per agent
    violation_time: float  # time with d <= d_OA, sum over agents [s]
    clearance: float  # least of the team [m]
    effort: float  # integral of |u| dt, sum over agents [N s]
    rms_velocity_error: float  # over all agents and substeps [m/s]
    rms_position_error: float  # over all agents and substeps [m]


class Row(NamedTuple):
    """One case's figures, or why there are none."""

    settings: tuple[str, ...]
    figures: Figures | None
    first_over_this: float | None  # RMS velocity error of the block's first row over this one's
    failure: str = ""


@dataclass(frozen=True)
class Study:
    """A question and the cases that answer it; run under the scripted supervisor.

    Rows with equal values of the first ``block`` parameters form a block, whose first row the others are compared with.
    """

    name: str
    caption: str
    about: str  # what varies and why; no number in it
    parameters: tuple[str, ...]
    cases: Callable[[], Sequence[Case]]
    columns: tuple[str, ...]  # of the printed table, keys of page.COLUMNS; the CSV has all
    block: int = 0
    remark: Callable[[Sequence[Row]], str] | None = None  # a sentence computed from the rows


def run_study(study: Study, progress: Progress | None = None) -> list[Row]:
    """Every case in turn. A setting that is refused and a run that fails are rows with their reason."""
    rows: list[Row] = []
    cases = study.cases()
    first: Row | None = None
    for case in cases:
        figures, failure = _attempt(case)
        if first is None or case.settings[: study.block] != first.settings[: study.block]:
            first = Row(case.settings, figures, None)
        ratio = first.figures.rms_velocity_error / figures.rms_velocity_error if figures and first.figures else None
        rows.append(Row(case.settings, figures, ratio, failure))
        if progress is not None:
            progress(study.name, len(rows), len(cases))
    return rows


def figures_of(trajectory: Trajectory) -> Figures:
    """The figures of one episode."""
    metrics = measure(trajectory)
    scores = team_scores(metrics)
    return Figures(
        total=scores["return"],
        switches=tuple(agent["switches"] for agent in metrics["agents"]),
        violation_time=scores["violation_time_sum"],
        clearance=scores["clearance_min_worst"],
        effort=scores["effort_integral_sum"],
        rms_velocity_error=scores["rms_velocity_error_rms"],
        rms_position_error=scores["rms_position_error_rms"],
    )


def _attempt(case: Case) -> tuple[Figures | None, str]:
    try:
        return figures_of(run_episode(World(case.scenario, case.controller, record=True), Scripted())), ""
    except SimulationError as error:
        return None, "diverged: " + str(error).split(":")[0].removeprefix("world 0, ")
    except ConfigurationError as error:
        return None, f"refused: {error}"
