"""Encoding of pictures as an H.264 MP4, an animated WebP or a GIF, chosen by the file's suffix."""

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
"""The color space that players expect of high-definition video, constant quality, and an index at the file's beginning."""
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
"""Lossless: text stays sharp, and with few colors the file is smaller than a lossy one. ``quality`` is then the effort."""
_GIF = ["-lavfi", "paletteuse=dither=none:diff_mode=rectangle", "-loop", "0"]

FORMATS = (".mp4", ".webp", ".gif")
"""Suffixes of a video's name."""
COLORS = {".webp": 96, ".gif": 256}
"""Number of colors of the animation formats; MP4 has no palette."""
PALETTE_FRAMES = 8  # number of frames from which the palette is computed


def check_format(path: Path) -> None:
    """Raise ConfigurationError for a name without one of the suffixes in ``FORMATS``."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigurationError(f"a video's name must end in {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, got {path.name!r}")


@contextmanager
def encoder(
    path: Path, size: tuple[int, int], fps: int, palette: np.ndarray | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """Provide a function that adds a picture (height, width, 3) to a video; the video is complete when the block has ended.

    Args:
        path: the file, with a suffix of ``FORMATS``.
        size: width and height [pixels].
        fps: frames per second.
        palette: (C, 3) uint8 colors of an animation, from :func:`common_palette`.

    Raises:
        SimulationError: the encoder failed, even if it left a file.
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
    """Colors (C, 3) uint8 that suit all pictures (height, width, 3) together, as many as the format has."""
    count = COLORS[suffix.lower()]
    strip = Image.fromarray(np.concatenate(list(pictures)))
    colors = strip.quantize(count, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).getpalette() or []
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


def _palette_image(palette: np.ndarray | None) -> Image.Image | None:
    """A picture of 16 x 16 pixels that has a palette and shows its colors, repeated up to 256; None without a palette."""
    if palette is None:
        return None
    image = Image.new("P", (16, 16))
    image.putpalette(np.resize(palette, (256, 3)).tobytes())
    image.putdata(range(256))
    return image


def _reduced(picture: np.ndarray, colors: Image.Image | None) -> np.ndarray:
    """A picture in the colors of a palette, or unchanged without one."""
    if colors is None:
        return picture
    return np.asarray(Image.fromarray(picture).quantize(palette=colors, dither=Image.Dither.NONE).convert("RGB"))


@contextmanager
def _encoding(command: Sequence[str]) -> Iterator[IO[bytes]]:
    """Run the encoder and provide its input stream; wait for it to end, and raise its errors."""
    with TemporaryFile() as errors:
        # In a session of its own, so that Ctrl-C reaches only this program, which then ends the encoder.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True
        )
        assert process.stdin is not None
        whole = False
        try:
            with suppress(BrokenPipeError):  # the encoder has ended; its error output says why
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
    """The most informative line of the encoder's error output."""
    return next(
        (line for line in said if "No space left" in line or "too large" in line), said[-1] if said else "no reason given"
    )


def poster(video: Path, time: float) -> bytes:
    """The frame of an MP4 at ``time`` [s] as a JPEG; empty if it cannot be extracted."""
    source = ["-ss", f"{time:.3f}", "-i", str(video), "-frames:v", "1", "-q:v", "4", "-f", "image2pipe", "-vcodec", "mjpeg", "-"]
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *source], capture_output=True, check=False)
    return done.stdout
