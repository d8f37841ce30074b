"""A training run: worlds, learner, replay and temperatures in one loop that can be saved and continued bit for bit."""

import math
from typing import Any

import numpy as np
import torch

from marlbc_mj.controllers import make_controller
from marlbc_mj.errors import ConfigurationError
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.tasks.batch import FormationBatch, Outcome, Starts
from marlbc_mj.training.codes import StateHash
from marlbc_mj.training.config import Shaping, TrainConfig
from marlbc_mj.training.exploration import Exploration
from marlbc_mj.training.learner import Learner
from marlbc_mj.training.leniency import Temperatures, leniency
from marlbc_mj.training.policy import Policy, greedy
from marlbc_mj.training.replay import Replay

WARM_UP = 5_000
"""Transitions before the states are hashed and the networks updated."""
LATE_TEMPERATURE = 0.05
"""The largest temperature after ``cool_by`` of the budget."""


class Trainer:
    """One run. :meth:`advance` makes a decision in every world and the updates that follow it.

    Raises:
        ConfigurationError: a scenario, controller or device that cannot be used.
    """

    def __init__(self, config: TrainConfig) -> None:
        if config.device == "cuda" and not torch.cuda.is_available():
            raise ConfigurationError("device cuda was asked for and torch finds none; choose cpu")
        torch.set_num_threads(config.threads)
        self.config = config
        self.scenario = make_scenario(config.scenario)
        self.batch = FormationBatch(
            self.scenario,
            make_controller(config.controller),
            worlds=config.worlds,
            threads=config.threads,
            interval=config.interval,
            state=config.state,
            actions=config.actions,
            starts=Starts(config.exploring_starts, config.start_length),
        )
        self.rng = np.random.default_rng(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        agents, actions, read = self.scenario.agents, self.batch.actions, self.batch.read
        self.learner = Learner(config, agents, actions, read.scale, self.generator)
        self.replay = Replay(config.rows, config.worlds, agents, read.size)
        self.hash = StateHash(read.size, config.bits, config.hash, self.rng)
        self.temperatures = Temperatures(agents, 1 << config.bits, actions)
        self.exploration = Exploration(config, agents, actions)
        self.first = np.zeros(config.worlds, dtype=np.int64)  # row at which each world's episode began
        self.state = self.batch.reset(config.seed)
        self.steps = 0  # mission steps made
        self.error = 0.0  # of the last update, mean |TD|
        self.explored = 0.0  # share of the last actions that were not greedy

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.steps >= self.config.budget

    def advance(self) -> Outcome:
        """One decision in every world, then ``updates`` gradient steps."""
        config, replay = self.config, self.replay
        share = self.steps / config.budget
        self.temperatures.nu = max(math.exp(math.log(LATE_TEMPERATURE) * share / config.cool_by), 1e-6)
        if not self.hash.arrays["fitted"][0] and replay.count * config.worlds >= WARM_UP:
            self._fit_hash()
        codes = self.hash((self.state / self.batch.read.scale).astype(np.float32))
        warmth = self.temperatures.read(codes)
        best = greedy(self.learner.values(self.state), self.batch.last, self.batch.fresh, config.switching_margin)
        actions = self.exploration(best, warmth.mean(axis=-1), self.rng)
        self.explored = float((actions != best).mean())
        outcome = self.batch.step(actions)
        shaping = config.shaping
        gone = lost(outcome, shaping, self.scenario.safe_distance)
        reward = shaped_reward(outcome, shaping)
        replay.store(
            state=self.state,
            final=outcome.final_state,
            action=actions,
            reward=np.where(gone, -shaping.own_violation_cost / shaping.scale, reward),
            leniency=leniency(np.take_along_axis(warmth, actions[..., None], axis=-1)[..., 0]),
            code=codes,
            ended=outcome.ended,
            terminal=outcome.terminal[:, None] | gone,
        )
        self._end_episodes(outcome.ended)
        self.state = outcome.state
        self.steps += config.worlds * config.interval
        if replay.count * config.worlds >= WARM_UP and replay.count > config.n_step:
            self._learn(share)
        return outcome

    def _fit_hash(self) -> None:
        states = self.replay.arrays["state"][: self.replay.count].reshape(-1, self.batch.read.size)
        self.hash.fit((states / self.batch.read.scale).astype(np.float32), self.generator)

    def _end_episodes(self, ended: np.ndarray) -> None:
        replay = self.replay
        for b in np.flatnonzero(ended):
            first = max(int(self.first[b]), replay.count - replay.rows)
            self.temperatures.cool(replay.arrays["code"], replay.arrays["action"], int(b), first, replay.count - 1)
        self.first[ended] = replay.count
        self.exploration.forget(ended)

    def _learn(self, share: float) -> None:
        config = self.config
        rate = config.final_learning_rate + (config.learning_rate - config.final_learning_rate) * max(0.0, 1.0 - share)
        for _ in range(config.updates):
            batch = self.replay.sample(config.batch, config.n_step, config.gamma, self.rng)
            self.error = self.learner.update(batch, rate)
        if not math.isfinite(self.error):
            raise ConfigurationError(f"the networks diverged after {self.steps} mission steps; try a lower learning_rate")

    def policy(self) -> Policy:
        """The greedy policy of the present networks."""
        network = self.learner.network
        weights = tuple(w.detach().cpu().numpy().copy() for w in network.weights)
        biases = tuple(b.detach().cpu().numpy().copy() for b in network.biases)
        scale = self.batch.read.scale.astype(np.float32)
        return Policy(weights, biases, scale, self.config.dueling, self.config.switching_margin)

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Everything that the run needs to go on bit for bit: arrays, and the rest as JSON data."""
        arrays = {
            **_prefixed("learner", self.learner.snapshot()),
            **_prefixed("replay", self.replay.arrays),
            **_prefixed("hash", self.hash.arrays),
            **_prefixed("world", self.batch.world.snapshot()),
            **{name: getattr(owner, name) for owner, name in self._plain_arrays()},
            "table": self.temperatures.table,
            "generator": self.generator.get_state().numpy(),
        }
        scalars = {
            "rng": self.rng.bit_generator.state,
            "starts_rng": self.batch.rng.bit_generator.state,
            "steps": self.steps,
            "error": self.error,
            "rows": self.replay.count,
            "updates": self.learner.updates,
            "next_copy": self.learner.targets.next,
        }
        return arrays, scalars

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Go on from a :meth:`snapshot` of a run with the same configuration."""
        self.learner.restore(_unprefixed("learner", arrays))
        for name, array in self.replay.arrays.items():
            array[:] = arrays[f"replay.{name}"]
        self.hash.arrays = {name: array.copy() for name, array in _unprefixed("hash", arrays).items()}
        self.batch.world.restore(_unprefixed("world", arrays))
        for owner, name in self._plain_arrays():
            setattr(owner, name, arrays[name].copy())
        self.temperatures.table[:] = arrays["table"]
        self.generator.set_state(torch.from_numpy(arrays["generator"].copy()))
        self.rng.bit_generator.state = scalars["rng"]
        self.batch.rng.bit_generator.state = scalars["starts_rng"]
        self.steps, self.error, self.replay.count = scalars["steps"], scalars["error"], scalars["rows"]
        self.learner.updates, self.learner.targets.next = scalars["updates"], scalars["next_copy"]

    def _plain_arrays(self) -> list[tuple[Any, str]]:
        """Arrays that are attributes, by owner and name."""
        return [(self, "state"), (self, "first"), (self.batch, "cut"), (self.batch, "last"), (self.exploration, "left"),
                (self.exploration, "held")]  # fmt: skip


def _prefixed(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def _unprefixed(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name.removeprefix(f"{prefix}."): array for name, array in arrays.items() if name.startswith(f"{prefix}.")}


def shaped_reward(outcome: Outcome, shaping: Shaping) -> np.ndarray:
    """(B, N) float32: the reward of every agent, made from the printed terms as ``shaping`` says; see :func:`lost`."""
    team = outcome.formation + shaping.violation * outcome.violation + outcome.switching - shaping.centre * outcome.steps
    own = shaping.own_switch_cost * outcome.switches
    return np.asarray((team[:, None] - own) / shaping.scale, dtype=np.float32)


def lost(outcome: Outcome, shaping: Shaping, safe_distance: float) -> np.ndarray:
    """(B, N) bool: agents for which the mission counts as lost, because they came too close."""
    if not shaping.own_violation_cost:
        return np.zeros(outcome.clearance.shape, dtype=bool)
    return np.asarray(outcome.clearance < safe_distance + shaping.margin)
