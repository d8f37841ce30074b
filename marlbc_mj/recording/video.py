"""Videos and stills of an episode, drawn from its log after the run."""

import subprocess
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import imageio_ffmpeg
import numpy as np

from marlbc_mj.recording.camera import make_camera, project
from marlbc_mj.recording.caption import Caption
from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.recording.offscreen import Offscreen
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import staged_file
from marlbc_mj.util.text import one_line

LEAST_PIXELS, MOST_PIXELS = 64, 4096  # pixels, either side
MOST_SAMPLES = 16  # per pixel
COLORS = "scale=out_color_matrix=bt709:out_range=tv,setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709"
ENCODING = ["-vf", COLORS, "-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"]
"""Colors as players expect them of a high-definition picture, constant quality, and an index at the file's beginning."""


@dataclass(frozen=True)
class VideoStyle:
    """Which part of an episode a video shows, and how."""

    speed: float = 4.0  # seconds of the mission per second of video
    fps: int = 30  # frames per second of video
    width: int = 1280  # [pixels], even
    height: int = 720  # [pixels], even
    camera: str = "track"  # ``track``, ``top``, ``close`` or a camera of the model
    start: float | None = None  # first moment of the mission that is shown [s]; None: its beginning
    end: float | None = None  # last one [s]; None: its end
    samples: int = 0  # per pixel; 4 smooths edges and takes about twice as long


def render_video(
    log: EpisodeLog,
    path: str | Path,
    style: VideoStyle = VideoStyle(),
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write an H.264 MP4 of an episode; the file appears under its name when it is complete.

    Args:
        log: the episode.
        path: a name that ends in ``.mp4``.
        style: what is shown, and how.
        overwrite: replace an existing file.
        progress: called after every frame with how many are done and how many there are.

    Returns:
        The number of frames.

    Raises:
        ConfigurationError: an argument that cannot be used, an existing file without ``overwrite``, or no OpenGL.
        SimulationError: the encoder failed.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ConfigurationError(f"a video's name must end in .mp4, got {path.name!r}")
    if not 0 <= style.samples <= MOST_SAMPLES:
        raise ConfigurationError(f"samples must be from 0 to {MOST_SAMPLES}, got {style.samples}")
    times = frame_times(log, speed=style.speed, fps=style.fps, start=style.start, end=style.end)
    size = style.width, style.height
    pictures = _frames(log, times, size, camera=style.camera, samples=style.samples, speed=style.speed)
    with staged_file(path, overwrite=overwrite) as partial, closing(pictures):
        try:
            _encode(pictures, partial, size, style.fps, len(times), progress)
        except (OSError, SimulationError) as error:
            raise SimulationError(f"cannot write video {path}: {one_line(error)}") from error
    return len(times)


def render_still(
    log: EpisodeLog, time: float, *, width: int = 1280, height: int = 720, camera: str = "track", samples: int = 4
) -> np.ndarray:
    """(height, width, 3) uint8: the frame that a video shows at ``time`` [s].

    Raises:
        ConfigurationError: an argument that cannot be used, or no OpenGL.
    """
    frames = _frames(log, np.array([time]), (width, height), camera=camera, samples=samples, speed=None)
    with closing(frames):
        return next(frames)


def frame_times(log: EpisodeLog, *, speed: float, fps: int, start: float | None, end: float | None) -> np.ndarray:
    """(F,) mission time of every frame [s].

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
        raise ConfigurationError(f"start {start} and end {end} leave nothing of the log's {first:g} to {last:g} s")
    count = max(1, int(np.ceil((until - begin) * fps / speed - 1e-6)))
    return begin + np.arange(count) * speed / fps


def _frames(
    log: EpisodeLog, times: np.ndarray, size: tuple[int, int], *, camera: str, samples: int, speed: float | None
) -> Generator[np.ndarray, None, None]:
    """(height, width, 3) uint8 for every time [s]."""
    _check_size(*size)
    stage = make_stage(log)
    caption = Caption(log, *size, speed, badges=bool(stage.free))
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
    size: tuple[int, int],
    fps: int,
    count: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Hand all pictures to the encoder, and see that it has written them.

    Raises:
        SimulationError: the encoder failed, for want of room on the disk for example.
    """
    first = next(pictures)  # before the encoder starts: what cannot be drawn fails here
    with encoder(path, size, fps) as stream:
        for done, picture in enumerate(chain([first], pictures), 1):
            stream.write(np.ascontiguousarray(picture).data)
            if progress is not None:
                progress(done, count)


@contextmanager
def encoder(path: Path, size: tuple[int, int], fps: int) -> Iterator[IO[bytes]]:
    """A stream that takes pictures of ``size``, width and height, as RGB bytes; the video is whole when the block has ended.

    Raises:
        SimulationError: the encoder said that it failed, whatever the file looks like.
    """
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(Fraction(fps).limit_denominator())]
    target = ["-an", "-vcodec", "libx264", "-pix_fmt", "yuv420p", "-v", "error", *ENCODING, str(path)]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", *source, "-i", "-", *target]
    with TemporaryFile() as errors:
        # A group of its own: Ctrl-C is for the program, which then ends the encoder.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True
        )
        assert process.stdin is not None
        whole = False
        try:
            with suppress(BrokenPipeError):  # the encoder has ended, and says why
                yield process.stdin
                process.stdin.close()
                whole = True
            status = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        finally:
            with suppress(OSError):
                process.stdin.close()
        if status or not whole:
            errors.seek(0)
            said = errors.read().decode(errors="replace").strip().splitlines()
            raise SimulationError(f"the encoder failed with status {status}: {_reason(said)}")


def _reason(said: Sequence[str]) -> str:
    """The line of the encoder that tells the most."""
    return next(
        (line for line in said if "No space left" in line or "too large" in line), said[-1] if said else "no reason given"
    )


def _check_size(width: int, height: int) -> None:
    for name, value in (("width", width), ("height", height)):
        if not LEAST_PIXELS <= value <= MOST_PIXELS or value % 2:
            raise ConfigurationError(f"{name} must be an even number of pixels from {LEAST_PIXELS} to {MOST_PIXELS}, got {value}")
