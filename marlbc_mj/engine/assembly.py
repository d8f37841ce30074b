"""One model assembly: arena + N robots + the scenario's obstacles, built with MjSpec and handed on as one MJCF text.

The engine compiles this text, and the dm_control arena is made from the same text, so there is one model.
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

POINT_RADIUS = 0.25  # drawn radius of a point obstacle [m]
OBSTACLE_HEIGHT = 1.2  # [m]
LEAST_SOLID = 0.05  # radius of a point obstacle that robots can hit, in the robot's length unit [m]
MARGIN = 4.0  # that the top camera leaves around the mission [m]
MEMORY = 256 * 1024  # arena of one MjData [bytes]; MuJoCo's default is 13.6 MB, too much for thousands of worlds
MEMORY_PER_AGENT = 4 * 1024  # beyond the first 32; measured with 256: 133 KiB in use. Only what is used becomes resident
MEMORY_OF_CONTACTS = 512 * 1024  # more of it for every agent that touches ground, obstacles and others [bytes]
_OWN = ("timestep", "disableflags")
OPTIONS = tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_") and name not in _OWN)
"""Options of a robot's MJCF that the arena takes over, gravity and air among them: whoever flies or slides there depends on them.
The time step is the scenario's."""
MEDIUM = ("gravity", "wind", "density", "viscosity", "magnetic", "disableflags")
"""Options in which robots of one world must agree; of others, what one robot's file leaves open is as another's says."""


def agent_prefix(agent: int) -> str:
    """Prefix of every MJCF name of one agent: ``agent1_`` is agent 0's, as the paper counts from 1."""
    return f"agent{agent + 1}_"


def assemble(scenario: Scenario, limit: float) -> str:
    """The MJCF of a whole scenario.

    Args:
        scenario: which robots, what obstacles, which substep.
        limit: force range of every motor [N]; infinite, for laws that ignore the actuator, removes those of a robot that has no
            mass and no force limit of its own.

    Raises:
        ConfigurationError: unknown robot, one that MuJoCo does not take several times, robots whose options contradict each
            other, or a limit that is not positive.
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
    """The MJCF that every assembly begins with."""
    return mujoco.MjSpec.from_file(str(MODELS / "arena.xml"))


def unfit(scenario: Scenario, error: Exception) -> ConfigurationError:
    """The error for robots that MuJoCo takes alone, but not as a team."""
    fleet = scenario.fleet
    who, times = (f"robots {fleet.words}", "") if fleet.mixed else (f"robot {fleet.words}", f" {scenario.agents} times")
    return ConfigurationError(f"{who} cannot be put into one world{times}: {one_line(error)}")


def _prepare_arena(spec: mujoco.MjSpec, fleet: RobotFleet) -> None:
    """Take the options of contact from the robots' MJCF, and draw the ground at their scale."""
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
    """An option that holds for all robots: the one that is not MuJoCo's default, where the others leave it at that.

    Raises:
        ConfigurationError: two robots that say different things, or live in different media.
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
    most = limit if robot.mass is None else min(limit, robot.force_limit)  # what a robot's motors give, no law can change
    for name in robot.motors:
        motor = child.actuator(name)
        bounded = np.isfinite(most)
        motor.ctrlrange = motor.forcerange = (-most, most) if bounded else (0.0, 0.0)
        motor.ctrllimited = motor.forcelimited = int(bounded)
    spec.attach(child, prefix=agent_prefix(agent), frame=spec.worldbody.add_frame())


def _add_obstacle(spec: mujoco.MjSpec, k: int, obstacle: Obstacle, fleet: RobotFleet) -> None:
    """A cylinder without contact: the paper's obstacles are passed through, and counted. For robots with contact it is solid,
    as large as the scenario says, on a body that an episode's draw can move.
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
    """``top`` sees the whole mission in a 16:9 picture; ``track`` follows its centre of mass; ``length`` [m] is the unit."""
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
    """Lower and upper corner (2,) [m] of a box around starts, obstacles and the formations' way along the path."""
    ends = np.stack([desired_centroid(scenario, time) for time in (0.0, scenario.duration)])
    slots = ends[:, None] + scenario.formations.reshape(1, -1, 2)
    obstacles = scenario.obstacle_array()
    zone = obstacles[:, 2:] + scenario.safe_distance
    points = [slots.reshape(-1, 2), np.array(scenario.starts), obstacles[:, :2] - zone, obstacles[:, :2] + zone]
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)
