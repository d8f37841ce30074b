"""Source of the velocity gains of the finite- and fixed-time baselines: a search that inverts the maxima published in Table 6.

Their largest force occurs where v_r jumps: in the first substep of the column (FR), and again in the first one after it. It is
nearly proportional to the velocity gain, so one gain cannot fit four published maxima. The search fits the largest of them; the
maxima of the other agents show how well the law's shape explains the table.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from marlbc_mj.controllers import FiniteTime, FixedTime
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.report.paper_values import PUBLISHED_INPUT_MAX
from marlbc_mj.scenarios import Scenario, paper
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.supervisors import Scripted
from marlbc_mj.util.errors import ConfigurationError, SimulationError, unknown
from marlbc_mj.util.progress import Progress, silent

CALIBRATED: dict[str, FiniteTime | FixedTime] = {"finite-time": FiniteTime(), "fixed-time": FixedTime()}
"""Controllers with a ``velocity_gain`` fitted to Table 6, as shipped."""
TOLERANCE = 1e-6  # relative, of the maximum
MOST_EPISODES = 40


@dataclass(frozen=True)
class Calibration:
    """Result of the search for one controller."""

    controller: str
    published: tuple[float, ...]  # Table 6, per agent [N]
    found: float  # velocity gain that reproduces the largest published maximum [1/s]
    shipped: float  # default velocity gain of the dataclass [1/s]
    at_found: tuple[float, ...]  # max |u|_inf per agent with ``found`` [N]
    at_shipped: tuple[float, ...]  # max |u|_inf per agent with ``shipped`` [N]
    episodes: int  # number simulated by the search

    @property
    def errors(self) -> tuple[float, ...]:
        """Relative error of each agent's maximum with the gain found."""
        return tuple(reached / wanted - 1.0 for reached, wanted in zip(self.at_found, self.published, strict=True))

    @property
    def shipped_errors(self) -> tuple[float, ...]:
        """Relative error of each agent's maximum with the default gain."""
        return tuple(reached / wanted - 1.0 for reached, wanted in zip(self.at_shipped, self.published, strict=True))


class CalibrationJob(NamedTuple):
    """One search."""

    controller: str  # a key of CALIBRATED
    scenario: Scenario
    tolerance: float


@dataclass(frozen=True)
class CalibrationStudy:
    """One search per controller, and a table of gains and maxima.

    Raises:
        ConfigurationError: an unknown controller name.
    """

    controllers: tuple[str, ...] = tuple(CALIBRATED)

    def __post_init__(self) -> None:
        for name in self.controllers:
            if name not in CALIBRATED:
                raise unknown("calibrated controller", name, CALIBRATED)

    def jobs(self) -> list[CalibrationJob]:
        return [CalibrationJob(name, paper(), TOLERANCE) for name in self.controllers]

    def run(self, job: CalibrationJob, watch: Watch) -> Calibration:
        return calibrate(*job, progress=partial(watch.progress, job.controller))

    def report(self, results: Sequence[Calibration], out: Path | None, progress: Progress = silent) -> Report:
        """The table as text; this study writes no file."""
        return Report("\n".join(calibration_lines(results)), list(results))


def calibrate(
    name: str,
    scenario: Scenario | None = None,
    tolerance: float = TOLERANCE,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Find the velocity gain that reproduces the largest maximum of Table 6 in whole episodes under the scripted supervisor.

    Args:
        name: a key of :data:`CALIBRATED`.
        scenario: the case study by default; a shorter scenario must keep a switch between FM and FR.
        tolerance: relative error of the maximum at which the search ends.
        progress: called after every episode of the search with the number of episodes so far and the most allowed.

    Raises:
        ConfigurationError: an unknown name, a tolerance that is not positive, or a number of agents other than Table 6's.
        SimulationError: no gain between a quarter and four times the default reproduces the maximum, or a run diverged.
    """
    if name not in CALIBRATED:
        raise unknown("calibrated controller", name, CALIBRATED)
    if not tolerance > 0.0:
        raise ConfigurationError(f"tolerance must be positive, got {tolerance}")
    scenario = scenario or paper()
    law, published = CALIBRATED[name], PUBLISHED_INPUT_MAX.values[name]
    if scenario.agents != len(published):
        raise ConfigurationError(f"Table 6 has {len(published)} agents, the scenario {scenario.agents}")
    target = max(published)
    tried: dict[float, tuple[float, ...]] = {}

    def excess(gain: float) -> float:
        tried[gain] = maxima(replace(law, velocity_gain=gain), scenario)
        if progress is not None:
            progress(len(tried), MOST_EPISODES)
        return max(tried[gain]) / target - 1.0

    found = _root(excess, law.velocity_gain / 4.0, law.velocity_gain * 4.0, tolerance)
    shipped = maxima(law, scenario)
    return Calibration(name, tuple(map(float, published)), found, law.velocity_gain, tried[found], shipped, len(tried))


def maxima(controller: FiniteTime | FixedTime, scenario: Scenario) -> tuple[float, ...]:
    """(N,) largest |u|_inf of each agent over one episode [N]."""
    trajectory = run_episode(World(scenario, controller, record=True), Scripted())
    return tuple(float(force) for force in np.abs(trajectory.force).max(axis=(0, 2)))


def calibration_lines(results: Sequence[Calibration]) -> list[str]:
    """A Markdown table: per controller the published maxima, then one row each for the gain found and the gain shipped."""
    lines = [
        "| controller | velocity gain, 1/s | max ‖u‖∞ per agent, N | relative error per agent |",
        "|---|---:|---:|---:|",
    ]
    for result in results:
        lines.append(f"| {result.controller}, published | – | {_slashed(result.published, 'g')} | – |")
        rows = (
            ("found", result.found, result.at_found, result.errors),
            ("shipped", result.shipped, result.at_shipped, result.shipped_errors),
        )
        for kind, gain, reached, errors in rows:
            cells = f"{gain:.4f} | {_slashed(reached, '.2f')} | {_slashed(errors, '+.2%')}"
            lines.append(f"| {result.controller}, {kind} | {cells} |")
    return lines


def _slashed(numbers: Sequence[float], form: str) -> str:
    return " / ".join(format(round(number, 4) + 0.0, form) for number in numbers)  # + 0.0: no negative zero


def _root(function: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Root of an increasing function to ``tolerance``: false position that halves the value at the end that stays."""
    at_low, at_high = function(low), function(high)
    if at_low > 0.0 or at_high < 0.0:
        raise SimulationError(f"no gain from {low:g} to {high:g} /s gives the published maximum")
    for _ in range(MOST_EPISODES - 2):
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        value = function(middle)
        if abs(value) <= tolerance:
            return middle
        if value < 0.0:
            low, at_low, at_high = middle, value, 0.5 * at_high
        else:
            high, at_high, at_low = middle, value, 0.5 * at_low
    raise SimulationError(f"no gain found to a relative error of {tolerance:g} within {MOST_EPISODES} episodes")
