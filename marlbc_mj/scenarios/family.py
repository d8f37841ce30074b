"""The base of all families of missions: a frozen dataclass of a team, its formation and its route that builds a scenario.

A team starts at rest in formation at the origin, travels ``length`` along +x at ``speed``, and forms a column (FR) when its
supervisor chooses it. Every length, speed, gain and limit is a field, so a family fits robots of any size. Settings that make a
mission infeasible are rejected with the reason when the scenario is built.
"""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from marlbc_mj.core.behaviors import Behavior
from marlbc_mj.core.communication import IDEAL, Communication
from marlbc_mj.core.disturbances import Disturbance, PaperDrag
from marlbc_mj.core.imperfections import NO_IMPERFECTIONS, Imperfections
from marlbc_mj.scenarios.base import Obstacle, Perturbation, Point, Scenario, Window, standard_behaviors
from marlbc_mj.scenarios.formations import column, make_formation
from marlbc_mj.scenarios.layout import Layout, motions_of
from marlbc_mj.scenarios.obstacles import Range
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.settings import check_kinds

NOMINAL = 0
"""Number of the layout that a scenario contains before a seed is drawn; it is a training layout."""


@dataclass(frozen=True, kw_only=True)
class Mission:
    """The settings of a mission that do not depend on its route: time steps, robots, avoidance and formation."""

    name: str
    safe_distance: float = 1.0  # from obstacles: d_OA [m]
    agent_avoidance: bool = True  # whether AA is one of the behaviors
    agent_distance: float = 1.5  # between agents: d_AA [m]
    avoidance_gain: float = 20.0  # gain of OA and AA [1/s]
    formation_gain: float  # gain of FM and FR [1/s]
    formation_tolerance: float = 0.5  # largest distance from the slot, relative to the centroid [m]
    mission_step: float = 0.05  # [s]
    substep: float = 0.005  # [s]
    reference: Literal["virtual", "actual"] = "virtual"
    composition: Literal["null-space", "set-based"] = "null-space"  # avoidance as an equality task, or as an inequality
    column_approach: Literal["straight", "line"] = "straight"  # how FR approaches its slots, see LineFormation
    robot: str = "point_mass"  # robot of all agents
    robots: tuple[str, ...] = ()  # robot of each agent if they differ
    mass: float = 1.0  # [kg]
    force_limit: float = 200.0  # per axis [N]
    unit_force: float = 1.0  # force for a controller's output of 1 [N]; a robot's scale sets it to the robot's mass
    speed_limit: float = np.inf  # speed limit of references [m/s]
    acceleration_limit: float = np.inf  # acceleration limit of references [m/s^2]
    imperfections: Imperfections = NO_IMPERFECTIONS
    communication: Communication = IDEAL
    disturbance: Disturbance = field(default_factory=PaperDrag)
    perturbation: Perturbation = field(default_factory=Perturbation)

    def shared(self) -> dict[str, Any]:
        """The fields that a scenario has under the same name."""
        known = {f.name for f in fields(Scenario)}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name in known}

    def behaviors_for(
        self, slots: tuple[Point, ...], column: tuple[Point, ...], *, two_sided: bool = False
    ) -> tuple[Behavior, ...]:
        """OA, FM and FR, and AA if agents avoid each other. The line width of FR is ``agent_distance``."""
        return standard_behaviors(
            slots,
            column,
            avoidance_gain=self.avoidance_gain,
            formation_gain=self.formation_gain,
            safe_distance=self.safe_distance,
            two_sided=two_sided,
            agent_distance=self.agent_distance if self.agent_avoidance else None,
            line_width=self.agent_distance if self.column_approach == "line" else None,
        )


@dataclass(frozen=True, kw_only=True)
class Family(Mission):
    """The base of all families; used by itself, a mission without obstacles.

    Raises:
        ConfigurationError: from :meth:`build`, for settings that make the mission infeasible; the message names value and reason.
    """

    name: str = "open"
    formation_gain: float = 4.0  # gain of FM and FR [1/s]; half the case study's, which gives references of up to 96 m/s
    agents: int = 4  # 2 to 256
    formation: str = "wedge"  # line, wedge, circle or grid
    spacing: float = 6.0  # between neighbors in formation [m]
    files: int = 1  # number of columns side by side that FR forms
    column_spacing: float = 3.0  # between neighbors in the column [m]
    length: float = 60.0  # length of the route [m]
    speed: float = 1.0  # speed of the desired centroid [m/s]
    two_sided: bool = False  # OA as the published equality (erratum 6)
    split: Literal["train", "test"] = "train"  # which layouts are drawn; "test" layouts are held out
    summary: ClassVar[str] = "nothing in the way"
    cluttered: ClassVar[bool] = False  # whether the route must have room for obstacles

    @cached_property
    def slots(self) -> np.ndarray:
        """(N, 2) slot offsets of the formation [m]."""
        return make_formation(self.formation, self.agents, self.spacing)

    @cached_property
    def column(self) -> np.ndarray:
        """(N, 2) slot offsets of the column [m]."""
        return column(self.slots, self.column_spacing, self.files)

    @property
    def way(self) -> Range:
        """Range of x for obstacle surfaces that keeps the formation clear of them at both ends of the route [m]."""
        margin = self.safe_distance + self.formation_tolerance
        return float(self.slots[:, 0].max() + margin), float(self.length + self.slots[:, 0].min() - margin)

    @property
    def reach(self) -> float:
        """Half the width of the formation [m]."""
        return float(np.abs(self.slots[:, 1]).max())

    def layout(self) -> Layout | None:
        """The layout that draws the obstacles; None without obstacles."""
        return None

    def schedule(self) -> tuple[Window, ...]:
        """Windows for the scripted supervisor; empty if every seed would need other windows."""
        return (Window(0.0, 0.0, -1, "FM"),)

    def starts(self) -> np.ndarray:
        """(N, 2) start positions [m]."""
        return self.slots

    def build(self, **changes: Any) -> Scenario:
        """The scenario; ``changes`` replace fields of the family, or of the scenario if the family has no such field."""
        own = {f.name for f in fields(self)}
        family = replace(self, **{key: value for key, value in changes.items() if key in own})
        rest = {key: value for key, value in changes.items() if key not in own}
        unfit = set(rest) - {f.name for f in fields(Scenario)}
        if unfit:
            raise ConfigurationError(
                f"scenario {self.name!r} has no setting {sorted(unfit)[0]!r}; it has: {', '.join(sorted(own))}"
            )
        check_kinds(family, f"scenario {family.name!r}: ")
        family.check()
        return family._scenario(rest)

    def check(self) -> None:
        """Raise ConfigurationError for settings that make the mission infeasible."""
        slots = self.slots  # rejects an unknown formation and a team that is too small or too large
        for key in ("length", "speed", "column_spacing", "agent_distance"):
            value = getattr(self, key)
            if not (np.isfinite(value) and value > 0):
                raise self.infeasible(f"{key} must be positive and finite, got {value}")
        if not 1 <= self.files <= self.agents:
            raise self.infeasible(f"files must be from 1 to {self.agents}, got {self.files}")
        for key in ("spacing", "column_spacing") if self.agent_avoidance else ():
            if getattr(self, key) < 1.1 * self.agent_distance:
                least = f"1.1 times the agent_distance of {self.agent_distance:g} m"
                value = getattr(self, key)
                raise self.infeasible(f"{key} must be at least {least}, or AA would break up the formation; got {value:g} m")
        if self.cluttered and not self.way[0] < self.way[1]:
            extent = float(np.ptp(slots[:, 0]))
            raise self.infeasible(
                f"a formation {extent:g} m long leaves no room for obstacles on a path of {self.length:g} m; make the path longer"
            )

    def behaviors(self) -> tuple[Behavior, ...]:
        """The behaviors for the family's formation and column."""
        return self.behaviors_for(points(self.slots), points(self.column), two_sided=self.two_sided)

    def infeasible(self, reason: str) -> ConfigurationError:
        """The error that rejects this family's parameters."""
        return ConfigurationError(f"scenario {self.name!r} is infeasible: {reason}")

    def _scenario(self, rest: dict[str, Any]) -> Scenario:
        layout = self.layout()
        try:
            sample = None if layout is None else layout.sample(np.random.default_rng(NOMINAL))
        except ConfigurationError as error:
            raise self.infeasible(str(error)) from error
        made: dict[str, Any] = {
            **self.shared(),
            "starts": points(self.starts()),
            "behaviors": self.behaviors(),
            "path_velocity": (self.speed, 0.0),
            "obstacles": () if sample is None else tuple(Obstacle(*row) for row in sample.obstacles.tolist()),
            "motions": () if sample is None else motions_of(sample.motions),
            "layout": layout,
            "duration": self.mission_step * round(self.length / self.speed / self.mission_step),
            "schedule": self.schedule(),
            "description": f"{self.agents} agents in a {self.formation}: {self.summary}",
        }
        return Scenario(**{**made, **rest})


def points(rows: np.ndarray) -> tuple[tuple[float, float], ...]:
    """The rows of an (n, 2) array as a tuple of points."""
    return tuple((float(x), float(y)) for x, y in rows)
