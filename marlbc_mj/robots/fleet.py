"""The robots of one team, agent by agent: what they have in common, and whose scale counts where they differ."""

from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.robots.base import Robot
from marlbc_mj.util.errors import ConfigurationError


class AgentGroup(NamedTuple):
    """Adjacent agents with the same robot."""

    first: int
    end: int  # behind the last of them
    robot: Robot


@dataclass(frozen=True)
class RobotFleet:
    """The robots of a team, one per agent, in the order of the agents; they may differ.

    Where one number is wanted for the whole team, that of the robot counts that is hardest to please: the greatest size and
    length unit, the smallest speed, acceleration and substep.
    """

    robots: tuple[Robot, ...]

    @property
    def mixed(self) -> bool:
        """Whether two of them differ."""
        return any(robot is not self.robots[0] for robot in self.robots)

    @property
    def kinds(self) -> tuple[Robot, ...]:
        """Each different robot once, in the order in which they occur."""
        return tuple({id(robot): robot for robot in self.robots}.values())

    @property
    def groups(self) -> tuple[AgentGroup, ...]:
        """Adjacent agents with the same robot; agents keep their numbers, so a kind may have several groups."""
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
        """The robots in messages: ``'disc'``, or ``'disc' and 'omni'``."""
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
        """Greatest length unit: what 1 m of the paper's mission is for the team [m]."""
        return max(robot.length for robot in self.robots)

    @property
    def height(self) -> float:
        """Greatest height [m]; 0 where nobody flies."""
        return max(robot.height for robot in self.robots)

    @property
    def contact(self) -> bool:
        """Whether obstacles are solid: to any of them."""
        return self.solid is not None

    @property
    def solid(self) -> str | None:
        """Name of the first robot to which obstacles are solid."""
        return next((robot.name for robot in self.robots if robot.contact), None)

    @property
    def floating(self) -> bool:
        """Whether any moves on a free joint, so that it has a pose."""
        return any(len(robot.joints) == 1 for robot in self.robots)

    @property
    def massive(self) -> bool:
        """Whether any has a mass of its own."""
        return any(robot.mass is not None for robot in self.robots)

    def least(self, name: str) -> float:
        """Smallest value of a robot's field."""
        return min(float(getattr(robot, name)) for robot in self.robots)

    def masses(self, own: float) -> np.ndarray:
        """(N,) masses [kg]; those without a mass have their scenario's ``own``."""
        return np.array([own if robot.mass is None else robot.mass for robot in self.robots], dtype=np.float64)

    def unit_forces(self, own: float) -> np.ndarray:
        """(N,) what a controller's output of 1 is [N]: the scenario's ``own`` in a team of one robot, else each robot's mass."""
        return self.masses(own) if self.mixed else np.full(len(self.robots), own, dtype=np.float64)

    def force_limits(self, limit: float) -> np.ndarray:
        """(N,) force limits per axis [N]: the scenario's, and no more than each robot has."""
        return np.array([min(limit, robot.force_limit) for robot in self.robots], dtype=np.float64)

    def scale(self) -> dict[str, Any]:
        """The fields of a :class:`~marlbc_mj.scenarios.Scenario` that these robots set.

        In a mixed team every agent has its robot's own mass, force limit and force unit. The scenario's ``force_limit`` is the
        greatest of them; ``speed_limit``, ``acceleration_limit`` and ``substep`` are the smallest. The scenario's ``mass`` and
        ``unit_force`` stand for robots that have none. What is unlimited is left out.
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
        """Raise ConfigurationError where a scenario asks of these robots what they are not."""
        if not self.mixed:
            self.robots[0].check(scenario)
            return
        for robot in self.kinds:
            robot.check_limit(scenario, "substep")

    def check_ground(self) -> None:
        """Raise ConfigurationError where one stands on the arena's ground and another on a floor of its own file."""
        standing = [robot.name for robot in self.kinds if robot.ground]
        others = [robot.name for robot in self.kinds if robot.contact and not robot.ground and not robot.height]
        if standing and others:
            raise ConfigurationError(
                f"robots {standing[0]!r} and {others[0]!r} cannot be in one world: the first stands on the arena's ground, the "
                "second on a floor of its own file"
            )
