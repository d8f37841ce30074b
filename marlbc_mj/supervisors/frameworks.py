"""The older behavioral frameworks, rivals of priority orders and null-space composition together: each gives v_r itself.

All three weigh the behaviors' own velocities (8)-(11), evaluated where the mission evaluates them (at p_r in ``virtual`` mode,
else at the measured p), by each agent's measured clearance d; every agent decides for itself. The label that goes with a
velocity is the order of the behavior that weighs most: OA>FM for OA, FR, FM. So a switch is a change of the dominant behavior;
the velocity may change, even jump, without one, and no label says that its composition (12) is what moves the agent.

Their sources describe other robots and other behaviors. What is read into them here is said at each class.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.engine.composition import WORKSPACE, Behaviors, compose_team, path_at
from marlbc_mj.engine.plan import grid_room, make_behaviors
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Blend, Situation
from marlbc_mj.supervisors.fms import memberships
from marlbc_mj.supervisors.neighbors import GiveWay, crowded, give_way
from marlbc_mj.util.errors import ConfigurationError

_FM, _FR, _OA, _AA = 0, 1, 2, 3


class Repertoire(NamedTuple):
    """What a framework blends, fixed for an episode."""

    behaviors: Behaviors  # of the scenario, in a table of orders that hold one behavior each: FM, FR, OA, and AA if named
    orders: np.ndarray  # (3,) or (4,) the order that labels each
    safe_distance: float  # d_OA [m]
    way: GiveWay  # to other agents
    grid: np.ndarray  # scratch


def repertoire(scenario: Scenario, names: tuple[str, ...] = ("FM", "FR", "OA")) -> Repertoire:
    """FM, FR and OA of a scenario, with AA too if it is named.

    Raises:
        ConfigurationError: the scenario lacks one of them.
    """
    labels = {"FM": "FM", "FR": "FR", "OA": "OA>FM", "AA": "AA>FM"}
    orders = np.array([scenario.orders.index(labels[name]) for name in names])
    place = [b.name for b in scenario.behaviors]
    alone = np.array([[place.index(name)] for name in names])
    behaviors = make_behaviors(scenario)._replace(table=alone)
    return Repertoire(behaviors, orders, scenario.safe_distance, give_way(scenario), np.zeros(grid_room(scenario)))


def evaluated_at(situation: Situation, memory: Repertoire) -> np.ndarray:
    """(N, 2) where the mission evaluates behaviors [m]."""
    return np.ascontiguousarray(situation.reference if memory.behaviors.virtual else situation.position)


def behavior_velocities(situation: Situation, memory: Repertoire) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (8) of FM, FR, OA (and AA), each alone, for every agent, (3 or 4, N, 2) [m/s]; and p_cd, p_cd' (2, 2)."""
    at = evaluated_at(situation, memory)
    now, workspace = np.empty((2, 2)), np.empty((WORKSPACE, 2))
    path_at(situation.time, memory.behaviors.path, now)
    velocities = np.empty((len(memory.orders), *at.shape))
    for behavior, velocity in enumerate(velocities):
        alone = np.full(len(at), behavior)
        compose_team(situation.time, alone, memory.behaviors, at, situation.obstacles, memory.grid, workspace, velocity)
    return velocities, now


@dataclass(frozen=True)
class Layered:
    """The highest active behavior has the agent to itself (Brooks 1986): OA if d <= d_OA, FR if d <= ``reach`` d_OA, else FM.

    Subsumption of whole layers: those below are suppressed, not projected, so an agent that avoids an obstacle neither follows
    the path nor keeps its slot meanwhile. OA brings it to d = d_OA, where OA is still active: it can rest there for good
    while the path goes on. The regions are those of FSAMS as printed. Where the scenario has agent avoidance, AA is the layer
    above OA, active while a neighbor is within d_AA.
    """

    reach: float = 2.0  # FR is active within this many d_OA

    def __post_init__(self) -> None:
        if not (np.isfinite(self.reach) and self.reach >= 1):
            raise ConfigurationError(f"Layered reach must be at least 1 and finite, got {self.reach}")

    def start(self, scenario: Scenario) -> Repertoire:
        """The scenario's behaviors."""
        avoiding = any(b.name == "AA" for b in scenario.behaviors)
        return repertoire(scenario, ("FM", "FR", "OA", "AA") if avoiding else ("FM", "FR", "OA"))

    def weights(self, clearance: np.ndarray, safe_distance: float) -> np.ndarray:
        """(3, N), 1 for the highest active of FM, FR and OA and 0 for the others, at clearances (N,) [m]."""
        near, within = clearance <= safe_distance, clearance <= self.reach * safe_distance
        return np.stack([~within, within & ~near, near]).astype(np.float64)

    def decide(self, situation: Situation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One behavior per agent."""
        weights = self.weights(situation.clearance, memory.safe_distance)
        if len(memory.orders) > _AA:
            close = crowded(situation, memory.way, reach=1.0)  # alone, AA has an agent stand still from d_AA on
            weights = np.concatenate([weights * ~close, close[None].astype(np.float64)])
        velocities, _ = behavior_velocities(situation, memory)
        return _blend(weights, velocities, memory), memory


@dataclass(frozen=True)
class FuzzyBlend:
    """v_r = sum mu_j v_j / sum mu_j (Vadakkepat et al. 2004): near -> OA, mid -> FR, far -> FM, with the sets of FMS.

    The rules are those of FMS without the clearance rate. OA has no feed-forward: the share that it weighs is missing from the
    path's velocity.
    """

    def start(self, scenario: Scenario) -> Repertoire:
        """The scenario's behaviors."""
        return repertoire(scenario)

    def weights(self, clearance: np.ndarray, safe_distance: float) -> np.ndarray:
        """(3, N), mu_j / sum mu_j of FM, FR and OA at clearances (N,) [m]."""
        sets = memberships(clearance, np.zeros(len(clearance)), safe_distance)
        degrees = np.stack([sets.far, sets.mid, sets.near])
        return np.asarray(degrees / degrees.sum(axis=0))

    def decide(self, situation: Situation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One mixture per agent."""
        weights = self.weights(situation.clearance, memory.safe_distance)
        velocities, _ = behavior_velocities(situation, memory)
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

    def start(self, scenario: Scenario) -> Repertoire:
        """The scenario's behaviors."""
        return repertoire(scenario)

    def magnitude(self, clearance: np.ndarray) -> np.ndarray:
        """(N,) m in [0, 1] at clearances (N,) [m]."""
        return np.asarray(np.clip((self.sphere - clearance) / (self.sphere - self.saturation), 0.0, 1.0))

    def weights(self, clearance: np.ndarray) -> np.ndarray:
        """(3, N), gain x magnitude of FM, FR and OA at clearances (N,) [m]."""
        near, always = self.magnitude(clearance), np.ones(len(clearance))
        reconstruction = always if self.reconstruct_always else near
        return np.stack([self.formation * always, self.reconstruction * reconstruction, self.avoidance * near])

    def decide(self, situation: Situation, memory: Repertoire) -> tuple[Blend, Repertoire]:
        """One sum per agent."""
        weights = self.weights(situation.clearance)
        velocities, now = behavior_velocities(situation, memory)
        velocities[:_OA] = _cut(velocities[:_OA] - now[1], self.speed)
        for i, p in enumerate(evaluated_at(situation, memory)):
            nearest_obstacle(p, situation.obstacles, velocities[_OA, i])
        velocities[_OA] *= self.speed
        blend = _blend(weights, velocities, memory)
        return blend._replace(velocity=blend.velocity + now[1]), memory


def _cut(velocities: np.ndarray, speed: float) -> np.ndarray:
    """``velocities`` (..., 2) with those faster than ``speed`` shortened to it."""
    length = np.linalg.norm(velocities, axis=-1, keepdims=True)
    return np.asarray(velocities * (speed / np.maximum(length, speed)))


def _blend(weights: np.ndarray, velocities: np.ndarray, memory: Repertoire) -> Blend:
    """Sum over behaviors of ``weights`` (3, N) times ``velocities`` (3, N, 2), labelled by the greatest weight."""
    return Blend(memory.orders[weights.argmax(axis=0)], (weights[..., None] * velocities).sum(axis=0))
