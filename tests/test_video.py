"""Videos and stills come from the real renderer; the viewer is tested up to its window."""

import os
import subprocess
import sys
from dataclasses import replace
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from conftest import Episode
from PIL import Image, ImageSequence

from marlbc_mj.controllers import SORLC
from marlbc_mj.recording.camera import make_camera, project
from marlbc_mj.recording.caption import Caption
from marlbc_mj.recording.encoding import poster
from marlbc_mj.recording.gl import choose_gl
from marlbc_mj.recording.log import EpisodeLog, from_trajectory
from marlbc_mj.recording.marks import corner_indices
from marlbc_mj.recording.offscreen import Offscreen
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.recording.video import VideoStyle, frame_times, parse_size, render_still, render_video
from marlbc_mj.recording.view import HOME, LEFT, RIGHT, SPACE, Playback, view
from marlbc_mj.robots import ROBOTS
from marlbc_mj.scenarios import SCENARIOS
from marlbc_mj.scenarios.titles import MISSION_TITLES, ROBOT_TITLES, mission_title
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.palette import AGENT_COLORS, BEHAVIOR_COLORS, agent_color, ink_on, rgba

SMALL: dict[str, Any] = {"size": (320, 180)}


@pytest.fixture(scope="module")
def log(episode: Episode) -> EpisodeLog:
    """Log of the case study under the scripted supervisor, with SORLC."""
    return from_trajectory(episode("scripted", "sorlc"), SORLC())


def _look(log: EpisodeLog, camera: str, time: float, points: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A picture of 640 x 360 without bars, and the pixels (P, 2) of points (P, 3), by default the agents' centers."""
    stage = make_stage(log)
    size = 640, 360
    with Offscreen(stage, make_camera(camera, stage, size[0] / size[1]), *size) as offscreen:
        picture = offscreen.render(time)
        points = stage.middles() if points is None else points
        pixels, _ = project(offscreen.scene, points, np.ones(len(points)), *size)
    return picture, pixels.round().astype(int)


def _hue(color: np.ndarray) -> np.ndarray:
    """Direction of a color from gray, which light and shade do not change."""
    difference = np.asarray(color, dtype=float) - np.mean(color)
    return np.asarray(difference / np.linalg.norm(difference))


def _read(path: Path) -> tuple[str, np.ndarray]:
    """ffmpeg's report on a video, and its frames (F, 180, 320, 3)."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return done.stderr.decode(), np.frombuffer(done.stdout, np.uint8).reshape(-1, 180, 320, 3)


def test_video_decodes_to_what_was_asked_for(log: EpisodeLog, tmp_path: Path) -> None:
    """Two seconds of the mission at 4x and 20 frames per second are ten frames, and the first shows the still of its time."""
    path = tmp_path / "clip.mp4"
    counted: list[tuple[int, int]] = []
    count = render_video(log, path, VideoStyle(start=19, end=21, fps=20, **SMALL), progress=lambda *done: counted.append(done))
    said, frames = _read(path)
    for part in ("Video: h264", "yuv420p(tv, bt709", "320x180", "20 fps"):
        assert part in said
    assert len(frames) == count == 10
    assert counted == [(k, 10) for k in range(1, 11)]
    still = render_still(log, 19.0, **SMALL, samples=0)
    picture = slice(Caption(log, 320, 180).header + 1, 140)
    assert np.abs(frames[0][picture].astype(int) - still[picture]).mean() < 4
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animations_repeat_for_ever_and_show_the_frames(log: EpisodeLog, tmp_path: Path, suffix: str) -> None:
    """They have five frames of 0.1 s, and the first shows the still of its time."""
    path = tmp_path / f"clip{suffix}"
    assert render_video(log, path, VideoStyle(start=19, end=21, fps=10, samples=4, **SMALL)) == 5
    with Image.open(path) as animation:
        assert (animation.n_frames, animation.size, animation.info["loop"]) == (5, (320, 180), 0)
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(animation)]
        assert animation.info["duration"] == 100
    still = render_still(log, 19.0, **SMALL)
    picture = slice(Caption(log, 320, 180).header + 1, 140)
    assert np.abs(frames[0][picture] - still[picture]).mean() < 4
    assert np.abs(frames[0] - frames[-1]).mean() > 0.1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "text", ["1280", "1280x", "x720", "12.5x3", "1280x720x3", "-64x64", "99999999999x64", "66x65", "\u00b2x64"]
)
def test_a_wrong_size_is_named(text: str) -> None:
    """The error shows an example of a size."""
    with pytest.raises(ConfigurationError, match=f"size must be two even numbers .*, for example 1280x720; got '?{text}"):
        parse_size(text)
    assert parse_size("640X360") == (640, 360)


def test_video_replaces_a_file_only_when_told(log: EpisodeLog, tmp_path: Path) -> None:
    """An existing file is kept unless ``overwrite`` is set."""
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"mine")
    with pytest.raises(ConfigurationError, match="exists"):
        render_video(log, path, VideoStyle(**SMALL))
    assert path.read_bytes() == b"mine"
    render_video(log, path, VideoStyle(start=0, end=0.2, **SMALL), overwrite=True)
    assert len(_read(path)[1]) == 2


def test_interrupted_video_leaves_nothing(log: EpisodeLog, tmp_path: Path) -> None:
    """Neither the file nor a part of it stays behind."""

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_video(log, tmp_path / "clip.mp4", VideoStyle(**SMALL), progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("camera", ["track", "top", "wide"])
@pytest.mark.parametrize("time", [20.0, 65.0])
def test_agents_are_where_they_are_projected(log: EpisodeLog, camera: str, time: float) -> None:
    """The pixel at an agent's projected center has the agent's hue."""
    picture, pixels = _look(log, camera, time)
    for agent, (column, row) in enumerate(pixels):
        assert _hue(picture[row, column]) @ _hue(np.array(agent_color(agent)[:3])) > 0.95


def test_halo_has_the_color_of_the_command(log: EpisodeLog) -> None:
    """While agent 1 avoids an obstacle, its halo has OA's color, the others' halos have FM's."""
    stage = make_stage(log)
    stage.pose(20.0)
    rims = stage.middles() + np.array([1.22 * stage.radii[0], 0.0, 0.1 - stage.radii[0]])
    picture, pixels = _look(log, "top", 20.0, rims)
    colors = [picture[row, column] for column, row in pixels]
    expected = [BEHAVIOR_COLORS[name] for name in ("OA", "FM", "FM", "FM")]
    for color, name in zip(colors, expected, strict=True):
        assert _hue(color) @ _hue(np.array(rgba(name)[:3])) > 0.95


def test_picture_follows_the_log(log: EpisodeLog) -> None:
    """The same time gives the same pixels, another time different ones."""
    first, again, later = (_look(log, "top", time)[0] for time in (10.0, 10.0, 12.0))
    np.testing.assert_array_equal(first, again)
    assert (first != later).any(axis=2).sum() > 50


def test_obstacle_is_drawn_where_the_log_has_it(log: EpisodeLog) -> None:
    """The model has the nominal position, but a perturbed episode's log has its own, which is drawn."""
    obstacles = log.obstacles.copy()
    obstacles[2, :2] = 10.0, -4.0
    moved = replace(log, obstacles=obstacles)
    for shown, dark in ((log, (True, False)), (moved, (False, True))):
        places = np.array([[*log.obstacles[2, :2], 1.2], [*obstacles[2, :2], 1.2]])
        picture, pixels = _look(shown, "top", 0.0, places)
        assert tuple(bool(picture[row, column].mean() < 140) for column, row in pixels) == dark


def test_log_is_interpolated_and_held(log: EpisodeLog) -> None:
    """Positions are linear between mission steps and constant outside the log."""
    stage = make_stage(log)
    middle = 0.5 * (log.position[100] + log.position[101])
    np.testing.assert_allclose(stage.sample(log.position, 100.5 * log.mission_step), middle, atol=1e-9)
    np.testing.assert_array_equal(stage.sample(log.position, -1.0), log.position[0])
    np.testing.assert_array_equal(stage.sample(log.position, 1e3), log.position[-1])


def test_corners_stay_close_to_the_path() -> None:
    """No point of a path is farther than the tolerance from the straight pieces; a straight path needs two corners."""
    angle = np.linspace(0.0, 3.0, 400)
    path = np.column_stack([angle, np.sin(3 * angle)])
    corners = corner_indices(path, 0.02)
    assert len(corners) < 60
    drawn = np.interp(path[:, 0], path[corners, 0], path[corners, 1])
    assert np.abs(drawn - path[:, 1]).max() < 0.02 * np.hypot(1, 3)
    assert corner_indices(np.column_stack([angle, angle]), 0.02).tolist() == [0, 399]
    assert corner_indices(np.zeros((5, 2)), 0.02).tolist() == [0, 4]


def test_frame_times_cover_the_mission(log: EpisodeLog) -> None:
    """100 s at 4x and 30 frames per second are 750 frames, the last one before the end."""
    times = frame_times(log, speed=4.0, fps=30, start=None, end=None)
    assert len(times) == 750
    assert times[0] == 0.0
    assert 99.8 < times[-1] < 100.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": (321, 180)}, "size must be two even numbers of pixels from 64 to 4096, for example 1280x720; got 321x180"),
        ({"size": (320, 20)}, "size must be"),
        ({"samples": 17}, "samples must be from 0 to 16"),
        ({"camera": "moon"}, "unknown camera 'moon'; choose from: track, close, agent1, wide, at:X,Y,R, top, agent2,"),
        ({"camera": "agent5"}, "unknown camera 'agent5'"),
        ({"camera": "at:1,2"}, "camera 'at:1,2' must be at:X,Y,R"),
        ({"camera": "at:1,2,0"}, "must be at:X,Y,R"),
        ({"camera": "at:nan,2,1"}, "must be at:X,Y,R"),
        ({"speed": 0.0}, "speed must be positive"),
        ({"fps": -1}, "fps must be positive"),
        ({"start": 50.0, "end": 40.0}, "nothing of which is left with"),
        ({"start": 200.0}, "nothing of which is left with"),
    ],
)
def test_wrong_settings_are_named(log: EpisodeLog, tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    """Invalid settings are refused before anything is written."""
    with pytest.raises(ConfigurationError, match=message):
        render_video(log, tmp_path / "clip.mp4", VideoStyle(**{**SMALL, **changes}))
    assert list(tmp_path.iterdir()) == []


def test_wrong_files_and_logs_are_named(log: EpisodeLog, tmp_path: Path) -> None:
    """Refused are unknown video formats, folders that cannot be created, and logs without steps or with a foreign model."""
    with pytest.raises(ConfigurationError, match=r"must end in \.mp4, \.webp or \.gif, got 'clip.avi'"):
        render_video(log, tmp_path / "clip.avi")
    (tmp_path / "none").touch()
    with pytest.raises(ConfigurationError, match="cannot write"):
        render_video(log, tmp_path / "none" / "clip.mp4")
    with pytest.raises(ConfigurationError, match="no mission step"):
        render_video(replace(log, time=log.time[:0]), tmp_path / "clip.mp4")
    with pytest.raises(ConfigurationError, match="'agent1_ has no slides along x and y'"):
        make_stage(replace(log, mjcf="<mujoco/>"))


def test_top_camera_of_the_model_sees_the_mission(log: EpisodeLog) -> None:
    """The camera in the MJCF does so in a 16:9 picture, for users who render the model without this package."""
    model = mujoco.MjModel.from_xml_string(log.mjcf)
    half = model.camera("top").pos[2] * np.tan(np.radians(0.5 * model.camera("top").fovy[0])) * np.array([16 / 9, 1.0])
    assert (np.abs(log.position - model.camera("top").pos[:2]) < half).all()


def _choose_in_a_new_process(**environment: str) -> str:
    """The output of choose_gl in a new process with these environment variables."""
    code = (
        "import sys\nfrom marlbc_mj.util.errors import ConfigurationError\nfrom marlbc_mj.recording.gl import choose_gl\n"
        "assert 'mujoco' not in sys.modules\n"
        "try: print(choose_gl())\nexcept ConfigurationError as error: print(error)"
    )
    root = str(Path(__file__).resolve().parents[1])
    variables = {**os.environ, "PYTHONPATH": root, **environment}
    return subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=True).stdout


def test_missing_opengl_is_one_clear_line() -> None:
    """If EGL's loader finds no driver, the error names the packages that help."""
    said = _choose_in_a_new_process(MUJOCO_GL="egl", __EGL_VENDOR_LIBRARY_DIRS="/nonexistent")
    assert said.count("\n") == 1
    for part in ("tried egl", "libegl1 libgl1-mesa-dri", "libosmesa6", "MUJOCO_GL=osmesa"):
        assert part in said


def test_gl_setting_is_respected() -> None:
    """An unknown backend and a switched-off one are refused; a working one is chosen."""
    assert "unknown MUJOCO_GL 'vulkan'; choose from: " in _choose_in_a_new_process(MUJOCO_GL="vulkan")
    assert "switches rendering off" in _choose_in_a_new_process(MUJOCO_GL="off")
    assert choose_gl() in ("egl", "osmesa", "glfw", "cgl")


def test_viewer_without_display_says_what_to_do(log: EpisodeLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the other way to see the episode."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(ConfigurationError, match="`marlbc video`"):
        view(log)


def test_playback_obeys_speed_and_keys() -> None:
    """Mission time runs at the given speed, stops at the ends, pauses, jumps and starts again."""
    playback = Playback(first=0.0, last=20.0, speed=4.0, time=0.0)
    assert playback.advance(1.0) == 4.0
    playback.press(SPACE)
    assert playback.advance(1.0) == 4.0
    playback.press(RIGHT)
    assert playback.advance(1.0) == 9.0
    playback.press(LEFT)
    playback.press(LEFT)
    assert playback.time == 0.0
    playback.press(SPACE)
    assert playback.advance(100.0) == 20.0
    playback.press(HOME)
    assert playback.time == 0.0


SIGHTS = {
    "normal": np.eye(3),
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
}
"""Matrices that map linear RGB to its appearance for each kind of vision (Machado, Oliveira and Fernandes 2009)."""


def _linear(color: str) -> np.ndarray:
    values = np.array(rgba(color)[:3])
    return np.asarray(np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4))


def _lab(color: str, sight: str) -> np.ndarray:
    """CIELAB coordinates of a color as it appears to one kind of vision."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    seen = np.clip(np.array(SIGHTS[sight]) @ _linear(color), 0.0, 1.0)
    x, y, z = np.cbrt(to_xyz @ seen / [0.95047, 1.0, 1.08883])
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize(("sight", "least"), [("normal", 30.0), ("deuteranopia", 10.0), ("protanopia", 10.0)])
def test_agents_and_behaviors_share_no_color(sight: str, least: float) -> None:
    """The first four agents' colors differ from each other and behaviors' in CIELAB, the rest from behaviors' in normal sight."""
    agents = [_lab(color, sight) for color in (AGENT_COLORS if sight == "normal" else AGENT_COLORS[:4])]
    behaviors = [_lab(color, sight) for color in BEHAVIOR_COLORS.values()]
    assert min(np.linalg.norm(a - b) for a in agents for b in behaviors) > least
    assert min(np.linalg.norm(a - b) for a, b in combinations(agents[:4], 2)) > least


def test_a_poster_is_a_frame_of_the_video(log: EpisodeLog, tmp_path: Path) -> None:
    """It is a JPEG, and there is none beyond the video's end."""
    render_video(log, tmp_path / "clip.mp4", VideoStyle(start=19, end=21, fps=10, **SMALL))
    with Image.open(BytesIO(poster(tmp_path / "clip.mp4", 0.3))) as picture:
        assert (picture.format, picture.size) == ("JPEG", (320, 180))
    assert poster(tmp_path / "clip.mp4", 5.0) == b""


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("paper", "Case study"),
        ("robot_gate-crazyflie", "Point and gate, Crazyflies"),
        ("traffic", "Traffic"),
        ("my_own-run", "My own-run"),
        ("", ""),
    ],
)
def test_missions_have_titles(name: str, title: str) -> None:
    """Every scenario and robot has a title for people; a user's own name stays readable."""
    assert mission_title(name) == title
    assert set(MISSION_TITLES) == set(SCENARIOS) and set(ROBOT_TITLES) == set(ROBOTS)


@pytest.mark.parametrize("size", [(1280, 720), (640, 320), (320, 180)])
def test_a_long_title_does_not_cover_the_speed(log: EpisodeLog, size: tuple[int, int]) -> None:
    """From a little left of the speed on, the upper bar looks the same with a short and with a very long title."""
    long = replace(log, supervisor="marlms-general", controller="predefined-time-limited", seed=1_000_000, scenario="x" * 60)
    picture = np.zeros((Caption(log, *size).picture_height, size[0], 3), np.uint8)
    nobody = np.empty((0, 2)), np.empty(0)
    short, full = (
        np.asarray(Caption(each, *size, speed=3.0).frame(picture, 5.0, 100, *nobody))[: Caption(log, *size).header - 3]
        for each in (replace(log, scenario="x", supervisor="", controller="", seed=0), long)
    )
    ink = np.flatnonzero((short != short[0, 0]).any(axis=(0, 2)))
    speed = int(ink[np.diff(ink).argmax() + 1])
    assert speed > 0.5 * size[0]
    np.testing.assert_array_equal(full[:, speed - 4 :], short[:, speed - 4 :])
    assert (full[:, : speed - 4] != full[0, 0]).any()


@pytest.mark.parametrize("color", [*AGENT_COLORS, *BEHAVIOR_COLORS.values()])
def test_text_is_readable_on_every_color(color: str) -> None:
    """The contrast (WCAG) is at least 2.6 to 1, which suits large bold text."""
    low, high = sorted(float(np.dot([0.2126, 0.7152, 0.0722], _linear(name))) for name in (color, ink_on(color)))
    assert (high + 0.05) / (low + 0.05) > 2.6
