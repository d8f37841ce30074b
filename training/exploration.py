"""Exploration by temperature, T^zeta per agent; random orders may be held for a while and shared by the team."""

import numpy as np

from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.leniency import ZETA

BEGINNING = -1
"""Stands for the decisions left of a held order where an episode has just begun."""


class Exploration:
    """Replaces a share T^zeta of the greedy actions by random ones. With ``hold=1, together=0`` it does so as published.

    Every agent has random orders of its own, and the team has joint ones, which come first: while an agent takes part in a joint
    exploration, its own stands still. Each of these is in force for a share of the decisions, see :meth:`_hold`, independently
    of the others. So an agent's actions are random in exactly the share T^zeta of all decisions, the first of an episode as well
    as the last, for any ``hold`` and ``together``. :meth:`begin` and agreement add to that share; an agent to which the joint
    order is not allowed has less.

    Args:
        config: its hold, together, agreement and least_exploration are used.
        agents: N.
        actions: A, number of actions.
    """

    def __init__(self, config: TrainConfig, agents: int, actions: int) -> None:
        self.config = config
        self.actions = actions
        shape = config.worlds, agents + 1  # one column per agent, the team's last
        self.left = np.full(shape, BEGINNING, dtype=np.int64)  # decisions that a held order still lasts
        self.held = np.zeros(shape, dtype=np.int64)
        lengths = np.arange(config.hold, 0, -1.0)
        self.rest = lengths / lengths.sum()  # chance that 1, 2, ... decisions are left of an order under way

    def __call__(
        self,
        greedy: np.ndarray,
        temperature: np.ndarray,
        rng: np.random.Generator,
        *,
        last: np.ndarray | None = None,
        allowed: np.ndarray | None = None,
    ) -> np.ndarray:
        """(B, N) actions.

        Args:
            greedy: (B, N) the best actions.
            temperature: (B, N) each agent's mean temperature.
            rng: random numbers of all draws.
            last: (B, N) actions in force, by which a disagreement is told; without them there is none.
            allowed: (B, N, A) bool. An agent stays out of what the team does jointly while the order is not allowed for it:
                otherwise the team's gain from endangering a member would make the order look good to the others.
        """
        greedy = greedy if last is None else self._agree(greedy, last, allowed, rng)
        joint, alone = shares(self._share(temperature), self.config.together)
        inside = np.zeros(greedy.shape, dtype=bool)
        if self.config.together or (self.left[:, -1] > 0).any():
            everybody = np.ones((len(greedy), 1), dtype=bool)
            inside = np.repeat(self._hold(slice(-1, None), joint[:, None], everybody, rng), greedy.shape[1], axis=1)
            inside &= _permits(allowed, self.held[:, -1])
        busy = self._hold(slice(-1), alone, ~inside, rng)
        return np.where(inside, self.held[:, -1:], np.where(busy, self.held[:, :-1], greedy))

    def _agree(self, greedy: np.ndarray, last: np.ndarray, allowed: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
        """Where an agent wants to change its order and not all want the same, all may take one member's order instead."""
        if not self.config.agreement:
            return greedy
        torn = (greedy != greedy[:, :1]).any(axis=1) & (greedy != last).any(axis=1)
        agree = torn & (rng.random(len(greedy)) < self.config.agreement)
        order = greedy[np.arange(len(greedy)), rng.integers(greedy.shape[1], size=len(greedy))]
        return np.where(agree[:, None] & _permits(allowed, order), order[:, None], greedy)

    def _share(self, temperature: np.ndarray) -> np.ndarray:
        """(B, N) shares of random actions, T^ZETA."""
        return np.asarray(np.maximum(temperature**ZETA, self.config.least_exploration))

    def _hold(self, columns: slice, share: np.ndarray, runs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Bool: where a held order is in force. Columns that do not run stand still.

        Orders last m = (hold + 1) / 2 decisions on average. One that begins in a free decision with probability
        s / (s + m (1 - s)) is therefore in force in the share s of all decisions. An episode begins in the middle of that: with
        probability s an order is under way, with the rest of its length left.

        Args:
            columns: the columns of ``left`` and ``held`` that are meant, the agents' or the team's.
            share: s of each column.
            runs: bool, whether a column runs.
            rng: random numbers of the draws.
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
        return np.asarray(busy)

    def begin(self, orders: np.ndarray, rng: np.random.Generator) -> None:
        """Have whole teams take one order for 1 to ``hold`` decisions.

        Args:
            orders: (B,) the orders, -1 for teams that go on as they are.
            rng: random numbers of the lengths.
        """
        teams = orders >= 0
        self.held[teams, -1] = orders[teams]
        self.left[teams, -1] = rng.integers(1, self.config.hold + 1, size=int(teams.sum()))

    def forget(self, ended: np.ndarray) -> None:
        """Drop the held orders of worlds whose episode ``ended`` (B,)."""
        self.left[ended] = BEGINNING


def _permits(allowed: np.ndarray | None, order: np.ndarray) -> np.ndarray | bool:
    """(B, N) bool: the agents to which each team's ``order`` (B,) is allowed."""
    return True if allowed is None else np.asarray(allowed[np.arange(len(order)), :, order])


def shares(share: np.ndarray, together: float) -> tuple[np.ndarray, np.ndarray]:
    """Shares of joint explorations (B,), and of the agents' own outside of these (B, N), that make up each agent's share.

    j = min(together mean_i s_i, min_i s_i), so that no agent explores more than its share, and s_i = j + (1 - j) alone_i.

    Args:
        share: (B, N) s, share of random actions of each agent.
        together: wanted share of the explorations that are joint.
    """
    joint = np.minimum(together * share.mean(axis=1), share.min(axis=1))
    rest = 1.0 - joint[:, None]
    alone = np.divide(share - joint[:, None], rest, out=np.zeros_like(share), where=rest > 0)
    return joint, np.clip(alone, 0.0, 1.0)
