"""MAPPO for teams of any size: one actor for all agents, and one critic on an agent's inputs and their mean over the team."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from marlbc_mj.policies.general_inputs import INPUTS
from marlbc_mj.training.general.trainer import GeneralTrainer
from marlbc_mj.training.learner import Learner
from marlbc_mj.training.mappo import HUBER, LAST_LAYER, ValueScale, advantages, clipped_loss, log_probability
from marlbc_mj.training.networks import NetworkSize, TeamNetwork
from marlbc_mj.training.replay import Replay


class Assessed(NamedTuple):
    """M decisions of single agents under one policy, with advantages and returns."""

    state: Tensor  # (M, S) inputs of the actor
    view: Tensor  # (M, 2 S) inputs of the critic
    action: Tensor  # (1, M)
    old: Tensor  # (1, M) log-probabilities of the actions when they were taken
    gain: Tensor  # (1, M) advantages, with mean 0 and deviation 1
    returns: Tensor  # (1, M) normalised

    def part(self, rows: Tensor) -> "Assessed":
        """The subset ``rows`` of the decisions."""
        return Assessed(self.state[rows], self.view[rows], *(each[:, rows] for each in self[2:]))


class TeamPPO(Learner):
    """Actor and critic of MAPPO (Yu et al., NeurIPS 2022) with parameter sharing; the network's values are the actor's logits.

    An agent's return is that of its own rewards. The critic's input is the agent's, together with its mean over the team.
    """

    joint = True

    def further(self, agents: int, scale: np.ndarray, generator: torch.Generator) -> list[nn.Parameter]:
        """Create the critic and the scale of its values, and start the actor with about equally likely actions."""
        self.network.weights[-1].data *= LAST_LAYER
        size = NetworkSize(agents, 2 * len(scale), 1, self.config.hidden)
        twice = torch.from_numpy(np.concatenate([scale, scale]))
        self.critic = TeamNetwork(size, twice, dueling=False, generator=generator).to(self.config.device)
        self.scaling = ValueScale(1)
        return list(self.critic.parameters())

    @torch.no_grad()
    def assess(self, rows: dict[str, np.ndarray], sizes: np.ndarray, gamma: float) -> Assessed:
        """Advantages and returns of T decisions of M agents.

        Args:
            rows: arrays of a :class:`Replay`, first axis T.
            sizes: (K,) number of agents of each team, in the order of the columns.
            gamma: discount factor per decision.
        """
        view, after = (self.tensor(with_team(rows[name], sizes)) for name in ("state", "final"))
        now, ahead = (self.scaling.undo(self.critic(each.flatten(0, 1))[0].cpu().numpy()) for each in (view, after))
        shape = rows["reward"].shape  # (T, M, 1)
        now, ahead = now.reshape(shape), ahead.reshape(shape)
        trace = self.config.ppo.trace
        gain = advantages(rows["reward"], now, ahead, rows["terminal"], rows["ended"], gamma, trace).reshape(-1, 1)
        returns = gain + now.reshape(-1, 1)
        self.scaling.take(returns)
        gain = (gain - gain.mean()) / (gain.std() + 1e-5)
        state = self.tensor(rows["state"]).flatten(0, 1)
        action = torch.from_numpy(rows["action"].reshape(1, -1)).to(state.device)
        old, _ = log_probability(self.network(state), action)
        return Assessed(state, view.flatten(0, 1), action, old, self.tensor(gain.T), self.tensor(self.scaling(returns).T))

    def objective(self, part: Assessed) -> tuple[Tensor, Tensor]:
        """The loss (clipped surrogate, entropy bonus and Huber loss of the values), and the values' errors (1, M)."""
        ppo = self.config.ppo
        new, entropy = log_probability(self.network(part.state), part.action)
        value = self.critic(part.view)[..., 0]
        missed = nn.functional.huber_loss(value, part.returns, reduction="none", delta=HUBER)
        loss = clipped_loss(new, part.old, part.gain, ppo.clip) - ppo.entropy * entropy + missed
        return loss.mean(), (part.returns - value).detach()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of everything that training changes, by name."""
        return super().snapshot() | {"returns": self.scaling.sums.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a :meth:`snapshot`."""
        super().restore(arrays)
        self.scaling.sums[:] = arrays["returns"]


class PPOTrainer(GeneralTrainer):
    """A run of MAPPO: it draws actions from the policy, learns from ``ppo.rollout`` decisions at a time and discards them."""

    learner: TeamPPO

    def kind(self) -> type[Learner]:
        """Class of the learner."""
        return TeamPPO

    def make_replay(self, rows: int) -> Replay:
        """A buffer with room for one rollout."""
        return Replay(self.config.ppo.rollout, rows, 1, INPUTS)

    @property
    def flown(self) -> TeamNetwork:
        """The current actor: with so few updates, a running mean would still contain the untrained network."""
        return self.learner.network

    def choose(self, inputs: np.ndarray) -> list[np.ndarray]:
        """(W, N) actions of every squad, drawn from the softmax of the logits."""
        logits = self.learner.values(inputs)[:, 0]
        return self.by_squad((logits + self.rng.gumbel(size=logits.shape)).argmax(axis=-1))

    def learn(self) -> None:
        """At the end of a rollout, make ``ppo.epochs`` passes over it."""
        ppo = self.config.ppo
        if self.replay.count % ppo.rollout:
            return
        whole = self.learner.assess(self.replay.arrays, self.sizes, self.config.gamma)
        for _ in range(ppo.epochs):
            order = torch.from_numpy(self.rng.permutation(len(whole.state))).to(whole.state.device)
            for rows in order.tensor_split(ppo.minibatches):
                self.error = self.learner.descend(*self.learner.objective(whole.part(rows)), self.learning_rate)
        self.check_finite()


def with_team(rows: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(T, M, 2 S) rows (T, M, S) of M agents, each joined with its team's mean; ``sizes`` (K,) are the team sizes."""
    begins = np.cumsum(sizes) - sizes
    means = np.add.reduceat(rows, begins, axis=1) / sizes[:, None].astype(rows.dtype)
    return np.concatenate([rows, np.repeat(means, sizes, axis=1)], axis=-1)
