"""Families of missions, one per kind of obstacles; every seed draws new positions. Their base class is in
:mod:`marlbc_mj.scenarios.family`. A family is used by name, from a TOML file, or as a Python object:
``Field(agents=9, formation="grid").build()``.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from marlbc_mj.scenarios.base import Perturbation, Scenario, Window
from marlbc_mj.scenarios.family import Family
from marlbc_mj.scenarios.layout import Layout
from marlbc_mj.scenarios.obstacles import Range, Scatter, Traffic, Walls
from marlbc_mj.util.errors import ConfigurationError

START_SPREAD = Perturbation(start_spread=0.5)


@dataclass(frozen=True, kw_only=True)
class Exchange(Family):
    """Agents on a circle swap places with the opposite side; without agent avoidance all of them meet in the middle."""

    name: str = "exchange"
    agents: int = 8
    formation: str = "circle"
    spacing: float = 6.0
    column_spacing: float = 4.0
    length: float = 40.0
    formation_gain: float = 0.2  # about 3 m/s at the start, slow enough for AA to act
    agent_distance: float = 2.5
    perturbation: Perturbation = START_SPREAD
    summary: ClassVar[str] = "everyone starts opposite its slot, so that all paths cross"

    def starts(self) -> np.ndarray:
        return -self.slots


@dataclass(frozen=True, kw_only=True)
class Field(Family):
    """Discs of random sizes at random places."""

    name: str = "field"
    obstacles: int = 12
    radius: Range = (0.5, 2.0)  # [m]
    margin: float = 3.0  # extra width of the field on each side of the formation [m]
    gap: float = 3.0  # least distance between the surfaces of two discs [m]
    summary: ClassVar[str] = "a field of discs, drawn by the seed"
    cluttered: ClassVar[bool] = True

    def check(self) -> None:
        super().check()
        self.check_discs(self.obstacles, self.radius)
        if self.gap <= 2.0 * self.safe_distance:
            raise self.infeasible(
                f"a gap of {self.gap:g} m has no place farther than the safe distance {self.safe_distance:g} m from both discs; "
                f"it must exceed {2.0 * self.safe_distance:g} m"
            )

    def check_discs(self, count: int, radius: Range) -> None:
        """Raise ConfigurationError for an invalid number or range of radii."""
        if count < 1:
            raise self.infeasible(f"obstacles must be at least 1, got {count}; the family 'open' has none")
        if not (np.isfinite(radius).all() and 0 <= radius[0] <= radius[1]):
            raise self.infeasible(f"radius must be an ordered range of non-negative numbers, got {tuple(radius)}")
        if self.way[1] - self.way[0] <= 2.0 * radius[1]:
            raise self.infeasible(
                f"no disc of radius {radius[1]:g} m fits between {self.way[0]:g} and {self.way[1]:g} m of the way"
            )

    def layout(self) -> Layout:
        return self.scatter(self.obstacles, self.radius, self.gap)

    def scatter(self, count: int, radius: Range, gap: float) -> Scatter:
        """Discs at random places along the whole route."""
        first, last, width = self.way[0] + radius[1], self.way[1] - radius[1], self.reach + self.margin
        return Scatter(count, radius, (first, last), (-width, width), gap)

    def schedule(self) -> tuple[Window, ...]:
        return ()  # every seed would need its own schedule


@dataclass(frozen=True, kw_only=True)
class Forest(Field):
    """Many thin trunks, far enough apart for an agent to pass between any two."""

    name: str = "forest"
    obstacles: int = 0  # 0: the number follows from ``density``
    density: float = 0.025  # trunks per square metre
    radius: Range = (0.15, 0.4)
    safe_distance: float = 0.75
    gap: float = 2.5
    summary: ClassVar[str] = "a forest of thin trunks, drawn by the seed"

    def check(self) -> None:
        if not (np.isfinite(self.density) and self.density > 0):
            raise self.infeasible(f"density must be positive and finite, got {self.density}")
        replace(self, obstacles=self.trunks)._check_field()

    def _check_field(self) -> None:
        super().check()

    @property
    def trunks(self) -> int:
        """Number of trunks."""
        area = (self.way[1] - self.way[0]) * 2.0 * (self.reach + self.margin)
        return self.obstacles or max(1, round(self.density * area))

    def layout(self) -> Layout:
        return self.scatter(self.trunks, self.radius, self.gap)


@dataclass(frozen=True, kw_only=True)
class Gates(Family):
    """Walls of discs across the route, each with one opening of the same width."""

    name: str = "gates"
    gates: int = 2
    width: float = 5.0  # free width of an opening, between the surfaces of the discs [m]
    shift: float = 0.75  # largest distance of an opening's middle from the path [m]
    post: float = 1.5  # radius of the discs that form a wall [m]
    depth: float = 0.0  # length of the passage behind an opening [m]
    summary: ClassVar[str] = "walls across the way, each with an opening at a drawn place"
    cluttered: ClassVar[bool] = True

    def check(self) -> None:
        super().check()
        for key, least in (("width", 0.0), ("post", 0.0), ("shift", -1e-12), ("depth", -1e-12)):
            value = getattr(self, key)
            if not (np.isfinite(value) and value > least):
                raise self.infeasible(f"{key} must be {'non-negative' if least else 'positive'} and finite, got {value}")
        if self.gates < 1:
            raise self.infeasible(f"gates must be at least 1, got {self.gates}; the family 'open' has none")
        file = 0.5 * float(np.ptp(self.column[:, 1]))
        least = 2.0 * (self.safe_distance + self.shift + file)
        if self.width <= least:
            raise self.infeasible(
                f"an opening {self.width:g} m wide, up to {self.shift:g} m beside the path, does not let a column {2 * file:g} m "
                f"wide pass at the safe distance {self.safe_distance:g} m; it must exceed {least:g} m"
            )
        if self._pitch() < self.depth + 2.0 * self.post:
            each, whole = self.depth + 2.0 * self.post, float(np.ptp(self.way))
            raise self.infeasible(f"{self.gates} passages of {each:g} m do not fit into a way of {whole:g} m")

    def _pitch(self) -> float:
        """Distance from one opening to the next [m]."""
        return float(np.ptp(self.way)) / self.gates

    def passages(self) -> tuple[Range, ...]:
        """Start and end of each passage along the route [m]; a passage is in the middle of its share of the route."""
        middles = self.way[0] + self._pitch() * (np.arange(self.gates) + 0.5)
        return tuple((float(x - 0.5 * self.depth), float(x + 0.5 * self.depth)) for x in middles)

    def layout(self) -> Layout:
        return Walls(self.passages(), self.width, self.shift, self.post, self.reach + self.safe_distance + 2.0 * self.post)

    def schedule(self) -> tuple[Window, ...]:
        """Column (FR) from before the first agent comes near a wall until the last agent has left it."""
        farthest = float(np.linalg.norm(self.slots - self.column, axis=1).max())
        settle = 1.0 + float(np.log(max(2.0, farthest / self.formation_tolerance))) / self.formation_gain
        zone = self.post + self.safe_distance
        front = float(max(self.slots[:, 0].max(), self.column[:, 0].max()))
        rear = float(min(self.slots[:, 0].min(), self.column[:, 0].min()))
        windows: list[Window] = []
        for first, last in self.passages():
            start, end = (first - zone - front) / self.speed - settle, (last + zone - rear) / self.speed + 0.5
            if windows and start < windows[-1].end:
                windows[-1] = windows[-1]._replace(end=end)
            else:
                windows.append(Window(start, end, -1, "FR"))
        return tuple(windows)


@dataclass(frozen=True, kw_only=True)
class Corridor(Gates):
    """One wall whose opening leads into a long passage between two walls."""

    name: str = "corridor"
    gates: int = 1
    depth: float = 20.0
    post: float = 1.0
    summary: ClassVar[str] = "a wall across the way, and behind its opening a corridor"


@dataclass(frozen=True, kw_only=True)
class TrafficFamily(Family):
    """Moving obstacles, which the paper's Assumption 2 excludes: some cross the route as the team passes, others swing across."""

    name: str = "traffic"
    obstacles: int = 6
    swinging: int = 3  # number of obstacles that swing; the others cross
    radius: Range = (0.5, 1.5)  # [m]
    obstacle_speed: Range = (0.3, 1.0)  # [m/s]
    swing: Range = (2.0, 5.0)  # amplitude [m]
    gap: float = 3.0  # least distance between the surfaces of two obstacles at any time [m]
    summary: ClassVar[str] = "obstacles that cross the way or swing across it"
    cluttered: ClassVar[bool] = True

    def check(self) -> None:
        super().check()
        if self.obstacles < 1 or not 0 <= self.swinging <= self.obstacles:
            raise self.infeasible(
                f"obstacles must be at least 1 and swinging from 0 to obstacles, got {self.obstacles} and {self.swinging}"
            )
        for key, least in (("radius", 0.0), ("obstacle_speed", 1e-9), ("swing", 1e-9)):
            low, high = getattr(self, key)
            if not (np.isfinite((low, high)).all() and least <= low <= high):
                raise self.infeasible(f"{key} must be an ordered range of positive numbers, got {(low, high)}")
        if self.gap <= 2.0 * self.safe_distance:
            raise self.infeasible(f"gap must exceed twice the safe distance, {2 * self.safe_distance:g} m, got {self.gap:g} m")

    def layout(self) -> Layout:
        zone = self.safe_distance + self.formation_tolerance
        lows, highs = self.slots.min(axis=0) - zone, self.slots.max(axis=0) + zone
        boxes = tuple((x + lows[0], x + highs[0], lows[1], highs[1]) for x in (0.0, self.length))
        return Traffic(
            count=self.obstacles,
            swinging=self.swinging,
            radius=self.radius,
            speed=self.obstacle_speed,
            swing=self.swing,
            x=(self.way[0] + self.radius[1], self.way[1] - self.radius[1]),
            y=0.5 * self.reach,
            arrival=(0.0, 1.0 / self.speed),
            spread=0.1 * self.length / self.speed,
            end=self.length / self.speed,
            keep_out=boxes,
            gap=self.gap,
        )

    def schedule(self) -> tuple[Window, ...]:
        return ()


FAMILIES: dict[str, type[Family]] = {
    "open": Family,
    "exchange": Exchange,
    "field": Field,
    "forest": Forest,
    "gates": Gates,
    "corridor": Corridor,
    "traffic": TrafficFamily,
}
"""Family classes by name."""


def held_out(scenario: Scenario) -> Scenario:
    """The same scenario with layouts that no training seed draws.

    Raises:
        ConfigurationError: the scenario draws no layouts.
    """
    if scenario.layout is None:
        drawn = ", ".join(name for name, family in FAMILIES.items() if family().layout() is not None)
        raise ConfigurationError(
            f"scenario {scenario.name!r} draws no layouts, so none can be held out; scenarios that do: {drawn}"
        )
    return replace(scenario, split="test")
