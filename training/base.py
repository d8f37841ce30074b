"""Base class of trainers for one team: worlds, the learner's reward, and a state that is saved and restored bit for bit."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch

from marlbc_mj.controllers import make_controller
from marlbc_mj.policies.greedy import Policy
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.tasks.batch import DecisionOutcome, FormationBatch
from marlbc_mj.tasks.starts import Starts
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.networks import TeamNetwork
from marlbc_mj.training.shaping import lost, shaped_reward
from marlbc_mj.util.errors import ConfigurationError


class BaseTrainer(ABC):
    """One training run; :meth:`advance` makes a decision in every world and learns from it.

    Args:
        config: configuration of the run.

    Raises:
        ConfigurationError: the scenario, controller or device cannot be used.
    """

    def __init__(self, config: TrainConfig) -> None:
        check_device(config.device)
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
            starts=make_starts(config),
        )
        self.rng = np.random.default_rng(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.state = self.batch.reset(config.seed)  # (B, S)
        self.steps = 0  # mission steps simulated so far, over all worlds
        self.error = 0.0  # mean absolute TD error of the last update
        self.explored = 0.0  # share of the last actions that were not greedy
        single_thread()

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.steps >= self.config.budget

    @property
    @abstractmethod
    def updates(self) -> int:
        """Number of gradient steps taken."""

    @property
    @abstractmethod
    def temperature(self) -> float:
        """Randomness of the actions: 1 at the start, lower later."""

    @property
    @abstractmethod
    def network(self) -> TeamNetwork:
        """The networks of the greedy policy, whose largest output marks the greedy action."""

    @abstractmethod
    def advance(self) -> DecisionOutcome:
        """Make one decision in every world and learn from it."""

    def step(self, actions: np.ndarray) -> DecisionOutcome:
        """Make one decision in every world: each agent takes its action in ``actions`` (B, N)."""
        outcome = self.batch.step(actions)
        single_thread()
        return outcome

    def judge(self, outcome: DecisionOutcome) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each agent's reward for a decision, and whether the agent's return ends with it.

        Returns:
            (B, N) float32 rewards to learn from; (B, N) bool, whether the agent's return ends here, because the mission is over
            or because the agent was :func:`lost` at a cost; (B, N) bool, whether the agent was lost.
        """
        shaping = self.config.shaping
        gone = lost(outcome, shaping, self.scenario.safe_distance)
        pays = gone & (shaping.own_violation_cost > 0)
        reward = np.where(pays, -shaping.own_violation_cost / shaping.scale, shaped_reward(outcome, shaping))
        return reward, outcome.terminal[:, None] | pays, gone

    def learning_rate(self, share: float) -> float:
        """Step size once a ``share`` of the budget is spent, linear from the initial to the final one."""
        config = self.config
        return config.final_learning_rate + (config.learning_rate - config.final_learning_rate) * max(0.0, 1.0 - share)

    def check_finite(self) -> None:
        """Raise ConfigurationError if the last update's error is not finite."""
        if not np.isfinite(self.error):
            raise ConfigurationError(f"the networks diverged after {self.steps} mission steps; try a lower learning_rate")

    def policy(self) -> Policy:
        """The greedy policy of the current :attr:`network`."""
        network = self.network
        weights = tuple(w.detach().cpu().numpy().copy() for w in network.weights)
        biases = tuple(b.detach().cpu().numpy().copy() for b in network.biases)
        scale = self.batch.read.scale.astype(np.float32)
        risk = self.config.risk_limit if network.risk else 0.0
        return Policy(weights, biases, scale, network.dueling, self.config.switching_margin, risk)

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The state that resumes the run bit for bit: arrays, and the remaining values as JSON data."""
        arrays = {
            **prefixed("world", self.batch.world.snapshot()),
            **{name: getattr(owner, name) for owner, name in self.plain_arrays()},
            "generator": self.generator.get_state().numpy(),
        }
        scalars = {
            "rng": self.rng.bit_generator.state,
            "starts_rngs": [rng.bit_generator.state for rng in self.batch.rngs],
            "steps": self.steps,
            "error": self.error,
        }
        return arrays, scalars

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a run with the same configuration."""
        self.batch.world.restore(unprefixed("world", arrays))
        for owner, name in self.plain_arrays():
            setattr(owner, name, arrays[name].copy())
        self.generator.set_state(torch.from_numpy(arrays["generator"].copy()))
        self.rng.bit_generator.state = scalars["rng"]
        for rng, state in zip(self.batch.rngs, scalars["starts_rngs"], strict=True):
            rng.bit_generator.state = state
        self.steps, self.error = scalars["steps"], scalars["error"]

    def plain_arrays(self) -> list[tuple[Any, str]]:
        """The arrays that a snapshot takes as they are: pairs of the owning object and the attribute's name."""
        return [(self, "state"), *((self.batch, name) for name in ("cut", "last"))]


def check_device(device: str) -> None:
    """Check that this machine has the device for the networks.

    Raises:
        ConfigurationError: the device is cuda, and torch finds no GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigurationError("device is cuda, but torch finds no GPU; choose cpu")


def single_thread() -> None:
    """Restrict torch to one thread: small networks gain nothing from more, and sums would depend on the number of threads.

    numba's thread pool shares OpenMP with torch and sets the number of threads at every parallel loop, so call this again after
    each of them. The number is set per thread: networks that learn in a thread of their own are not affected.
    """
    torch.set_num_threads(1)


def make_starts(config: TrainConfig) -> Starts:
    """The settings of a run for where episodes begin."""
    return Starts(config.exploring_starts, config.start_length, config.focus, turning=config.turning)


def prefixed(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays, renamed from ``name`` to ``prefix.name``."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def unprefixed(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays named ``prefix.name``, renamed to ``name``."""
    return {name.removeprefix(f"{prefix}."): array for name, array in arrays.items() if name.startswith(f"{prefix}.")}
