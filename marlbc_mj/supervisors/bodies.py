"""The common part of ORCA and CBF-QP: an agent's desired velocity, and the bodies that it has to avoid.

Both move the reference itself (a :class:`~marlbc_mj.supervisors.base.Blend`), so they measure distances from the point where
behaviors are evaluated: p_r in ``virtual`` mode. The desired velocity is v_c of one formation behavior, FM by default, with
bounded length.
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
    """Distances that agents keep from other bodies, and limits of their motion."""

    agents: float  # least distance wanted between the centers of two agents [m]
    obstacles: float  # least clearance wanted from obstacles [m]
    sight: float  # a body more than this beyond its wanted distance is ignored [m]
    speed: float  # upper bound of speeds [m/s]
    step: float  # time between two decisions [s]


class Cruise(NamedTuple):
    """Memory of ORCA and CBF-QP."""

    motion: Repertoire  # contains only the formation behavior
    bodies: Bodies
    velocity: np.ndarray | None  # (B, N, 2) last reference velocities [m/s]; None before the first decision


class Wish(NamedTuple):
    """Positions, velocities and desired velocities of B teams at one mission step."""

    at: np.ndarray  # (B, N, 2) position of each agent or its reference [m]
    velocity: np.ndarray  # (B, N, 2) last reference velocity; the measured one before the first decision [m/s]
    wanted: np.ndarray  # (B, N, 2) v_c, bounded [m/s]
    obstacles: np.ndarray  # (B, K, 3), or (B, K, 5) where they move


def make_cruise(scenario: Scenario, motion: str, margin: float, speed: float, sight: float) -> Cruise:
    """Memory at the start of an episode.

    Agents keep d_AA apart, or two robot radii if the scenario has no AA. The margin is added to all distances.

    Raises:
        ConfigurationError: an unknown behavior, a negative margin, or a speed or sight that is not positive.
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
    """Base class of ORCA and CBF-QP, which have these fields."""

    motion: str
    margin: float
    speed: float
    sight: float

    def start(self, scenario: Scenario, teams: int) -> Cruise:
        """Initial memory, without a last velocity.

        Raises:
            ConfigurationError: an unknown behavior, or an invalid number.
        """
        return make_cruise(scenario, self.motion, self.margin, self.speed, self.sight)


def give(velocity: np.ndarray, memory: Cruise) -> tuple[Blend, Cruise]:
    """Velocities (B, N, 2) [m/s] as a decision, labelled with the order of the formation behavior, and stored in the memory."""
    orders = np.full(velocity.shape[:2], memory.motion.orders[0])
    return Blend(orders, velocity), memory._replace(velocity=velocity)


def wish_of(observation: Observation, memory: Cruise) -> Wish:
    """Positions, velocities and desired velocities of all agents, before a decision."""
    velocity = observation.velocity if memory.velocity is None else memory.velocity
    wanted = behavior_velocities(observation, memory.motion)[0]
    length = np.linalg.norm(wanted, axis=-1, keepdims=True)
    wanted = wanted * (memory.bodies.speed / np.maximum(length, memory.bodies.speed))
    at = evaluated_at(observation, memory.motion)
    return Wish(at, *map(np.ascontiguousarray, (velocity, wanted, observation.obstacles)))


@allocation_free
def relative(p, v, body, body_velocity, out):
    """Write a body's position and velocity relative to an agent at ``p`` with ``v`` to ``out`` (2, 2); return the distance."""
    for axis in range(2):
        out[0, axis], out[1, axis] = body[axis] - p[axis], body_velocity[axis] - v[axis]
    return np.sqrt(out[0, 0] * out[0, 0] + out[0, 1] * out[0, 1])
