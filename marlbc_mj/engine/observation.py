"""What supervisors, policies and learners see of B teams at the start of a mission step."""

from typing import NamedTuple

import numpy as np

NEVER = -np.inf
"""Value of ``Team.since`` for a command with which the episode began."""


class Observation(NamedTuple):
    """Observation of B teams of N agents among K obstacles. :meth:`team` gives that of one team, without the leading axis."""

    step: np.ndarray  # (B,) int64, number of mission steps since the start of the mission
    time: np.ndarray  # (B,) [s]
    position: np.ndarray  # (B, N, 2) measured [m]
    velocity: np.ndarray  # (B, N, 2) measured [m/s]
    clearance: np.ndarray  # (B, N) to the nearest obstacle's surface [m]
    formation: np.ndarray  # (B,) int64, G: 2 in formation, 1 in column, 0 neither
    command: np.ndarray  # (B, N) int64, index into scenario.orders.commands of the last order; 0 before the first
    age: np.ndarray  # (B, N) time for which that command has been in force [s]; infinite if the episode began with it
    reference: np.ndarray  # (B, N, 2) p_r [m], at which behaviors are evaluated if the reference is ``virtual``
    obstacles: np.ndarray  # (B, K, 3) x, y, radius [m]; (B, K, 5) with their velocity [m/s] if they move
    noise_seed: np.ndarray  # (B,) int64, drawn with the episode; seeds all that is random after the draw, including lost messages

    def team(self, b: int) -> "Observation":
        """The observation of team ``b``: ``position`` (N, 2), ``clearance`` (N,), ``obstacles`` (K, 3), and so on."""
        return Observation(*(field[b] for field in self))

    def state(self) -> np.ndarray:
        """The published state s = (X, Pr, G), (B, (2n+1)N+1): positions and velocities agent by agent, priorities, G."""
        joint = np.concatenate([self.position, self.velocity], axis=-1).reshape(len(self.time), -1)
        return np.concatenate([joint, self.command, self.formation[:, None]], axis=1)
