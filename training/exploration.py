"""Exploration by temperature, T^zeta per agent; random orders may be held for a while and shared by the team or a part of it."""

import numpy as np

from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.leniency import ZETA


class Exploration:
    """Replaces a share T^zeta of the greedy actions by random ones. With ``hold=1, together=0`` it does so as printed.

    Args:
        config: hold, together, subsets and least_exploration of it are used.
        agents: N.
        actions: A.
    """

    def __init__(self, config: TrainConfig, agents: int, actions: int) -> None:
        self.config = config
        self.actions = actions
        self.left = np.zeros((config.worlds, agents), dtype=np.int64)  # decisions that a held order still lasts
        self.held = np.zeros((config.worlds, agents), dtype=np.int64)

    def __call__(self, greedy: np.ndarray, temperature: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(B, N) actions from greedy ones (B, N) and each agent's mean temperature (B, N)."""
        config = self.config
        share = np.maximum(temperature**ZETA, config.least_exploration)
        mean_hold = (config.hold + 1) / 2
        chance = share / (share + mean_hold * (1.0 - share))  # of a beginning, such that ``share`` of all orders are random
        free = self.left == 0
        team = (rng.random(len(chance)) < config.together * chance.mean(axis=1)) & free.all(axis=1)
        alone = (rng.random(chance.shape) < (1.0 - config.together) * chance) & free
        some = (rng.random(len(chance)) < config.subsets)[:, None] & (rng.random(chance.shape) < 0.5)
        begin = (team[:, None] & ~some) | alone
        one = np.broadcast_to(rng.integers(self.actions, size=(len(chance), 1)), chance.shape)
        order = np.where(team[:, None], one, rng.integers(self.actions, size=chance.shape))
        one = np.broadcast_to(rng.integers(1, config.hold + 1, size=(len(chance), 1)), chance.shape)
        length = np.where(team[:, None], one, rng.integers(1, config.hold + 1, size=chance.shape))
        self.held = np.where(begin, order, self.held)
        self.left = np.where(begin, length, self.left)
        chosen = np.where(self.left > 0, self.held, greedy)
        self.left = np.maximum(self.left - 1, 0)
        return np.asarray(chosen)

    def begin(self, orders: np.ndarray, rng: np.random.Generator) -> None:
        """Have whole teams take one order for 1 to ``hold`` decisions; ``orders`` (B,), -1 for teams that go on as they are."""
        teams = orders >= 0
        self.held[teams] = orders[teams, None]
        self.left[teams] = rng.integers(1, self.config.hold + 1, size=(int(teams.sum()), 1))

    def forget(self, ended: np.ndarray) -> None:
        """Drop held orders of worlds whose episode ended; ``ended`` (B,)."""
        self.left[ended] = 0
