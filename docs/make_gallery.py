"""Draw the gallery: flies the missions and leaves one still and one short clip of each in docs/gallery. ``make gallery``."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import imageio_ffmpeg
from PIL import Image

from marlbc_mj import World, make_controller, make_supervisor, paper, run_episode
from marlbc_mj.recording.log import EpisodeLog, from_trajectory
from marlbc_mj.recording.video import VideoStyle, render_still, render_video
from marlbc_mj.robots import make_robot
from marlbc_mj.studies.robot_gate import GATE_CONTROLLERS, SHOWN, fly_gate

GALLERY = Path(__file__).parent / "gallery"
STILL, CLIP = (960, 540), (640, 360)  # [pixels]
QUALITY = (82, 30)  # of the JPEG, and x264's constant rate factor
MOST_BYTES = 150_000


class Shot(NamedTuple):
    """What of an episode is shown."""

    name: str
    log: EpisodeLog
    camera: str
    still: float  # [s]
    clip: tuple[float, float]  # [s]
    speed: float  # seconds of the mission per second of the clip


def shots(names: list[str]) -> Iterator[Shot]:
    """Those asked for, or all; each is flown when its turn comes."""
    for name in names or ["case_study", *SHOWN]:
        if name == "case_study":
            controller = make_controller("sorlc")
            world, names_shown = World(paper(), controller, record=True), ("scripted", "sorlc")
            trajectory = run_episode(world, make_supervisor("scripted"), names=names_shown)
            draw_mission(from_trajectory(trajectory, controller))
            yield Shot(name, from_trajectory(trajectory, controller), "track", 57.0, (41.0, 67.0), 4.0)
        else:
            _, trajectory = fly_gate(name, "scripted")
            duration = trajectory.scenario.duration
            log = from_trajectory(trajectory, GATE_CONTROLLERS["pd"](make_robot(name)))
            clip = 0.35 * duration, 0.60 * duration
            yield Shot(name, log, "close", 0.56 * duration, clip, max(1.0, round((clip[1] - clip[0]) / 6.0)))


def draw_mission(log: EpisodeLog) -> None:
    """The picture of the README: agent 1 avoids the first obstacle."""
    picture = render_still(log, 20.0, width=1280, height=720, camera="track")
    colors = Image.fromarray(picture).quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)  # keeps small marks
    colors.save(GALLERY.parent / "mission.png", optimize=True)


def draw(shot: Shot) -> None:
    """A JPEG and an MP4, small enough to be kept in a repository."""
    still, clip = (GALLERY / f"{shot.name}{suffix}" for suffix in (".jpg", ".mp4"))
    picture = render_still(shot.log, shot.still, width=STILL[0], height=STILL[1], camera=shot.camera)
    Image.fromarray(picture).save(still, quality=QUALITY[0], optimize=True)
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "clip.mp4"
        (start, end), (width, height) = shot.clip, CLIP
        render_video(
            shot.log,
            large,
            VideoStyle(camera=shot.camera, speed=shot.speed, fps=20, start=start, end=end, width=width, height=height, samples=4),
        )
        squeeze = ["-crf", str(QUALITY[1]), "-preset", "veryslow", "-movflags", "+faststart"]
        ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", "-i", str(large)]
        subprocess.run([*ffmpeg, *squeeze, str(clip)], check=True)
    for path in (still, clip):
        size_of = path.stat().st_size
        print(f"{path.name:20} {size_of / 1e3:6.0f} kB{' (too large)' if size_of > MOST_BYTES else ''}", flush=True)


if __name__ == "__main__":
    GALLERY.mkdir(exist_ok=True)
    for one in shots(sys.argv[1:]):
        draw(one)
