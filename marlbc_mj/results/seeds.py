"""Every method on the same draws around a scenario. Keeps scalars only, so memory stays flat; report/ has the statistics."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller, make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Trajectory, run_episode
from marlbc_mj.results.metrics import Metrics, measure
from marlbc_mj.results.summary import method_key
from marlbc_mj.scenarios import Perturbation, Scenario
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError, SimulationError

CASE_STUDY_PERTURBATION = Perturbation(start_spread=1.0, obstacle_spread=0.5, drag_scale=(0.0, 2.0))
"""Starts within 1 m, obstacles within 0.5 m per axis, drag from none to twice the printed: for scenarios that name no own.

A slot of the case study passes its points at 1 m and the gate is 8 m wide, so 0.5 m moves when a supervisor has to act, not
whether the mission can be done. A schedule fixed in time may violate then; that is an outcome.
"""

STUCK = 0.1
"""A limited law whose force is at its limit throughout this last share of an episode has failed: saturated forever."""

Progress = Callable[[str, float, float], None]


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


def seed_range(count: int, first: int = 0) -> tuple[int, ...]:
    """``count`` seeds from ``first`` on.

    Raises:
        ConfigurationError: fewer than one, or a negative seed.
    """
    if count < 1:
        raise ConfigurationError(f"seeds must be at least 1, got {count}")
    if first < 0:
        raise ConfigurationError(f"seed must not be negative, got {first}")
    return tuple(range(first, first + count))


def perturbed(scenario: Scenario) -> Scenario:
    """The scenario, with the case study's perturbation if it has none of its own and draws no layout."""
    if scenario.perturbation != Perturbation() or scenario.layout is not None:
        return scenario
    return replace(scenario, perturbation=CASE_STUDY_PERTURBATION)


def run_seeds(
    scenario: Scenario,
    supervisors: Sequence[str],
    controllers: Sequence[str],
    seeds: Sequence[int],
    progress: Progress | None = None,
    *,
    reference: str | None = None,
    workers: int = 1,
) -> SeedResults:
    """:func:`run_methods` for every supervisor with every controller."""
    methods = list(product(supervisors, controllers))
    return run_methods(scenario, methods, seeds, progress, reference=reference, workers=workers)


def run_methods(
    scenario: Scenario,
    methods: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    progress: Progress | None = None,
    *,
    reference: str | None = None,
    workers: int = 1,
) -> SeedResults:
    """Run every method on every seed; one world per method is reset from seed to seed.

    A run that fails, or a method that cannot start in this scenario, is kept with its reason. What a method does depends on
    neither the other methods nor their order.

    Args:
        scenario: drawn from as :func:`perturbed` says.
        methods: names of supervisor and controller.
        progress: called with the method, how many seeds of it are done and how many there are.
        reference: the key of the method that others are compared with; by default the first.
        workers: processes that share the methods; decision times are best measured with one.

    Raises:
        ConfigurationError: unknown names, no or repeated methods or seeds; nothing has been run then.
    """
    scenario = perturbed(scenario)
    keys = [method_key(*method) for method in methods]
    _check(keys, seeds, workers)
    if reference is not None and reference not in keys:
        raise ConfigurationError(f"reference method {reference!r} is not run; choose from: {', '.join(keys)}")
    for supervisor, controller in methods:
        make_supervisor(supervisor, controller)
        make_controller(controller)
    say = progress or (lambda what, done, total: None)
    results = _run_all(scenario, methods, tuple(seeds), say, workers)
    return SeedResults(scenario, tuple(seeds), results, reference or keys[0])


def _check(keys: Sequence[str], seeds: Sequence[int], workers: int) -> None:
    if not keys:
        raise ConfigurationError("name at least one supervisor and one controller")
    if len(set(keys)) != len(keys):
        raise ConfigurationError(f"a method is named twice: {', '.join(keys)}")
    if not len(seeds):
        raise ConfigurationError("name at least one seed")
    if len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise ConfigurationError(f"seeds must differ and not be negative, got {list(seeds)}")
    if workers < 1:
        raise ConfigurationError(f"workers must be at least 1, got {workers}")


def _run_all(
    scenario: Scenario, methods: Sequence[tuple[str, str]], seeds: tuple[int, ...], say: Progress, workers: int
) -> tuple[MethodRuns, ...]:
    if workers == 1:
        return tuple(run_method(scenario, supervisor, controller, seeds, say) for supervisor, controller in methods)
    results = []
    with ProcessPoolExecutor(min(workers, len(methods)), mp_context=get_context("spawn")) as pool:
        run = partial(run_method, scenario, seeds=seeds)
        for method in pool.map(run, *zip(*methods, strict=True)):
            results.append(method)
            say(method.key, len(seeds), len(seeds))
    return tuple(results)


def run_method(
    scenario: Scenario, supervisor: str, controller: str, seeds: Sequence[int], say: Progress | None = None
) -> MethodRuns:
    """One method on every seed."""
    law = make_controller(controller)
    try:
        world = World(scenario, law, record=True)
    except ConfigurationError as error:  # this law cannot run in this scenario, whatever the draw
        return MethodRuns(supervisor, controller, tuple(SeedRun(seed, None, failure=str(error)) for seed in seeds))
    runs = []
    for done, seed in enumerate(seeds):
        runs.append(run_seed(world, law, supervisor, controller, seed))
        if say is not None:
            say(method_key(supervisor, controller), done + 1, len(seeds))
    return MethodRuns(supervisor, controller, tuple(runs))


def run_seed(world: World, law: Controller, supervisor: str, controller: str, seed: int) -> SeedRun:
    """One episode in a world made with ``record=True``; its trajectory is measured and let go."""
    try:
        world.reset(seed)
    except ConfigurationError as error:  # no layout was found for this seed
        return SeedRun(seed, None, failure=str(error))
    state = world.state
    instance = Instance(state.position[0].copy(), state.obstacles[0, :, :3].copy(), float(state.disturbance_params[0, 0]))
    try:
        trajectory = run_episode(world, make_supervisor(supervisor, controller), seed=seed, names=(supervisor, controller))
        check_free(trajectory, law)
        return SeedRun(seed, instance, metrics=measure(trajectory))
    except (ConfigurationError, SimulationError) as error:  # a supervisor that cannot start here is an outcome too
        return SeedRun(seed, instance, failure=str(error))


def check_free(trajectory: Trajectory, law: Controller) -> None:
    """Raise SimulationError for an agent of a limited law that was at its force limit throughout the end of the episode."""
    scenario = trajectory.scenario
    if not law.limited:
        return
    last = max(1, round(STUCK * len(trajectory.force)))
    at_limit = (np.abs(trajectory.force[-last:]) >= scenario.force_limit * (1 - 1e-12)).any(axis=-1).all(axis=0)
    if at_limit.any():
        agents = ", ".join(str(i + 1) for i in np.flatnonzero(at_limit))
        raise SimulationError(
            f"saturated forever: agent {agents} at the force limit of {scenario.force_limit:g} N "
            f"throughout the last {last * scenario.substep:g} s"
        )
