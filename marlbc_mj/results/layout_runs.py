"""Results of methods on the layouts of missions, and the CSV files that hold them with one row per layout."""

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.outcomes import FAILED_MISSION, MissionOutcome, intervened, outcome
from marlbc_mj.results.scores import SCORES
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.text import one_line

DIGITS = 6
"""Significant digits of numbers in a row. They are rounded before use, so statistics from memory and from a file are equal."""
LAYOUT_SCORES = (
    *("return", "violation_time_worst", "clearance_min_worst", "agent_distance_min", "end_error_worst"),
    *("effort_integral_sum", "cost_integral_sum", "rms_position_error_rms", "intervention_share_mean"),
)
"""Names of the scores in a row."""


class Method(NamedTuple):
    """A method: its supervisor, its controller, how orders are composed, and whether there is a shield."""

    supervisor: str
    controller: str
    composition: str = "null-space"
    shield: bool = False

    @property
    def key(self) -> str:
        """The method's name in files: ``fsams+sorlc``, ``fsams+sorlc+set-based+shield``."""
        others = [*([] if self.composition == "null-space" else [self.composition]), *(["shield"] if self.shield else [])]
        return "+".join([self.supervisor, self.controller, *others])


class LayoutRun(NamedTuple):
    """One run of a method on one layout. A failed run has NaN for its numbers and counts as the worst outcome."""

    seed: int
    failure: str  # why the run failed; empty if it finished
    reached: bool
    violated: bool
    struck: bool
    collided: bool
    intervened: bool  # whether a shield changed a force or a reference
    switches: float  # sum over agents
    decision_ms: float  # median time for the decisions of all agents in one mission step [ms]
    scores: tuple[float, ...]  # in the order of LAYOUT_SCORES, in SI units

    @property
    def success(self) -> bool:
        """See :attr:`MissionOutcome.success`."""
        return MissionOutcome(self.reached, self.violated, self.struck, self.collided).success

    @property
    def unfinished(self) -> bool:
        """Whether there is no complete episode: the method refused the mission, or the run failed."""
        return bool(self.failure)

    def score(self, name: str) -> float:
        """The score of this name, one of :data:`LAYOUT_SCORES`."""
        return self.scores[LAYOUT_SCORES.index(name)]


class MissionRuns(NamedTuple):
    """The runs of one method on the layouts of one mission."""

    track: str
    mission: str
    method: Method
    runs: tuple[LayoutRun, ...]

    @property
    def failures(self) -> dict[str, int]:
        """Number of failed runs by reason."""
        reasons = [run.failure for run in self.runs if run.failure]
        return {reason: reasons.count(reason) for reason in dict.fromkeys(reasons)}


def layout_run(seed: int, metrics: Metrics | None, scenario: Scenario, failure: str | None = None) -> LayoutRun:
    """The row of an episode, from its metrics or, if it failed, from the reason."""
    ended = FAILED_MISSION if metrics is None else outcome(metrics, scenario)
    if metrics is None:
        numbers = [math.nan] * (2 + len(LAYOUT_SCORES))
    else:
        switches = float(sum(agent["switches"] for agent in metrics["agents"]))
        numbers = [switches, metrics["team"]["decision_ms_median"], *(SCORES[name].read(metrics) for name in LAYOUT_SCORES)]
    switches, decision_ms, *scores = map(_rounded, numbers)
    reason = one_line(failure) if metrics is None else ""
    return LayoutRun(seed, reason, *ended, intervened(metrics), switches, decision_ms, tuple(scores))


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


_FLAGS = ("reached", "violated", "struck", "collided", "intervened")
_HEADER = (
    *("mission", "supervisor", "controller", "composition", "shield", "seed", "success", *_FLAGS, "switches", *LAYOUT_SCORES),
    *("decision_ms", "failure"),
)


def write_layout_rows(group: Iterable[MissionRuns], path: Path) -> Path:
    """Write a CSV file with one row per method, mission and layout; numbers of a failed run are empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_HEADER)
        for each in group:
            method = (each.mission, *each.method[:3], int(each.method.shield))
            writer.writerows([*method, *_cells(run)] for run in each.runs)
    return path


def _cells(run: LayoutRun) -> list[Any]:
    flags = [int(getattr(run, name)) for name in _FLAGS]
    numbers = [_text(value) for value in (run.switches, *run.scores, run.decision_ms)]
    return [run.seed, int(run.success), *flags, *numbers, run.failure]


def _text(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.{DIGITS}g}"


def read_layout_rows(path: Path, track: str) -> list[MissionRuns]:
    """Read a file that :func:`write_layout_rows` wrote; methods and missions keep its order.

    Raises:
        ConfigurationError: the file cannot be read, is of another kind, or has an invalid or repeated line, which the message
            names.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"cannot read {path}: {one_line(error)}") from error
    if tuple(header) != _HEADER:
        raise ConfigurationError(f"{path} is not a file of layouts: its columns are {', '.join(header)}")
    found: dict[tuple[str, Method], list[LayoutRun]] = {}
    seen: set[tuple[str, Method, int]] = set()
    for line, row in enumerate(rows, 2):
        try:
            mission, method, run = _parsed(row)
        except ValueError as error:
            raise ConfigurationError(f"{path}, line {line}: {one_line(error)}") from error
        if (mission, method, run.seed) in seen:
            raise ConfigurationError(f"{path}, line {line}: {mission}, {method.key}, seed {run.seed} has a row already")
        seen.add((mission, method, run.seed))
        found.setdefault((mission, method), []).append(run)
    return [MissionRuns(track, mission, method, tuple(runs)) for (mission, method), runs in found.items()]


def _parsed(row: Sequence[str]) -> tuple[str, Method, LayoutRun]:
    """Mission, method and run of one line; raises ValueError if the line is damaged."""
    cells = dict(zip(_HEADER, row, strict=True))
    method = Method(cells["supervisor"], cells["controller"], cells["composition"], bool(int(cells["shield"])))
    flags = {name: bool(int(cells[name])) for name in _FLAGS}
    switches, decision_ms, *scores = (float(cells[name] or "nan") for name in ("switches", "decision_ms", *LAYOUT_SCORES))
    ended = (flags["reached"], flags["violated"], flags["struck"], flags["collided"], flags["intervened"])
    run = LayoutRun(int(cells["seed"]), cells["failure"], *ended, switches, decision_ms, tuple(scores))
    return cells["mission"], method, run
