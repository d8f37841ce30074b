"""Multi-agent PPO (Yu et al., NeurIPS 2022): one actor per agent and one critic of the state, trained on fresh rollouts."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from marlbc_mj.tasks.batch import DecisionOutcome
from marlbc_mj.training.base import BaseTrainer, prefixed, unprefixed
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.learner import LARGEST_GRADIENT
from marlbc_mj.training.networks import NetworkSize, TeamNetwork, as_tensor, restore, saved, with_moments

LAST_LAYER = 0.01
"""Factor of the initial weights of an actor's last layer, so that all actions are about equally likely."""
HUBER = 10.0
"""Normalised value errors larger than this count linearly in the loss instead of squared."""
RETURNS_MEMORY = 0.99999
"""Decay factor per rollout of the running means of returns and squared returns; debiased, so they start as plain means."""


class MAPPO(BaseTrainer):
    """One run of MAPPO. After every ``ppo.rollout`` decisions it learns from the rollout and discards it.

    An agent's reward is the team's minus the agent's own costs, and its return can end before those of the others. So the critic
    has one value per agent.

    Args:
        config: configuration of the run.

    Raises:
        ConfigurationError: the scenario, controller or device cannot be used.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        agents, read = self.scenario.agents, self.batch.read

        def network(networks: int, outputs: int) -> TeamNetwork:
            scale = torch.from_numpy(read.scale)
            size = NetworkSize(networks, read.size, outputs, config.hidden)
            plain = TeamNetwork(size, scale, dueling=False, generator=self.generator)
            return plain.to(config.device)

        self.actors = network(agents, self.batch.actions)
        self.actors.weights[-1].data *= LAST_LAYER
        self.critic = network(1, agents)
        self.parameters = [*self.actors.parameters(), *self.critic.parameters()]
        self.optimiser = with_moments(torch.optim.Adam(self.parameters, lr=config.learning_rate, eps=1e-5))
        self.scaling = ValueScale(agents)
        rows, worlds = config.ppo.rollout, config.worlds
        self.rows: dict[str, np.ndarray] = {
            "state": np.zeros((rows, worlds, read.size), dtype=np.float32),
            "final": np.zeros((rows, worlds, read.size), dtype=np.float32),  # the true successor
            "action": np.zeros((rows, worlds, agents), dtype=np.int64),
            "reward": np.zeros((rows, worlds, agents), dtype=np.float32),
            "over": np.zeros((rows, worlds, agents), dtype=bool),
            "ended": np.zeros((rows, worlds), dtype=bool),
        }
        self.row = 0  # number of rows of the rollout filled so far
        self.made = 0  # gradient steps taken
        self.entropy = 1.0  # mean entropy of the policy at the last update, relative to its maximum

    @property
    def updates(self) -> int:
        """Number of gradient steps taken."""
        return self.made

    @property
    def temperature(self) -> float:
        """Mean entropy of the actors, 1 if all actions are equally likely."""
        return self.entropy

    @property
    def network(self) -> TeamNetwork:
        """The actors, with logits in place of action values."""
        return self.actors

    def advance(self) -> DecisionOutcome:
        """Sample and make one decision in every world; at the end of a rollout, learn from it."""
        config = self.config
        share = self.steps / config.budget
        with torch.no_grad():
            logits = self.actors(as_tensor(self.state, config.device)).transpose(0, 1).cpu().numpy()
        actions = (logits + self.rng.gumbel(size=logits.shape)).argmax(axis=-1)  # a draw from the softmax
        self.explored = float((actions != logits.argmax(axis=-1)).mean())
        outcome = self.step(actions)
        reward, over, _ = self.judge(outcome)
        values = (self.state, outcome.final_state, actions, reward, over, outcome.ended)
        for array, value in zip(self.rows.values(), values, strict=True):
            array[self.row] = value
        self.state = outcome.state
        self.steps += config.worlds * config.interval
        self.row += 1
        if self.row == config.ppo.rollout:
            self.row = 0
            self._learn(self.learning_rate(share))
        return outcome

    @torch.no_grad()
    def _assess(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """State (T B, S), actions, old log-probabilities, advantages and normalised returns (N, T B) of the rollout."""
        rows, device = self.rows, self.config.device
        flat = {name: array.reshape(-1, *array.shape[2:]) for name, array in rows.items()}
        state, final = (as_tensor(flat[name], device) for name in ("state", "final"))
        shape = rows["reward"].shape
        now, ahead = (self.scaling.undo(self.critic(s)[0].cpu().numpy()).reshape(shape) for s in (state, final))
        advantage = advantages(rows["reward"], now, ahead, rows["over"], rows["ended"], self.config.gamma, self.config.ppo.trace)
        returns = (advantage + now).reshape(-1, shape[-1])
        self.scaling.take(returns)
        action = torch.from_numpy(np.ascontiguousarray(flat["action"].T)).to(device)
        old, _ = log_probability(self.actors(state), action)
        gain = advantage.reshape(-1, shape[-1])
        gain = (gain - gain.mean(axis=0)) / (gain.std(axis=0) + 1e-5)
        return state, action, old, as_tensor(gain.T, device), as_tensor(self.scaling(returns).T, device)

    def _learn(self, rate: float) -> None:
        """Make ``ppo.epochs`` passes over the rollout with the step size ``rate``."""
        config, ppo = self.config, self.config.ppo
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        state, action, old, gain, returns = self._assess()
        for _ in range(ppo.epochs):
            order = torch.from_numpy(self.rng.permutation(len(state))).to(config.device)
            for part in order.tensor_split(ppo.minibatches):
                new, entropy = log_probability(self.actors(state[part]), action[:, part])
                value = self.critic(state[part])[0].T
                errors = nn.functional.huber_loss(value, returns[:, part], reduction="none", delta=HUBER)
                loss = clipped_loss(new, old[:, part], gain[:, part], ppo.clip) - ppo.entropy * entropy + errors
                self.optimiser.zero_grad()
                loss.sum(dim=0).mean().backward()
                for network in (self.actors, self.critic):
                    nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
                self.optimiser.step()
                self.made += 1
                self.error = float((returns[:, part] - value).detach().abs().mean())
                self.entropy = float(entropy.detach().mean()) / float(np.log(self.batch.actions))
        self.check_finite()

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The state that resumes the run bit for bit: arrays, and the remaining values as JSON data."""
        arrays, scalars = super().snapshot()
        tensors = saved(self.parameters, self.optimiser)
        arrays |= {
            **prefixed("learner", {name: tensor.cpu().numpy().copy() for name, tensor in tensors.items()}),
            **prefixed("rollout", self.rows),
            "returns": self.scaling.sums.copy(),
        }
        return arrays, scalars | {"row": self.row, "updates": self.made, "entropy": self.entropy}

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a run with the same configuration."""
        super().restore(arrays, scalars)
        restore(unprefixed("learner", arrays), self.parameters, self.optimiser)
        for name, array in self.rows.items():
            array[:] = arrays[f"rollout.{name}"]
        self.scaling.sums[:] = arrays["returns"]
        self.row, self.made, self.entropy = scalars["row"], scalars["updates"], scalars["entropy"]


class ValueScale:
    """Running mean and standard deviation of the returns of N agents, which normalise the critic's targets."""

    def __init__(self, agents: int) -> None:
        self.sums = np.zeros((3, agents))  # decayed sums of weights, returns and squared returns

    def take(self, returns: np.ndarray) -> None:
        """Update the mean and deviation with the returns (M, N) of a rollout."""
        moments = np.stack([np.ones(returns.shape[1]), returns.mean(axis=0), (returns**2.0).mean(axis=0)])
        self.sums = RETURNS_MEMORY * self.sums + (1.0 - RETURNS_MEMORY) * moments

    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        weight, total, square = self.sums
        if not weight.any():
            return np.zeros_like(weight), np.ones_like(weight)
        mean = total / weight
        return mean, np.sqrt(np.maximum(square / weight - mean**2, 1e-2))

    def __call__(self, returns: np.ndarray) -> np.ndarray:
        """The returns (M, N), normalised by the running mean and deviation."""
        mean, deviation = self._moments()
        return np.asarray((returns - mean) / deviation)

    def undo(self, values: np.ndarray) -> np.ndarray:
        """Returns (M, N) from normalised values, such as the critic's outputs."""
        mean, deviation = self._moments()
        return np.asarray(values * deviation + mean)


def advantages(
    reward: np.ndarray,
    value: np.ndarray,
    ahead: np.ndarray,
    over: np.ndarray,
    ended: np.ndarray,
    gamma: float,
    trace: float,
) -> np.ndarray:
    """(T, B, N) generalised advantage estimates A = d + gamma trace A', d = r + gamma V(s') - V(s) (Schulman et al., ICLR 2016).

    V(s') is 0 where an agent's return ends, and no trace crosses the end of an episode.

    Args:
        reward: (T, B, N) r.
        value: (T, B, N) V(s).
        ahead: (T, B, N) V(s') of the true successors, before any restart.
        over: (T, B, N) bool, whether the agent's return ends here.
        ended: (T, B) bool, whether the episode ends here.
        gamma: discount factor.
        trace: lambda of the estimate.
    """
    delta = reward + gamma * np.where(over, 0.0, ahead) - value
    goes_on = ~(over | ended[..., None])
    gain, running = np.zeros(delta.shape), np.zeros(delta.shape[1:])
    for t in range(len(delta) - 1, -1, -1):
        running = delta[t] + gamma * trace * goes_on[t] * running
        gain[t] = running
    return gain


def log_probability(logits: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probabilities (N, M) of actions under softmax policies, and the policies' entropies (N, M).

    Args:
        logits: (N, M, A) logits of the policies.
        action: (N, M) actions taken.
    """
    every = torch.log_softmax(logits, dim=-1)
    return every.gather(-1, action[..., None]).squeeze(-1), -(every.exp() * every).sum(dim=-1)


def clipped_loss(new: Tensor, old: Tensor, gain: Tensor, clip: float) -> Tensor:
    """(N, M) loss -min(q A, clip(q, 1 - clip, 1 + clip) A) with the ratio q = exp(new - old) (Schulman et al. 2017).

    Args:
        new: (N, M) log-probabilities of the actions under the current policy.
        old: (N, M) log-probabilities under the policy that chose them.
        gain: (N, M) advantages A.
        clip: change of the ratio beyond which the loss rewards no further change.
    """
    ratio = (new - old).exp()
    gained: Tensor = torch.minimum(ratio * gain, ratio.clamp(1.0 - clip, 1.0 + clip) * gain)
    return -gained
