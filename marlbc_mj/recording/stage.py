"""A log at one time as a picture shows it: the posed model, and marks that are not part of the model.

Marks are flat shapes on the ground, added to a scene when it is drawn, so physics never pays for them.
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

BALL = 0.8  # least drawn radius of an agent [m]: half a metre is hard to see in a mission of 100 m; less where distances are
BALL_SHARE = 0.4  # of the safe distance, so that no drawing touches what an agent keeps clear of
HALO = 1.6  # radius of the disc under an agent, in drawn radii
RIM = 0.14  # width of the white rim around it, in drawn radii
LINK_WIDTH = 0.13  # of the strip between two agents that hear each other [m]
LINK_HEIGHT = 0.5  # of that strip, in drawn radii of the first: above the trails
GHOST = 0.45  # radius of a reference's ghost, in drawn radii


OUTSIDE = ("include", "plugin", "extension", "replicate", "composite", "flexcomp")
"""Elements of MJCF that read files, load programs or multiply what stands in them; an assembled model has none of them."""


@dataclass(frozen=True)
class Stage:
    """A log's model and marks. Build with :func:`make_stage`."""

    log: EpisodeLog
    model: mujoco.MjModel
    data: mujoco.MjData
    joints: np.ndarray  # (N, 2) addresses of the agents' axes in qpos
    discs: np.ndarray  # (K,) geoms of the obstacles
    radii: np.ndarray  # (N,) drawn radii of the agents [m]
    rings: list[Mark]
    trails: list[Trail]
    scale: float = 1.0  # what 1 m of the paper's mission is here: marks and cameras shrink with small robots [m]
    free: tuple[int | None, ...] = ()  # addresses in qpos of the agents' free joints, where the log has poses; None: slides

    def step(self, time: float) -> int:
        """Index of the mission step that ``time`` [s] lies in, the nearest one outside the log."""
        return int(np.clip(np.searchsorted(self.log.time, time + 1e-9, side="right") - 1, 0, len(self.log.time) - 1))

    def sample(self, values: np.ndarray, time: float) -> np.ndarray:
        """``values`` (M, ...) at ``time`` [s], linear between mission steps and constant outside them."""
        k = self.step(time)
        after = min(k + 1, len(values) - 1)
        weight = np.clip((time - self.log.time[k]) / self.log.mission_step, 0.0, 1.0)
        return np.asarray((1.0 - weight) * values[k] + weight * values[after])

    def commands(self, time: float) -> list[str]:
        """Every agent's command at ``time`` [s], "OA>FM" for example."""
        return [self.log.commands[k] for k in self.log.command[self.step(time)]]

    def shielded(self, time: float) -> list[int]:
        """Agents whose shield changes what they do in the mission step of ``time`` [s]."""
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
        """Add rings, trails, links, halos and references at ``time`` [s] to a scene, after its model is in it.

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
        """(N, 3) where every agent's number goes [m]: on the middle of a ball, above a robot that has a pose."""
        heights = [
            radius if first is None else self.data.qpos[first + 2] + 1.9 * radius
            for first, radius in zip(self.free or (None,) * len(self.radii), self.radii, strict=True)
        ]
        return np.column_stack([self.data.qpos[self.joints], heights])

    def _trails(self, time: float) -> list[Mark]:
        here = self.sample(self.log.position, time)
        return [mark for i, trail in enumerate(self.trails) for mark in trail.until(time, here[i])]

    def _links(self, time: float) -> list[Mark]:
        """Links of a team with communication."""
        if not self.log.link.shape[1]:
            return []
        here, links = self.sample(self.log.position, time), links_of_log(self.log, self.step(time))
        return [
            ribbon(here[i], here[j], LINK_WIDTH * self.scale, LINK_HEIGHT * self.radii[i], tuple(color), self.scale)
            for (i, j), color in zip(links.ends.tolist(), links.colors().tolist(), strict=True)
        ]

    def _agents(self, time: float) -> list[Mark]:
        """Halos in the color of the command, their rims in the shield's where it acts, and the references as ghosts."""
        position, reference = (self.sample(v, time) for v in (self.log.position, self.log.reference))
        marks, unit, shielded = [], self.scale, self.shielded(time)
        for i, command in enumerate(self.commands(time)):
            radius, rim = float(self.radii[i]), SHIELD_COLOR if i in shielded else "#FFFFFF"
            marks.append(flat_disc(position[i], HALO * radius, 0.06 * unit, rgba(rim), unit))
            marks.append(flat_disc(position[i], (HALO - RIM) * radius, 0.09 * unit, rgba(command_color(command)), unit))
            far = bool(np.hypot(*(reference[i] - position[i])) > radius)
            if far:
                marks.append(ribbon(position[i], reference[i], 0.1 * unit, 0.12 * unit, agent_color(i), unit))
            if far or not self.free or self.free[i] is None:  # a robot that is on its reference is not to be hidden by it
                marks.append(ball(reference[i], GHOST * radius, (*agent_color(i)[:3], 0.45)))
        return marks


def make_stage(log: EpisodeLog) -> Stage:
    """The stage of a log, its obstacles where this episode had them.

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
            raise ValueError(f"it says a length unit of {unit} m and radii of {radii} m")
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
    """Raise ValueError for a model that reads other files, which logs of this package never do, or is larger than theirs."""
    if "<!DOCTYPE" in mjcf or "<!ENTITY" in mjcf:
        raise ValueError("it defines entities")
    for element in ElementTree.fromstring(mjcf).iter():
        files = [name for name in element.attrib if name.lower().startswith("file")]
        if files or element.tag in OUTSIDE:
            named = f"{files[0]} {element.attrib[files[0]]!r}" if files else "a part of another program"
            raise ValueError(f"its element {element.tag!r} reads {named}; a log holds all that it needs")


def restage(stage: Stage, log: EpisodeLog) -> Stage:
    """The same model and what is drawn with it, showing another log of the same scenario."""
    _place_obstacles(stage.model, stage.data, stage.discs.tolist(), log.obstacles, stage.scale)
    trails = [make_trail(i, log.time, log.position[:, i], stage.scale) for i in range(log.position.shape[1])]
    return replace(stage, log=log, rings=_rings(log, 0.0, stage.scale), trails=trails)


def _free_joint(model: mujoco.MjModel, prefix: str) -> int | None:
    """Address in qpos of an agent's free joint; None where it has slides."""
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        if model.body(model.jnt_bodyid[j]).name.startswith(prefix):
            return int(model.jnt_qposadr[j])
    return None


def _slides(model: mujoco.MjModel, prefix: str) -> list[int]:
    """Addresses in qpos of an agent's slides along x and y.

    Raises:
        KeyError: it has none.
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
    """Length unit of the mission and drawn radius of each robot [m], as the assembly left them; 1 and zeros for point masses.

    Raises:
        ValueError: neither one radius nor one per agent.
    """
    if model.nnumeric == 0:
        return 1.0, [0.0] * agents
    unit, *radii = model.numeric("robot").data.tolist()
    if len(radii) not in (1, agents):
        raise ValueError(f"it says {len(radii)} radii for {agents} agents")
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
    """Safe distances around all obstacles at ``time`` [s]."""
    return [mark for obstacle in log.obstacles_at(time) for mark in _zone(obstacle, log.safe_distance, unit)]


def _zone(obstacle: np.ndarray, safe_distance: float, unit: float) -> list[Mark]:
    """Where the clearance to an obstacle (3,) is below the safe distance [m]: a tinted disc in a dashed circle."""
    center, radius = obstacle[:2], float(obstacle[2]) + safe_distance
    circle = dashed_circle(center, radius, rgba(SAFE_DISTANCE_COLOR), unit)
    return [flat_disc(center, radius, 0.01 * unit, rgba(SAFE_DISTANCE_COLOR, 0.1), unit), *circle]


def _enlarge(model: mujoco.MjModel, agent: int, least: float) -> float:
    """Draw an agent's spheres in its color and no smaller than ``least`` [m], resting on the ground; returns the largest drawn
    radius [m].
    """
    largest = least
    for geom in range(model.ngeom):
        if not model.body(model.geom_bodyid[geom]).name.startswith(agent_prefix(agent)):
            continue
        model.geom_rgba[geom] = agent_color(agent)  # also of logs that were written with other colors
        size = model.geom_size[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE and size[0] < least:
            model.geom_pos[geom, 2] += least - size[0]
            model.geom_sameframe[geom] = 0  # or MuJoCo would skip the new position
            size[:] = least
        largest = max(largest, float(size[0]))
    return largest
