"""The 3D scene of an episode for viewers: Foxglove's SceneUpdate and FrameTransforms in protobuf, and a Foxglove layout."""

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from marlbc_mj.core.motion import NUMBERS, obstacles_at
from marlbc_mj.engine.assembly import OBSTACLE_HEIGHT, POINT_RADIUS
from marlbc_mj.recording.links import drawn_links
from marlbc_mj.scenarios.base import Scenario, desired_centroid
from marlbc_mj.supervisors.communication import Hearing
from marlbc_mj.util.palette import BEHAVIOR_COLORS, agent_color, rgba

SCENE_TOPIC = "/scene"
TRANSFORMS_TOPIC = "/tf"
WORLD_FRAME = "world"

_OBSTACLE_COLOR = (0.42, 0.45, 0.50, 1.0)
_RING_COLOR = rgba(BEHAVIOR_COLORS["OA"], 0.7)
_RING_POINTS = 32
_RING_HEIGHT = 0.02  # above the ground, so that it does not flicker [m]
_LINK_HEIGHT = 0.05  # [m]
_REFERENCE_DIAMETER = 0.3  # [m]


class Scene:
    """Builds the messages of one episode. The protobuf objects are made once; a mission step only changes their numbers.

    Args:
        scenario: gives the team and the safe distance.
        obstacles: (K, 3) this episode's x, y, radius [m]; for a moving one the anchor, see :mod:`marlbc_mj.core.motion`.
        motions: (K, 6) columns as in :mod:`marlbc_mj.core.motion`; None: all obstacles are at rest.
    """

    def __init__(self, scenario: Scenario, obstacles: np.ndarray, motions: np.ndarray | None = None) -> None:
        self._obstacles, self._motions = obstacles, np.zeros((0, NUMBERS)) if motions is None else motions
        self._safe_distance = scenario.safe_distance
        self._static = self._obstacles_at(0.0)
        fleet = scenario.fleet
        radii = fleet.radii.tolist()
        self._team = SceneUpdate(entities=[_agent_entity(i, radius, fleet.length) for i, radius in enumerate(radii)])
        self._transforms = FrameTransforms()
        for i, radius in enumerate(radii):
            transform = self._transforms.transforms.add(parent_frame_id=WORLD_FRAME, child_frame_id=f"agent{i + 1}")
            transform.translation.z = radius
            transform.rotation.w = 1.0
        entities, transforms = self._team.entities, self._transforms.transforms
        self._stamps = [part.timestamp for part in (*entities, *transforms)]
        self._positions = [
            (e.spheres[0].pose.position, e.lines[0].points[0], t.translation) for e, t in zip(entities, transforms, strict=True)
        ]
        self._references = [(e.spheres[1].pose.position, e.lines[0].points[1]) for e in entities]

    def encode(
        self, stamp: int, position: np.ndarray, reference: np.ndarray, hearing: Hearing | None = None
    ) -> tuple[bytes, bytes]:
        """Serialized SceneUpdate and FrameTransforms of one mission step.

        Obstacles are in every SceneUpdate: after a seek a viewer receives only one message per topic, and would otherwise
        show no obstacles. This is cheap: the concatenated bytes of two protobuf messages are the merged message.

        Args:
            stamp: time stamp [ns].
            position: (N, 2) positions of the agents [m].
            reference: (N, 2) reference positions p_r [m].
            hearing: links and ages (N, N) if agents communicate.
        """
        seconds, nanos = divmod(stamp, 1_000_000_000)
        for timestamp in self._stamps:
            timestamp.seconds = seconds
            timestamp.nanos = nanos
        for points, at in ((self._positions, position), (self._references, reference)):
            for targets, (x, y) in zip(points, at.tolist(), strict=True):
                for target in targets:
                    target.x = x
                    target.y = y
        static = self._obstacles_at(1e-9 * stamp) if len(self._motions) else self._static
        links = b"" if hearing is None else _links_message(position, hearing)
        return static + links + self._team.SerializeToString(), self._transforms.SerializeToString()

    def _obstacles_at(self, time: float) -> bytes:
        """Serialized message of all obstacles at ``time`` [s]."""
        now = obstacles_at(time, self._obstacles, self._motions)
        return bytes(SceneUpdate(entities=[_obstacle_entity(now, self._safe_distance)]).SerializeToString())


def _color(color: tuple[float, float, float, float]) -> Color:
    return Color(r=color[0], g=color[1], b=color[2], a=color[3])


def _pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0))


def _agent_entity(agent: int, radius: float, length: float) -> SceneEntity:
    """A sphere for the agent, a small one for its reference, scaled by the team's length unit, and a line between them."""
    color = _color(agent_color(agent))
    spheres = [
        SpherePrimitive(pose=_pose(z=radius), size=Vector3(x=d, y=d, z=d), color=color)
        for d in (2 * radius, _REFERENCE_DIAMETER * length)
    ]
    points = [Point3(z=radius), Point3(z=radius)]
    line = LinePrimitive(pose=_pose(), points=points, thickness=2.0, scale_invariant=True, color=color)
    return SceneEntity(frame_id=WORLD_FRAME, id=f"agent{agent + 1}", spheres=spheres, lines=[line])


def _links_message(position: np.ndarray, hearing: Hearing) -> bytes:
    """Serialized message of the links between agents: one list of lines, with a color for both ends of each line."""
    links = drawn_links(position, hearing.link, hearing.age)
    points = [Point3(x=x, y=y, z=_LINK_HEIGHT) for pair in position[links.ends].tolist() for x, y in pair]
    colors = [_color(color) for color in np.repeat(links.colors(), 2, axis=0).tolist()]
    lines = LinePrimitive(
        type=LinePrimitive.LINE_LIST, pose=_pose(), points=points, thickness=3.0, scale_invariant=True, colors=colors
    )
    entity = SceneEntity(frame_id=WORLD_FRAME, id="links", lines=[lines])
    return bytes(SceneUpdate(entities=[entity]).SerializeToString())


def _obstacle_entity(obstacles: np.ndarray, safe_distance: float) -> SceneEntity:
    """All obstacles, each with a ring at the safe distance from its surface."""
    entity = SceneEntity(frame_id=WORLD_FRAME, id="obstacles")
    for x, y, radius in obstacles.tolist():
        drawn = 2 * max(radius, POINT_RADIUS)
        entity.cylinders.append(
            CylinderPrimitive(
                pose=_pose(x, y, 0.5 * OBSTACLE_HEIGHT),
                size=Vector3(x=drawn, y=drawn, z=OBSTACLE_HEIGHT),
                bottom_scale=1.0,
                top_scale=1.0,
                color=_color(_OBSTACLE_COLOR),
            )
        )
        entity.lines.append(_ring(x, y, radius + safe_distance))
    return entity


def _ring(x: float, y: float, radius: float) -> LinePrimitive:
    angles = np.linspace(0.0, 2 * np.pi, _RING_POINTS, endpoint=False)
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return LinePrimitive(
        type=LinePrimitive.LINE_LOOP,
        pose=_pose(x, y, _RING_HEIGHT),
        points=[Point3(x=a, y=b) for a, b in circle.tolist()],
        thickness=2.0,
        scale_invariant=True,
        color=_color(_RING_COLOR),
    )


def foxglove_layout(scenario: Scenario) -> dict[str, Any]:
    """A layout for Foxglove: the scene from above, and force, clearance and priorities over time."""
    agents = range(scenario.agents)
    forces = [(f"/force.agents[{i}].{axis}", f"agent {i + 1} {axis}") for i in agents for axis in ("x", "y")]
    clearances = [(f"/metrics.agents[{i}].clearance", f"agent {i + 1}") for i in agents]
    priorities = [(f"/priorities.agents[{i}].command", f"agent {i + 1}") for i in agents]
    panels = {
        "3D!scene": _scene_panel(scenario),
        "Plot!force": {"foxglovePanelTitle": "Force [N]", "isSynced": True, "paths": _paths(forces)},
        "Plot!clearance": {"foxglovePanelTitle": "Clearance [m]", "isSynced": True, "paths": _paths(clearances)},
        "StateTransitions!priorities": {"foxglovePanelTitle": "Priorities", "isSynced": True, "paths": _paths(priorities)},
    }
    plots = _split("column", "Plot!force", _split("column", "Plot!clearance", "StateTransitions!priorities", 50), 33)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", "3D!scene", plots, 60),
    }


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _paths(series: list[tuple[str, str]]) -> list[dict[str, Any]]:
    return [{"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"} for path, label in series]


def _scene_panel(scenario: Scenario) -> dict[str, Any]:
    """The 3D panel, seen from above the middle of the path."""
    middle = desired_centroid(scenario, 0.5 * scenario.duration).tolist()
    camera = {
        "perspective": True,
        "distance": float(20.0 + scenario.duration * np.linalg.norm(scenario.path_velocity)),
        "phi": 0.0,
        "thetaOffset": 0.0,
        "targetOffset": [*middle, 0.0],
        "target": [0.0, 0.0, 0.0],
        "targetOrientation": [0.0, 0.0, 0.0, 1.0],
        "fovy": 45.0,
        "near": 0.5,
        "far": 5000.0,
    }
    return {
        "foxglovePanelTitle": "Scene",
        "cameraState": camera,
        "followMode": "follow-none",
        "followTf": WORLD_FRAME,
        "topics": {SCENE_TOPIC: {"visible": True}},
        "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "frameLocked": True, "size": 200, "divisions": 40}},
    }
