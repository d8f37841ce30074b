"""Robots by name, each with an MJCF file and a Python file, or from the path of a user's file."""

from collections.abc import Callable, Sequence
from functools import cache

from marlbc_mj.robots.base import MODELS, Robot
from marlbc_mj.robots.crazyflie import CRAZYFLIE, crazyflie
from marlbc_mj.robots.diff_drive import DIFF_DRIVE, diff_drive
from marlbc_mj.robots.disc import DISC, disc
from marlbc_mj.robots.fleet import RobotFleet
from marlbc_mj.robots.omni import OMNI, omni
from marlbc_mj.robots.point_mass import POINT_MASS, point_mass
from marlbc_mj.robots.user import Stamp, is_file, load, stamp_of
from marlbc_mj.util.errors import ConfigurationError, unknown

ROBOTS: dict[str, tuple[Callable[[], Robot], str]] = {
    "point_mass": (point_mass, POINT_MASS),
    "disc": (disc, DISC),
    "omni": (omni, OMNI),
    "diff_drive": (diff_drive, DIFF_DRIVE),
    "crazyflie": (crazyflie, CRAZYFLIE),
}
"""Factory and one-line description of each robot, by name."""

_make = cache(lambda factory: factory())
_loaded: dict[str, tuple[Stamp, Robot]] = {}


def _load(name: str) -> Robot:
    """The robot of a user's file; it is loaded again after an edit or when the name resolves to another file."""
    stamp = stamp_of(name)
    if name not in _loaded or _loaded[name][0] != stamp:
        _loaded[name] = stamp, load(name)
    return _loaded[name][1]


def make_robot(name: str) -> Robot:
    """A robot by name, or from the path of a user's ``.py`` or ``.xml`` file.

    Raises:
        ConfigurationError: an unknown name, an unusable file, or a missing optional package.
    """
    if name in ROBOTS:
        robot: Robot = _make(ROBOTS[name][0])
        return robot
    if is_file(name):
        return _load(name)
    raise unknown("robot", name, (*ROBOTS, "a path that ends in .py or .xml"))


def make_fleet(names: Sequence[str]) -> RobotFleet:
    """The robots of a team, from the names of all agents' robots.

    Raises:
        ConfigurationError: as :func:`make_robot`, or robots that cannot share a world.
    """
    fleet = RobotFleet(tuple(map(make_robot, names)))
    fleet.check_ground()
    return fleet


def register(robot: Robot) -> Robot:
    """Register a user's robot under its name, so that scenarios in this process can use it.

    Raises:
        ConfigurationError: another robot has that name.
    """
    if robot.name in ROBOTS and _make(ROBOTS[robot.name][0]) != robot:
        raise ConfigurationError(f"a robot named {robot.name!r} exists; names that are taken: {', '.join(ROBOTS)}")
    ROBOTS[robot.name] = (lambda: robot, robot.description)
    return robot


__all__ = ["MODELS", "ROBOTS", "RobotFleet", "Robot", "make_fleet", "make_robot", "register"]
