"""Leniency (16): temperatures of hashed states, which cool with every visit, and the share of negative TD errors that is
ignored at a given temperature.
"""

import numpy as np

from marlbc_mj.core.laws import compiled

KAPPA = 2.0
"""Leniency moderation: L = 1 - exp(-KAPPA T)."""
RHO = -0.01
"""Published exponent of the cooling factor at the last decision of an episode (16)."""
DECAY = 0.95
"""Published factor of that exponent per decision, from the last decision back to the first (16)."""
ZETA = 0.999
"""Published exponent of the exploration rate T^ZETA."""


class Temperatures:
    """Tables ``T_i[code][action]`` of N agents (Palmer et al. 2018), and the largest temperature nu, which the trainer lowers.

    Args:
        agents: N.
        codes: number of hash codes.
        actions: A, number of actions.
    """

    def __init__(self, agents: int, codes: int, actions: int) -> None:
        self.table = np.full((agents, codes, actions), np.inf, dtype=np.float32)  # inf: not visited yet, counts as nu
        self.nu = 1.0

    def read(self, codes: np.ndarray) -> np.ndarray:
        """(B, N, A) temperatures of the states with hash codes ``codes`` (B,)."""
        values = self.table[:, codes].transpose(1, 0, 2)
        return np.where(np.isinf(values), np.float32(self.nu), values)

    def cool(self, codes: np.ndarray, actions: np.ndarray, world: int, first: int, last: int) -> None:
        """Cool the entries that a finished episode visited: T <- min(exp(RHO DECAY^m) T, nu), m decisions before its last.

        Args:
            codes: (T, B) ring of hash codes, one row per decision.
            actions: (T, B, N) ring of actions.
            world: index of the world that the episode ran in.
            first: first decision of the episode, counted from the start of the run; its row is ``first`` modulo T.
            last: last decision of the episode, likewise.
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
    """L = 1 - exp(-KAPPA T) (16): the share of negative TD errors that is ignored."""
    return -np.expm1(-KAPPA * temperature)
