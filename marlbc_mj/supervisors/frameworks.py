"""The older behavioral frameworks, rivals of priority orders and null-space composition together: each gives v_r itself.

All three weigh the behaviors' own velocities (8)-(11), evaluated where the mission evaluates them (at p_r in ``virtual`` mode,
else at the measured p), by each agent's measured clearance d; every agent decides for itself. The label that goes with a
velocity is the order of the behavior that weighs most: OA>FM for OA, FR, FM. So a switch is a change of the dominant behavior;
the velocity may change, even jump, without one, and no label says that its composition (12) is what moves the agent.

Their sources describe other robots and other behaviors. Each class says how its source is read here.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.core.laws import compiled
from marlbc_mj.engine.composition import WORKSPACE, Behaviors, compose_team
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import grid_room, make_behaviors
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Blend
from marlbc_mj.supervisors.fms import memberships
from marlbc_mj.supervisors.neighbors import GiveWay, crowded, give_way
from marlbc_mj.util.errors import ConfigurationError

_FM, _FR, _OA, _AA = 0, 1, 2, 3
_LABELS = {"OA": "OA>FM", "AA": "AA>FM"}


class Repertoire(NamedTuple):
    """The behaviors that a framework blends, fixed for an episode; M behaviors: FM, FR, OA and perhaps AA."""

    alone: Behaviors  # of the scenario; order j is behavior j alone
    orders: np.ndarray  # (M,) the order that labels each behavior
    safe_distance: float  # d_OA [m]
    way: GiveWay  # to other agents
    grid: np.ndarray  # scratch


def repertoire(scenario: Scenario, names: tuple[str, ...] = ("FM", "FR", "OA")) -> Repertoire:
    """FM, FR and OA of a scenario, with AA too if it is named.

    Raises:
        ConfigurationError: the scenario lacks one of them.
    """
    orders = np.array([scenario.orders.index(_LABELS.get(name, name)) for name in names])
    place = [b.name for b in scenario.behaviors]
    alone = make_behaviors(replace(scenario, composition="null-space"))._replace(
        table=np.array([[place.index(name)] for name in names])
    )
    return Repertoire(alone, orders, scenario.safe_distance, give_way(scenario), np.zeros(grid_room(scenario)))


def evaluated_at(observation: Observation, memory: Repertoire) -> np.ndarray:
    """(B, N, 2) where the mission evaluates behaviors [m]."""
    return np.ascontiguousarray(observation.reference if memory.alone.virtual else observation.position)


def behavior_velocities(observation: Observation, memory: Repertoire) -> np.ndarray:
    """Velocity (8) of every behavior alone, for every agent: (M, B, N, 2) [m/s]."""
    at = evaluated_at(observation, memory)
    velocities = np.empty((len(memory.orders), *at.shape))
    _fill_velocities(memory.alone, observation.time, at, np.ascontiguousarray(observation.obstacles), memory.grid, velocities)
    return velocities


@compiled
def _fill_velocities(alone, time, at, obstacles, grid, velocities):
    """Velocities (M, B, N, 2) [m/s] of every behavior of ``alone`` at ``time`` (B,) [s] and positions (B, N, 2) [m]."""
    orders, workspace = np.empty(at.shape[1], dtype=np.int64), np.empty((WORKSPACE, 2))
    for behavior in range(velocities.shape[0]):
        orders[:] = behavior
        for b in range(at.shape[0]):
            compose_team(time[b], orders, alone, at[b], obstacles[b], grid, workspace, velocities[behavior, b])


@compiled
def _fill_normals(at, obstacles, normals):
    """Outward unit normals (B, N, 2) of the obstacles (B, K, 3) nearest to positions (B, N, 2) [m]."""
    for b in range(at.shape[0]):
        for i in range(at.shape[1]):
            nearest_obstacle(at[b, i], obstacles[b], normals[b, i])


@dataclass(frozen=True)
class Layered:
    """The highest active behavior has the agent to itself (Brooks 1986): OA if d <= d_OA, FR if d <= ``reach`` d_OA, else FM.

    Subsumption of whole layers: those below are suppressed, not projected, so an agent that avoids an obstacle neither follows
    the path nor keeps its slot meanwhile. OA brings it to d = d_OA, where OA is still active: it can rest there for good
    while the path goes on. The regions are those of FSAMS as published. Where the scenario has agent avoidance, AA is the layer
    above OA, active while a neighbor is within d_AA.
    """

    reach: float = 2.0  # FR is active within this many d_OA

    def __post_init__(self) -> None:
        if not (np.isfinite(self.reach) and self.reach >= 1):
            raise ConfigurationError(f"Layered reach must be at least 1 and finite, got {self.reach}")

    def start(self, scenario: Scenario, teams: int) -> Repertoire:
        """The scenario's behaviors."""
        avoiding = any(b.name == "AA" for b in scenario.behaviors)
        return repertoire(scenario, ("FM", "FR", "OA", "AA") if avoiding else ("FM", "FR", "OA"))

    def weights(self, clearance: np.ndarray, safe_distance: float) -> np.ndarray:
        """(3, B, N), 1 for the highest active of FM, FR and OA and 0 for the others, at clearances (B, N) [m]."""
        near, within = clearance <= safe_distance, clearance <= self.reach * safe_distance
        return np.stack([~within, within & ~near, near]).astype(np.float64)

    def decide(self, observation: Observation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One behavior per agent."""
        weights = self.weights(observation.clearance, memory.safe_distance)
        if len(memory.orders) > _AA:
            close = crowded(observation, memory.way, reach=1.0)  # alone, AA has an agent stand still from d_AA on
            weights = np.concatenate([weights * ~close, close[None].astype(np.float64)])
        velocities = behavior_velocities(observation, memory)
        return _blend(weights, velocities, memory), memory


@dataclass(frozen=True)
class FuzzyBlend:
    """v_r = sum mu_j v_j / sum mu_j (Vadakkepat et al. 2004): near -> OA, mid -> FR, far -> FM, with the sets of FMS.

    The rules are those of FMS without the clearance rate. OA has no feed-forward: the share that it weighs is missing from the
    path's velocity.
    """

    def start(self, scenario: Scenario, teams: int) -> Repertoire:
        """The scenario's behaviors."""
        return repertoire(scenario)

    def weights(self, clearance: np.ndarray, safe_distance: float) -> np.ndarray:
        """(3, B, N), mu_j / sum mu_j of FM, FR and OA at clearances (B, N) [m]."""
        sets = memberships(clearance, np.zeros(clearance.shape), safe_distance)
        degrees = np.stack([sets.far, sets.mid, sets.near])
        return np.asarray(degrees / degrees.sum(axis=0))

    def decide(self, observation: Observation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One mixture per agent."""
        weights = self.weights(observation.clearance, memory.safe_distance)
        velocities = behavior_velocities(observation, memory)
        return _blend(weights, velocities, memory), memory


@dataclass(frozen=True)
class MotorSchema:
    """v_r = p_cd' + ``speed`` x the sum of gain x magnitude x direction of all schemas (Arkin 1989; Balch and Arkin 1998).

    Magnitudes lie in [0, 1]; nothing is projected. That of an obstacle, m, is 0 beyond the distance ``sphere``, rises linearly to
    1 at ``saturation`` and stays 1 inside.

    - OA: along the outward normal, magnitude m.
    - FM: the feedback of (10), cut at ``speed``: linear near the slot, of magnitude 1 from speed / Lambda = 1.25 m on. As it is,
      the pull of a distant slot exceeds whatever an obstacle can set against it (case study: 57 s in violation instead of 2 s).
    - FR: the feedback of (11), cut as FM's, times m, since a column is what an obstacle calls for. With ``reconstruct_always``
      without m, the literal sum: the team then rests between its formations and holds neither (case study: return -188).

    The path's velocity is added once; as a part of FM and of FR it would count up to 1.8 times. All schemas together make a loop
    of 1.5 * 10 / 2 + 1.8 * 8 = 22 /s around the reference, which steps of 0.05 s hold (40 /s); with four times the speed they
    do not.
    """

    avoidance: float = 1.5  # gain of OA
    formation: float = 1.0  # gain of FM
    reconstruction: float = 0.8  # gain of FR
    sphere: float = 4.0  # S, sphere of influence [m]
    saturation: float = 2.0  # R [m]
    speed: float = 10.0  # of a schema at gain and magnitude 1 [m/s]
    reconstruct_always: bool = False

    def __post_init__(self) -> None:
        for name in ("avoidance", "formation", "reconstruction", "saturation", "sphere"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"MotorSchema {name} must be non-negative and finite, got {value}")
        if not (np.isfinite(self.speed) and self.speed > 0):
            raise ConfigurationError(f"MotorSchema speed must be positive and finite, got {self.speed}")
        if self.sphere <= self.saturation:
            raise ConfigurationError(f"MotorSchema sphere must be greater than saturation = {self.saturation}, got {self.sphere}")

    def start(self, scenario: Scenario, teams: int) -> Repertoire:
        """The scenario's behaviors."""
        return repertoire(scenario)

    def magnitude(self, clearance: np.ndarray) -> np.ndarray:
        """(B, N) m in [0, 1] at clearances (B, N) [m]."""
        return np.asarray(np.clip((self.sphere - clearance) / (self.sphere - self.saturation), 0.0, 1.0))

    def weights(self, clearance: np.ndarray) -> np.ndarray:
        """(3, B, N), gain x magnitude of FM, FR and OA at clearances (B, N) [m]."""
        near, always = self.magnitude(clearance), np.ones(clearance.shape)
        reconstruction = always if self.reconstruct_always else near
        return np.stack([self.formation * always, self.reconstruction * reconstruction, self.avoidance * near])

    def decide(self, observation: Observation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One sum per agent."""
        weights = self.weights(observation.clearance)
        velocities, path_velocity = behavior_velocities(observation, memory), memory.alone.path[1]
        velocities[:_OA] = _cut(velocities[:_OA] - path_velocity, self.speed)
        _fill_normals(evaluated_at(observation, memory), np.ascontiguousarray(observation.obstacles), velocities[_OA])
        velocities[_OA] *= self.speed
        blend = _blend(weights, velocities, memory)
        return blend._replace(velocity=blend.velocity + path_velocity), memory


def _cut(velocities: np.ndarray, speed: float) -> np.ndarray:
    """``velocities`` (..., 2) with those faster than ``speed`` shortened to it."""
    length = np.linalg.norm(velocities, axis=-1, keepdims=True)
    return np.asarray(velocities * (speed / np.maximum(length, speed)))


def _blend(weights: np.ndarray, velocities: np.ndarray, memory: Repertoire) -> Blend:
    """Sum over behaviors of ``weights`` (M, B, N) times ``velocities`` (M, B, N, 2), labelled by the greatest weight."""
    return Blend(memory.orders[weights.argmax(axis=0)], (weights[..., None] * velocities).sum(axis=0))
