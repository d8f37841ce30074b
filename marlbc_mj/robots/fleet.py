"""The robots of one team, one per agent, and the numbers that apply to the whole team if they differ."""

from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.robots.base import Robot
from marlbc_mj.util.errors import ConfigurationError


class AgentGroup(NamedTuple):
    """Adjacent agents with the same robot."""

    first: int
    end: int  # one past the last agent
    robot: Robot


@dataclass(frozen=True)
class RobotFleet:
    """The robots of a team, one per agent, in the order of the agents; they may differ.

    A single number for the whole team is the most restrictive one: the greatest size and length unit, the smallest speed,
    acceleration and substep.
    """

    robots: tuple[Robot, ...]

    @property
    def mixed(self) -> bool:
        """Whether any two robots differ."""
        return any(robot is not self.robots[0] for robot in self.robots)

    @property
    def kinds(self) -> tuple[Robot, ...]:
        """Each distinct robot once, in order of first occurrence."""
        return tuple({id(robot): robot for robot in self.robots}.values())

    @property
    def groups(self) -> tuple[AgentGroup, ...]:
        """Groups of adjacent agents with the same robot; agents keep their numbers, so a robot may have several groups."""
        found, first = [], 0
        for _, members in groupby(self.robots, key=id):
            same = list(members)
            found.append(AgentGroup(first, first + len(same), same[0]))
            first += len(same)
        return tuple(found)

    @property
    def driven(self) -> tuple[AgentGroup, ...]:
        """Groups whose robots have laws of their own."""
        return tuple(group for group in self.groups if not group.robot.direct)

    @property
    def words(self) -> str:
        """Names of the robots for messages: ``'disc'``, or ``'disc' and 'omni'``."""
        first, *others = [repr(robot.name) for robot in self.kinds]
        return f"{', '.join([first, *others[:-1]])} and {others[-1]}" if others else first

    @property
    def radius(self) -> float:
        """Greatest radius [m]."""
        return max(robot.radius for robot in self.robots)

    @property
    def radii(self) -> np.ndarray:
        """(N,) radii [m]."""
        return np.array([robot.radius for robot in self.robots])

    @property
    def length(self) -> float:
        """Greatest length unit: 1 m of the paper's mission at the team's scale [m]."""
        return max(robot.length for robot in self.robots)

    @property
    def height(self) -> float:
        """Greatest flight height [m]; 0 if no robot flies."""
        return max(robot.height for robot in self.robots)

    @property
    def contact(self) -> bool:
        """Whether obstacles are solid to any of the robots."""
        return self.solid is not None

    @property
    def solid(self) -> str | None:
        """Name of the first robot to which obstacles are solid."""
        return next((robot.name for robot in self.robots if robot.contact), None)

    @property
    def floating(self) -> bool:
        """Whether any robot has a free joint, and so a pose."""
        return any(len(robot.joints) == 1 for robot in self.robots)

    @property
    def massive(self) -> bool:
        """Whether any robot has a mass of its own."""
        return any(robot.mass is not None for robot in self.robots)

    def least(self, name: str) -> float:
        """Smallest value of a field over all robots."""
        return min(float(getattr(robot, name)) for robot in self.robots)

    def masses(self, own: float) -> np.ndarray:
        """(N,) masses [kg]; robots without a mass take ``own``, the scenario's mass."""
        return np.array([own if robot.mass is None else robot.mass for robot in self.robots], dtype=np.float64)

    def unit_forces(self, own: float) -> np.ndarray:
        """(N,) forces for a controller's output of 1 [N]: each robot's mass in a mixed team, else ``own``, the scenario's."""
        return self.masses(own) if self.mixed else np.full(len(self.robots), own, dtype=np.float64)

    def force_limits(self, limit: float) -> np.ndarray:
        """(N,) force limits per axis [N]: the scenario's ``limit``, capped by each robot's own."""
        return np.array([min(limit, robot.force_limit) for robot in self.robots], dtype=np.float64)

    def scale(self) -> dict[str, Any]:
        """The fields of a :class:`~marlbc_mj.scenarios.Scenario` that these robots set.

        In a mixed team every agent uses its robot's own mass, force limit and force unit. The scenario's ``force_limit`` is the
        greatest force limit; ``speed_limit``, ``acceleration_limit`` and ``substep`` are the smallest ones. The scenario's
        ``mass`` and ``unit_force`` apply to robots without a mass. Infinite limits are omitted.
        """
        first = self.robots[0]
        if not self.mixed:
            return first.scale()
        names = tuple(robot.name for robot in self.robots)
        numbers = {"force_limit": max(float(robot.force_limit) for robot in self.robots)}
        numbers |= {name: self.least(name) for name in ("speed_limit", "acceleration_limit", "substep")}
        finite = {name: value for name, value in numbers.items() if np.isfinite(value)}
        return {"robot": names[0], "robots": names, **finite}

    def check(self, scenario: Any) -> None:
        """Raise ConfigurationError if a scenario does not fit these robots; for a mixed team only the substep is checked."""
        if not self.mixed:
            self.robots[0].check(scenario)
            return
        for robot in self.kinds:
            robot.check_limit(scenario, "substep")

    def check_ground(self) -> None:
        """Raise ConfigurationError if one robot stands on the arena's ground and another on a floor in its own MJCF."""
        standing = [robot.name for robot in self.kinds if robot.ground]
        others = [robot.name for robot in self.kinds if robot.contact and not robot.ground and not robot.height]
        if standing and others:
            raise ConfigurationError(
                f"robots {standing[0]!r} and {others[0]!r} cannot be in one world: the first stands on the arena's ground, the "
                "second on a floor in its own file"
            )
