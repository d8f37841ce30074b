"""Learners of the general policy: VDN and QMIX for teams of any size, with one error per team; imitation and distillation."""

import numpy as np
import torch
from torch import Tensor, nn

from marlbc_mj.policies.general import MOTIONS, GeneralPolicy
from marlbc_mj.training.learner import Learner
from marlbc_mj.training.networks import feed_forward, side_by_side
from marlbc_mj.training.replay import Batch, Replay
from marlbc_mj.training.rivals import QMIX, MixingLayers


def team_means(rows: Tensor, team: Tensor) -> Tensor:
    """(K, F) means of ``rows`` (M, F) over each of K teams; ``team`` (M,) is the team of each row, from 0 to K - 1."""
    count = torch.bincount(team).to(rows.dtype)
    return torch.zeros((len(count), rows.shape[1]), device=rows.device).index_add(0, team, rows) / count[:, None]


def by_motion(values: Tensor) -> Tensor:
    """(M, 2) best of the values (M, A) of the actions that take each motion, formation and column."""
    return values.reshape(-1, values.shape[-1] // len(MOTIONS), len(MOTIONS)).amax(dim=1)


class TeamVDN(Learner):
    """VDN (Sunehag et al., AAMAS 2018) with one network for all agents, for teams of any size.

    A team's value, reward and target are the means over its agents, so that large teams do not outweigh small ones. If agents
    decide by consensus, a team takes the better of its two motions next; else every agent takes its own best action.
    """

    joint = True
    consensus = True  # whether agents decide by the mean of their leads

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(1, K) values of the actions of K teams, and their targets; ``batch`` lists the agents team by team."""
        chosen = self.chosen(batch, now)
        team = _teams_of(batch, chosen)
        value = team_means(chosen.T, team).T
        if not self.consensus:
            _, target = super().estimates(batch, now, ahead)
            return value, team_means(target.T, team).T
        reward, discount = (team_means(self.tensor(each), team).T for each in (batch.reward, batch.discount))
        return value, reward + discount * team_means(by_motion(ahead[0]), team).amax(dim=-1)


class TeamMixer(MixingLayers):
    """QMIX's mixing network for any team size: w2(x) . elu(mean_i |W1(x_i)| Q_i + b1(x)) + b2(x), x the mean of inputs x_i.

    W1, which weights an agent's value, has that agent's inputs as input and is shared by all agents. The other layers have the
    team's mean as input.
    """

    def __init__(self, inputs: int, generator: torch.Generator) -> None:
        super().__init__(inputs, 1, generator)

    def forward(self, values: Tensor, inputs: Tensor, team: Tensor) -> Tensor:
        """(1, K) values of K teams from the agents' values (1, M), inputs (M, S) and teams ``team`` (M,)."""
        return self.mix(team_means(self.weight1(inputs).abs() * values.T, team), team_means(inputs, team))


class TeamQMIX(QMIX):
    """QMIX with one network for all agents and a :class:`TeamMixer`; reward and consensus as in :class:`TeamVDN`."""

    consensus = True

    def make_mixer(self, agents: int, scale: Tensor, generator: torch.Generator) -> nn.Module:
        """A mixer for any number of agents; inputs are not scaled."""
        return TeamMixer(len(scale), generator)

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(1, K) values of the actions of K teams, and their targets."""
        chosen = self.chosen(batch, now)
        team = _teams_of(batch, chosen)
        reward, discount = (team_means(self.tensor(each), team).T for each in (batch.reward, batch.discount))
        best = by_motion(ahead[0]) if self.consensus else ahead[0].amax(dim=-1, keepdim=True)
        state = self.tensor(batch.next_state)
        team_value = torch.stack([self.target_mixer(own[None], state, team) for own in best.unbind(dim=-1)]).amax(dim=0)
        return self.mixer(chosen, self.tensor(batch.state), team), reward + discount * team_value


class Imitation(Learner):
    """Pure imitation: the network's outputs are logits, and a batch's actions are the guide's, not those that were taken."""

    def loss(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """The mean cross entropy of the guide's actions, and one minus the probability of each (1, M)."""
        logits = self.network(self.tensor(batch.state))[0]
        shown = torch.from_numpy(batch.action[:, 0]).to(logits.device)
        each = nn.functional.cross_entropy(logits, shown, reduction="none")
        return each.mean(), 1.0 - torch.exp(-each.detach())[None]


LEAD_LINEAR = 0.25
"""Errors of a lead larger than this count linearly, not squared: far from a switch it need not be exact; :class:`Distilled`."""
MEAN_WEIGHT = 0.01
"""Weight of the error of the values' mean relative to the errors of the leads."""


class Distilled(Learner):
    """Policy distillation (Rusu et al., ICLR 2016): one network learns the values of a teacher, the mean of several policies, in
    the states that the network visits itself.

    The choice of an action depends on the lead of its value over the mean of all values, so the loss puts most weight on leads.
    """

    def teach(self, teacher: GeneralPolicy) -> None:
        """Set the teacher; call this before the first update."""
        network = teacher.network
        self.weights = [self.tensor(weight) for weight in network.weights]
        self.biases = [self.tensor(bias) for bias in network.biases]
        self.first_layer = side_by_side(self.weights[0], self.biases[0])

    def loss(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """The Huber loss of the leads and of the values' mean, and each state's largest error of a lead (1, M)."""
        state = self.tensor(batch.state)
        with torch.no_grad():
            wanted = self.network.split(feed_forward(self.weights, self.biases, state, self.first_layer))[0].mean(dim=0)
        found = self.network(state)[0]
        mean, wanted_mean = found.mean(dim=-1, keepdim=True), wanted.mean(dim=-1, keepdim=True)
        lead, wanted_lead = found - mean, wanted - wanted_mean
        each = nn.functional.huber_loss(lead, wanted_lead, reduction="none", delta=LEAD_LINEAR).sum(dim=-1)
        rest = nn.functional.huber_loss(mean, wanted_mean, delta=self.config.huber)
        return each.mean() + MEAN_WEIGHT * rest, (lead - wanted_lead).detach().abs().amax(dim=-1)[None]


GENERAL_RIVALS: dict[str, type[Learner]] = {
    "vdn": TeamVDN,
    "qmix": TeamQMIX,
    "imitation": Imitation,
    "distilled": Distilled,
}
"""Learner class by the setting ``learner``; for others it is :class:`~marlbc_mj.training.learner.Learner`, or that of MAPPO."""


def _teams_of(batch: Batch, like: Tensor) -> Tensor:
    """(M,) team of each transition, on the device of the tensor ``like``."""
    assert batch.team is not None
    return torch.from_numpy(batch.team).to(like.device)


class TeamReplay(Replay):
    """A ring buffer that draws whole teams: the decisions of all agents of a team at the same time.

    Args:
        rows: number of decisions kept.
        sizes: (T,) number of agents of each team, in the order of the columns.
        state: S, the size of an agent's inputs.
    """

    def __init__(self, rows: int, sizes: np.ndarray, state: int) -> None:
        super().__init__(rows, int(sizes.sum()), 1, state)
        self.sizes = sizes
        self.begins = np.cumsum(sizes) - sizes  # (T,) first column of each team

    def sample(self, size: int, steps: int, gamma: float, rng: np.random.Generator, share: float = 0.0) -> Batch:
        """Draw as many teams as have ``size`` agents on average; see :meth:`Replay.sample`."""
        teams = max(1, round(size / self.sizes.mean()))
        drawn, first = rng.integers(len(self.sizes), size=teams), self.draw_rows(teams, steps, rng)
        sizes = self.sizes[drawn]
        team = np.repeat(np.arange(teams), sizes)
        within = np.arange(len(team)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return self.gather(first[team], self.begins[drawn][team] + within, steps, gamma)._replace(team=team)
