"""How pictures become a file: an H.264 MP4, an animated WebP or a GIF, as the file's ending says."""

import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO

import imageio_ffmpeg
import numpy as np
from PIL import Image

from marlbc_mj.util.errors import ConfigurationError, SimulationError

_BT709 = "scale=out_color_matrix=bt709:out_range=tv,setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709"
_MP4 = [
    "-vcodec",
    "libx264",
    "-pix_fmt",
    "yuv420p",
    "-vf",
    _BT709,
    "-crf",
    "20",
    "-preset",
    "veryfast",
    "-movflags",
    "+faststart",
]
"""Colors as players expect them of a high-definition picture, constant quality, and an index at the file's beginning."""
_WEBP = [
    "-vcodec",
    "libwebp_anim",
    "-pix_fmt",
    "bgra",
    "-lossless",
    "1",
    "-compression_level",
    "4",
    "-quality",
    "60",
    "-loop",
    "0",
]
"""Without loss: text stays sharp, and with few colors this is smaller than with loss. ``quality`` is then the effort."""
_GIF = ["-lavfi", "paletteuse=dither=none:diff_mode=rectangle", "-loop", "0"]

FORMATS = (".mp4", ".webp", ".gif")
"""Endings of a video's name."""
COLORS = {".webp": 96, ".gif": 256}
"""How many colors the formats for animations get; video has no palette."""
PALETTE_FRAMES = 8  # that the palette is made of


def check_format(path: Path) -> None:
    """Raise ConfigurationError for a name whose ending is none of ``FORMATS``."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigurationError(f"a video's name must end in {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, got {path.name!r}")


@contextmanager
def encoder(
    path: Path, size: tuple[int, int], fps: int, palette: np.ndarray | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that takes pictures of ``size``, width and height; the video is whole when the block has ended.

    Args:
        path: the file, whose ending is one of ``FORMATS``.
        size: width and height [pixels].
        fps: frames per second.
        palette: (C, 3) uint8 colors of an animation, as :func:`common_palette` gives them.

    Raises:
        SimulationError: the encoder said that it failed, whatever the file looks like.
    """
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(fps)]
    target = {".webp": _WEBP, ".gif": _GIF}.get(path.suffix.lower(), _MP4)
    with TemporaryDirectory() as folder:
        inputs, colors = ["-i", "-"], _palette_image(palette)
        if path.suffix.lower() == ".gif" and colors is not None:
            colors.convert("RGB").save(Path(folder) / "palette.png")
            inputs += ["-i", str(Path(folder) / "palette.png")]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", *source, *inputs, "-an", "-v", "error", *target, str(path)]
        with _encoding(command) as stream:

            def add(picture: np.ndarray) -> None:
                stream.write(np.ascontiguousarray(_reduced(picture, colors)).data)

            yield add


def common_palette(pictures: Iterable[np.ndarray], suffix: str) -> np.ndarray:
    """(C, 3) uint8: the colors that serve pictures (height, width, 3) best, as many as the format gets."""
    count = COLORS[suffix.lower()]
    strip = Image.fromarray(np.concatenate(list(pictures)))
    colors = strip.quantize(count, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).getpalette() or []
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


def _palette_image(palette: np.ndarray | None) -> Image.Image | None:
    """A picture of 16 x 16 pixels that shows a palette's colors and has them; missing ones are repeated."""
    if palette is None:
        return None
    image = Image.new("P", (16, 16))
    image.putpalette(np.resize(palette, (256, 3)).tobytes())
    image.putdata(range(256))
    return image


def _reduced(picture: np.ndarray, colors: Image.Image | None) -> np.ndarray:
    """A picture in the colors of a palette, if there is one."""
    if colors is None:
        return picture
    return np.asarray(Image.fromarray(picture).quantize(palette=colors, dither=Image.Dither.NONE).convert("RGB"))


@contextmanager
def _encoding(command: Sequence[str]) -> Iterator[IO[bytes]]:
    """The running encoder's input; its end is awaited, its errors are raised."""
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


def poster(video: Path, time: float) -> bytes:
    """The frame of an MP4 at ``time`` [s] as a JPEG, empty where the encoder cannot give it."""
    source = ["-ss", f"{time:.3f}", "-i", str(video), "-frames:v", "1", "-q:v", "4", "-f", "image2pipe", "-vcodec", "mjpeg", "-"]
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *source], capture_output=True, check=False)
    return done.stdout
