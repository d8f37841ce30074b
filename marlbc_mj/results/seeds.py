"""Every method on the same draws around a scenario, as scalars only, so that memory stays small."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.summary import method_key
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.method_names import display_method


class Instance(NamedTuple):
    """What a seed drew: one instance of the scenario, the same for every method."""

    starts: np.ndarray  # (N, 2) [m]
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]
    disturbance_scale: float  # the scenario's, times the draw


@dataclass(frozen=True)
class SeedRun:
    """One episode's scalars, or the reason why there are none."""

    seed: int
    instance: Instance | None  # None where the controller cannot run in this scenario
    metrics: Metrics | None = None
    failure: str | None = None

    @property
    def violated(self) -> bool:
        """Whether any agent came within the safe distance; a run that failed counts as one that did."""
        return self.metrics is None or any(agent["violation_time"] > 0.0 for agent in self.metrics["agents"])


@dataclass(frozen=True)
class MethodRuns:
    """One method on every seed, in the order of the seeds."""

    supervisor: str
    controller: str
    runs: tuple[SeedRun, ...]

    @property
    def key(self) -> str:
        """The method's name in every file."""
        return method_key(self.supervisor, self.controller)

    @property
    def display(self) -> str:
        """The method's name for people."""
        return display_method(self.supervisor, self.controller)

    @property
    def failed(self) -> tuple[SeedRun, ...]:
        """The runs that failed."""
        return tuple(run for run in self.runs if run.metrics is None)

    def values(self, read: Callable[[Metrics], float], failure: float | None = None) -> np.ndarray:
        """One scalar of every run; a failed run is left out, or is ``failure`` where that is given."""
        numbers = (failure if run.metrics is None else float(read(run.metrics)) for run in self.runs)
        return np.array([number for number in numbers if number is not None], dtype=float)


@dataclass(frozen=True)
class SeedResults:
    """The whole matrix."""

    scenario: Scenario  # with the perturbation that was drawn from
    seeds: tuple[int, ...]
    methods: tuple[MethodRuns, ...]
    reference: str  # the method that others are compared with


MOST_SEEDS = 10_000_000
"""More seeds than one run's memory holds results for."""


def seed_range(count: int, first: int = 0) -> tuple[int, ...]:
    """``count`` seeds from ``first`` on.

    Raises:
        ConfigurationError: fewer than one or more than :data:`MOST_SEEDS`, or a negative seed.
    """
    if count < 1:
        raise ConfigurationError(f"seeds must be at least 1, got {count}")
    if count > MOST_SEEDS:
        raise ConfigurationError(f"seeds must be at most {MOST_SEEDS} in one run, got {count}")
    if first < 0:
        raise ConfigurationError(f"seed must not be negative, got {first}")
    return tuple(range(first, first + count))
