"""What supervisors, policies and learners see of B teams at the start of a mission step."""

from typing import NamedTuple

import numpy as np

NEVER = -np.inf
"""Mission step since which a command is in force that an episode began with."""


class Observation(NamedTuple):
    """B teams of N agents among K obstacles. :meth:`team` is one of them, with the same fields and no leading axis."""

    step: np.ndarray  # (B,) int64, mission steps made since the mission's start
    time: np.ndarray  # (B,) [s]
    position: np.ndarray  # (B, N, 2) measured [m]
    velocity: np.ndarray  # (B, N, 2) measured [m/s]
    clearance: np.ndarray  # (B, N) to the nearest obstacle's surface [m]
    formation: np.ndarray  # (B,) int64, G: 2 in formation, 1 in column, 0 neither
    command: np.ndarray  # (B, N) int64, index into scenario.orders.commands of the last order; 0 before the first
    age: np.ndarray  # (B, N) how long that command has been in force [s]; infinite where the episode began with it
    reference: np.ndarray  # (B, N, 2) p_r [m], where a ``virtual`` reference has its behaviors evaluated
    obstacles: np.ndarray  # (B, K, 3) x, y, radius [m]; (B, K, 5) where they move, with their velocity [m/s]
    noise_seed: np.ndarray  # (B,) int64, drawn with the episode: seeds what is random in it besides its draw, lost messages too

    def team(self, b: int) -> "Observation":
        """Team ``b`` alone: ``position`` (N, 2), ``clearance`` (N,), ``obstacles`` (K, 3), and so on."""
        return Observation(*(field[b] for field in self))

    def state(self) -> np.ndarray:
        """The published state s = (X, Pr, G), (B, (2n+1)N+1): positions and velocities agent by agent, priorities, G."""
        joint = np.concatenate([self.position, self.velocity], axis=-1).reshape(len(self.time), -1)
        return np.concatenate([joint, self.command, self.formation[:, None]], axis=1)
