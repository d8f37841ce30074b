"""Training with a replay buffer: worlds, learner, replay and temperatures in one loop."""

import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from marlbc_mj.policies.greedy import greedy
from marlbc_mj.tasks.batch import DecisionOutcome
from marlbc_mj.training.base import BaseTrainer, prefixed, unprefixed
from marlbc_mj.training.codes import StateHash
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.exploration import Exploration
from marlbc_mj.training.learner import restore_learning, snapshot_learning
from marlbc_mj.training.leniency import Temperatures, leniency
from marlbc_mj.training.networks import TeamNetwork
from marlbc_mj.training.prioritised import PrioritisedReplay
from marlbc_mj.training.replay import Replay
from marlbc_mj.training.rivals import learner_class, own_entries

WARM_UP = 5_000
"""Transitions stored before the networks' first update and before states are hashed."""
LATE_TEMPERATURE = 0.05
"""Largest temperature once the share ``cool_by`` of the budget is spent."""


class Trainer(BaseTrainer):
    """One run of a method with a replay buffer; :meth:`advance` makes a decision in every world and updates the networks.

    The updates draw from transitions stored before the decision, so that the networks can learn while the worlds are simulated.
    With one thread, the updates come before the simulation, with the same results.

    Args:
        config: configuration of the run.

    Raises:
        ConfigurationError: the method, scenario, controller or device cannot be used.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        agents, actions, read = self.scenario.agents, self.batch.actions, self.batch.read
        kind = learner_class(config.method)
        mask = own_entries(read, agents) if kind.own_state else None
        self.learner = kind(config, agents, actions, read.scale, self.generator, mask)
        self.replay = (PrioritisedReplay if kind.prioritised else Replay)(config.rows, config.worlds, agents, read.size)
        self.hash = StateHash(read.size, config.bits, config.hash, self.rng)
        self.temperatures = Temperatures(agents, 1 << config.bits, actions)
        self.exploration = Exploration(config, agents, actions)
        self.exploration.begin(self.batch.turn, self.rng)
        self.first = np.zeros(config.worlds, dtype=np.int64)  # row of the buffer at which each world's episode began
        self.aside = ThreadPoolExecutor(1, "updates", torch.set_num_threads, (1,)) if config.threads > 1 else None

    @property
    def updates(self) -> int:
        """Number of gradient steps taken."""
        return self.learner.updates

    @property
    def temperature(self) -> float:
        """The largest temperature."""
        return self.temperatures.nu

    @property
    def network(self) -> TeamNetwork:
        """The networks of the greedy policy, with the running mean of the weights."""
        return self.learner.smooth

    def advance(self) -> DecisionOutcome:
        """Make one decision in every world and the configured number of gradient steps."""
        config, replay = self.config, self.replay
        share = self.steps / config.budget
        self.temperatures.nu = max(math.exp(math.log(LATE_TEMPERATURE) * share / config.cool_by), 1e-6)
        if not self.hash.fitted and self._seen_enough():
            self._fit_hash()
        codes = self.hash((self.state / self.batch.read.scale).astype(np.float32))
        warmth = self.temperatures.read(codes)
        actions = self._choose(warmth)
        lenient = leniency(np.take_along_axis(warmth, actions[..., None], axis=-1)[..., 0])
        with self._learning(share):
            outcome = self.step(actions)
        reward, over, gone = self.judge(outcome)
        replay.store(
            state=self.state,
            final=outcome.final_state,
            action=actions,
            reward=reward,
            leniency=lenient,
            lost=gone,
            code=codes,
            ended=outcome.ended,
            terminal=over,
        )
        self._end_episodes(outcome.ended)
        self.state = outcome.state
        self.steps += config.worlds * config.interval
        return outcome

    def _choose(self, warmth: np.ndarray) -> np.ndarray:
        """(B, N) actions: greedy ones, some replaced by exploration according to the temperatures ``warmth`` (B, N, A)."""
        values, last = self.learner.values(self.state), self.batch.last
        best = greedy(values, last, self.batch.fresh, self.config.switching_margin)
        allowed = values > -np.inf if self.config.risk_gamma else None
        actions = self.exploration(best, warmth.mean(axis=-1), self.rng, last=last, allowed=allowed)
        self.explored = float((actions != best).mean())
        return actions

    def _seen_enough(self) -> bool:
        """Whether the buffer holds states from the whole mission.

        If episodes begin anywhere along the route, WARM_UP transitions suffice. Otherwise a whole mission is also needed, or a
        full buffer if that is shorter.
        """
        mission = 0 if self.config.exploring_starts else self.batch.decisions
        rows = self.replay.count
        return rows * self.config.worlds >= WARM_UP and rows >= min(mission, self.replay.rows)

    def _fit_hash(self) -> None:
        """Fit the hash to the buffer's states. Episodes count from now on, as earlier decisions have no code and cool nothing."""
        self.first[:] = self.replay.count
        states = self.replay.arrays["state"][: self.replay.count].reshape(-1, self.batch.read.size)
        self.hash.fit((states / self.batch.read.scale).astype(np.float32), self.generator)

    def _end_episodes(self, ended: np.ndarray) -> None:
        replay = self.replay
        for b in np.flatnonzero(ended) if self.hash.fitted else ():
            first = max(int(self.first[b]), replay.count - replay.rows)
            self.temperatures.cool(replay.arrays["code"], replay.arrays["action"], int(b), first, replay.count - 1)
        self.first[ended] = replay.count
        self.exploration.forget(ended)
        if self.steps < self.config.turn_until * self.config.budget:
            self.exploration.begin(np.where(ended, self.batch.turn, -1), self.rng)

    @contextmanager
    def _learning(self, share: float) -> Iterator[None]:
        """If the buffer holds enough, learn while the block runs; with one thread, learn before it."""
        replay, config = self.replay, self.config
        if replay.count * config.worlds < WARM_UP or replay.count <= config.n_step:
            yield
        elif self.aside is None:
            self._learn(share)
            yield
        else:
            learnt = self.aside.submit(self._learn, share)
            try:
                yield
            finally:
                self._await(learnt)

    def _await(self, learnt: Future[None]) -> None:
        """Wait for the networks' updates; a separate method, so that a profile shows the waiting time."""
        learnt.result()

    def _learn(self, share: float) -> None:
        config = self.config
        for _ in range(config.updates):
            batch = self.replay.sample(config.batch, config.n_step, config.gamma, self.rng, share)
            self.error = self.learner.update(batch, self.learning_rate(share))
            self.replay.learnt(batch, self.learner.errors)
        self.check_finite()

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The state that resumes the run bit for bit: arrays, and the remaining values as JSON data."""
        arrays, scalars = super().snapshot()
        arrays |= {**prefixed("hash", self.hash.arrays), "table": self.temperatures.table}
        learnt, counts = snapshot_learning(self.learner, self.replay)
        return arrays | learnt, scalars | counts

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a run with the same configuration."""
        super().restore(arrays, scalars)
        restore_learning(self.learner, self.replay, arrays, scalars)
        self.hash.arrays = {name: array.copy() for name, array in unprefixed("hash", arrays).items()}
        self.temperatures.table[:] = arrays["table"]

    def plain_arrays(self) -> list[tuple[Any, str]]:
        """The arrays that a snapshot takes as they are: pairs of the owning object and the attribute's name."""
        return [*super().plain_arrays(), (self, "first"), *((self.exploration, name) for name in ("left", "held"))]
