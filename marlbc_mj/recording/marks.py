"""Shapes that are drawn in addition to a model: flat ribbons, discs, dashed circles and trails on the ground, and balls."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np

from marlbc_mj.util.palette import agent_color

TRAIL_WIDTH = 0.26  # [m]
TRAIL_TOLERANCE = 0.01  # largest distance of a path from its simplified trail [m]
CIRCLE_WIDTH = 0.14  # [m]
DASH_LENGTH = 0.6  # intended length of a dash [m]
DASH_ANGLE = np.radians(6.0)  # least angle of a dash, which limits their number
SHEET = 0.01  # half the thickness of flat marks [m]

Color = tuple[float, float, float, float]
_UPRIGHT = np.eye(3).ravel()


class Mark(NamedTuple):
    """One shape in a scene."""

    kind: int  # mjtGeom
    size: np.ndarray  # (3,) [m]
    position: np.ndarray  # (3,) [m]
    frame: np.ndarray  # (9,) rotation matrix, by rows
    color: Color


@dataclass(frozen=True)
class Trail:
    """An agent's path, simplified to few straight pieces."""

    agent: int
    time: np.ndarray  # (P,) when each corner is passed [s]
    corner: np.ndarray  # (P, 2) [m]
    pieces: list[Mark]  # P - 1 of them
    scale: float = 1.0

    def until(self, time: float, here: np.ndarray) -> list[Mark]:
        """Marks of the path up to ``time`` [s], which ends at ``here`` (2,) [m]."""
        passed = int(np.searchsorted(self.time, time, side="right"))
        if passed == 0:
            return []
        return [*self.pieces[: passed - 1], _trail_piece(self.agent, self.corner[passed - 1], here, self.scale)]


def add(scene: mujoco.MjvScene, mark: Mark) -> None:
    """Append one shape to a scene that has room for it."""
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, mark.kind, mark.size, mark.position, mark.frame, np.array(mark.color, dtype=np.float32))
    geom.specular = 0.0
    scene.ngeom += 1


def ribbon(a: np.ndarray, b: np.ndarray, width: float, height: float, color: Color, scale: float = 1.0) -> Mark:
    """A flat strip between two points (2,), ``height`` [m] above the ground."""
    along = b - a
    length = float(np.hypot(*along))
    cosine, sine = along / length if length > 1e-9 else (1.0, 0.0)
    size = np.array([0.5 * length + 0.25 * width, 0.5 * width, SHEET * scale])
    frame = np.array([cosine, -sine, 0.0, sine, cosine, 0.0, 0.0, 0.0, 1.0])
    return Mark(mujoco.mjtGeom.mjGEOM_BOX, size, np.array([*(0.5 * (a + b)), height]), frame, color)


def flat_disc(center: np.ndarray, radius: float, height: float, color: Color, scale: float = 1.0) -> Mark:
    """A flat disc around ``center`` (2,), ``height`` [m] above the ground."""
    size = np.array([radius, SHEET * scale, 0.0])
    return Mark(mujoco.mjtGeom.mjGEOM_CYLINDER, size, np.array([*center, height]), _UPRIGHT, color)


def ball(center: np.ndarray, radius: float, color: Color) -> Mark:
    """A ball of ``radius`` [m] that rests on the ground at ``center`` (2,)."""
    return Mark(mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius), np.array([*center, radius]), _UPRIGHT, color)


def dashed_circle(center: np.ndarray, radius: float, color: Color, scale: float = 1.0) -> list[Mark]:
    """A circle of dashes around ``center`` (2,) on the ground; ``DASH_LENGTH`` and ``DASH_ANGLE`` set their number.

    In this module, ``scale`` is the drawn length of 1 m of a mark [m]: less than 1 in a mission of small robots.
    """
    dashes = int(np.clip(np.pi * radius / (DASH_LENGTH * scale), 8, np.pi / DASH_ANGLE))
    turn = np.linspace(0.0, 2.0 * np.pi, 2 * dashes, endpoint=False)
    points = center + radius * np.column_stack([np.cos(turn), np.sin(turn)])
    size = CIRCLE_WIDTH * scale, 0.03 * scale, color, scale
    return [ribbon(points[k], points[k + 1], *size) for k in range(0, 2 * dashes, 2)]


def make_trail(agent: int, time: np.ndarray, path: np.ndarray, scale: float = 1.0) -> Trail:
    """The trail of a path (M, 2) [m], its points passed at ``time`` (M,) [s]."""
    corners = corner_indices(path, TRAIL_TOLERANCE * scale)
    points = path[corners]
    pieces = [_trail_piece(agent, a, b, scale) for a, b in pairwise(points)]
    return Trail(agent, time[corners], points, pieces, scale)


def corner_indices(path: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices of the points that keep a polyline within ``tolerance`` [m] of a path (M, 2) (Ramer, Douglas and Peucker)."""
    kept = {0, len(path) - 1}
    spans = [(0, len(path) - 1)]
    while spans:
        a, b = spans.pop()
        if b - a < 2:
            continue
        distance = _distances(path[a + 1 : b] - path[a], path[b] - path[a])
        worst = int(distance.argmax())
        if distance[worst] > tolerance:
            middle = a + 1 + worst
            kept.add(middle)
            spans += [(a, middle), (middle, b)]
    return np.array(sorted(kept))


def _distances(points: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(P,) distances of points (P, 2) from the segment that starts at the origin and ends at ``along`` (2,)."""
    squared = float(along @ along)
    share = np.clip(points @ along / squared, 0.0, 1.0) if squared > 0.0 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - share[:, None] * along, axis=1))


def _trail_piece(agent: int, a: np.ndarray, b: np.ndarray, scale: float) -> Mark:
    """One straight piece of a trail; heights differ slightly between agents, so that crossing trails do not flicker."""
    height = 0.04 + 0.002 * (agent % 8)
    return ribbon(a, b, TRAIL_WIDTH * scale, height * scale, agent_color(agent), scale)
