"""The older behavioral frameworks: baselines for priority orders with null-space composition. Each computes v_r itself.

All three weight the velocities (8)-(11) of the single behaviors by each agent's measured clearance d. The behaviors are evaluated
where the mission evaluates them (at p_r in ``virtual`` mode, else at the measured p), and every agent decides for itself. Each
velocity is labelled with the order of the behavior of greatest weight: OA>FM for OA, AA>FM for AA, else FR or FM. So a switch is
a change of the dominant behavior. The velocity may change without one, even jump, and is not the composition (12) of its label.

The sources describe other robots and other behaviors. Each class states how its source is interpreted here.
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
    """The M behaviors that a framework blends, fixed for an episode: FM, FR, OA and possibly AA."""

    alone: Behaviors  # the scenario's, but order j consists of behavior j alone
    orders: np.ndarray  # (M,) the order that labels each behavior
    safe_distance: float  # d_OA [m]
    way: GiveWay  # data for giving way to other agents
    grid: np.ndarray  # scratch for grids of obstacles and team


def repertoire(scenario: Scenario, names: tuple[str, ...] = ("FM", "FR", "OA")) -> Repertoire:
    """The behaviors of a scenario with the given ``names``.

    Raises:
        ConfigurationError: the scenario lacks one of their orders.
    """
    orders = np.array([scenario.orders.index(_LABELS.get(name, name)) for name in names])
    place = [b.name for b in scenario.behaviors]
    alone = make_behaviors(replace(scenario, composition="null-space"))._replace(
        table=np.array([[place.index(name)] for name in names])
    )
    return Repertoire(alone, orders, scenario.safe_distance, give_way(scenario), np.zeros(grid_room(scenario)))


def evaluated_at(observation: Observation, memory: Repertoire) -> np.ndarray:
    """(B, N, 2) positions at which the mission evaluates behaviors [m]."""
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

    Lower layers are suppressed entirely, not projected, so an agent that avoids an obstacle neither follows the path nor keeps
    its slot meanwhile. OA brings it to d = d_OA, where OA is still active: it can stay there forever while the path moves on.
    The regions are those of FSAMS as published. If the scenario has agent avoidance, AA is the layer above OA, active while a
    neighbor is within d_AA.
    """

    reach: float = 2.0  # clearance up to which FR is active, in d_OA

    def __post_init__(self) -> None:
        if not (np.isfinite(self.reach) and self.reach >= 1):
            raise ConfigurationError(f"Layered reach must be at least 1 and finite, got {self.reach}")

    def start(self, scenario: Scenario, teams: int) -> Repertoire:
        """Memory: the scenario's behaviors."""
        avoiding = any(b.name == "AA" for b in scenario.behaviors)
        return repertoire(scenario, ("FM", "FR", "OA", "AA") if avoiding else ("FM", "FR", "OA"))

    def weights(self, clearance: np.ndarray, safe_distance: float) -> np.ndarray:
        """(3, B, N) weights of FM, FR and OA at clearances (B, N) [m]: 1 for the highest active one, 0 for the others."""
        near, within = clearance <= safe_distance, clearance <= self.reach * safe_distance
        return np.stack([~within, within & ~near, near]).astype(np.float64)

    def decide(self, observation: Observation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """The velocity of one behavior per agent."""
        weights = self.weights(observation.clearance, memory.safe_distance)
        if len(memory.orders) > _AA:
            close = crowded(observation, memory.way, reach=1.0)  # at d_AA and beyond, AA alone commands zero velocity
            weights = np.concatenate([weights * ~close, close[None].astype(np.float64)])
        velocities = behavior_velocities(observation, memory)
        return _blend(weights, velocities, memory), memory


@dataclass(frozen=True)
class FuzzyBlend:
    """v_r = sum mu_j v_j / sum mu_j (Vadakkepat et al. 2004): near -> OA, mid -> FR, far -> FM, with the sets of FMS.

    The rules are those of FMS without the clearance rate. OA contains no path velocity, so the blend follows the path more slowly
    by the weight of OA.
    """

    def start(self, scenario: Scenario, teams: int) -> Repertoire:
        """Memory: the scenario's behaviors."""
        return repertoire(scenario)

    def weights(self, clearance: np.ndarray, safe_distance: float) -> np.ndarray:
        """(3, B, N) weights mu_j / sum mu_j of FM, FR and OA at clearances (B, N) [m]."""
        sets = memberships(clearance, np.zeros(clearance.shape), safe_distance)
        degrees = np.stack([sets.far, sets.mid, sets.near])
        return np.asarray(degrees / degrees.sum(axis=0))

    def decide(self, observation: Observation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One blended velocity per agent."""
        weights = self.weights(observation.clearance, memory.safe_distance)
        velocities = behavior_velocities(observation, memory)
        return _blend(weights, velocities, memory), memory


@dataclass(frozen=True)
class MotorSchema:
    """v_r = p_cd' + ``speed`` x the sum of gain x magnitude x direction of all schemas (Arkin 1989; Balch and Arkin 1998).

    Magnitudes lie in [0, 1]; nothing is projected. The magnitude m of an obstacle is 0 beyond the distance ``sphere``, rises
    linearly to 1 at ``saturation`` and is 1 below it.

    - OA: along the outward normal, with magnitude m.
    - FM: the feedback of (10), limited to ``speed``: linear near the slot, of magnitude 1 from speed / Lambda = 1.25 m on.
      Without the limit, the pull of a distant slot exceeds any repulsion (case study: 57 s in violation instead of 2 s).
    - FR: the feedback of (11), limited likewise, times m, since only obstacles require a column. ``reconstruct_always`` omits m,
      which is the literal sum: the team then settles between its two formations and holds neither (case study: return -188).

    The path velocity is added once; as a part of both FM and FR it would count up to 1.8 times. All schemas together give the
    reference a loop gain of 1.5 * 10 / 2 + 1.8 * 8 = 22 /s, which is stable with steps of 0.05 s (limit: 40 /s). With four times
    the speed it is not.
    """

    avoidance: float = 1.5  # gain of OA
    formation: float = 1.0  # gain of FM
    reconstruction: float = 0.8  # gain of FR
    sphere: float = 4.0  # S, sphere of influence [m]
    saturation: float = 2.0  # R [m]
    speed: float = 10.0  # speed of a schema at gain and magnitude 1 [m/s]
    reconstruct_always: bool = False  # FR also without an obstacle nearby

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
        """Memory: the scenario's behaviors."""
        return repertoire(scenario)

    def magnitude(self, clearance: np.ndarray) -> np.ndarray:
        """(B, N) magnitude m in [0, 1] at clearances (B, N) [m]."""
        return np.asarray(np.clip((self.sphere - clearance) / (self.sphere - self.saturation), 0.0, 1.0))

    def weights(self, clearance: np.ndarray) -> np.ndarray:
        """(3, B, N) weights, gain x magnitude, of FM, FR and OA at clearances (B, N) [m]."""
        near, always = self.magnitude(clearance), np.ones(clearance.shape)
        reconstruction = always if self.reconstruct_always else near
        return np.stack([self.formation * always, self.reconstruction * reconstruction, self.avoidance * near])

    def decide(self, observation: Observation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """The sum of all schemas per agent."""
        weights = self.weights(observation.clearance)
        velocities, path_velocity = behavior_velocities(observation, memory), memory.alone.path[1]
        velocities[:_OA] = _cut(velocities[:_OA] - path_velocity, self.speed)
        _fill_normals(evaluated_at(observation, memory), np.ascontiguousarray(observation.obstacles), velocities[_OA])
        velocities[_OA] *= self.speed
        blend = _blend(weights, velocities, memory)
        return blend._replace(velocity=blend.velocity + path_velocity), memory


def _cut(velocities: np.ndarray, speed: float) -> np.ndarray:
    """``velocities`` (..., 2), shortened to ``speed`` where they are faster."""
    length = np.linalg.norm(velocities, axis=-1, keepdims=True)
    return np.asarray(velocities * (speed / np.maximum(length, speed)))


def _blend(weights: np.ndarray, velocities: np.ndarray, memory: Repertoire) -> Blend:
    """Sum over behaviors of ``weights`` (M, B, N) times ``velocities`` (M, B, N, 2), labelled by the greatest weight."""
    return Blend(memory.orders[weights.argmax(axis=0)], (weights[..., None] * velocities).sum(axis=0))
