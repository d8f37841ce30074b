"""Model assembly: arena + N robots + the scenario's obstacles, built with MjSpec and returned as one MJCF text.

The engine compiles this text, and the dm_control arena is made from the same text, so both use the same model.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import mujoco
import numpy as np

from marlbc_mj.robots import MODELS, Robot, RobotFleet
from marlbc_mj.robots.standard import quiet
from marlbc_mj.scenarios.base import Obstacle, Scenario, desired_centroid
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.palette import agent_color
from marlbc_mj.util.text import one_line

POINT_RADIUS = 0.25  # drawn radius of a point obstacle, in the robot's length unit
OBSTACLE_HEIGHT = 1.2  # in the robot's length unit
LEAST_SOLID = 0.05  # radius of a point obstacle that robots can hit, in the robot's length unit
MARGIN = 4.0  # free space around the mission in the top camera's picture, in the robot's length unit
MEMORY = 256 * 1024  # arena of one MjData [bytes]; MuJoCo's default is 13.6 MB, too much for thousands of worlds
MEMORY_PER_AGENT = 4 * 1024  # for each agent beyond 32; 256 agents use 133 KiB, measured. Only used memory becomes resident
MEMORY_OF_CONTACTS = 512 * 1024  # for each agent instead, if a robot has a mass of its own and so may have contacts [bytes]
_OWN = ("timestep", "disableflags")
OPTIONS = tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_") and name not in _OWN)
"""Options that the arena takes over from a robot's MJCF, including gravity and air, on which flying and sliding robots depend.
The time step is the scenario's."""
MEDIUM = ("gravity", "wind", "density", "viscosity", "magnetic", "disableflags")
"""Options that must be equal for all robots of one world. Of the others, a robot's default gives way to another robot's value."""


def agent_prefix(agent: int) -> str:
    """Prefix of every MJCF name of one agent: ``agent1_`` for agent 0, since the paper counts from 1."""
    return f"agent{agent + 1}_"


def assemble(scenario: Scenario, limit: float) -> str:
    """Assemble the MJCF of a scenario.

    Args:
        scenario: provides the robots, the obstacles and the substep.
        limit: force range of every motor [N]. Infinite, for laws that ignore the actuator limit, removes the range of motors of a
            robot without a mass or a force limit of its own.

    Raises:
        ConfigurationError: an unknown robot, a robot that MuJoCo does not accept several times, robots with contradicting
            options, or a limit that is not positive.
    """
    if not limit > 0:
        raise ConfigurationError(f"force limit must be positive, got {limit}")
    fleet = scenario.fleet
    spec = _arena().copy()
    spec.modelname = scenario.name
    spec.option.timestep = scenario.substep
    spec.memory = MEMORY + MEMORY_PER_AGENT * max(0, scenario.agents - 32)
    _prepare_arena(spec, fleet)
    for agent, robot in enumerate(fleet.robots):
        _attach(spec, robot, agent, scenario.mass, limit)
    for k, obstacle in enumerate(scenario.obstacles):
        _add_obstacle(spec, k, obstacle, fleet)
    _add_cameras(spec, scenario, fleet.length)
    with quiet():
        try:
            spec.compile()
            return str(spec.to_xml())
        except (ValueError, mujoco.FatalError) as error:
            raise unfit(scenario, error) from error


@cache
def _arena() -> mujoco.MjSpec:
    """The arena with which every assembly begins."""
    return mujoco.MjSpec.from_file(str(MODELS / "arena.xml"))


def unfit(scenario: Scenario, error: Exception) -> ConfigurationError:
    """The error for robots that MuJoCo accepts alone, but not as a team."""
    fleet = scenario.fleet
    who, times = (f"robots {fleet.words}", "") if fleet.mixed else (f"robot {fleet.words}", f" {scenario.agents} times")
    return ConfigurationError(f"{who} cannot be put into one world{times}: {one_line(error)}")


def _prepare_arena(spec: mujoco.MjSpec, fleet: RobotFleet) -> None:
    """Set the arena's options, ground contact and memory for the robots, and draw the ground at their scale."""
    children = [(robot.name, robot.spec().option) for robot in fleet.kinds]
    for name in OPTIONS:
        setattr(spec.option, name, _agreed(name, children))
    _agreed("disableflags", children)
    spec.option.disableflags |= children[0][1].disableflags
    if any(robot.ground for robot in fleet.robots):
        ground = spec.geom("ground")
        ground.contype = ground.conaffinity = 1
    if fleet.massive:
        spec.memory = MEMORY + len(fleet.robots) * MEMORY_OF_CONTACTS
        radii = fleet.radii.tolist() if fleet.mixed else [fleet.radius]
        spec.add_numeric(name="robot", data=[fleet.length, *radii])  # the size of marks and cameras
        spec.material("ground").texrepeat = np.array(spec.material("ground").texrepeat) / fleet.length


def _agreed(name: str, children: Sequence[tuple[str, Any]]) -> Any:
    """The common value of an option for all robots: the one that is not MuJoCo's default, if the others keep the default.

    Raises:
        ConfigurationError: two robots with different values, neither of them the default, or robots with different media.
    """
    first, chosen = children[0][0], getattr(children[0][1], name)
    if len(children) == 1:
        return chosen
    default, strict = getattr(mujoco.MjSpec().option, name), name in MEDIUM
    for other, option in children[1:]:
        value = getattr(option, name)
        if np.array_equal(value, chosen) or (not strict and np.array_equal(value, default)):
            continue
        if strict or not np.array_equal(chosen, default):
            raise ConfigurationError(
                f"robots {first!r} and {other!r} cannot be in one world: their files say {name} {chosen} and {value}"
            )
        first, chosen = other, value
    return chosen


def _attach(spec: mujoco.MjSpec, robot: Robot, agent: int, mass: float, limit: float) -> None:
    child = robot.spec()
    child.option.timestep, child.option.disableflags = spec.option.timestep, spec.option.disableflags  # else they conflict
    geoms = child.body(robot.body).geoms
    total = sum(geom.mass for geom in geoms)
    if robot.mass is None and not total > 0:
        raise ConfigurationError(f"robot {robot.name!r} has no mass; give the geoms of body {robot.body!r} one")
    for geom in geoms:
        geom.rgba = agent_color(agent) if robot.mass is None or not geom.material else geom.rgba
        if robot.mass is None:
            geom.mass *= mass / total
    most = limit if robot.mass is None else min(limit, robot.force_limit)  # no law exceeds what a robot's motors provide
    for name in robot.motors:
        motor = child.actuator(name)
        bounded = np.isfinite(most)
        motor.ctrlrange = motor.forcerange = (-most, most) if bounded else (0.0, 0.0)
        motor.ctrllimited = motor.forcelimited = int(bounded)
    spec.attach(child, prefix=agent_prefix(agent), frame=spec.worldbody.add_frame())


def _add_obstacle(spec: mujoco.MjSpec, k: int, obstacle: Obstacle, fleet: RobotFleet) -> None:
    """Add a cylinder without contact: robots pass through the paper's obstacles, and violations are counted.

    For robots with contact it is solid, has the scenario's radius, and is on a body that an episode's draw can move.
    """
    radius = max(obstacle.radius, POINT_RADIUS * fleet.length)
    height = max(OBSTACLE_HEIGHT * fleet.length, 1.5 * fleet.height)
    place, parent = [obstacle.x, obstacle.y, 0.5 * height], spec.worldbody
    if fleet.contact:
        parent = spec.worldbody.add_body(name=f"obstacle{k + 1}", pos=[obstacle.x, obstacle.y, 0.0], mocap=True)
        place, radius = [0.0, 0.0, 0.5 * height], max(obstacle.radius, LEAST_SOLID * fleet.length)
    parent.add_geom(
        name=f"obstacle{k + 1}",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius, 0.5 * height, 0.0],
        pos=place,
        material="obstacle",
        contype=int(fleet.contact),
        conaffinity=int(fleet.contact),
        mass=0.0,
    )


def _add_cameras(spec: mujoco.MjSpec, scenario: Scenario, length: float) -> None:
    """Add ``top``, a 16:9 view of the mission, and ``track``, which follows the center of mass; ``length`` [m] is the unit."""
    low, high = _mission_bounds(scenario)
    width, depth = high - low + 2.0 * MARGIN * length
    fovy = 30.0
    height = 0.5 * max(depth, width * 9.0 / 16.0) / np.tan(np.radians(0.5 * fovy))
    spec.stat.center = [*(0.5 * (low + high)), 0.0]
    spec.stat.extent = 0.5 * max(depth, width)
    spec.worldbody.add_camera(name="top", pos=[*(0.5 * (low + high)), height], fovy=fovy)
    spec.worldbody.add_camera(
        name="track",
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[0.0, -34.0 * length, 26.0 * length],
        xyaxes=[1.0, 0.0, 0.0, 0.0, 0.6, 0.8],
        fovy=40.0,
    )


def _mission_bounds(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (2,) [m] of a box around the starts, the obstacles and the formations along the path."""
    ends = np.stack([desired_centroid(scenario, time) for time in (0.0, scenario.duration)])
    slots = ends[:, None] + scenario.formations.reshape(1, -1, 2)
    obstacles = scenario.obstacle_array()
    zone = obstacles[:, 2:] + scenario.safe_distance
    points = [slots.reshape(-1, 2), np.array(scenario.starts), obstacles[:, :2] - zone, obstacles[:, :2] + zone]
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)
