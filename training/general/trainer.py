"""Training of the general policy: one dueling network learns from the transitions of all agents of all squads."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from marlbc_mj.policies.general import ACTIONS_UNDER, GeneralPolicy, make_general, mean_policy, orders_for, read_general
from marlbc_mj.policies.general_inputs import INPUTS
from marlbc_mj.training.base import check_device, prefixed, single_thread, unprefixed
from marlbc_mj.training.general.config import (
    TEAM_ERRORS,
    GeneralConfig,
    as_flown,
    input_mask,
    learner_config,
    training_scenarios,
)
from marlbc_mj.training.general.rivals import GENERAL_RIVALS, Distilled, TeamQMIX, TeamReplay, TeamVDN
from marlbc_mj.training.general.squads import Squad
from marlbc_mj.training.learner import Learner, restore_learning, snapshot_learning
from marlbc_mj.training.leniency import leniency
from marlbc_mj.training.networks import TeamNetwork
from marlbc_mj.training.replay import Replay
from marlbc_mj.util.errors import ConfigurationError

COLD = 0.05
"""Temperature once the share ``cool_by`` of the budget is spent."""


class GeneralTrainer:
    """One training run; :meth:`advance` makes a decision in every world and learns from all agents' transitions alike.

    Args:
        config: configuration of the run.

    Raises:
        ConfigurationError: the scenario, controller or device cannot be used.
    """

    def __init__(self, config: GeneralConfig) -> None:
        check_device(config.device)
        self.config = config
        learning = learner_config(config)
        self.squads = [Squad(each, config, learning, k) for k, each in enumerate(training_scenarios(config))]
        generator = torch.Generator().manual_seed(config.seed)
        scale = np.ones(INPUTS, dtype=np.float32)
        self.learner = self.kind()(learning, 1, ACTIONS_UNDER[config.composition], scale, generator, input_mask(config))
        if config.start:
            self._begin_with(read_general(Path(config.start))[0])
        self.teachers = [read_general(Path(path)) for path in config.teachers]  # policies and their headers
        if isinstance(self.learner, Distilled):
            self.learner.teach(self._teacher())
        if isinstance(self.learner, (TeamVDN, TeamQMIX)):
            self.learner.consensus = config.by_consensus
        self.rng = np.random.default_rng(config.seed)
        self.sizes = np.concatenate([np.full(config.worlds, squad.scenario.agents) for squad in self.squads])  # (T,) team sizes
        self.replay = self.make_replay(int(self.sizes.sum()))
        self.steps = 0  # mission steps simulated so far, over all worlds
        self.error = 0.0  # mean absolute TD error of the last update
        single_thread()

    def kind(self) -> type[Learner]:
        """Class of the learner."""
        return GENERAL_RIVALS.get(self.config.learner, Learner)

    def make_replay(self, rows: int) -> Replay:
        """The replay buffer for the decisions of ``rows`` agents."""
        kept = max(self.config.capacity // rows, 2 * self.config.n_step)
        return TeamReplay(kept, self.sizes, INPUTS) if self.config.learner in TEAM_ERRORS else Replay(kept, rows, 1, INPUTS)

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.steps >= self.config.budget

    @property
    def share(self) -> float:
        """Share of the budget that is spent."""
        return min(1.0, self.steps / self.config.budget)

    @property
    def temperature(self) -> float:
        """Temperature of the exploration, which falls from ``first_temperature``."""
        first = math.log(self.config.first_temperature)
        return math.exp(first + (math.log(COLD) - first) * self.share / self.config.cool_by)

    def _begin_with(self, policy: GeneralPolicy) -> None:
        """Copy a policy's network into the learner's network, its targets and its running mean.

        Raises:
            ConfigurationError: the policy's layer sizes differ from the configuration's, it is a mean of several networks, or it
                was trained under another composition.
        """
        if len(policy.network.weights[0]) > 1:
            raise ConfigurationError(f"checkpoint {self.config.start} is a mean of several networks; a run must start from one")
        found = tuple(bias.shape[2] for bias in policy.network.biases[:-1])
        if found != self.config.hidden:
            raise ConfigurationError(
                f"checkpoint {self.config.start} has hidden layers {found}, but the run has {self.config.hidden}"
            )
        orders_for(policy, self.squads[0].scenario)
        learner = self.learner
        arrays = (*policy.network.weights, *policy.network.biases)
        for network in (learner.network, learner.smooth):
            for parameter, array in zip((*network.weights, *network.biases), arrays, strict=True):
                parameter.data.copy_(torch.from_numpy(array.copy()))
        for _ in range(self.config.copies):
            learner.push()

    def _teacher(self) -> GeneralPolicy:
        """The mean of the configuration's teachers.

        Raises:
            ConfigurationError: the networks have different sizes or another composition.
        """
        teacher = mean_policy([policy for policy, _ in self.teachers], self.config.switching_margin)
        orders_for(teacher, self.squads[0].scenario)
        return teacher

    def advance(self) -> None:
        """Make one decision in every world, store it, and learn.

        Raises:
            ConfigurationError: the network diverged.
        """
        self._act()
        self.learn()

    def _act(self) -> None:
        inputs = np.concatenate([squad.inputs.reshape(-1, INPUTS) for squad in self.squads])
        outcomes = [squad.step(actions) for squad, actions in zip(self.squads, self.choose(inputs), strict=True)]
        single_thread()
        rows, temperature = len(inputs), self.temperature
        self.replay.store(
            state=inputs,
            final=np.concatenate([outcome.final.reshape(-1, INPUTS) for outcome in outcomes]),
            action=np.concatenate([outcome.action.reshape(-1, 1) for outcome in outcomes]),
            reward=np.concatenate([outcome.reward.reshape(-1, 1) for outcome in outcomes]),
            leniency=leniency(np.full((rows, 1), temperature)).astype(np.float32),
            lost=np.zeros((rows, 1), dtype=bool),
            code=np.zeros(rows, dtype=np.int64),
            ended=np.concatenate([np.repeat(o.ended, o.reward.shape[1]) for o in outcomes]),
            terminal=np.concatenate([np.repeat(o.terminal, o.reward.shape[1]) for o in outcomes])[:, None],
        )
        self.steps += sum(outcome.steps for outcome in outcomes)

    def choose(self, inputs: np.ndarray) -> list[np.ndarray]:
        """(W, N) actions of every squad (greedy, explored or the guide's), from the inputs of all agents (M, S)."""
        values, temperature = self.by_squad(self.learner.values(inputs)[:, 0]), self.temperature
        if self.config.by_consensus:
            values = [squad.agree(own) for squad, own in zip(self.squads, values, strict=True)]
        return [squad.choose(own.argmax(axis=-1), temperature) for squad, own in zip(self.squads, values, strict=True)]

    def by_squad(self, rows: np.ndarray) -> list[np.ndarray]:
        """Split an array with one row for every agent (M, ...) into those of every squad (W, N, ...)."""
        bounds = np.cumsum([squad.rows for squad in self.squads])[:-1]
        parts = zip(self.squads, np.split(rows, bounds), strict=True)
        return [own.reshape(*squad.last.shape, *rows.shape[1:]) for squad, own in parts]

    @property
    def learning_rate(self) -> float:
        """Current step size of Adam."""
        first, last = self.config.learning_rate, self.config.final_learning_rate
        return last + (first - last) * (1.0 - self.share)

    def learn(self) -> None:
        """Make the updates that follow a decision."""
        config = self.config
        if self.replay.count <= config.n_step:
            return
        self.learner.treatment = "plain" if self.share >= config.settle else self.learner.config.learner
        for _ in range(config.updates):
            batch = self.replay.sample(config.batch, config.n_step, config.gamma, self.rng)
            self.error = self.learner.update(batch, self.learning_rate)
        self.check_finite()

    def check_finite(self) -> None:
        """Check that the last update's error is finite.

        Raises:
            ConfigurationError: the network has diverged.
        """
        if not np.isfinite(self.error):
            raise ConfigurationError(f"the network diverged after {self.steps} mission steps; try a lower learning_rate")

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The state that resumes the run bit for bit: arrays, and the remaining values as JSON data."""
        squads = [squad.snapshot() for squad in self.squads]
        arrays, counts = snapshot_learning(self.learner, self.replay)
        for k, (own, _) in enumerate(squads):
            arrays |= prefixed(f"squad{k}", own)
        state = {"rng": self.rng.bit_generator.state, "steps": self.steps, "error": self.error}
        return arrays, {"squads": [own for _, own in squads], **counts, **state}

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a run with the same configuration."""
        for k, (squad, own) in enumerate(zip(self.squads, scalars["squads"], strict=True)):
            squad.restore(unprefixed(f"squad{k}", arrays), own)
        restore_learning(self.learner, self.replay, arrays, scalars)
        self.rng.bit_generator.state = scalars["rng"]
        self.steps, self.error = scalars["steps"], scalars["error"]

    @property
    def flown(self) -> TeamNetwork:
        """The network of the policy: the one with the running mean of the weights."""
        return self.learner.smooth

    def policy(self) -> GeneralPolicy:
        """The greedy policy of the network :attr:`flown`."""
        network = self.flown
        weights = tuple(w.detach().cpu().numpy().copy() for w in network.weights)
        biases = tuple(b.detach().cpu().numpy().copy() for b in network.biases)
        return as_flown(make_general(weights, biases, self.config.switching_margin), self.config)
