"""Replay buffer that stores the decisions of B worlds in order of time and draws n-step transitions."""

from typing import NamedTuple

import numpy as np


class Batch(NamedTuple):
    """M transitions over up to n decisions each; from a prioritised replay, M for each agent."""

    state: np.ndarray  # (M, S), or (N, M, S) if each agent has its own
    action: np.ndarray  # (M, N)
    reward: np.ndarray  # (M, N) discounted sum of up to n rewards
    discount: np.ndarray  # (M, N) discount of the bootstrap: gamma^n, or 0 where the agent's return ended
    next_state: np.ndarray  # (M, S) or (N, M, S) state to bootstrap from
    leniency: np.ndarray  # (M, N) leniency L of (16)
    weight: np.ndarray | None = None  # (M, N) importance weights of the TD errors; 1 by default
    place: np.ndarray | None = None  # (M, N) first decision of each transition in the buffer: row times B plus world
    lost: np.ndarray | None = None  # (M, N) bool, whether the agent came too close in the first decision
    team: np.ndarray | None = None  # (M,) index of the team that each transition belongs to, if whole teams are drawn


class Replay:
    """A ring buffer in which a row is one decision of all B worlds. All arrays are public, as a resumed run needs them.

    Args:
        rows: number of decisions kept.
        worlds: B.
        agents: N.
        state: S, the size of a state.
    """

    def __init__(self, rows: int, worlds: int, agents: int, state: int) -> None:
        self.rows = rows
        self.count = 0  # rows written since the start of the run
        self.arrays: dict[str, np.ndarray] = {
            "state": np.zeros((rows, worlds, state), dtype=np.float32),
            "final": np.zeros((rows, worlds, state), dtype=np.float32),  # the true successor, before any restart
            "action": np.zeros((rows, worlds, agents), dtype=np.int64),
            "reward": np.zeros((rows, worlds, agents), dtype=np.float32),
            "leniency": np.zeros((rows, worlds, agents), dtype=np.float32),
            "lost": np.zeros((rows, worlds, agents), dtype=bool),
            "code": np.zeros((rows, worlds), dtype=np.int64),
            "ended": np.zeros((rows, worlds), dtype=bool),
            "terminal": np.zeros((rows, worlds, agents), dtype=bool),
        }

    def store(self, **row: np.ndarray) -> None:
        """Write one row; the keywords are the names of ``arrays``."""
        for name, array in self.arrays.items():
            array[self.count % self.rows] = row[name]
        self.count += 1

    def sample(self, size: int, steps: int, gamma: float, rng: np.random.Generator, share: float = 0.0) -> Batch:
        """Draw ``size`` transitions uniformly.

        Args:
            size: M, the number of transitions.
            steps: number of decisions whose rewards are summed; fewer where an episode ended.
            gamma: discount factor per decision.
            rng: random generator for the draws.
            share: share of the budget spent so far; only prioritised replays use it.
        """
        first = self.draw_rows(size, steps, rng)
        world = rng.integers(self.arrays["ended"].shape[1], size=size)
        return self.gather(first, world, steps, gamma)

    def draw_rows(self, size: int, steps: int, rng: np.random.Generator) -> np.ndarray:
        """Draw (M,) rows, counted from the start of the run, at which transitions over ``steps`` decisions can begin."""
        return rng.integers(max(0, self.count - self.rows), self.count - steps + 1, size=size)

    def learnt(self, batch: Batch, errors: np.ndarray) -> None:
        """Receive the absolute TD errors (K, M) of an update with ``batch``; only a prioritised replay uses them."""

    def gather(self, first: np.ndarray, world: np.ndarray, steps: int, gamma: float) -> Batch:
        """The transitions that begin at the given decisions.

        Args:
            first: (M,) rows of the first decisions, counted from the start of the run.
            world: (M,) indices of their worlds.
            steps: number of decisions whose rewards are summed; fewer where an episode ended.
            gamma: discount factor per decision.
        """
        a, size = self.arrays, len(first)
        row = first % self.rows
        reward = np.zeros((size, a["reward"].shape[2]), dtype=np.float32)
        discount = np.ones_like(reward)
        running = np.ones(reward.shape, dtype=bool)  # the agent's return has not ended
        alive = np.ones(size, dtype=bool)  # the episode has not ended
        last = row
        for k in range(steps):
            now = (first + k) % self.rows
            counts = running & alive[:, None]
            reward += np.where(counts, discount * a["reward"][now, world], np.float32(0.0))
            discount = np.where(counts, np.float32(gamma) * discount, discount)
            running &= ~(counts & a["terminal"][now, world])
            last = np.where(alive, now, last)
            alive &= ~a["ended"][now, world]
        return Batch(
            a["state"][row, world],
            a["action"][row, world],
            reward,
            np.where(running, discount, np.float32(0.0)),
            a["final"][last, world],
            a["leniency"][row, world],
            lost=a["lost"][row, world],
        )
