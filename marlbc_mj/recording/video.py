"""Videos and stills of an episode, drawn from its log after the run."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from marlbc_mj.recording.camera import DISTANT, make_camera, project
from marlbc_mj.recording.caption import Caption
from marlbc_mj.recording.encoding import COLORS, PALETTE_FRAMES, check_format, common_palette, encoder
from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.recording.offscreen import Offscreen
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import staged_file
from marlbc_mj.util.text import one_line

LEAST_PIXELS, MOST_PIXELS = 64, 4096  # limits of width and height [pixels]
MOST_SAMPLES = 16  # largest number of samples per pixel
_SIZES = f"size must be two even numbers of pixels from {LEAST_PIXELS} to {MOST_PIXELS}, for example 1280x720"


@dataclass(frozen=True)
class VideoStyle:
    """Which part of an episode a video shows, and how."""

    speed: float = 4.0  # seconds of the mission per second of video
    fps: int = 30  # frames per second of video
    size: tuple[int, int] = (1280, 720)  # width and height [pixels], even
    camera: str = "track"  # a key of camera.CAMERAS, "agent1" and so on, or a camera of the model
    start: float | None = None  # first mission time shown [s]; None: the beginning of the log
    end: float | None = None  # last mission time shown [s]; None: the end of the log
    samples: int = 0  # samples per pixel; 4 smooths edges and takes about twice as long


def render_video(
    log: EpisodeLog,
    path: str | Path,
    style: VideoStyle = VideoStyle(),
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write a video of an episode; the file appears under its name when it is complete.

    Args:
        log: the episode.
        path: the file, whose suffix selects the format: ``.mp4`` (H.264), or ``.webp`` and ``.gif``, which repeat forever.
        style: what is shown, and how.
        overwrite: replace an existing file.
        progress: called after every frame with the number of frames done and the total number.

    Returns:
        The number of frames.

    Raises:
        ConfigurationError: an invalid argument, an existing file without ``overwrite``, or no usable OpenGL.
        SimulationError: the encoder failed.
    """
    if not isinstance(log, EpisodeLog):
        raise ConfigurationError(f"a video shows a log, as read_log returns it, got {type(log).__name__}")
    path = Path(path)
    check_format(path)
    if not 0 <= style.samples <= MOST_SAMPLES:
        raise ConfigurationError(f"samples must be from 0 to {MOST_SAMPLES}, got {style.samples}")
    times = frame_times(log, speed=style.speed, fps=style.fps, start=style.start, end=style.end)
    pictures = _frames(log, times, style.size, camera=style.camera, samples=style.samples, speed=style.speed)
    with staged_file(path, overwrite=overwrite) as partial, closing(pictures):
        palette = _palette(log, times, style, path.suffix)
        try:
            _encode(pictures, partial, style, len(times), progress, palette)
        except (OSError, SimulationError) as error:
            raise SimulationError(f"cannot write video {path}: {one_line(error)}") from error
    return len(times)


def _palette(log: EpisodeLog, times: np.ndarray, style: VideoStyle, suffix: str) -> np.ndarray | None:
    """Palette of an animation, from frames that are spread over it; None for an MP4."""
    if suffix.lower() not in COLORS:
        return None
    spread = times[np.unique(np.linspace(0, len(times) - 1, PALETTE_FRAMES).astype(int))]
    frames = _frames(log, spread, style.size, camera=style.camera, samples=style.samples, speed=style.speed)
    return common_palette(frames, suffix)


def render_still(
    log: EpisodeLog, time: float, *, size: tuple[int, int] = (1280, 720), camera: str = "track", samples: int = 4
) -> np.ndarray:
    """Frame (height, width, 3) uint8 at ``time`` [s], as in a video but without the speed label; ``size`` is (width, height).

    Raises:
        ConfigurationError: an invalid argument, or no usable OpenGL.
    """
    frames = _frames(log, np.array([time]), size, camera=camera, samples=samples, speed=None)
    with closing(frames):
        return next(frames)


def frame_times(log: EpisodeLog, *, speed: float, fps: int, start: float | None, end: float | None) -> np.ndarray:
    """Mission time of every frame (F,) [s].

    Raises:
        ConfigurationError: a speed or rate that is not positive, or an empty part of the mission.
    """
    for name, value in (("speed", speed), ("fps", fps)):
        if not (np.isfinite(value) and value > 0):
            raise ConfigurationError(f"{name} must be positive, got {value}")
    if len(log.time) == 0:
        raise ConfigurationError("the log holds no mission step, so there is nothing to show")
    first, last = float(log.time[0]), float(log.time[-1]) + log.mission_step
    begin, until = max(first, first if start is None else start), min(last, last if end is None else end)
    if not begin < until:
        asked = [f"{name} {value:g} s" for name, value in (("start", start), ("end", end)) if value is not None]
        raise ConfigurationError(f"the log holds {first:g} to {last:g} s, nothing of which is left with {' and '.join(asked)}")
    count = max(1, int(np.ceil((until - begin) * fps / speed - 1e-6)))
    return begin + np.arange(count) * speed / fps


def _frames(
    log: EpisodeLog, times: np.ndarray, size: tuple[int, int], *, camera: str, samples: int, speed: float | None
) -> Generator[np.ndarray, None, None]:
    """Draw the frame (height, width, 3) uint8 for every time [s]."""
    _check_size(*size)
    stage = make_stage(log)
    caption = Caption(log, *size, speed, numbers="above" if stage.free else "on" if camera in DISTANT else "inside")
    scene = size[0], caption.picture_height
    view = make_camera(camera, stage, scene[0] / scene[1])
    with Offscreen(stage, view, *scene, samples=samples) as offscreen:
        for time in times:
            picture = offscreen.render(float(time))
            labels, radii = project(offscreen.scene, stage.middles(), stage.radii, *scene)
            yield np.asarray(caption.frame(picture, float(time), stage.step(float(time)), labels, radii))


def _encode(
    pictures: Iterator[np.ndarray],
    path: Path,
    style: VideoStyle,
    count: int,
    progress: Callable[[int, int], None] | None = None,
    palette: np.ndarray | None = None,
) -> None:
    """Pass all pictures to the encoder, and check that it has written them.

    Raises:
        SimulationError: the encoder failed, for example because the disk is full.
    """
    first = next(pictures)  # before the encoder starts, so that errors in drawing are raised first
    with encoder(path, style.size, style.fps, palette) as add:
        for done, picture in enumerate(chain([first], pictures), 1):
            add(picture)
            if progress is not None:
                progress(done, count)


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [pixels] from ``1280x720``.

    Raises:
        ConfigurationError: the text is not a size, or not a valid size of a video.
    """
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() and side.isascii() and len(side) < 6 for side in sides):
        raise ConfigurationError(f"{_SIZES}; got {text!r}")
    _check_size(int(sides[0]), int(sides[1]))
    return int(sides[0]), int(sides[1])


def _check_size(width: int, height: int) -> None:
    if any(not LEAST_PIXELS <= side <= MOST_PIXELS or side % 2 for side in (width, height)):
        raise ConfigurationError(f"{_SIZES}; got {width}x{height}")
