"""Leniency (16): temperatures of hashed states that cool as they are visited, and what may be overlooked while they are warm."""

import numpy as np

from marlbc_mj.core.laws import compiled

KAPPA = 2.0
"""Leniency moderation: L = 1 - exp(-KAPPA T)."""
RHO = -0.01
DECAY = 0.95
ZETA = 0.999
"""Printed constants of (16) and of the exploration."""


class Temperatures:
    """Tables T_i[code][action] of N agents (Palmer et al. 2018), and the largest temperature nu, which decays.

    Args:
        agents: N.
        codes: number of hash codes.
        actions: A.
    """

    def __init__(self, agents: int, codes: int, actions: int) -> None:
        self.table = np.full((agents, codes, actions), np.inf, dtype=np.float32)  # inf: not seen, read as nu
        self.nu = 1.0

    def read(self, codes: np.ndarray) -> np.ndarray:
        """(B, N, A) temperatures of states with ``codes`` (B,)."""
        values = self.table[:, codes].transpose(1, 0, 2)
        return np.where(np.isinf(values), np.float32(self.nu), values)

    def cool(self, codes: np.ndarray, actions: np.ndarray, world: int, first: int, last: int) -> None:
        """Walk one ended episode backwards: T <- min(exp(RHO DECAY^m) T, nu), m = 0 at its last decision.

        Args:
            codes: (T, B) ring of hash codes, one row a decision.
            actions: (T, B, N) ring of actions.
            world: the episode's.
            first, last: its first and last decision, counted from the start of the run; rows are these modulo T.
        """
        _cool(self.table, self.nu, codes, actions, world, first, last)


@compiled
def _cool(table, nu, codes, actions, world, first, last):
    rows = codes.shape[0]
    factor = RHO
    for k in range(last, first - 1, -1):
        row = k % rows
        beta = np.exp(factor)
        factor *= DECAY
        for i in range(table.shape[0]):
            t = table[i, codes[row, world], actions[row, world, i]]
            if np.isinf(t):
                t = nu
            table[i, codes[row, world], actions[row, world, i]] = min(beta * t, nu)


def leniency(temperature: np.ndarray) -> np.ndarray:
    """L = 1 - exp(-KAPPA T) (16): the share of negative TD errors that is overlooked."""
    return -np.expm1(-KAPPA * temperature)
