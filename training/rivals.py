"""Baselines that learn from a replay buffer: VDN, QMIX, a central Q-network over joint orders, and RLMS for single agents."""

import copy

import numpy as np
import torch
from torch import Tensor, nn

from marlbc_mj.policies.states import TEAM_ENTRIES, PublishedState, State
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.learner import Learner
from marlbc_mj.training.replay import Batch
from marlbc_mj.util.errors import unknown

EMBEDDING = 32
"""Hidden units of QMIX's mixing network (Rashid et al. 2018)."""


class VDN(Learner):
    """Value decomposition (Sunehag et al., AAMAS 2018): the team's value is the sum of its agents', with one TD error for all.

    Target: the sum over agents of r_i + gamma_i max_b Q_i(s', b), with Q_i averaged over the past networks.
    """

    joint = True

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(1, M) values of the team's actions, and their targets."""
        chosen, target = super().estimates(batch, now, ahead)
        return chosen.sum(dim=0, keepdim=True), target.sum(dim=0, keepdim=True)


class MixingLayers(nn.Module):
    """w2(s) . elu(W1(s) Q + b1(s)) + b2(s), with W1 and w2 >= 0, so that the team's value never falls when a Q_i rises.

    W1 and w2 are absolute values of linear functions of the state; b2 has a hidden ReLU layer (Rashid et al., ICML 2018).

    Args:
        inputs: S, size of the layers' input.
        weighted: number of values that W1 weights at a time.
        generator: random generator for the initial weights.
    """

    def __init__(self, inputs: int, weighted: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight1 = _linear(inputs, weighted * EMBEDDING, generator)
        self.bias1 = _linear(inputs, EMBEDDING, generator)
        self.weight2 = _linear(inputs, EMBEDDING, generator)
        self.bias2 = nn.Sequential(_linear(inputs, EMBEDDING, generator), nn.ReLU(), _linear(EMBEDDING, 1, generator))

    def mix(self, weighted: Tensor, x: Tensor) -> Tensor:
        """(1, M) values of M teams from ``weighted`` = W1(s) Q (M, E) and the input ``x`` (M, S) of the other layers."""
        hidden = nn.functional.elu(weighted + self.bias1(x))
        mixed: Tensor = (hidden * self.weight2(x).abs()).sum(dim=-1) + self.bias2(x)[:, 0]
        return mixed[None]


class Mixer(MixingLayers):
    """The mixing network of QMIX for N agents.

    Args:
        agents: N.
        scale: (S,) divisor of the state.
        generator: random generator for the initial weights.
    """

    def __init__(self, agents: int, scale: Tensor, generator: torch.Generator) -> None:
        super().__init__(len(scale), agents, generator)
        self.agents = agents
        self.scale: Tensor
        self.register_buffer("scale", scale.to(torch.float32))

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        """(1, M) values of the team from the agents' values (N, M) in states (M, S)."""
        x = state / self.scale
        weight = self.weight1(x).abs().view(len(x), self.agents, EMBEDDING)
        return self.mix(torch.einsum("nm,mne->me", values, weight), x)


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    bound = 1.0 / np.sqrt(inputs)
    for parameter in layer.parameters():
        parameter.data = (2.0 * torch.rand(parameter.shape, generator=generator) - 1.0) * bound
    return layer


class QMIX(Learner):
    """QMIX: the team's value is a monotonic mixture of its agents' (Rashid et al., ICML 2018), see :class:`Mixer`.

    The team's reward is the sum of its agents' rewards; its return ends when the first agent's does. Target: r + gamma times the
    mixture of max_b Q_i(s', b), with Q_i averaged over the past networks. The mixer for targets is a copy of the mixer, renewed
    whenever the current network joins the past ones.
    """

    joint = True

    def further(self, agents: int, scale: np.ndarray, generator: torch.Generator) -> list[nn.Parameter]:
        """Create the mixer and its copy for targets; returns the mixer's parameters."""
        self.mixer = self.make_mixer(agents, torch.from_numpy(scale), generator).to(self.config.device)
        self.target_mixer = copy.deepcopy(self.mixer).requires_grad_(False)
        return list(self.mixer.parameters())

    def make_mixer(self, agents: int, scale: Tensor, generator: torch.Generator) -> nn.Module:
        """A mixer for N agents, with initial weights drawn from ``generator``."""
        return Mixer(agents, scale, generator)

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(1, M) values of the team's actions, and their targets."""
        reward, discount = team_return(batch)
        mixed: Tensor = self.target_mixer(ahead.amax(dim=-1), self.tensor(batch.next_state))
        target = self.tensor(reward) + self.tensor(discount) * mixed
        return self.mixer(self.chosen(batch, now), self.tensor(batch.state)), target

    def push(self) -> None:
        """Add the current networks to the past ones that targets average, and copy the mixer."""
        super().push()
        self.target_mixer.load_state_dict(self.mixer.state_dict())

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of everything that training changes, by name."""
        past = {f"past_mixer{k}": p.cpu().numpy().copy() for k, p in enumerate(self.target_mixer.parameters())}
        return super().snapshot() | past

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a :meth:`snapshot`."""
        super().restore(arrays)
        for k, p in enumerate(self.target_mixer.parameters()):
            p.data.copy_(torch.from_numpy(arrays[f"past_mixer{k}"]))


class Central(Learner):
    """One dueling network whose actions are the A^N joint actions in C order, with double Q-learning (van Hasselt et al. 2016).

    Target: r + gamma Q(s', argmax_b Q(s', b)), with the argmax from the current network and its value from the averaged past
    ones. The team's reward and the end of its return are as in :class:`QMIX`.
    """

    joint = True

    def __init__(
        self,
        config: TrainConfig,
        agents: int,
        actions: int,
        scale: np.ndarray,
        generator: torch.Generator,
        mask: np.ndarray | None = None,
    ) -> None:
        self.each = (actions,) * agents
        super().__init__(config, agents, actions, scale, generator, mask)

    def shape(self, agents: int, actions: int) -> tuple[int, int]:
        """One network with A^N values."""
        return 1, actions**agents

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(1, M) values of the joint actions, and their targets."""
        reward, discount = team_return(batch)
        best = self.network(self.tensor(batch.next_state)).detach().argmax(dim=-1, keepdim=True)
        target = self.tensor(reward) + self.tensor(discount) * ahead.gather(-1, best).squeeze(-1)
        joint = np.ravel_multi_index(tuple(batch.action.T), self.each)
        return self.chosen(batch._replace(action=joint[:, None]), now), target


class RLMS(Learner):
    """Independent single-agent mission supervisors (Huang, Mei, Zhang 2020): own state, own prioritised replay, RMSProp."""

    own_state = True
    prioritised = True

    def make_optimiser(self) -> torch.optim.Optimizer:
        """The optimiser for ``parameters``: RMSProp."""
        return torch.optim.RMSprop(self.parameters, lr=self.config.learning_rate)


LEARNERS: dict[str, type[Learner]] = {
    "marlms": Learner,
    "hysteretic": Learner,
    "iql": Learner,
    "vdn": VDN,
    "qmix": QMIX,
    "central": Central,
    "rlms": RLMS,
}
"""Learner class by method."""


def learner_class(method: str) -> type[Learner]:
    """The learner class of a method.

    Raises:
        ConfigurationError: there is no method of that name.
    """
    if method not in LEARNERS:
        raise unknown("method", method, LEARNERS)
    return LEARNERS[method]


def team_return(batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """The team's rewards (1, M), summed over agents, and its bootstrap discounts (1, M), 0 once an agent's return has ended."""
    return batch.reward.sum(axis=1)[None], batch.discount.min(axis=1)[None]


def own_entries(state: State, agents: int) -> np.ndarray:
    """(N, S) float32, 1 for the entries of a state that describe agent i, else 0. G describes the team and belongs to no agent.

    Slot errors in the extended state are relative to the measured centroid, so agent i's entries still depend on the others.

    Args:
        state: the kind of state.
        agents: N.
    """
    mask = np.zeros((agents, state.size), dtype=np.float32)
    published = isinstance(state, PublishedState)
    width = 4 if published else (state.size - TEAM_ENTRIES) // agents
    for i in range(agents):
        mask[i, i * width : (i + 1) * width] = 1.0
        if published:  # commands come after all positions and velocities
            mask[i, agents * width + i] = 1.0
    return mask
