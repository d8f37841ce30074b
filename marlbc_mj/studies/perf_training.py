"""How fast learning is on this machine: the environment alone, a training run and its profile, and a learned decision."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from threading import get_ident
from time import perf_counter
from typing import Any

import numpy as np

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.policies.checkpoint import signature
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.studies.timing import interleaved, ratio
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.tasks.batch import FormationBatch
from marlbc_mj.training.base import BaseTrainer, make_starts
from marlbc_mj.training.config import TrainConfig, make_config
from marlbc_mj.training.run import make_trainer
from marlbc_mj.util.progress import Progress, silent

WORLDS = 256  # when the environment is measured alone
DECISIONS = 10  # per world in one measurement
PROFILED = 40  # decisions covered by the profile
REST = "rest"


def training_config(threads: int) -> TrainConfig:
    """The configuration that is measured: the fast preset."""
    return make_config("fast", threads=threads)


def measure_training(threads: tuple[int, ...], rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Figures and ratios of learning for every number of ``threads``.

    The environment uses the preset's interval, actions and starts, and takes random actions. A training run is measured after its
    warm-up. The ends of exploring starts are spread, so that every measurement includes its share of new episodes.
    """
    configs = {n: training_config(n) for n in threads}
    environments = {n: _environment(config) for n, config in configs.items()}
    trainers = {n: make_trainer(config) for n, config in configs.items()}
    rng = np.random.default_rng(0)
    for batch in (*environments.values(), *(trainer.batch for trainer in trainers.values())):
        spread(batch, rng)
    progress("learned decisions", 0, 4)
    decision = _measure_decisions(trainers[threads[0]], rounds)
    progress("warm-up of training", 1, 4)
    for trainer in trainers.values():
        warm_up(trainer)
    progress("mission steps of the environment and of training", 2, 4)
    variants: dict[Any, Callable[[], None]] = {}
    for n in threads:
        variants["environment", n] = partial(_play, environments[n], rng)
        variants["training", n] = partial(_learn, trainers[n], DECISIONS)
    taken = interleaved(variants, rounds)
    made = {("environment", n): WORLDS * DECISIONS * configs[n].interval for n in threads}
    made |= {("training", n): configs[n].worlds * DECISIONS * configs[n].interval for n in threads}
    each = {key: [s / made[key] for s in seconds] for key, seconds in taken.items()}
    progress("where the time of training goes", 3, 4)
    figures = {
        f"{what}_mission_steps_per_s": {str(n): 1.0 / median(each[what, n]) for n in threads}
        for what in ("environment", "training")
    }
    profiles, aside = {}, {}
    for n in threads:
        profiles[str(n)], aside[str(n)] = profile(trainers[n], PROFILED)
    ratios = {f"training_over_environment_{n}": ratio(each["environment", n], each["training", n]) for n in threads}
    profiled = {"training_profile": profiles, "training_profile_aside": aside}
    return {**figures, **profiled, "decision_us": decision, "ratios": ratios}


def _environment(config: TrainConfig) -> FormationBatch:
    batch = FormationBatch(
        make_scenario(config.scenario),
        make_controller(config.controller),
        worlds=WORLDS,
        threads=config.threads,
        interval=config.interval,
        state="extended",
        actions=config.actions,
        starts=make_starts(config),
    )
    batch.reset(config.seed)
    return batch


def spread(batch: FormationBatch, rng: np.random.Generator) -> None:
    """End the first exploring episodes of the worlds at different times; later ones then stay out of step by themselves."""
    exploring = batch.cut < batch.scenario.mission_steps
    left = batch.cut - batch.world.state.steps
    batch.cut = batch.cut - np.where(exploring, rng.integers(np.maximum(left, 1)), 0)


def warm_up(trainer: BaseTrainer) -> None:
    """Advance until the first updates have been made."""
    while not trainer.updates:
        trainer.advance()


def _play(batch: FormationBatch, rng: np.random.Generator) -> None:
    for _ in range(DECISIONS):
        batch.step(rng.integers(batch.actions, size=batch.last.shape))


def _learn(trainer: BaseTrainer, decisions: int) -> None:
    for _ in range(decisions):
        trainer.advance()


class PartClock:
    """Seconds spent in each part of a program. Parts may call each other: only the innermost one is counted.

    ``seconds`` counts the thread that made the clock, and ``aside`` one other thread, in which parts must not call each other.
    """

    def __init__(self) -> None:
        self.thread = get_ident()
        self.aside: dict[str, float] = {}
        self.seconds: dict[str, float] = {REST: 0.0}
        self.part = REST
        self.since = perf_counter()

    def turn_to(self, part: str) -> str:
        """Count time for ``part`` from now on; returns the part counted before."""
        now, before = perf_counter(), self.part
        self.seconds[before] += now - self.since
        self.part, self.since = part, now
        return before

    @contextmanager
    def timing(self, owner: Any, names: tuple[str, ...], part: str) -> Iterator[None]:
        """Count the methods ``names`` of one object, ``__call__`` included, for ``part`` within the block."""
        self.seconds.setdefault(part, 0.0)
        kind = type(owner)
        owner.__class__ = type(kind.__name__, (kind,), {name: self._timed(getattr(kind, name), part) for name in names})
        try:
            yield
        finally:
            owner.__class__ = kind

    def _timed(self, method: Callable[..., Any], part: str) -> Callable[..., Any]:
        def run(*arguments: Any, **keywords: Any) -> Any:
            if get_ident() != self.thread:
                began = perf_counter()
                try:
                    return method(*arguments, **keywords)
                finally:
                    self.aside[part] = self.aside.get(part, 0.0) + perf_counter() - began
            before = self.turn_to(part)
            try:
                return method(*arguments, **keywords)
            finally:
                self.turn_to(before)

        return run


def profile(trainer: Any, decisions: int) -> tuple[dict[str, float], dict[str, float]]:
    """Shares of the wall time of training with a replay buffer: in the thread that simulates, and in the one that learns
    meanwhile, if there is one.

    Parts: "simulation" is the worlds' steps and resets, "state" the state vectors, "exploration" the hash codes, temperatures and
    random orders, "replay" storing and sampling, "waiting" the wait for updates that take longer than the simulation, and "rest"
    the greedy choice, rewards and leniency.
    """
    parts = (
        (trainer.batch.world, ("advance", "reset", "place"), "simulation"),
        (trainer.batch, ("states",), "state"),
        (trainer.learner, ("values",), "action_values"),
        (trainer.learner, ("update",), "updates"),
        (trainer.exploration, ("__call__", "forget"), "exploration"),
        (trainer.hash, ("__call__",), "exploration"),
        (trainer.temperatures, ("read", "cool"), "exploration"),
        (trainer.replay, ("store", "sample", "learnt"), "replay"),
        (trainer, ("_await",), "waiting"),
    )
    clock = PartClock()
    with ExitStack() as stack:
        for owner, names, part in parts:
            stack.enter_context(clock.timing(owner, names, part))
        clock.since = perf_counter()
        _learn(trainer, decisions)
        clock.turn_to(REST)
    total = sum(clock.seconds.values())
    own, aside = (
        {part: seconds / total for part, seconds in taken.items() if seconds > 0} for taken in (clock.seconds, clock.aside)
    )
    return own, aside


def _measure_decisions(trainer: BaseTrainer, episodes: int) -> dict[str, dict[str, float]]:
    """Median and 99th percentile of ``Learned.decide``'s time [us]: at the mission steps at which it decides, and at all steps.

    The networks are untrained; the outcome of a decision does not affect its duration.
    """
    scenario, config = trainer.scenario, trainer.config
    tied = signature(scenario, config.state, config.actions, config.interval)
    supervisor = Learned(trainer.policy(), tied, Path("untrained"))
    world = World(scenario, make_controller(config.controller))
    every: list[float] = []
    deciding: list[float] = []
    for _ in range(episodes):
        memory, observation = supervisor.start(scenario, 1), world.reset()
        supervisor.decide(observation, memory)
        for step in range(scenario.mission_steps):
            began = perf_counter()
            orders, memory = supervisor.decide(observation, memory)
            every.append(1e6 * (perf_counter() - began))
            if step % config.interval == 0:
                deciding.append(every[-1])
            observation = world.step(orders).observation
    samples = {"decision_step": deciding, "all_mission_steps": every}
    return {name: {"median": float(np.median(us)), "p99": float(np.percentile(us, 99))} for name, us in samples.items()}


def training_lines(figures: dict[str, Any]) -> list[str]:
    """The figures of learning as text, one line each."""
    lines = [
        f"{what}, {threads} thread(s): {rate:,.0f} mission steps/s"
        for what, key in ((f"FormationBatch, B = {WORLDS}", "environment"), ("training, preset fast", "training"))
        for threads, rate in figures[f"{key}_mission_steps_per_s"].items()
    ]
    for key, which in (("training_profile", ""), ("training_profile_aside", ", meanwhile in the one that learns")):
        for threads, shares in figures[key].items():
            named = ", ".join(f"{part.replace('_', ' ')} {share:.1%}" for part, share in shares.items())
            lines += [f"time of training, {threads} thread(s){which}: {named}"] if shares else []
    for name, taken in figures["decision_us"].items():
        lines.append(f"learned, {name.replace('_', ' ')}: median {taken['median']:.0f} us, p99 {taken['p99']:.0f} us")
    return lines
