"""One model assembly: arena + N robots + the scenario's obstacles, built with MjSpec and handed on as one MJCF text.

The engine compiles this text, and the dm_control arena is made from the same text, so there is one model.
"""

import mujoco
import numpy as np

from marlbc_mj.robots import MODELS, Robot, make_robot
from marlbc_mj.robots.standard import quiet
from marlbc_mj.scenarios import Obstacle, Scenario
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


def agent_prefix(agent: int) -> str:
    """Prefix of every MJCF name of one agent: ``agent1_`` is agent 0's, as the paper counts from 1."""
    return f"agent{agent + 1}_"


def assemble(scenario: Scenario, limit: float) -> str:
    """The MJCF of a whole scenario.

    Args:
        scenario: which robot, how many, what obstacles, which substep.
        limit: force range of every motor [N]; infinite, for laws that ignore the actuator, removes those of a robot that has no
            mass and no force limit of its own.

    Raises:
        ConfigurationError: unknown robot, one that MuJoCo does not take several times, or a limit that is not positive.
    """
    if not limit > 0:
        raise ConfigurationError(f"force limit must be positive, got {limit}")
    robot = make_robot(scenario.robot)
    spec = mujoco.MjSpec.from_file(str(MODELS / "arena.xml"))
    spec.modelname = scenario.name
    spec.option.timestep = scenario.substep
    spec.memory = MEMORY + MEMORY_PER_AGENT * max(0, scenario.agents - 32)
    _prepare_arena(spec, robot, scenario.agents)
    for agent in range(scenario.agents):
        _attach(spec, robot, agent, scenario.mass, limit)
    for k, obstacle in enumerate(scenario.obstacles):
        _add_obstacle(spec, k, obstacle, robot)
    _add_cameras(spec, scenario)
    with quiet():
        try:
            spec.compile()
            return str(spec.to_xml())
        except (ValueError, mujoco.FatalError) as error:
            raise unfit(scenario, error) from error


def unfit(scenario: Scenario, error: Exception) -> ConfigurationError:
    """The error for a robot that MuJoCo takes alone, but not as a team."""
    return ConfigurationError(f"robot {scenario.robot!r} cannot be put into one world {scenario.agents} times: {one_line(error)}")


def _prepare_arena(spec: mujoco.MjSpec, robot: Robot, agents: int) -> None:
    """Take the options of contact from the robot's MJCF, and draw the ground at its scale."""
    child = robot.spec()
    for name in OPTIONS:
        setattr(spec.option, name, getattr(child.option, name))
    spec.option.disableflags |= child.option.disableflags
    if robot.ground:
        ground = spec.geom("ground")
        ground.contype = ground.conaffinity = 1
    if robot.mass is not None:
        spec.memory = MEMORY + agents * MEMORY_OF_CONTACTS
        spec.add_numeric(name="robot", data=[robot.length, robot.radius])  # the size of marks and cameras
        spec.material("ground").texrepeat = np.array(spec.material("ground").texrepeat) / robot.length


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


def _add_obstacle(spec: mujoco.MjSpec, k: int, obstacle: Obstacle, robot: Robot) -> None:
    """A cylinder without contact: the paper's obstacles are passed through, and counted. For robots with contact it is solid,
    as large as the scenario says, on a body that an episode's draw can move.
    """
    radius = max(obstacle.radius, POINT_RADIUS * robot.length)
    height = max(OBSTACLE_HEIGHT * robot.length, 1.5 * robot.height)
    place, parent = [obstacle.x, obstacle.y, 0.5 * height], spec.worldbody
    if robot.contact:
        parent = spec.worldbody.add_body(name=f"obstacle{k + 1}", pos=[obstacle.x, obstacle.y, 0.0], mocap=True)
        place, radius = [0.0, 0.0, 0.5 * height], max(obstacle.radius, LEAST_SOLID * robot.length)
    parent.add_geom(
        name=f"obstacle{k + 1}",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius, 0.5 * height, 0.0],
        pos=place,
        material="obstacle",
        contype=int(robot.contact),
        conaffinity=int(robot.contact),
        mass=0.0,
    )


def _add_cameras(spec: mujoco.MjSpec, scenario: Scenario) -> None:
    """``top`` sees the whole mission in a 16:9 picture; ``track`` follows the team's centre of mass."""
    low, high = _mission_bounds(scenario)
    length = make_robot(scenario.robot).length
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
    ends = np.array(scenario.path_origin) + np.outer((0.0, scenario.duration), scenario.path_velocity)
    slots = ends[:, None] + scenario.formations.reshape(1, -1, 2)
    obstacles = scenario.obstacle_array()
    zone = obstacles[:, 2:] + scenario.safe_distance
    points = [slots.reshape(-1, 2), np.array(scenario.starts), obstacles[:, :2] - zone, obstacles[:, :2] + zone]
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)
