"""Results of all methods on the same draws around a scenario, as scalars only to save memory."""

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
    """The instance of a scenario that a seed draws, the same for every method."""

    starts: np.ndarray  # (N, 2) [m]
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]
    disturbance_scale: float  # the scenario's scale times the drawn factor


@dataclass(frozen=True)
class SeedRun:
    """The metrics of one episode, or the reason why it failed."""

    seed: int
    instance: Instance | None  # None if the run could not start, for example because the controller cannot run here
    metrics: Metrics | None = None
    failure: str | None = None

    @property
    def violated(self) -> bool:
        """Whether any agent came within the safe distance of an obstacle; a failed run counts as a violation."""
        return self.metrics is None or any(agent["violation_time"] > 0.0 for agent in self.metrics["agents"])


@dataclass(frozen=True)
class MethodRuns:
    """The runs of one method on all seeds, in the order of the seeds."""

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
        """One scalar per run; a failed run is left out, or counts as ``failure`` if that is given."""
        numbers = (failure if run.metrics is None else float(read(run.metrics)) for run in self.runs)
        return np.array([number for number in numbers if number is not None], dtype=float)


@dataclass(frozen=True)
class SeedResults:
    """The results of all methods on all seeds."""

    scenario: Scenario  # including the perturbation that seeds draw from
    seeds: tuple[int, ...]
    methods: tuple[MethodRuns, ...]
    reference: str  # key of the method that others are compared with


MOST_SEEDS = 10_000_000
"""Largest number of seeds in one run; memory does not hold results of more."""


def seed_range(count: int, first: int = 0) -> tuple[int, ...]:
    """``count`` consecutive seeds, starting with ``first``.

    Raises:
        ConfigurationError: fewer than one or more than :data:`MOST_SEEDS` seeds, or a negative seed.
    """
    if count < 1:
        raise ConfigurationError(f"seeds must be at least 1, got {count}")
    if count > MOST_SEEDS:
        raise ConfigurationError(f"seeds must be at most {MOST_SEEDS} in one run, got {count}")
    if first < 0:
        raise ConfigurationError(f"seed must not be negative, got {first}")
    return tuple(range(first, first + count))
