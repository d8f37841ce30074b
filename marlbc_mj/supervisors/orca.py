"""ORCA, optimal reciprocal collision avoidance (van den Berg, Guy, Lin & Manocha 2011), on the formation's velocity.

Two bodies of combined radius r at relative position x collide within the horizon tau if their relative velocity lies in a
truncated cone. Let u be the smallest change that takes it out of the cone. Each of two agents takes half of u, so its velocities
are restricted to the half-plane

    n^T (v - v_now - u/2) >= 0,   n the outward normal of the cone at that point.

With an obstacle, the agent takes all of u. The new velocity is the one nearest to v_c in all half-planes. If these contradict
each other, the greatest violation is minimized, that of obstacles first. There is no composition and there are no switches: the
label is always that of the behavior of v_c. So ORCA avoids, and waits where the way is closed; it never forms a column.

The combined radius r is d_AA for two agents, and d_OA plus the obstacle's radius for an agent and an obstacle, each plus a margin
for the tracking error.
"""

from dataclasses import dataclass

import numpy as np

from marlbc_mj.core.halfplanes import closest
from marlbc_mj.core.laws import allocation_free, compiled
from marlbc_mj.engine.observation import Observation
from marlbc_mj.supervisors.base import Blend
from marlbc_mj.supervisors.bodies import Cruise, Cruising, give, relative, wish_of
from marlbc_mj.util.errors import ConfigurationError


@dataclass(frozen=True)
class ORCA(Cruising):
    """Reciprocal velocity obstacles on the velocity of ``motion``; see the module.

    Raises:
        ConfigurationError: a horizon that is not positive.
    """

    motion: str = "FM"
    horizon: float = 2.0  # tau [s]
    margin: float = 0.1  # added to both distances [m]
    speed: float = 6.0  # upper bound of speeds [m/s]
    sight: float = 15.0  # a body more than this beyond its wanted distance is ignored [m]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.horizon) and self.horizon > 0):
            raise ConfigurationError(f"ORCA horizon must be positive and finite, got {self.horizon}")

    def decide(self, observation: Observation, memory: Cruise) -> tuple[Blend, Cruise]:
        """One velocity per agent."""
        wish = wish_of(observation, memory)
        velocity = np.empty_like(wish.wanted)
        _avoid(wish, memory.bodies, self.horizon, velocity)
        return give(velocity, memory)


@allocation_free
def orca_plane(between, radius, v, share, times, plane):
    """The half-plane n^T v >= c of velocities that one body permits, written to ``plane`` as n, c.

    Args:
        between: (2, 2) position x [m] and velocity [m/s] of the body relative to the agent.
        radius: combined radius r [m].
        v: (2,) current velocity of the agent [m/s].
        share: share of the change u that the agent takes, 1/2 or 1.
        times: tau, and the time within which overlapping bodies should separate [s].
        plane: (3 or more,), written in place.
    """
    x, y = between[0, 0], between[0, 1]
    square = x * x + y * y
    inside = square <= radius * radius
    time = times[1] if inside else times[0]
    w_x, w_y = -between[1, 0] - x / time, -between[1, 1] - y / time  # relative to the center of the truncating disc
    length = np.sqrt(w_x * w_x + w_y * w_y)
    back = w_x * x + w_y * y
    if inside or (back < 0.0 and back * back > radius * radius * length * length):
        if length > 0.0:
            n_x, n_y = w_x / length, w_y / length
        else:
            n_x, n_y = -1.0, 0.0
        gap = radius / time - length
    else:
        leg, side = np.sqrt(square - radius * radius), 1.0 if x * w_y - y * w_x > 0.0 else -1.0
        n_x, n_y = (-x * radius - side * y * leg) / square, (-y * radius + side * x * leg) / square
        gap = n_x * between[1, 0] + n_y * between[1, 1]
    plane[0], plane[1] = n_x, n_y
    plane[2] = n_x * v[0] + n_y * v[1] + share * gap


@compiled
def _avoid(wish, bodies, horizon, out):
    """Write the new velocities (B, N, 2) [m/s] of all agents of all teams to ``out``."""
    agents, obstacles = wish.at.shape[1], wish.obstacles.shape[1]
    planes = np.empty((2 * (agents + obstacles), 4))  # rows: normal, offset, level
    between, still, times = np.empty((2, 2)), np.zeros(2), (horizon, bodies.step)
    for b in range(wish.at.shape[0]):
        for i in range(agents):
            p, v, count = wish.at[b, i], wish.velocity[b, i], 0
            for k in range(obstacles):
                body = wish.obstacles[b, k]
                radius = body[2] + bodies.obstacles
                moves = body[3:5] if wish.obstacles.shape[2] > 3 else still
                if relative(p, v, body, moves, between) - radius < bodies.sight:
                    orca_plane(between, radius, v, 1.0, times, planes[count])
                    planes[count, 3] = 0.0
                    count += 1
            for j in range(agents):
                if j != i and relative(p, v, wish.at[b, j], wish.velocity[b, j], between) - bodies.agents < bodies.sight:
                    orca_plane(between, bodies.agents, v, 0.5, times, planes[count])
                    planes[count, 3] = 1.0
                    count += 1
            closest(wish.wanted[b, i], bodies.speed, planes, count, out[b, i])
