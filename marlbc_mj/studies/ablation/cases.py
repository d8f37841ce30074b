"""Questions and their rows: one episode per case, or the reason why there is none."""

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


class Case(NamedTuple):
    """A row of the table before it is measured: its settings, and how to run it."""

    settings: tuple[str, ...]  # one value for each of the question's parameters
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


class AblationRow(NamedTuple):
    """One case's figures, or why there are none."""

    settings: tuple[str, ...]
    figures: Figures | None
    first_over_this: float | None  # RMS velocity error of the block's first row over this one's
    failure: str = ""


@dataclass(frozen=True)
class Question:
    """A question about one choice, and the cases that answer it, run under the scripted supervisor.

    Rows with equal values of the first ``block`` parameters form a block, whose first row the others are compared with.
    """

    name: str
    caption: str
    about: str  # what varies and why; no number in it
    parameters: tuple[str, ...]
    cases: Callable[[], Sequence[Case]]
    columns: tuple[str, ...]  # of the table, keys of page.ABLATION_COLUMNS; the CSV has all
    block: int = 0
    remark: Callable[[Sequence[AblationRow]], str] | None = None  # a sentence computed from the rows


class Measured(NamedTuple):
    """The result of a case: figures, or the reason why there are none."""

    figures: Figures | None
    failure: str = ""


def measure_case(case: Case) -> Measured:
    """One episode. A setting that is refused and a run that fails have their reason in place of figures."""
    try:
        return Measured(figures_of(run_episode(World(case.scenario, case.controller, record=True), Scripted())))
    except SimulationError as error:
        return Measured(None, "diverged: " + str(error).split(":")[0].removeprefix("world 0, "))
    except ConfigurationError as error:
        return Measured(None, f"refused: {error}")


def compare_rows(question: Question, measured: Sequence[Measured]) -> list[AblationRow]:
    """The question's rows, in the order of its cases, each compared with the first of its block."""
    rows: list[AblationRow] = []
    first: AblationRow | None = None
    for case, (figures, failure) in zip(question.cases(), measured, strict=True):
        if first is None or case.settings[: question.block] != first.settings[: question.block]:
            first = AblationRow(case.settings, figures, None)
        ratio = first.figures.rms_velocity_error / figures.rms_velocity_error if figures and first.figures else None
        rows.append(AblationRow(case.settings, figures, ratio, failure))
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
