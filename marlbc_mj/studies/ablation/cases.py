"""Ablation questions and their table rows: the figures of one episode per case, or the reason why there are none."""

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
    """One episode to run: the settings shown in its table row, its scenario and its controller."""

    settings: tuple[str, ...]  # one value for each of the question's parameters
    scenario: Scenario
    controller: Controller


class Figures(NamedTuple):
    """The measured figures of one episode."""

    total: float  # return: sum of rewards over the episode
    switches: tuple[int, ...]  # per agent
    violation_time: float  # time with d <= d_OA, sum over agents [s]
    clearance: float  # least over agents and substeps [m]
    effort: float  # integral of |u| dt, sum over agents [N s]
    rms_velocity_error: float  # over all agents and substeps [m/s]
    rms_position_error: float  # over all agents and substeps [m]


class AblationRow(NamedTuple):
    """A table row: the figures of one case, or the reason why there are none."""

    settings: tuple[str, ...]
    figures: Figures | None
    first_over_this: float | None  # RMS velocity error of the block's first row, divided by this row's
    failure: str = ""


@dataclass(frozen=True)
class Question:
    """A question about one choice, and the cases that answer it, run under the scripted supervisor.

    Rows with equal values of the first ``block`` parameters form a block. Each row is compared with the first row of its block.
    """

    name: str
    caption: str
    about: str  # what varies and why, without measured numbers
    parameters: tuple[str, ...]
    cases: Callable[[], Sequence[Case]]
    columns: tuple[str, ...]  # of the table: ``ratio`` and keys of page.ABLATION_COLUMNS; the CSV has all
    block: int = 0
    remark: Callable[[Sequence[AblationRow]], str] | None = None  # a sentence computed from the rows


class Measured(NamedTuple):
    """The result of a case: figures, or the reason why there are none."""

    figures: Figures | None
    failure: str = ""


def measure_case(case: Case) -> Measured:
    """Run the episode of a case. If its settings are refused or the run fails, the result has the reason instead of figures."""
    try:
        return Measured(figures_of(run_episode(World(case.scenario, case.controller, record=True), Scripted())))
    except SimulationError as error:
        return Measured(None, "diverged: " + str(error).split(":")[0].removeprefix("world 0, "))
    except ConfigurationError as error:
        return Measured(None, f"refused: {error}")


def compare_rows(question: Question, measured: Sequence[Measured]) -> list[AblationRow]:
    """The question's rows, in the order of its cases, each compared with the first row of its block."""
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
