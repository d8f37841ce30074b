"""Where the picture is taken from: a view that follows the team, a map of the whole mission, or a camera of the model."""

from collections.abc import Callable

import mujoco
import numpy as np

from marlbc_mj.recording.stage import Stage
from marlbc_mj.util.errors import unknown

TRACK_AZIMUTH = 38.0  # from the direction of travel; the team moves into the picture [deg]
TRACK_ELEVATION = -33.0  # [deg]
TRACK_FOVY = 36.0  # [deg]
TRACK_SMOOTHING = 8.0  # position and size of the team are followed as means over this time [s]
TRACK_AHEAD = 5.0  # how far ahead of the team it looks [m]
TRACK_DISTANCE = 3.45  # how far away it is, in team radii
CLOSE_RADIUS = (4.0, 7.0)  # the same of the close view, which shows the robots rather than all of the team [m]
TRACK_RADIUS = (10.5, 60.0)  # least and largest team radius it adapts to [m]
TOP_MARGIN = 4.0  # around everything in the log [m]

Camera = Callable[[float], mujoco.MjvCamera]


def make_camera(name: str, stage: Stage, aspect: float) -> Camera:
    """The camera ``track``, ``close``, ``top`` or any one of the model, as a function of time [s].

    Args:
        aspect: width of the picture over its height.

    Raises:
        ConfigurationError: unknown camera.
    """
    if name in ("track", "close"):
        return _track(stage, TRACK_RADIUS if name == "track" else CLOSE_RADIUS)
    names = [stage.model.camera(k).name for k in range(stage.model.ncam)]
    if name not in names:
        raise unknown("camera", name, dict.fromkeys(["track", *names, "close"]))
    if name == "top":
        _fit_top(stage, aspect)
    fixed = mujoco.MjvCamera()
    fixed.type = mujoco.mjtCamera.mjCAMERA_FIXED
    fixed.fixedcamid = stage.model.camera(name).id
    return lambda time: fixed


def _track(stage: Stage, bounds: tuple[float, float]) -> Camera:
    """From behind and above, turned so that team, trails and what lies ahead are in the picture."""
    log = stage.log
    centroid = log.position.mean(axis=1, keepdims=True)
    reach = np.linalg.norm(log.position - centroid, axis=-1).max(axis=1, keepdims=True)
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
    """(2,) unit vector of a team's way (M, 2) from first to last, along x where it stays."""
    way = centroid[-1] - centroid[0]
    length = float(np.hypot(*way))
    return np.asarray(way / length) if length > 1.0 else np.array([1.0, 0.0])


def _smoothed(values: np.ndarray, window: int) -> np.ndarray:
    """Moving mean of (M, C) over ``window`` rows, the ends repeated outwards."""
    before, after = window // 2, window - 1 - window // 2
    padded = np.pad(values, ((before, after), (0, 0)), mode="edge")
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), padded]), axis=0)
    return np.asarray((total[window:] - total[:-window]) / window)


def _fit_top(stage: Stage, aspect: float) -> None:
    """Turn the model's top camera into a map: no perspective, and everything in the log just fits."""
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
    """Where a scene's camera shows balls.

    Args:
        points: (P, 3) their middles [m].
        radii: (P,) [m].
        width, height: of the picture [pixels].

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
