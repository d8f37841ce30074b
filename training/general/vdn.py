"""Value decomposition for teams of any size: the rival of the general policy whose one error is that of a whole team."""

import numpy as np
import torch
from torch import Tensor

from marlbc_mj.training.learner import Learner
from marlbc_mj.training.replay import Batch, Replay


class TeamValues(Learner):
    """VDN (Sunehag et al., AAMAS 2018) with one network for all agents of all teams, each of its own size.

    The team's value is the mean of its agents', so that large teams do not outweigh small ones; so are reward and target.
    """

    joint = True

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(1, K) values of the actions of K teams and their targets; ``batch`` has their agents one after the other."""
        chosen, target = super().estimates(batch, now, ahead)
        assert batch.team is not None
        team = torch.from_numpy(batch.team).to(chosen.device)
        count = torch.bincount(team).to(chosen.dtype)
        sums = (torch.zeros((1, len(count)), device=chosen.device).index_add(1, team, each) for each in (chosen, target))
        first, second = (each / count for each in sums)
        return first, second


class TeamReplay(Replay):
    """A ring of rows whose draws are whole teams: decisions of all agents of one team at one time.

    Args:
        rows: decisions kept.
        sizes: (T,) agents of each team, in the order of their columns.
        state: S, size of an agent's inputs.
    """

    def __init__(self, rows: int, sizes: np.ndarray, state: int) -> None:
        super().__init__(rows, int(sizes.sum()), 1, state)
        self.sizes = sizes
        self.begins = np.cumsum(sizes) - sizes  # (T,) first column of each

    def sample(self, size: int, steps: int, gamma: float, rng: np.random.Generator, share: float = 0.0) -> Batch:
        """Draw teams with ``size`` agents in the mean; see :meth:`Replay.sample`."""
        teams = max(1, round(size / self.sizes.mean()))
        drawn, first = rng.integers(len(self.sizes), size=teams), self.draw_rows(teams, steps, rng)
        sizes = self.sizes[drawn]
        team = np.repeat(np.arange(teams), sizes)
        within = np.arange(len(team)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return self.gather(first[team], self.begins[drawn][team] + within, steps, gamma)._replace(team=team)
