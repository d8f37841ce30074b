"""Proportional prioritised replay (Schaul et al., ICLR 2016): each agent draws the transitions that it predicts worst."""

import numpy as np

from marlbc_mj.training.replay import Batch, Replay

ALPHA = 0.6
"""Exponent of the priorities (|TD error| + LEAST_ERROR)^ALPHA."""
BETA = 0.4
"""Exponent of the importance weights at the start of the budget; it rises linearly to 1 at the end."""
LEAST_ERROR = 1e-3
"""Added to every |TD error|, so that every transition can still be drawn."""


class PrioritisedReplay(Replay):
    """A ring buffer with one priority per agent and transition, because each independent learner has its own TD errors.

    A new transition gets the agent's largest priority in the buffer, or 1 if the buffer is empty. ``arrays["priority"]``
    (rows, B, N) holds the priorities (|TD error| + LEAST_ERROR)^ALPHA.

    Args:
        rows: number of decisions kept.
        worlds: B.
        agents: N.
        state: S, the size of a state.
    """

    def __init__(self, rows: int, worlds: int, agents: int, state: int) -> None:
        super().__init__(rows, worlds, agents, state)
        self.arrays["priority"] = np.zeros((rows, worlds, agents))

    def store(self, **row: np.ndarray) -> None:
        """Write one row; the keywords are the names of ``arrays``, except ``priority``."""
        priority = self.arrays["priority"]
        largest = priority.max(axis=(0, 1)) if self.count else np.ones(priority.shape[2])
        super().store(priority=np.broadcast_to(largest, priority.shape[1:]), **row)

    def sample(self, size: int, steps: int, gamma: float, rng: np.random.Generator, share: float = 0.0) -> Batch:
        """Draw ``size`` transitions for each agent, one from each of ``size`` strata of equal probability.

        P(j) = p_j / sum p. Importance weights are (n P(j))^-beta, divided by the largest of the n transitions' weights.

        Args:
            size: M, transitions per agent.
            steps: number of decisions whose rewards are summed.
            gamma: discount factor per decision.
            rng: random generator for the draws.
            share: share of the budget spent so far; beta rises with it from ``BETA`` to 1.
        """
        priority = self.arrays["priority"]
        rows, worlds, agents = priority.shape
        allowed = np.zeros(rows, dtype=bool)
        allowed[np.arange(max(0, self.count - rows), self.count - steps + 1) % rows] = True
        chance = np.where(allowed[:, None, None], priority, 0.0).reshape(rows * worlds, agents)
        reach = chance.cumsum(axis=0)
        points = (np.arange(size)[:, None] + rng.random((size, agents))) / size * reach[-1]
        points = np.minimum(points, np.nextafter(reach[-1], 0.0))
        place = np.stack([np.searchsorted(reach[:, i], points[:, i], side="right") for i in range(agents)], axis=-1)
        beta = BETA + (1.0 - BETA) * min(share, 1.0)
        least = priority[allowed].min(axis=(0, 1))
        weight = (np.take_along_axis(chance, place, axis=0) / least) ** -beta  # n and sum p cancel
        return self._own(self.gather((place // worlds).ravel(), (place % worlds).ravel(), steps, gamma), weight, place)

    @staticmethod
    def _own(batch: Batch, weight: np.ndarray, place: np.ndarray) -> Batch:
        """The batch with each agent's part of its own transitions; in the given batch of M N, the agents' draws alternate."""
        size, agents = place.shape
        own = np.arange(agents)

        def part(array: np.ndarray) -> np.ndarray:
            return np.asarray(array.reshape(size, agents, agents)[:, own, own])

        def states(array: np.ndarray) -> np.ndarray:
            return array.reshape(size, agents, -1).transpose(1, 0, 2)

        return Batch(
            states(batch.state),
            part(batch.action),
            part(batch.reward),
            part(batch.discount),
            states(batch.next_state),
            part(batch.leniency),
            weight.astype(np.float32),
            place,
        )

    def learnt(self, batch: Batch, errors: np.ndarray) -> None:
        """Set the priorities of the drawn transitions from their absolute TD errors (N, M)."""
        priority = self.arrays["priority"]
        flat = priority.reshape(-1, priority.shape[2])  # a view
        assert batch.place is not None
        np.put_along_axis(flat, batch.place, (errors.T.astype(np.float64) + LEAST_ERROR) ** ALPHA, axis=0)
