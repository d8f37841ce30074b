"""``marlbc video``, ``view`` and ``log``: render, play, inspect and convert MCAP logs."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from marlbc_mj.cli.choices import ExistingPath, SomeNumber, SomePath
from marlbc_mj.cli.output import OutputOptions, ReportOptions
from marlbc_mj.util.progress import note


@dataclass(frozen=True)
class VideoCommand:
    """Render a video from a log, off-screen: .mp4, .webp or .gif."""

    log: Positional[ExistingPath]
    """MCAP log."""
    out: SomePath = None
    """Video file, whose suffix selects the format; by default the name of the log with .mp4."""
    speed: float = 4.0
    """Mission seconds per video second."""
    fps: int = 30
    """Frames per second."""
    camera: str = "track"
    """Camera: track or close (behind the team), agent1, wide (from the side), at:X,Y,R (a spot), top, or one in the model."""
    start: SomeNumber = None
    """First mission time shown [s]."""
    end: SomeNumber = None
    """Last mission time shown [s]."""
    size: str = "1280x720"
    """Width and height [pixel]."""
    samples: int = 0
    """Multisampling of edges: 0 is fast, 4 is smoother and takes about twice as long."""
    overwrite: bool = False
    """Replace an existing file."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Render with a progress bar; print the name of the backend after the first frame."""
        from marlbc_mj.recording.gl import choose_gl
        from marlbc_mj.recording.reader import read_log
        from marlbc_mj.recording.video import VideoStyle, parse_size, render_video

        out = self.out or self.log.with_suffix(".mp4")
        given = {each.name: getattr(self, each.name) for each in fields(VideoStyle)}
        style = VideoStyle(**{**given, "size": parse_size(self.size)})
        with self.output.progress(ends=False) as told:

            def show(done: int, total: int) -> None:
                if done == 1:
                    note(f"off-screen rendering with {choose_gl()}")
                told.progress("video", done, total)

            render_video(read_log(self.log), out, style, overwrite=self.overwrite, progress=show)
        self.output.say(out)


@dataclass(frozen=True)
class ViewCommand:
    """Play a log in MuJoCo's interactive viewer."""

    log: Positional[ExistingPath]
    """MCAP log."""
    speed: float = 4.0
    """Mission seconds per second of playback."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Open the viewer; needs a display."""
        from marlbc_mj.recording.reader import read_log
        from marlbc_mj.recording.view import view

        view(read_log(self.log), speed=self.speed)


@dataclass(frozen=True)
class LogInfoCommand:
    """Print the contents of a log as JSON."""

    log: Positional[ExistingPath]
    """MCAP log."""
    metrics: bool = False
    """Print the metrics instead, computed again from every substep."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Print metadata, topics and attachments, or metrics."""
        import json

        from marlbc_mj.recording.reader import log_info, read_log
        from marlbc_mj.results.metrics import measure

        found = measure(read_log(self.log)) if self.metrics else log_info(self.log)
        self.output.report(json.dumps(found, indent=2), found)


@dataclass(frozen=True)
class LogRecoverCommand:
    """Recover all undamaged parts of an incomplete or damaged log."""

    log: Positional[ExistingPath]
    """Incomplete or damaged file, for example *.mcap.partial."""
    out: Positional[Path]
    """File for the recovered log."""
    overwrite: bool = False
    """Replace an existing file."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Recover, and print the number of messages."""
        from marlbc_mj.recording.mcap_file import recover_log

        saved = recover_log(self.log, self.out, overwrite=self.overwrite)
        self.output.say(f"{self.out}: {saved} messages")


@dataclass(frozen=True)
class LogExportCommand:
    """Write a log as a table, a row per mission step and agent (.csv, .jsonl, .parquet), as arrays (.npz) or for Rerun (.rrd)."""

    log: Positional[ExistingPath]
    """MCAP log."""
    out: Positional[Path]
    """File to write; its suffix selects the format."""
    overwrite: bool = False
    """Replace an existing file."""
    output: OmitArgPrefixes[OutputOptions] = field(default_factory=OutputOptions)

    def run(self) -> None:
        """Export."""
        from marlbc_mj.recording.exports import export_log

        export_log(self.log, self.out, overwrite=self.overwrite)
        self.output.say(self.out)


@dataclass(frozen=True)
class LogCommand:
    """Inspect, recover or convert MCAP logs."""

    action: OmitSubcommandPrefixes[
        Annotated[LogInfoCommand, subcommand("info")]
        | Annotated[LogRecoverCommand, subcommand("recover")]
        | Annotated[LogExportCommand, subcommand("export")]
    ]

    def run(self) -> None:
        """Run the chosen subcommand."""
        self.action.run()
