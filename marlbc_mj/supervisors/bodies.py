"""The common part of ORCA and CBF-QP: an agent's desired velocity, and the bodies that it has to avoid.

Both move the reference itself (a :class:`~marlbc_mj.supervisors.base.Blend`), so both see bodies from where behaviors are
evaluated: p_r in ``virtual`` mode. The desired velocity is v_c of one formation behavior, FM by default, of bounded length.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import allocation_free
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Blend
from marlbc_mj.supervisors.frameworks import Repertoire, behavior_velocities, evaluated_at, repertoire
from marlbc_mj.supervisors.neighbors import give_way
from marlbc_mj.util.errors import ConfigurationError, unknown


class Bodies(NamedTuple):
    """Bodies of a scenario that agents avoid, and the distances that they keep."""

    agents: float  # wanted between the middles of two agents [m]
    obstacles: float  # wanted clearance [m]
    sight: float  # bodies whose gap beyond that is larger are ignored [m]
    speed: float  # bound of velocities [m/s]
    step: float  # between two decisions [s]


class Cruise(NamedTuple):
    """Memory of a supervisor that gives velocities."""

    motion: Repertoire  # the formation behavior alone
    bodies: Bodies
    velocity: np.ndarray | None  # (B, N, 2) given last [m/s]; None before the first decision


class Wish(NamedTuple):
    """One moment of B teams."""

    at: np.ndarray  # (B, N, 2) where each agent is [m]
    velocity: np.ndarray  # (B, N, 2) how it moves [m/s]
    wanted: np.ndarray  # (B, N, 2) v_c [m/s]
    obstacles: np.ndarray  # (B, K, 3), or (B, K, 5) where they move


def make_cruise(scenario: Scenario, motion: str, margin: float, speed: float, sight: float) -> Cruise:
    """Memory at the start of an episode. Agents keep d_AA apart, or two radii where no behavior says how much; all plus margin.

    Raises:
        ConfigurationError: an unknown behavior, a margin that is negative, a speed or a sight that is not positive.
    """
    for name, value in (("speed", speed), ("sight", sight)):
        if not value > 0:
            raise ConfigurationError(f"{name} must be positive, got {value}")
    if not (np.isfinite(margin) and margin >= 0):
        raise ConfigurationError(f"margin must be non-negative and finite, got {margin}")
    if motion not in scenario.formation_names:
        raise unknown("formation behavior", motion, scenario.formation_names)
    apart = give_way(scenario).distance or 2.0 * scenario.fleet.radius
    bodies = Bodies(
        agents=float(apart + margin),
        obstacles=float(scenario.safe_distance + margin),
        sight=float(sight),
        speed=float(min(speed, scenario.speed_limit)),
        step=float(scenario.mission_step),
    )
    return Cruise(repertoire(scenario, (motion,)), bodies, None)


class Cruising:
    """A supervisor that gives velocities, with these fields."""

    motion: str
    margin: float
    speed: float
    sight: float

    def start(self, scenario: Scenario, teams: int) -> Cruise:
        """Nobody has moved yet.

        Raises:
            ConfigurationError: an unknown behavior, or a number that cannot be.
        """
        return make_cruise(scenario, self.motion, self.margin, self.speed, self.sight)


def give(velocity: np.ndarray, memory: Cruise) -> tuple[Blend, Cruise]:
    """Velocities (B, N, 2) [m/s] as a decision under the one label that never changes, and remembered."""
    orders = np.full(velocity.shape[:2], memory.motion.orders[0])
    return Blend(orders, velocity), memory._replace(velocity=velocity)


def wish_of(observation: Observation, memory: Cruise) -> Wish:
    """Positions, velocities and desired velocities of all agents."""
    velocity = observation.velocity if memory.velocity is None else memory.velocity
    wanted = behavior_velocities(observation, memory.motion)[0]
    length = np.linalg.norm(wanted, axis=-1, keepdims=True)
    wanted = wanted * (memory.bodies.speed / np.maximum(length, memory.bodies.speed))
    at = evaluated_at(observation, memory.motion)
    return Wish(at, *map(np.ascontiguousarray, (velocity, wanted, observation.obstacles)))


@allocation_free
def relative(p, v, body, body_velocity, out):
    """Position and velocity of a body relative to an agent at ``p`` (2,) [m], ``v`` [m/s]: ``out`` (2, 2); their distance [m]."""
    for axis in range(2):
        out[0, axis], out[1, axis] = body[axis] - p[axis], body_velocity[axis] - v[axis]
    return np.sqrt(out[0, 0] * out[0, 0] + out[0, 1] * out[0, 1])
