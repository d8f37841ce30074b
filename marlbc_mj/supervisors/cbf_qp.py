"""CBF-QP: exponential control barrier functions of second order on accelerations (Ames et al. 2019; Nguyen & Sreenath 2016).

Each agent is modelled as a double integrator p'' = a. Let h be the remaining distance (d - d_OA - m to an obstacle,
|p_i - p_j| - d_AA - m to another agent). With a double pole at -rho, every body imposes

    h'' + 2 rho h' + rho^2 h >= 0,   h' = n^T v,   h'' = n^T a + |v_t|^2 / D,

where n is the body's outward normal, v the velocity relative to the body, v_t its part perpendicular to n and D the distance from
the body's center. Under this constraint, h and h' + rho h remain non-negative once they are. It is a half-plane of accelerations;
each of two agents takes half of it. The applied acceleration is

    a = argmin |a - rate (v_c - v)|  subject to all half-planes and |a| <= A.

If they contradict each other, the greatest violation is minimized, that of obstacles first.

Here a supervisor returns reference *velocities*, not forces. The acceleration is integrated over the mission step,
v_r = v + dt a, where v is the previous reference velocity. So the double integrator that is kept safe is the reference, a virtual
agent, with a held for dt. The measured agent is safe as far as it tracks the reference; the margin covers its lag. Any controller
can track it. As with ORCA there are no switches, and agents wait where the way is closed.
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
class CBFQP(Cruising):
    """Second-order barrier functions on the reference's acceleration; see the module.

    Raises:
        ConfigurationError: a rate or an acceleration that is not positive.
    """

    motion: str = "FM"
    pole: float = 3.0  # rho [1/s]
    rate: float = 4.0  # gain of the desired acceleration rate (v_c - v) [1/s]
    acceleration: float = 20.0  # A [m/s^2]
    margin: float = 0.1  # m [m]
    speed: float = 6.0  # bound of v_c [m/s]
    sight: float = 15.0  # a body more than this beyond its wanted distance is ignored [m]

    def __post_init__(self) -> None:
        for name in ("pole", "rate", "acceleration"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigurationError(f"CBFQP {name} must be positive and finite, got {value}")

    def decide(self, observation: Observation, memory: Cruise) -> tuple[Blend, Cruise]:
        """One velocity per agent: the previous one plus the acceleration times the mission step."""
        wish = wish_of(observation, memory)
        acceleration = np.empty_like(wish.wanted)
        _accelerate(wish, memory.bodies, self.pole, self.rate, self.acceleration, acceleration)
        velocity = wish.velocity + memory.bodies.step * acceleration
        return give(velocity, memory)


@allocation_free
def barrier_plane(between, distance, least, pole, share, plane):
    """The half-plane n^T a >= c of accelerations that one body permits, written to ``plane`` as n, c.

    Args:
        between: (2, 2) position [m] and velocity [m/s] of the body relative to the agent.
        distance: D between the two centers [m].
        least: least distance wanted [m]; h = D - least.
        pole: rho [1/s].
        share: share of the constraint that the agent takes, 1/2 or 1.
        plane: (3 or more,), written in place; the normal is (1, 0) if both centers coincide.
    """
    n_x, n_y = (-between[0, 0] / distance, -between[0, 1] / distance) if distance > 0.0 else (1.0, 0.0)
    rate = -(n_x * between[1, 0] + n_y * between[1, 1])
    across = n_x * between[1, 1] - n_y * between[1, 0]
    turn = across * across / distance if distance > 0.0 else 0.0
    plane[0], plane[1] = n_x, n_y
    plane[2] = -share * (2.0 * pole * rate + pole * pole * (distance - least) + turn)


@compiled
def _accelerate(wish, bodies, pole, rate, most, out):
    """Write the accelerations (B, N, 2) [m/s^2] of all agents of all teams to ``out``."""
    agents, obstacles = wish.at.shape[1], wish.obstacles.shape[1]
    planes = np.empty((2 * (agents + obstacles), 4))  # rows: normal, offset, level
    between, still, wanted = np.empty((2, 2)), np.zeros(2), np.empty(2)
    for b in range(wish.at.shape[0]):
        for i in range(agents):
            p, v, count = wish.at[b, i], wish.velocity[b, i], 0
            for k in range(obstacles):
                body = wish.obstacles[b, k]
                least = body[2] + bodies.obstacles
                distance = relative(p, v, body, body[3:5] if wish.obstacles.shape[2] > 3 else still, between)
                if distance - least < bodies.sight:
                    barrier_plane(between, distance, least, pole, 1.0, planes[count])
                    planes[count, 3] = 0.0
                    count += 1
            for j in range(agents):
                distance = relative(p, v, wish.at[b, j], wish.velocity[b, j], between)
                if j != i and distance - bodies.agents < bodies.sight:
                    barrier_plane(between, distance, bodies.agents, pole, 0.5, planes[count])
                    planes[count, 3] = 1.0
                    count += 1
            for axis in range(2):
                wanted[axis] = rate * (wish.wanted[b, i, axis] - v[axis])
            closest(wanted, most, planes, count, out[b, i])
