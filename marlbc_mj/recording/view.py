"""Interactive playback of a log in MuJoCo's viewer."""

import os
import sys
import warnings
from dataclasses import dataclass
from time import perf_counter, sleep
from typing import Any

import mujoco
import numpy as np

from marlbc_mj.recording.camera import make_camera
from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.recording.stage import Stage, make_stage
from marlbc_mj.util.errors import ConfigurationError

REFRESH = 1.0 / 60.0  # time between two frames [s]
JUMP = 5.0  # mission time that an arrow key skips [s]
SPACE, RIGHT, LEFT, HOME = 32, 262, 263, 268  # GLFW's key codes
KEYS = "space pause   left/right 5 s   home restart"
NO_DISPLAY = "the viewer needs a display; render a file instead with `marlbc video`"


@dataclass
class Playback:
    """The clock of a viewer: mission time that runs at ``speed``, stops at both ends and responds to keys."""

    first: float  # [s]
    last: float  # [s]
    speed: float
    time: float  # [s]
    paused: bool = False

    def advance(self, seconds: float) -> float:
        """Advance by ``seconds`` of wall time, unless paused, and return the mission time [s]."""
        if not self.paused:
            self._set(self.time + self.speed * seconds)
        return self.time

    def press(self, key: int) -> None:
        """Handle a key; other keys do nothing."""
        if key == SPACE:
            self.paused = not self.paused
        elif key in (LEFT, RIGHT):
            self._set(self.time + (JUMP if key == RIGHT else -JUMP))
        elif key == HOME:
            self._set(self.first)

    def _set(self, time: float) -> None:
        self.time = min(max(time, self.first), self.last)


def view(log: EpisodeLog, *, speed: float = 1.0) -> None:
    """Play a log in a window until it is closed; the camera moves along with the team and can be turned.

    Args:
        log: the episode.
        speed: seconds of the mission per second of wall time.

    Raises:
        ConfigurationError: no display, or a speed that is not positive.
    """
    if not (np.isfinite(speed) and speed > 0):
        raise ConfigurationError(f"speed must be positive, got {speed}")
    check_display()
    import mujoco.viewer as viewer  # loads GLFW, which only this function needs

    stage = make_stage(log)
    first = float(log.time[0])
    playback = Playback(first, float(log.time[-1]), speed, first)
    stage.pose(first)
    try:
        handle = viewer.launch_passive(
            stage.model, stage.data, key_callback=playback.press, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:
        raise ConfigurationError(f"the viewer did not start: {error}") from error
    with handle:
        _play(handle, stage, playback)


def check_display() -> None:
    """Make sure that a window can be opened; otherwise MuJoCo's viewer would wait forever.

    Raises:
        ConfigurationError: there is no display, or it does not answer.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigurationError(f"DISPLAY and WAYLAND_DISPLAY are unset: {NO_DISPLAY}")
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not glfw.init():
            raise ConfigurationError(f"the display {os.environ.get('DISPLAY', '')!r} does not answer: {NO_DISPLAY}")
        glfw.terminate()


def _play(handle: Any, stage: Stage, playback: Playback) -> None:
    track = make_camera("track", stage, 16 / 9)
    start = track(playback.time)
    followed = start.lookat.copy()
    with handle.lock():
        handle.cam.lookat[:] = followed
        handle.cam.distance, handle.cam.azimuth, handle.cam.elevation = start.distance, start.azimuth, start.elevation
    shown = perf_counter()
    while handle.is_running():
        now = perf_counter()
        time, shown = playback.advance(now - shown), now
        target = track(time).lookat.copy()
        with handle.lock():
            stage.pose(time)
            handle.cam.lookat[:] += target - followed
            handle.user_scn.ngeom = 0
            stage.draw(handle.user_scn, time)
        followed = target
        handle.set_texts(_texts(stage, time))
        handle.sync()
        sleep(max(0.0, REFRESH - (perf_counter() - now)))


def _texts(stage: Stage, time: float) -> list[tuple[int, int, str, str]]:
    """Overlay texts: time, priorities, and the available keys."""
    commands = stage.commands(time)
    names = "\n".join(["time", *(f"agent {i + 1}" for i in range(len(commands)))])
    shielded = stage.shielded(time)
    acting = [f"{command}  shield" if i in shielded else command for i, command in enumerate(commands)]
    values = "\n".join([f"{time:.1f} s", *acting])
    font, grid = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
    return [(font, grid.mjGRID_TOPLEFT, names, values), (font, grid.mjGRID_BOTTOMLEFT, KEYS, "")]
