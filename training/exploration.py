"""Exploration by temperature, T^zeta per agent; random orders may be held for a while and shared by the team or a part of it."""

import numpy as np

from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.leniency import ZETA

BEGINNING = -1
"""Decisions left of an order, where an episode has just begun."""


class Exploration:
    """Replaces a share T^zeta of the greedy actions by random ones. With ``hold=1, together=0`` it does so as printed.

    Every agent has random orders of its own, and the team has joint ones, which go before: while an agent takes part in a joint
    exploration its own stands still. Each of these is busy for a share of the decisions, see :meth:`_hold`, independently of
    the others, so that an agent's actions are random in exactly the share T^zeta of all decisions, the first of an episode as
    well as the last, for any ``hold``, ``together`` and ``subsets``. An agent that stays out of a joint exploration
    acts as if there were none.

    Args:
        config: hold, together, subsets and least_exploration of it are used.
        agents: N.
        actions: A.
    """

    def __init__(self, config: TrainConfig, agents: int, actions: int) -> None:
        self.config = config
        self.actions = actions
        shape = config.worlds, agents + 1  # one column an agent, the team's last
        self.left = np.full(shape, BEGINNING, dtype=np.int64)  # decisions that a held order still lasts
        self.held = np.zeros(shape, dtype=np.int64)
        self.joins = np.ones((config.worlds, agents), dtype=bool)  # who takes part in the joint exploration
        lengths = np.arange(config.hold, 0, -1.0)
        self.rest = lengths / lengths.sum()  # chance that 1, 2, ... decisions are left of an order under way

    def __call__(self, greedy: np.ndarray, temperature: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(B, N) actions from greedy ones (B, N) and each agent's mean temperature (B, N)."""
        joint, alone = shares(self._share(temperature), self.config.together, self.config.subsets)
        inside = np.zeros(greedy.shape, dtype=bool)
        if self.config.together or (self.left[:, -1] > 0).any():
            everybody = np.ones((len(greedy), 1), dtype=bool)
            busy, begun = self._hold(slice(-1, None), joint[:, None], everybody, rng)
            if self.config.subsets:
                some = (rng.random(len(greedy)) < self.config.subsets)[:, None] & (rng.random(greedy.shape) < 0.5)
                self.joins = np.where(begun, ~some, self.joins)
            inside = busy & self.joins
        busy, _ = self._hold(slice(-1), alone, ~inside, rng)
        return np.where(inside, self.held[:, -1:], np.where(busy, self.held[:, :-1], greedy))

    def _share(self, temperature: np.ndarray) -> np.ndarray:
        return np.asarray(np.maximum(temperature**ZETA, self.config.least_exploration))

    def _hold(
        self, columns: slice, share: np.ndarray, runs: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bool: where a held order is in force, and where it has just begun; columns of those that do not ``run`` stand still.

        Orders last m = (hold + 1) / 2 decisions on average, so that one that begins in a free decision with probability
        s / (s + m (1 - s)) is in force in the share s of all decisions. An episode begins amid that: with probability s an order
        is under way, with the rest of its length left.
        """
        hold, shape = self.config.hold, share.shape
        first = self.left[:, columns] == BEGINNING
        chance = np.where(first, share, share / (share + (hold + 1) / 2 * (1.0 - share)))
        begun = runs & (self.left[:, columns] <= 0) & (rng.random(shape) < chance)
        length = np.where(first, 1 + rng.choice(hold, size=shape, p=self.rest), rng.integers(1, hold + 1, size=shape))
        self.held[:, columns] = np.where(begun, rng.integers(self.actions, size=shape), self.held[:, columns])
        left = np.where(begun, length, np.where(runs, np.maximum(self.left[:, columns], 0), self.left[:, columns]))
        busy = runs & (left > 0)
        self.left[:, columns] = left - busy
        return busy, begun

    def begin(self, orders: np.ndarray, rng: np.random.Generator) -> None:
        """Have whole teams take one order for 1 to ``hold`` decisions; ``orders`` (B,), -1 for teams that go on as they are."""
        teams = orders >= 0
        self.held[teams, -1] = orders[teams]
        self.left[teams, -1] = rng.integers(1, self.config.hold + 1, size=int(teams.sum()))
        self.joins[teams] = True

    def forget(self, ended: np.ndarray) -> None:
        """Drop held orders of worlds whose episode ended; ``ended`` (B,)."""
        self.left[ended] = BEGINNING


def shares(share: np.ndarray, together: float, subsets: float) -> tuple[np.ndarray, np.ndarray]:
    """Shares of joint explorations (B,), and of agents' own (B, N) outside of these, that make up each agent's ``share`` (B, N).

    An agent takes part in p = 1 - subsets / 2 of the joint ones. j p = together * (mean share), or the smallest share where
    agents differ so much that the joint orders alone would be too many for one, and j <= 1; then s = j p + (1 - j p) alone.
    """
    taking = 1.0 - subsets / 2
    joint = np.minimum(np.minimum(together * share.mean(axis=1), share.min(axis=1)) / taking, 1.0)
    inside = (joint * taking)[:, None]
    rest = 1.0 - inside
    alone = np.divide(share - inside, rest, out=np.zeros_like(share), where=rest > 0)
    return joint, np.clip(alone, 0.0, 1.0)
