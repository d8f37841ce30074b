"""What every training run has: worlds, a learner's reward, and a state that can be saved and gone back to bit for bit."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch

from marlbc_mj.controllers import make_controller
from marlbc_mj.policies.greedy import Policy
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.tasks.batch import DecisionOutcome, FormationBatch
from marlbc_mj.tasks.starts import Starts
from marlbc_mj.training.config import Shaping, TrainConfig
from marlbc_mj.training.networks import TeamNetwork
from marlbc_mj.util.errors import ConfigurationError


class BaseTrainer(ABC):
    """One run. :meth:`advance` makes a decision in every world and learns from it.

    Raises:
        ConfigurationError: a scenario, controller or device that cannot be used.
    """

    def __init__(self, config: TrainConfig) -> None:
        if config.device == "cuda" and not torch.cuda.is_available():
            raise ConfigurationError("device cuda was asked for and torch finds none; choose cpu")
        torch.set_num_threads(1)  # the networks are small: a second thread gains nothing, and results would depend on it
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
        self.state = self.batch.reset(config.seed)
        self.steps = 0  # mission steps made
        self.error = 0.0  # of the last update, mean |TD|
        self.explored = 0.0  # share of the last actions that were not greedy

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.steps >= self.config.budget

    @property
    @abstractmethod
    def updates(self) -> int:
        """Gradient steps made."""

    @property
    @abstractmethod
    def temperature(self) -> float:
        """How random the actions are meant to be, from 1 downwards."""

    @property
    @abstractmethod
    def network(self) -> TeamNetwork:
        """The networks whose largest output is the greedy action."""

    @abstractmethod
    def advance(self) -> DecisionOutcome:
        """One decision in every world, and what is learned then."""

    def judge(self, outcome: DecisionOutcome) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(B, N) float32 rewards to learn from, and bool: the agent's return ends here, by the mission's end or its own loss;
        the agent came too close.
        """
        shaping = self.config.shaping
        gone = lost(outcome, shaping, self.scenario.safe_distance)
        pays = gone & (shaping.own_violation_cost > 0)
        reward = np.where(pays, -shaping.own_violation_cost / shaping.scale, shaped_reward(outcome, shaping))
        return reward, outcome.terminal[:, None] | pays, gone

    def learning_rate(self, share: float) -> float:
        """From the first to the final one, linear in the ``share`` of the budget that is spent."""
        config = self.config
        return config.final_learning_rate + (config.learning_rate - config.final_learning_rate) * max(0.0, 1.0 - share)

    def refuse_nonsense(self) -> None:
        """Raise ConfigurationError where the last update's error is not a number."""
        if not np.isfinite(self.error):
            raise ConfigurationError(f"the networks diverged after {self.steps} mission steps; try a lower learning_rate")

    def policy(self) -> Policy:
        """The greedy policy of the present networks."""
        network = self.network
        weights = tuple(w.detach().cpu().numpy().copy() for w in network.weights)
        biases = tuple(b.detach().cpu().numpy().copy() for b in network.biases)
        scale = self.batch.read.scale.astype(np.float32)
        risk = self.config.risk_limit if network.risk else 0.0
        return Policy(weights, biases, scale, network.dueling, self.config.switching_margin, risk)

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Everything that the run needs to go on bit for bit: arrays, and the rest as JSON data."""
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
        """Go on from a :meth:`snapshot` of a run with the same configuration."""
        self.batch.world.restore(unprefixed("world", arrays))
        for owner, name in self.plain_arrays():
            setattr(owner, name, arrays[name].copy())
        self.generator.set_state(torch.from_numpy(arrays["generator"].copy()))
        self.rng.bit_generator.state = scalars["rng"]
        for rng, state in zip(self.batch.rngs, scalars["starts_rngs"], strict=True):
            rng.bit_generator.state = state
        self.steps, self.error = scalars["steps"], scalars["error"]

    def plain_arrays(self) -> list[tuple[Any, str]]:
        """Arrays that are attributes, by owner and name."""
        return [(self, "state"), *((self.batch, name) for name in ("cut", "last"))]


def make_starts(config: TrainConfig) -> Starts:
    """Where a run's episodes begin."""
    return Starts(config.exploring_starts, config.start_length, config.focus, turning=config.turning)


def prefixed(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays under ``prefix.name``."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def unprefixed(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays that are under ``prefix.name``, by name."""
    return {name.removeprefix(f"{prefix}."): array for name, array in arrays.items() if name.startswith(f"{prefix}.")}


def shaped_reward(outcome: DecisionOutcome, shaping: Shaping) -> np.ndarray:
    """(B, N) float32: the reward of every agent, made from the printed terms as ``shaping`` says; see :func:`lost`."""
    team = outcome.formation + shaping.violation * outcome.violation + outcome.switching - shaping.centre * outcome.steps
    own = outcome.switches * (shaping.own_switch_cost + shaping.haste_cost * (outcome.age < shaping.dwell))
    return np.asarray((team[:, None] - own) / shaping.scale, dtype=np.float32)


def lost(outcome: DecisionOutcome, shaping: Shaping, safe_distance: float) -> np.ndarray:
    """(B, N) bool: agents that came too close."""
    return np.asarray(outcome.clearance < safe_distance + shaping.margin)
