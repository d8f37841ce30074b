"""Cameras: behind the team or one agent, beside or above the whole mission, or a camera of the model."""

from collections.abc import Callable

import mujoco
import numpy as np

from marlbc_mj.recording.stage import Stage
from marlbc_mj.util.errors import ConfigurationError, unknown

TRACK_AZIMUTH = 38.0  # relative to the direction of travel, so that the team moves into the picture [deg]
TRACK_ELEVATION = -33.0  # [deg]
TRACK_FOVY = 36.0  # [deg]
TRACK_SMOOTHING = 8.0  # averaging time of the team's position and size [s]
TRACK_AHEAD = 5.0  # how far ahead of the team the camera looks [m]
TRACK_DISTANCE = 3.45  # distance of the camera, in team radii
CLOSE_RADIUS = (4.0, 7.0)  # least and largest team radius of the close view, which shows robots rather than the whole team [m]
TRACK_RADIUS = (10.5, 60.0)  # least and largest team radius of the track view [m]
CHASE_RADIUS = 2.2  # replaces the team radius in the view of one agent [m]
WIDE_AZIMUTH, WIDE_ELEVATION, WIDE_FOVY = (
    72.0,
    -36.0,
    24.0,
)  # angles of the view from the side; azimuth relative to the direction of travel [deg]
WIDE_MARGIN = 0.02  # share of the picture that stays free at each edge
TOP_MARGIN = 4.0  # margin of the top view around everything in the log [m]

CAMERAS = {
    "track": "behind the team, and as far away as it is large",
    "close": "behind the team, and near the robots",
    "agent1": "behind agent 1, 2 and so on",
    "wide": "beside the whole mission, at rest",
    "at:X,Y,R": "beside the point (X, Y) [m], at rest, and R [m] to each side of it",
    "top": "above the whole mission, as on a map",
}
"""What each camera shows; a model may have more cameras."""
SPOT = "at:"
DISTANT = ("wide", "top")
"""Cameras in whose pictures agents are small."""

Camera = Callable[[float], mujoco.MjvCamera]


def make_camera(name: str, stage: Stage, aspect: float) -> Camera:
    """The camera of ``CAMERAS`` or of the model, as a function of time [s].

    Args:
        name: name of the camera; "agent2" follows agent 2, and so on.
        stage: the stage to show.
        aspect: width of the picture divided by its height.

    Raises:
        ConfigurationError: unknown camera.
    """
    agents = [f"agent{i + 1}" for i in range(stage.log.position.shape[1])]
    if name in agents:
        return _track(stage, stage.log.position[:, [agents.index(name)]], (CHASE_RADIUS, CHASE_RADIUS))
    if name in ("track", "close"):
        return _track(stage, stage.log.position, TRACK_RADIUS if name == "track" else CLOSE_RADIUS)
    if name == "wide":
        return _wide(stage, aspect)
    if name.startswith(SPOT):
        return _beside(stage, aspect, *_spot(name))
    names = [stage.model.camera(k).name for k in range(stage.model.ncam)]
    if name not in names:
        raise unknown("camera", name, dict.fromkeys([*CAMERAS, *names, *agents]))
    if name == "top":
        _fit_top(stage, aspect)
    fixed = mujoco.MjvCamera()
    fixed.type = mujoco.mjtCamera.mjCAMERA_FIXED
    fixed.fixedcamid = stage.model.camera(name).id
    return lambda time: fixed


def _track(stage: Stage, position: np.ndarray, bounds: tuple[float, float]) -> Camera:
    """Camera behind and above agents at (M, A, 2) [m], turned so that it shows them, their trails and what lies ahead."""
    log = stage.log
    centroid = position.mean(axis=1, keepdims=True)
    reach = np.linalg.norm(position - centroid, axis=-1).max(axis=1, keepdims=True)
    team = np.hstack([centroid[:, 0], np.clip(reach, stage.scale * bounds[0], stage.scale * bounds[1])])
    smooth = _smoothed(team, max(1, round(TRACK_SMOOTHING / log.mission_step)))
    heading = _heading(centroid[:, 0])
    ahead = TRACK_AHEAD * stage.scale * bounds[0] / TRACK_RADIUS[0]
    stage.model.vis.global_.fovy = TRACK_FOVY
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth = np.degrees(np.arctan2(heading[1], heading[0])) + TRACK_AZIMUTH
    camera.elevation = TRACK_ELEVATION

    def at(time: float) -> mujoco.MjvCamera:
        now = stage.sample(smooth, time)
        camera.lookat[:2] = now[:2] + ahead * heading
        camera.distance = TRACK_DISTANCE * now[2]
        return camera

    return at


def _heading(centroid: np.ndarray) -> np.ndarray:
    """Unit vector (2,) from the first to the last of a team's centroids (M, 2), or along x if the team hardly moves."""
    way = centroid[-1] - centroid[0]
    length = float(np.hypot(*way))
    return np.asarray(way / length) if length > 1.0 else np.array([1.0, 0.0])


def _smoothed(values: np.ndarray, window: int) -> np.ndarray:
    """Moving mean of (M, C) over ``window`` rows; the first and last rows are repeated beyond the ends."""
    before, after = window // 2, window - 1 - window // 2
    padded = np.pad(values, ((before, after), (0, 0)), mode="edge")
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), padded]), axis=0)
    return np.asarray((total[window:] - total[:-window]) / window)


def _side_view(stage: Stage) -> tuple[np.ndarray, float]:
    """Axes of the view from the side (right, up and forward as the columns of (3, 3)), and its azimuth [deg]."""
    way = _heading(stage.log.position.mean(axis=1))
    azimuth, elevation = np.arctan2(way[1], way[0]) + np.radians(WIDE_AZIMUTH), np.radians(WIDE_ELEVATION)
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])
    return np.column_stack([right, np.cross(right, forward), forward]), float(np.degrees(azimuth))


def _wide(stage: Stage, aspect: float) -> Camera:
    """Camera at rest, at the side and above, just far enough away to show everything in the log."""
    axes, azimuth = _side_view(stage)
    points = _corners(stage) @ axes
    half = np.tan(np.radians(0.5 * WIDE_FOVY)) * np.array([aspect, 1.0]) * (1.0 - 2.0 * WIDE_MARGIN)
    middle, distance = points.mean(axis=0), 0.0
    for _ in range(20):  # fixed-point iteration: distance and middle depend on each other
        offset = points - middle
        distance = float((np.abs(offset[:, :2]) / half - offset[:, 2:]).max())
        seen = offset[:, :2] / (offset[:, 2:] + distance)
        middle[:2] += 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance
    return _resting(stage, axes @ middle, distance, azimuth)


def _beside(stage: Stage, aspect: float, x: float, y: float, reach: float) -> Camera:
    """Camera at rest, at the side and above, that shows ``reach`` [m] to the left and to the right of a point."""
    distance = reach / (aspect * float(np.tan(np.radians(0.5 * WIDE_FOVY))))
    return _resting(stage, np.array([x, y, 0.0]), distance, _side_view(stage)[1])


def _spot(name: str) -> tuple[float, float, float]:
    """The three numbers of ``at:X,Y,R``.

    Raises:
        ConfigurationError: they are not two finite coordinates and a positive reach.
    """
    try:
        x, y, reach = (float(part) for part in name.removeprefix(SPOT).split(","))
    except ValueError:
        x, y, reach = np.nan, np.nan, np.nan
    if not (np.isfinite([x, y, reach]).all() and reach > 0):
        raise ConfigurationError(f"camera {name!r} must be at:X,Y,R with a point and a positive reach [m], for example at:60,0,8")
    return x, y, reach


def _resting(stage: Stage, target: np.ndarray, distance: float, azimuth: float) -> Camera:
    """A camera at rest that looks at ``target`` (3,)."""
    stage.model.vis.global_.fovy = WIDE_FOVY
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = target
    camera.distance, camera.azimuth, camera.elevation = distance, azimuth, WIDE_ELEVATION
    return lambda time: camera


def _corners(stage: Stage) -> np.ndarray:
    """Positions of agents and corners of the obstacles' zones (P, 3) [m]."""
    low, high = stage.log.zone()
    boxes = [np.column_stack([x, y]) for x in (low[:, 0], high[:, 0]) for y in (low[:, 1], high[:, 1])]
    ground = np.concatenate([stage.log.position.reshape(-1, 2), *boxes])
    return np.column_stack([ground, np.zeros(len(ground))])


def _fit_top(stage: Stage, aspect: float) -> None:
    """Turn the model's top camera into a map: orthographic, and just wide enough for everything in the log."""
    log, model = stage.log, stage.model
    everything = np.concatenate([log.position.reshape(-1, 2), *log.zone()])
    low, high = everything.min(axis=0) - TOP_MARGIN * stage.scale, everything.max(axis=0) + TOP_MARGIN * stage.scale
    camera = model.camera("top").id
    model.cam_projection[camera] = mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC
    model.cam_fovy[camera] = max(high[1] - low[1], (high[0] - low[0]) / aspect)
    model.cam_pos[camera] = *(0.5 * (low + high)), 60.0
    model.cam_quat[camera] = 1.0, 0.0, 0.0, 0.0


def project(
    scene: mujoco.MjvScene, points: np.ndarray, radii: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Project balls into the picture of a scene's camera.

    Args:
        points: (P, 3) their centers [m].
        radii: (P,) their radii [m].
        width, height: size of the picture [pixels].

    Returns:
        (P, 2) their columns and rows, NaN behind the camera, and (P,) their radii, all in pixels.
    """
    left, right = scene.camera
    forward, up = np.asarray(left.forward, dtype=float), np.asarray(left.up, dtype=float)
    offset = points - 0.5 * (np.asarray(left.pos, dtype=float) + np.asarray(right.pos, dtype=float))
    depth = offset @ forward
    scale = np.full(len(points), height / (left.frustum_top - left.frustum_bottom))
    if not left.orthographic:
        scale *= left.frustum_near / np.where(depth > left.frustum_near, depth, np.nan)
    column = 0.5 * width + offset @ np.cross(forward, up) * scale
    row = 0.5 * height - offset @ up * scale
    return np.stack([column, row], axis=1), radii * scale
