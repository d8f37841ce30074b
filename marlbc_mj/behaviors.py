"""Elementary behaviors: obstacle avoidance (9), formation maintenance (10), formation reconstruction (11).

Each is closed-loop inverse kinematics (8): v = J^+ (rho_d' + Lambda rho~). The desired centroid path enters as feed-forward
(erratum 3: p_c cancels in the error, so the feed-forward is the velocity of p_cd).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from marlbc_mj import laws
from marlbc_mj.errors import ConfigurationError


@laws.allocation_free
def nearest_obstacle(p: np.ndarray, obstacles: np.ndarray, normal: np.ndarray) -> float:
    """Clearance d = min_k (|p - o_k| - radius_k) [m], negative inside (errata 7), and the outward unit normal.

    Args:
        p: (2,) [m].
        obstacles: (K, 3), rows x, y, radius [m]; K = 0 gives an infinite clearance and a zero normal.
        normal: (2,), written in place; (1, 0) at the very centre of an obstacle, where no direction is defined.
    """
    clearance = np.inf
    normal[0] = 0.0
    normal[1] = 0.0
    for k in range(obstacles.shape[0]):
        x = p[0] - obstacles[k, 0]
        y = p[1] - obstacles[k, 1]
        distance = np.sqrt(x * x + y * y)
        if distance - obstacles[k, 2] < clearance:
            clearance = distance - obstacles[k, 2]
            normal[0] = x / distance if distance > 0.0 else 1.0
            normal[1] = y / distance if distance > 0.0 else 0.0
    return clearance


@laws.compiled
def _fill_clearances(positions, obstacles, out):  # type: ignore[no-untyped-def]
    normal = np.empty(2)
    for k in range(positions.shape[0]):
        out[k] = nearest_obstacle(positions[k], obstacles, normal)


def clearances(positions: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
    """:func:`nearest_obstacle`'s clearance [m] at every one of ``positions`` (..., 2) [m], (...,)."""
    flat = np.ascontiguousarray(positions, dtype=np.float64).reshape(-1, 2)
    out = np.empty(len(flat))
    _fill_clearances(flat, np.ascontiguousarray(obstacles, dtype=np.float64), out)
    return out.reshape(np.shape(positions)[:-1])


@laws.behavior
def obstacle_avoidance(params, p, path, obstacles, team, agent, velocity_out, jacobian_out):  # type: ignore[no-untyped-def]
    """OA (9): v = n Lambda max(0, d_OA - d), J = n^T; ``params`` = Lambda [1/s], d_OA [m], two-sided (0 or 1).

    One-sided by default: the equality task as printed attracts agents from beyond d_OA (erratum 6).
    """
    clearance = nearest_obstacle(p, obstacles, jacobian_out[0])
    error = params[1] - clearance
    if clearance == np.inf or (params[2] == 0.0 and error < 0.0):
        error = 0.0
    velocity_out[0] = jacobian_out[0, 0] * params[0] * error
    velocity_out[1] = jacobian_out[0, 1] * params[0] * error
    return 1


@laws.behavior
def formation(params, p, path, obstacles, team, agent, velocity_out, jacobian_out):  # type: ignore[no-untyped-def]
    """FM (10) and FR (11): v = p_cd' + Lambda (p_cd + offset - p), J = I; ``params`` = Lambda [1/s], offset x, y [m]."""
    velocity_out[0] = path[1, 0] + params[0] * (path[0, 0] + params[1] - p[0])
    velocity_out[1] = path[1, 1] + params[0] * (path[0, 1] + params[2] - p[1])
    jacobian_out[0, 0] = 1.0
    jacobian_out[0, 1] = 0.0
    jacobian_out[1, 0] = 0.0
    jacobian_out[1, 1] = 1.0
    return 2


@runtime_checkable
class Behavior(Protocol):
    """What the engine asks of a behavior: a name, its law, whether J has full rank, and its numbers per agent."""

    @property
    def name(self) -> str: ...
    @property
    def law(self) -> laws.Law: ...
    @property
    def complete(self) -> bool: ...
    def params(self, agent: int) -> Sequence[float]:
        """Numbers handed to the law as ``params`` for this agent."""
        ...


@dataclass(frozen=True)
class ObstacleAvoidance:
    """Keep ``safe_distance`` from the nearest obstacle (9)."""

    gain: float = 20.0  # Lambda_OA [1/s]
    safe_distance: float = 2.0  # d_OA [m]
    two_sided: bool = False  # the printed equality task (erratum 6)
    name: str = "OA"
    complete = False
    law = staticmethod(obstacle_avoidance)

    def __post_init__(self) -> None:
        _require_positive(f"{self.name} gain", self.gain)
        _require_positive(f"{self.name} safe_distance", self.safe_distance)

    def params(self, agent: int) -> tuple[float, ...]:
        return (self.gain, self.safe_distance, float(self.two_sided))


@dataclass(frozen=True)
class Formation:
    """Hold one's slot around the moving desired centroid: FM (10), and with the column's offsets FR (11)."""

    name: str
    offsets: tuple[tuple[float, float], ...]  # one (x, y) per agent [m]
    gain: float = 8.0  # Lambda_FM, Lambda_FR [1/s]
    complete = True
    law = staticmethod(formation)

    def __post_init__(self) -> None:
        _require_positive(f"{self.name} gain", self.gain)
        if not np.isfinite(self.offsets).all():
            raise ConfigurationError(f"{self.name} offsets must be finite, got {self.offsets}")

    def params(self, agent: int) -> tuple[float, ...]:
        return (self.gain, *self.offsets[agent])


def _require_positive(what: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ConfigurationError(f"{what} must be a positive finite number, got {value}")
