"""Jobs of the suite, each of which flies one method on a block of layouts."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from marlbc_mj.results.layout_runs import LayoutRun, Method, layout_run
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.base import COMPOSITIONS
from marlbc_mj.studies.draws import DrawsJob, fly_draws
from marlbc_mj.studies.suite.definition import QUICK, SuiteMission
from marlbc_mj.studies.suite.entries import Choice, Entrant, entrants
from marlbc_mj.util.progress import Progress, silent

BLOCK = QUICK
"""Layouts per job; as many as in a quick run, so that the whole suite can reuse its results."""


class SuiteJob(NamedTuple):
    """One method on a block of layouts of one mission."""

    track: str
    mission: str
    scenario: Scenario  # with the method's composition
    entrant: Entrant
    seeds: tuple[int, ...]

    @property
    def method(self) -> Method:
        """The method that is flown."""
        return self.entrant.method


def suite_jobs(missions: Sequence[SuiteMission], choice: Choice) -> list[SuiteJob]:
    """All jobs, mission by mission.

    Raises:
        ConfigurationError: an invalid name, see :func:`~marlbc_mj.studies.suite.entries.entrants`.
    """
    flown = {track: entrants(track, choice) for track in dict.fromkeys(mission.track for mission in missions)}
    return [
        SuiteJob(mission.track, mission.name, composed[entrant.method.composition], entrant, seeds)
        for mission in missions
        for composed in [{name: under(mission.scenario, name) for name in COMPOSITIONS}]
        for entrant in flown[mission.track]
        for seeds in _blocks(mission.seeds)
    ]


def under(scenario: Scenario, composition: str) -> Scenario:
    """The scenario with the named composition.

    Raises:
        ConfigurationError: an unknown composition.
    """
    changes: dict[str, Any] = {"composition": composition}
    return replace(scenario, **changes)


def _blocks(seeds: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    yield from (seeds[first : first + BLOCK] for first in range(0, len(seeds), BLOCK))


def fly_layouts(job: SuiteJob, progress: Progress = silent) -> tuple[LayoutRun, ...]:
    """Fly the method on every layout of the block; a run that fails or cannot start gives a row with the reason."""
    entrant, scenario = job.entrant, job.scenario
    draws = DrawsJob(scenario, entrant.supervisor, entrant.controller, job.seeds, entrant.method.shield)
    runs = fly_draws(draws, progress).runs
    return tuple(layout_run(run.seed, run.metrics, scenario, run.failure) for run in runs)
