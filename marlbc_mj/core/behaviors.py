"""Elementary behaviors: obstacle avoidance (9), formation maintenance (10), formation reconstruction (11), agent avoidance.

Each is closed-loop inverse kinematics (8): v = J^+ (rho_d' + Lambda rho~). The desired centroid path enters as feed-forward
(erratum 3: p_c cancels in the error, so the feed-forward is the velocity of p_cd). Agent avoidance, AA, is defined by this
project: the paper has no such behavior, so its agents may collide.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError

EVERYTHING, NEAREST_OBSTACLE, NEAREST_NEIGHBOR = 0, 1, 2
"""The part of the surroundings that a behavior's law needs: all obstacles and agents, or only the nearest of one kind.

A behavior declares it in the attribute ``sees``. In large teams its law then receives only the nearest one, found in a grid. The
result is the same."""


@laws.allocation_free
def nearest_obstacle(p: np.ndarray, obstacles: np.ndarray, normal: np.ndarray) -> float:
    """Return the clearance d = min_k (|p - o_k| - radius_k) [m], negative inside (erratum 7); write the outward unit normal.

    Args:
        p: (2,) [m].
        obstacles: (K, 3 or more), rows x, y, radius [m]; K = 0 gives an infinite clearance and a zero normal.
        normal: (2,), written in place; (1, 0) at the exact center of an obstacle, where no direction is defined.
    """
    clearance: float = _nearest(p, obstacles, normal)[0]
    return clearance


@laws.allocation_free
def _nearest(p, obstacles, normal):
    """The clearance of :func:`nearest_obstacle`, and the index of that obstacle, -1 if there is none."""
    clearance, nearest = np.inf, -1
    normal[0] = 0.0
    normal[1] = 0.0
    for k in range(obstacles.shape[0]):
        x = p[0] - obstacles[k, 0]
        y = p[1] - obstacles[k, 1]
        distance = np.sqrt(x * x + y * y)
        if distance - obstacles[k, 2] < clearance:
            clearance, nearest = distance - obstacles[k, 2], k
            normal[0] = x / distance if distance > 0.0 else 1.0
            normal[1] = y / distance if distance > 0.0 else 0.0
    return clearance, nearest


@laws.compiled
def _fill_clearances(positions, obstacles, out):
    normal = np.empty(2)
    for k in range(positions.shape[0]):
        out[k] = nearest_obstacle(positions[k], obstacles, normal)


def clearances(positions: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
    """The clearance (...,) [m] of :func:`nearest_obstacle` at each of the ``positions`` (..., 2) [m]."""
    flat = np.ascontiguousarray(positions, dtype=np.float64).reshape(-1, 2)
    out = np.empty(len(flat))
    _fill_clearances(flat, np.ascontiguousarray(obstacles, dtype=np.float64), out)
    return out.reshape(np.shape(positions)[:-1])


@laws.compiled
def _fill_clearances_among(positions, obstacles, out):
    normal = np.empty(2)
    for t in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            out[t, i] = nearest_obstacle(positions[t, i], obstacles[t], normal)


def clearances_among(positions: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
    """The clearances (T, N) [m] at ``positions`` (T, N, 2) [m] among obstacles (T, K, 3 or more) at the same T times."""
    out = np.empty(positions.shape[:2])
    arrays = (np.ascontiguousarray(a, dtype=np.float64) for a in (positions, obstacles))
    _fill_clearances_among(*arrays, out)
    return out


@laws.behavior(gains=("gain", "safe_distance", "two_sided"))
def obstacle_avoidance(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    """OA (9): v = n Lambda max(0, d_OA - d), J = n^T.

    The task is one-sided by default, because the published equality task attracts agents from beyond d_OA (erratum 6). If
    obstacles move, d' = n^T (v - o'), so n n^T o' is fed forward; ``obstacles`` is then (K, 5), with o' in its last columns.
    """
    clearance, k = _nearest(p, obstacles, jacobian_out[0])
    error = gains.safe_distance - clearance
    if clearance == np.inf or (gains.two_sided == 0.0 and error < 0.0):
        error = 0.0
    velocity_out[0] = jacobian_out[0, 0] * gains.gain * error
    velocity_out[1] = jacobian_out[0, 1] * gains.gain * error
    if k >= 0 and obstacles.shape[1] > 3:
        along = jacobian_out[0, 0] * obstacles[k, 3] + jacobian_out[0, 1] * obstacles[k, 4]
        velocity_out[0] += jacobian_out[0, 0] * along
        velocity_out[1] += jacobian_out[0, 1] * along
    return 1


@laws.behavior(gains=("gain", "distance"))
def agent_avoidance(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    """AA: v = n (n^T p_cd' + Lambda max(0, d_AA - d)), J = n^T. Defined by this project.

    d = |p - p_j| is the distance to the nearest other agent j, and n = (p - p_j) / d. The rate d' = n^T (v - p_j') contains the
    neighbor's velocity, which an agent does not know, so the velocity of the common path replaces it. Unlike OA, the task has no
    Jacobian row from d_AA on: even at the highest priority it then blocks no direction, and the agent is free to move away. Two
    agents at the same place separate along x.
    """
    nearest, distance = -1, np.inf
    for other in range(team.shape[0]):
        x, y = p[0] - team[other, 0], p[1] - team[other, 1]
        between = np.sqrt(x * x + y * y)
        if other != agent and between < distance:
            nearest, distance = other, between
    if nearest < 0 or distance >= gains.distance:
        velocity_out[0] = velocity_out[1] = 0.0
        return 0
    normal = jacobian_out[0]
    if distance > 0.0:
        normal[0], normal[1] = (p[0] - team[nearest, 0]) / distance, (p[1] - team[nearest, 1]) / distance
    else:
        normal[0], normal[1] = (1.0 if agent > nearest else -1.0), 0.0
    along = normal[0] * path[1, 0] + normal[1] * path[1, 1] + gains.gain * (gains.distance - distance)
    velocity_out[0] = normal[0] * along
    velocity_out[1] = normal[1] * along
    return 1


@laws.behavior(gains={"gain": (), "slot": 2})
def formation(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    """FM (10) and FR (11): v = p_cd' + Lambda (p_cd + slot - p), J = I; the slot is an offset from the centroid [m]."""
    for axis in range(2):
        velocity_out[axis] = path[1, axis] + gains.gain * (path[0, axis] + gains.slot[axis] - p[axis])
        for other in range(2):
            jacobian_out[axis, other] = 1.0 if other == axis else 0.0
    return 2


@laws.behavior(gains={"gain": (), "width": (), "slot": 2})
def line_formation(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    """FR along the line of its slot: v = p_cd' + Lambda (s e_a + e_c), s = max(0, 1 - (|e_c| / w)^2), J = I.

    e_a and e_c are the components of the slot error along and across the path. So an agent first goes to the line on which its
    slot moves, and only then along it: beside an opening it does not run into the wall. On the line, and if the path is at rest,
    the law equals :func:`formation`. The two components are those of line-of-sight guidance (T. I. Fossen, Handbook of Marine
    Craft Hydrodynamics and Motion Control, 2011, section 10.3). The factor s is specific to this project.
    """
    speed = np.sqrt(path[1, 0] ** 2 + path[1, 1] ** 2)
    x, y = path[0, 0] + gains.slot[0] - p[0], path[0, 1] + gains.slot[1] - p[1]
    share, ux, uy = 1.0, 1.0, 0.0
    if speed > 0.0:
        ux, uy = path[1, 0] / speed, path[1, 1] / speed
        share = max(0.0, 1.0 - ((ux * y - uy * x) / gains.width) ** 2)
    along = (1.0 - share) * (ux * x + uy * y)
    velocity_out[0] = path[1, 0] + gains.gain * (x - along * ux)
    velocity_out[1] = path[1, 1] + gains.gain * (y - along * uy)
    for axis in range(2):
        for other in range(2):
            jacobian_out[axis, other] = 1.0 if other == axis else 0.0
    return 2


@runtime_checkable
class Behavior(Protocol):
    """The interface of behaviors: a name, the law, whether J has full rank, and the gains."""

    @property
    def name(self) -> str: ...
    @property
    def law(self) -> laws.Law: ...
    @property
    def complete(self) -> bool: ...
    def params(self, agent: int) -> laws.Numbers:
        """The gains of the law by name, for one agent."""
        ...


@dataclass(frozen=True)
class ObstacleAvoidance:
    """Keep ``safe_distance`` from the nearest obstacle (9)."""

    gain: float = 20.0  # Lambda_OA [1/s]
    safe_distance: float = 2.0  # d_OA [m]
    two_sided: bool = False  # True: the published equality task (erratum 6)
    name: str = "OA"
    complete = False
    sees = NEAREST_OBSTACLE
    law = staticmethod(obstacle_avoidance)

    def __post_init__(self) -> None:
        _require_positive(f"{self.name} gain", self.gain)
        _require_positive(f"{self.name} safe_distance", self.safe_distance)

    def params(self, agent: int) -> laws.Numbers:
        return laws.gains_of(self)


@dataclass(frozen=True)
class AgentAvoidance:
    """Keep ``distance`` from the nearest other agent."""

    gain: float = 20.0  # Lambda_AA [1/s]
    distance: float = 1.5  # d_AA, between centers [m]
    name: str = "AA"
    complete = False
    sees = NEAREST_NEIGHBOR
    law = staticmethod(agent_avoidance)

    def __post_init__(self) -> None:
        _require_positive(f"{self.name} gain", self.gain)
        _require_positive(f"{self.name} distance", self.distance)

    def params(self, agent: int) -> laws.Numbers:
        return laws.gains_of(self)


@dataclass(frozen=True)
class Formation:
    """Hold a slot around the moving desired centroid: FM (10), or FR (11) with the offsets of the column."""

    name: str
    offsets: tuple[tuple[float, float], ...]  # (x, y) of each agent [m]
    gain: float = 8.0  # Lambda_FM, Lambda_FR [1/s]
    complete = True
    law = staticmethod(formation)

    def __post_init__(self) -> None:
        _require_positive(f"{self.name} gain", self.gain)
        if not np.isfinite(self.offsets).all():
            raise ConfigurationError(f"{self.name} offsets must be finite, got {self.offsets}")

    def params(self, agent: int) -> laws.Numbers:
        return laws.gains_of(self, slot=self.offsets[agent])


@dataclass(frozen=True)
class LineFormation(Formation):
    """Hold a slot, approaching first the line on which it moves."""

    width: float = 1.5  # w: at this distance from the line and beyond, the error along it is ignored [m]
    law = staticmethod(line_formation)

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_positive(f"{self.name} width", self.width)


def _require_positive(what: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ConfigurationError(f"{what} must be a positive finite number, got {value}")
