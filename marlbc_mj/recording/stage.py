"""What a picture shows of a log at one time: the posed model, and marks that are not part of the model.

Marks are shapes that are added to a scene when it is drawn, so they cost the physics nothing.
"""

from dataclasses import dataclass, replace
from xml.etree import ElementTree

import mujoco
import numpy as np

from marlbc_mj.engine.assembly import LEAST_SOLID, POINT_RADIUS, agent_prefix
from marlbc_mj.recording.links import links_of_log
from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.recording.marks import Mark, Trail, add, ball, dashed_circle, flat_disc, make_trail, ribbon
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.palette import SAFE_DISTANCE_COLOR, SHIELD_COLOR, agent_color, command_color, rgba
from marlbc_mj.util.text import one_line

BALL = 0.8  # least drawn radius of an agent [m]: a radius of 0.5 m is hard to see in a mission of 100 m
BALL_SHARE = 0.4  # that radius is at most this share of the safe distance, so that no ball touches an obstacle kept clear of
HALO = 1.6  # radius of the disc under an agent, in drawn radii
RIM = 0.14  # width of the rim of that disc, in drawn radii
LINK_WIDTH = 0.13  # width of the strip between two linked agents [m]
LINK_HEIGHT = 0.5  # height of that strip, in drawn radii of the first agent: above the trails
GHOST = 0.45  # radius of a reference's ghost, in drawn radii


OUTSIDE = ("include", "plugin", "extension", "replicate", "composite", "flexcomp")
"""MJCF elements that read files, load plugins or replicate their content; an assembled model has none of them."""


@dataclass(frozen=True)
class Stage:
    """A log's model and marks. Build with :func:`make_stage`."""

    log: EpisodeLog
    model: mujoco.MjModel
    data: mujoco.MjData
    joints: np.ndarray  # (N, 2) addresses of the agents' x and y in qpos
    discs: np.ndarray  # (K,) geom numbers of the obstacles
    radii: np.ndarray  # (N,) drawn radii of the agents [m]
    rings: list[Mark]
    trails: list[Trail]
    scale: float = 1.0  # length of 1 m of the paper's mission here [m]: marks and cameras shrink with small robots
    free: tuple[int | None, ...] = ()  # addresses in qpos of the agents' free joints if the log has poses; None: slide joints

    def step(self, time: float) -> int:
        """Index of the mission step that contains ``time`` [s], or of the nearest one outside the log."""
        return int(np.clip(np.searchsorted(self.log.time, time + 1e-9, side="right") - 1, 0, len(self.log.time) - 1))

    def sample(self, values: np.ndarray, time: float) -> np.ndarray:
        """``values`` (M, ...) at ``time`` [s], interpolated linearly between mission steps and constant outside the log."""
        k = self.step(time)
        after = min(k + 1, len(values) - 1)
        weight = np.clip((time - self.log.time[k]) / self.log.mission_step, 0.0, 1.0)
        return np.asarray((1.0 - weight) * values[k] + weight * values[after])

    def commands(self, time: float) -> list[str]:
        """Every agent's command at ``time`` [s], "OA>FM" for example."""
        return [self.log.commands[k] for k in self.log.command[self.step(time)]]

    def shielded(self, time: float) -> list[int]:
        """Indices of the agents whose force or reference the shield changes in the mission step at ``time`` [s]."""
        return [int(i) for i in np.flatnonzero(self.log.intervened(self.step(time)))]

    def pose(self, time: float) -> None:
        """Move the model's agents and obstacles to where they are at ``time`` [s]."""
        if len(self.log.motions):
            _place_obstacles(self.model, self.data, self.discs.tolist(), self.log.obstacles_at(time), self.scale)
        self.data.qpos[self.joints] = self.sample(self.log.position, time)
        poses = self.sample(self.log.pose, time) if self.free else ()
        for first, pose in zip(self.free, poses, strict=True):
            if first is None:
                continue
            pose[3:] /= np.linalg.norm(pose[3:])
            self.data.qpos[first : first + 7] = pose
        mujoco.mj_forward(self.model, self.data)

    def draw(self, scene: mujoco.MjvScene, time: float) -> None:
        """Add rings, trails, links, halos and references at ``time`` [s] to a scene that already contains the model.

        Raises:
            ConfigurationError: the scene has no room for them.
        """
        rings = _rings(self.log, time, self.scale) if len(self.log.motions) else self.rings
        marks = [*rings, *self._trails(time), *self._links(time), *self._agents(time)]
        if scene.ngeom + len(marks) > scene.maxgeom:
            raise ConfigurationError(f"a scene of {scene.maxgeom} shapes cannot hold {len(marks)} marks")
        for mark in marks:
            add(scene, mark)

    def middles(self) -> np.ndarray:
        """Positions (N, 3) of the agents' numbers [m]: in the middle of a ball, or above a robot that has a pose."""
        heights = [
            radius if first is None else self.data.qpos[first + 2] + 1.9 * radius
            for first, radius in zip(self.free or (None,) * len(self.radii), self.radii, strict=True)
        ]
        return np.column_stack([self.data.qpos[self.joints], heights])

    def _trails(self, time: float) -> list[Mark]:
        here = self.sample(self.log.position, time)
        return [mark for i, trail in enumerate(self.trails) for mark in trail.until(time, here[i])]

    def _links(self, time: float) -> list[Mark]:
        """Marks of the communication links, if there are any."""
        if not self.log.link.shape[1]:
            return []
        here, links = self.sample(self.log.position, time), links_of_log(self.log, self.step(time))
        return [
            ribbon(here[i], here[j], LINK_WIDTH * self.scale, LINK_HEIGHT * self.radii[i], tuple(color), self.scale)
            for (i, j), color in zip(links.ends.tolist(), links.colors().tolist(), strict=True)
        ]

    def _agents(self, time: float) -> list[Mark]:
        """Halos in the color of the command, with a rim in the shield's color while it acts, and the references as ghosts."""
        position, reference = (self.sample(v, time) for v in (self.log.position, self.log.reference))
        marks, unit, shielded = [], self.scale, self.shielded(time)
        for i, command in enumerate(self.commands(time)):
            radius, rim = float(self.radii[i]), SHIELD_COLOR if i in shielded else "#FFFFFF"
            marks.append(flat_disc(position[i], HALO * radius, 0.06 * unit, rgba(rim), unit))
            marks.append(flat_disc(position[i], (HALO - RIM) * radius, 0.09 * unit, rgba(command_color(command)), unit))
            far = bool(np.hypot(*(reference[i] - position[i])) > radius)
            if far:
                marks.append(ribbon(position[i], reference[i], 0.1 * unit, 0.12 * unit, agent_color(i), unit))
            if far or not self.free or self.free[i] is None:  # a reference must not hide a robot that is on it
                marks.append(ball(reference[i], GHOST * radius, (*agent_color(i)[:3], 0.45)))
        return marks


def make_stage(log: EpisodeLog) -> Stage:
    """The stage of a log, with the obstacles of this episode.

    Raises:
        ConfigurationError: the log is empty, or its model does not fit it.
    """
    if len(log.time) == 0:
        raise ConfigurationError("the log holds no mission step, so there is nothing to show")
    agents = range(log.position.shape[1])
    try:
        _check_self_contained(log.mjcf)
        model = mujoco.MjModel.from_xml_string(log.mjcf)
        unit, radii = _size(model, len(agents))
        free = [_free_joint(model, agent_prefix(i)) for i in agents]
        joints = [_slides(model, agent_prefix(i)) if first is None else [first, first + 1] for i, first in enumerate(free)]
        data = mujoco.MjData(model)
        discs = [model.geom(f"obstacle{k + 1}").id for k in range(len(log.obstacles))]
        _place_obstacles(model, data, discs, log.obstacles, unit)
        if not (np.isfinite([unit, *radii]).all() and unit > 0 and min(radii) >= 0):
            raise ValueError(f"it has a length unit of {unit} m and radii of {radii} m")
    except (KeyError, ValueError, ElementTree.ParseError) as error:
        raise ConfigurationError(f"the log's model cannot be shown: {one_line(error)}") from error
    return Stage(
        log=log,
        model=model,
        data=data,
        joints=np.array(joints),
        discs=np.array(discs, dtype=np.int64),
        radii=np.array([radii[i] or _enlarge(model, i, min(BALL, BALL_SHARE * log.safe_distance)) for i in agents]),
        rings=_rings(log, 0.0, unit),
        trails=[make_trail(i, log.time, log.position[:, i], unit) for i in agents],
        scale=unit,
        free=tuple(free) if log.pose.shape[1] else (),
    )


def _check_self_contained(mjcf: str) -> None:
    """Raise ValueError for a model that reads files, loads plugins or replicates elements; models of this package never do."""
    if "<!DOCTYPE" in mjcf or "<!ENTITY" in mjcf:
        raise ValueError("it defines entities")
    for element in ElementTree.fromstring(mjcf).iter():
        files = [name for name in element.attrib if name.lower().startswith("file")]
        if files or element.tag in OUTSIDE:
            named = f"{files[0]} {element.attrib[files[0]]!r}" if files else "something from outside the file"
            raise ValueError(f"its element {element.tag!r} reads {named}; a log must hold all that it needs")


def restage(stage: Stage, log: EpisodeLog) -> Stage:
    """A stage with the same model that shows another log of the same scenario."""
    _place_obstacles(stage.model, stage.data, stage.discs.tolist(), log.obstacles, stage.scale)
    trails = [make_trail(i, log.time, log.position[:, i], stage.scale) for i in range(log.position.shape[1])]
    return replace(stage, log=log, rings=_rings(log, 0.0, stage.scale), trails=trails)


def _free_joint(model: mujoco.MjModel, prefix: str) -> int | None:
    """Address in qpos of an agent's free joint; None if it has slide joints."""
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        if model.body(model.jnt_bodyid[j]).name.startswith(prefix):
            return int(model.jnt_qposadr[j])
    return None


def _slides(model: mujoco.MjModel, prefix: str) -> list[int]:
    """Addresses in qpos of an agent's slide joints along x and y.

    Raises:
        KeyError: the agent lacks one of them.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    slides = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE]
    own = [j for j in slides if model.body(model.jnt_bodyid[j]).name.startswith(prefix)]
    found = [next((j for j in own if data.xaxis[j][axis] > 1.0 - 1e-6), None) for axis in (0, 1)]
    if None in found:
        raise KeyError(f"{prefix} has no slides along x and y")
    return [int(model.jnt_qposadr[j]) for j in found if j is not None]


def _size(model: mujoco.MjModel, agents: int) -> tuple[float, list[float]]:
    """Length unit of the mission and drawn radius of each robot [m], as stored in the model; 1 and zeros for point masses.

    Raises:
        ValueError: the model has neither one radius nor one per agent.
    """
    if model.nnumeric == 0:
        return 1.0, [0.0] * agents
    unit, *radii = model.numeric("robot").data.tolist()
    if len(radii) not in (1, agents):
        raise ValueError(f"it has {len(radii)} radii for {agents} agents")
    return unit, radii if len(radii) == agents else radii * agents


def _place_obstacles(model: mujoco.MjModel, data: mujoco.MjData, discs: list[int], obstacles: np.ndarray, unit: float) -> None:
    """Set the places and radii of obstacles (K, 3)."""
    least = unit * (LEAST_SOLID if model.nmocap else POINT_RADIUS)
    for geom, (x, y, radius) in zip(discs, obstacles, strict=True):
        model.geom_size[geom, 0] = max(radius, least)
        if model.nmocap:
            data.mocap_pos[model.body(model.geom_bodyid[geom]).mocapid[0], :2] = x, y
        else:
            model.geom_pos[geom, :2] = x, y


def _rings(log: EpisodeLog, time: float, unit: float) -> list[Mark]:
    """Marks of the safe distances around all obstacles at ``time`` [s]."""
    return [mark for obstacle in log.obstacles_at(time) for mark in _zone(obstacle, log.safe_distance, unit)]


def _zone(obstacle: np.ndarray, safe_distance: float, unit: float) -> list[Mark]:
    """Marks of the area in which the clearance to an obstacle (3,) is below the safe distance: a disc in a dashed circle."""
    center, radius = obstacle[:2], float(obstacle[2]) + safe_distance
    circle = dashed_circle(center, radius, rgba(SAFE_DISTANCE_COLOR), unit)
    return [flat_disc(center, radius, 0.01 * unit, rgba(SAFE_DISTANCE_COLOR, 0.1), unit), *circle]


def _enlarge(model: mujoco.MjModel, agent: int, least: float) -> float:
    """Color an agent's geoms, and enlarge its spheres, which rest on the ground, to a radius of at least ``least`` [m].

    Returns:
        The largest drawn radius [m].
    """
    largest = least
    for geom in range(model.ngeom):
        if not model.body(model.geom_bodyid[geom]).name.startswith(agent_prefix(agent)):
            continue
        model.geom_rgba[geom] = agent_color(agent)  # also for logs that were written with other colors
        size = model.geom_size[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE and size[0] < least:
            model.geom_pos[geom, 2] += least - size[0]
            model.geom_sameframe[geom] = 0  # otherwise MuJoCo would ignore the new position
            size[:] = least
        largest = max(largest, float(size[0]))
    return largest
