"""Exploration with rate T^zeta per agent; a random order can be held for several decisions and shared by the team."""

import numpy as np

from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.leniency import ZETA

BEGINNING = -1
"""Value of ``Exploration.left`` where an episode has just begun."""


class Exploration:
    """Replaces a share T^zeta of the greedy actions by random ones; as published with ``hold=1, together=0``.

    Each agent explores with random orders of its own, and the team with joint ones. Joint orders take precedence: while an agent
    follows one, its own random order is paused. Each kind is in force for a given share of the decisions, see :meth:`_hold`,
    independently of the others. So an agent's actions are random in exactly the share T^zeta of all decisions, from the first of
    an episode to the last, for any ``hold`` and ``together``. :meth:`begin` and agreement raise that share; it is lower for an
    agent to which a joint order is not allowed.

    Args:
        config: configuration of the run; only hold, together, agreement and least_exploration are used.
        agents: N.
        actions: A, number of actions.
    """

    def __init__(self, config: TrainConfig, agents: int, actions: int) -> None:
        self.config = config
        self.actions = actions
        shape = config.worlds, agents + 1  # one column per agent, the team's last
        self.left = np.full(shape, BEGINNING, dtype=np.int64)  # decisions left of the held order
        self.held = np.zeros(shape, dtype=np.int64)
        lengths = np.arange(config.hold, 0, -1.0)
        self.rest = lengths / lengths.sum()  # probabilities of 1, 2, ... decisions left in a held order

    def __call__(
        self,
        greedy: np.ndarray,
        temperature: np.ndarray,
        rng: np.random.Generator,
        *,
        last: np.ndarray | None = None,
        allowed: np.ndarray | None = None,
    ) -> np.ndarray:
        """The actions (B, N) to take.

        Args:
            greedy: (B, N) greedy actions.
            temperature: (B, N) each agent's mean temperature.
            rng: random generator for all draws.
            last: (B, N) actions in force, needed for ``agreement``; without them there is none.
            allowed: (B, N, A) bool; all actions by default. An agent does not follow a joint order that is not allowed for it.
                Otherwise the team's gain from endangering one member would make the order look good to the others.
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
        """Where greedy actions differ and one would switch, let all agents take one member's with probability ``agreement``."""
        if not self.config.agreement:
            return greedy
        torn = (greedy != greedy[:, :1]).any(axis=1) & (greedy != last).any(axis=1)
        agree = torn & (rng.random(len(greedy)) < self.config.agreement)
        order = greedy[np.arange(len(greedy)), rng.integers(greedy.shape[1], size=len(greedy))]
        return np.where(agree[:, None] & _permits(allowed, order), order[:, None], greedy)

    def _share(self, temperature: np.ndarray) -> np.ndarray:
        """(B, N) shares of random actions: T^ZETA, at least ``least_exploration``."""
        return np.asarray(np.maximum(temperature**ZETA, self.config.least_exploration))

    def _hold(self, columns: slice, share: np.ndarray, runs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Bool: where a held random order is in force at this decision. Paused columns do not change.

        An order lasts m = (hold + 1) / 2 decisions on average. If a free decision begins one with probability
        s / (s + m (1 - s)), random orders are in force in the share s of all decisions. The start of an episode is a point in the
        middle of this process: with probability s an order is already in force, and the rest of its length remains.

        Args:
            columns: columns of ``left`` and ``held`` to use, those of the agents or that of the team.
            share: s of each column.
            runs: bool, whether a column runs; otherwise it is paused.
            rng: random generator for all draws.
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
        """Make whole teams take one order for 1 to ``hold`` decisions.

        Args:
            orders: (B,) the orders; -1 leaves a team as it is.
            rng: random generator for the lengths.
        """
        teams = orders >= 0
        self.held[teams, -1] = orders[teams]
        self.left[teams, -1] = rng.integers(1, self.config.hold + 1, size=int(teams.sum()))

    def forget(self, ended: np.ndarray) -> None:
        """Drop the held orders of the worlds in which an episode ``ended`` (B,)."""
        self.left[ended] = BEGINNING


def _permits(allowed: np.ndarray | None, order: np.ndarray) -> np.ndarray | bool:
    """(B, N) bool: the agents for which their team's ``order`` (B,) is allowed."""
    return True if allowed is None else np.asarray(allowed[np.arange(len(order)), :, order])


def shares(share: np.ndarray, together: float) -> tuple[np.ndarray, np.ndarray]:
    """Share of decisions with joint exploration (B,), and each agent's share of own exploration in the others (B, N).

    j = min(together mean_i s_i, min_i s_i), so that no agent exceeds its share s_i, and s_i = j + (1 - j) alone_i.

    Args:
        share: (B, N) s, each agent's share of random actions.
        together: intended share of explorations that are joint.
    """
    joint = np.minimum(together * share.mean(axis=1), share.min(axis=1))
    rest = 1.0 - joint[:, None]
    alone = np.divide(share - joint[:, None], rest, out=np.zeros_like(share), where=rest > 0)
    return joint, np.clip(alone, 0.0, 1.0)
