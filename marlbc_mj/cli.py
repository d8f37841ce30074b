"""The command line, ``marlbc``. Heavy imports wait until a command needs them, so that help is instant."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from marlbc_mj.errors import MarlbcError
from marlbc_mj.terminal import prepare_gl, print_results, progress_bars

if TYPE_CHECKING:
    from marlbc_mj.scenarios import Scenario


@dataclass(frozen=True)
class ScenarioOptions:
    """Changes to the scenario."""

    substep: float | None = None
    """Physics and control step [s]; must divide the mission step of 0.05 s."""
    reference: str | None = None
    """Where behaviors are evaluated: virtual (at the reference) or actual (at the measured position)."""
    two_sided: bool = False
    """Obstacle avoidance as the printed equality task, which also attracts (erratum 6)."""
    disturbance: str | None = None
    """Unknown dynamics: paper, linear, quadratic or wind."""
    drag_scale: float | None = None
    """Multiplies the disturbance."""
    force_limit: float | None = None
    """Actuator limit per axis [N]; laws without limit (see `marlbc list`) ignore it."""
    duration: float | None = None
    """Mission time [s]."""

    def build(self, name: str) -> "Scenario":
        """The named scenario with these changes."""
        from marlbc_mj.disturbances import make_disturbance
        from marlbc_mj.scenarios import make_scenario

        keys = ("substep", "reference", "force_limit", "duration")
        changes: dict[str, Any] = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        if self.two_sided:
            changes["two_sided"] = True
        if self.disturbance is not None or self.drag_scale is not None:
            scale = 1.0 if self.drag_scale is None else self.drag_scale
            changes["disturbance"] = make_disturbance(self.disturbance or "paper", scale)
        return make_scenario(name, **changes)


@dataclass(frozen=True)
class Bench:
    """Run every supervisor with every controller and write tables, figures, logs, a video and a page."""

    scenario: Positional[str] = "paper"
    """Scenario, see `marlbc list`."""
    supervisors: tuple[str, ...] = ("scripted", "fsams", "fsams-hysteresis")
    """Supervisors to run."""
    controllers: tuple[str, ...] = ("sorlc", "pd")
    """Controllers to run each of them with."""
    out: Path = Path("out/paper")
    """Folder of the results."""
    seed: int = 0
    """Draw of the scenario; every seed is the same where nothing is perturbed."""
    seeds: int | None = None
    """Number of draws around the scenario, from --seed on: tables with intervals instead of logs and videos."""
    workers: int = 1
    """Processes that share the methods of --seeds."""
    video: Literal["first", "all", "none"] = "first"
    """Which methods get a video."""
    figures: bool = True
    """Draw the figures."""
    logs: bool = True
    """Write an MCAP log of every episode."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """Run the matrix, then say where the results are and what they are."""
        from marlbc_mj.bench import BenchConfig, run_bench, run_bench_seeds

        config = BenchConfig(
            supervisors=self.supervisors,
            controllers=self.controllers,
            seed=self.seed,
            figures=self.figures,
            logs=self.logs,
            video=self.video,
            overwrite=self.overwrite,
            seeds=self.seeds,
            workers=self.workers,
        )
        if self.seeds is not None:
            with progress_bars() as progress:
                run_bench_seeds(self.options.build(self.scenario), config, self.out, progress=progress)
            print(f"{self.out / 'index.html'} shows it all")
            return
        with progress_bars() as progress:
            results, problems = run_bench(self.options.build(self.scenario), config, self.out, progress=progress)
        print_results(results)
        for problem in problems:
            print(f"marlbc: {problem}", file=sys.stderr)
        print(f"{self.out / 'index.html'} shows it all")


@dataclass(frozen=True)
class Run:
    """Run one episode of one method and log it."""

    scenario: Positional[str] = "paper"
    """Scenario, see `marlbc list`."""
    supervisor: str = "scripted"
    """Mission supervisor."""
    controller: str = "sorlc"
    """Controller."""
    out: Path = Path("out/run")
    """Folder of the log, the metrics and the configuration."""
    seed: int = 0
    """Draw of the scenario."""
    overwrite: bool = False
    """Replace what is in the output folder."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """One episode, its log and its metrics."""
        from marlbc_mj.bench import run_single

        with progress_bars() as progress:
            result = run_single(
                self.options.build(self.scenario),
                self.supervisor,
                self.controller,
                self.out,
                seed=self.seed,
                overwrite=self.overwrite,
                progress=progress,
            )
        print_results([result])
        print(f"{self.out} holds the log, the metrics and the configuration")


@dataclass(frozen=True)
class Video:
    """Render a video from a log, off-screen."""

    log: Positional[Path]
    """MCAP log."""
    out: Path | None = None
    """Video file; the log's name with .mp4 by default."""
    speed: float = 4.0
    """Mission seconds per video second."""
    fps: int = 30
    """Frames per second."""
    camera: str = "track"
    """Camera: track or top."""
    start: float | None = None
    """First mission time shown [s]."""
    end: float | None = None
    """Last mission time shown [s]."""
    width: int = 1280
    """Picture width [pixel]."""
    height: int = 720
    """Picture height [pixel]."""
    samples: int = 0
    """Multisampling of edges: 0 is fast, 4 is smoother and takes about twice as long."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Render, with progress."""
        from marlbc_mj.recording.reader import read_log
        from marlbc_mj.recording.video import render_video

        out = self.out or self.log.with_suffix(".mp4")
        with progress_bars() as progress:
            render_video(
                read_log(self.log),
                out,
                speed=self.speed,
                fps=self.fps,
                width=self.width,
                height=self.height,
                camera=self.camera,
                start=self.start,
                end=self.end,
                samples=self.samples,
                overwrite=self.overwrite,
                progress=lambda done, total: progress("video", done, total),
            )
        print(out)


@dataclass(frozen=True)
class View:
    """Play a log in MuJoCo's interactive viewer."""

    log: Positional[Path]
    """MCAP log."""
    speed: float = 4.0
    """Mission seconds per second."""

    def run(self) -> None:
        """Open the viewer; needs a display."""
        from marlbc_mj.recording.reader import read_log
        from marlbc_mj.recording.view import view

        view(read_log(self.log), speed=self.speed)


@dataclass(frozen=True)
class LogInfo:
    """Say what a log holds."""

    log: Positional[Path]
    """MCAP log."""

    def run(self) -> None:
        """Metadata, topics, attachments."""
        import json

        from marlbc_mj.recording.reader import log_info

        print(json.dumps(log_info(self.log), indent=2))


@dataclass(frozen=True)
class LogRecover:
    """Salvage a log that was torn: all whole chunks of it."""

    log: Positional[Path]
    """The torn file, *.mcap.partial for example."""
    out: Positional[Path]
    """Where the salvaged log goes."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Recover and count."""
        from marlbc_mj.recording.reader import recover_log

        saved = recover_log(self.log, self.out, overwrite=self.overwrite)
        print(f"{self.out}: {saved} messages")


@dataclass(frozen=True)
class LogExport:
    """Write a log as .csv (a row per mission step and agent) or .npz (arrays)."""

    log: Positional[Path]
    """MCAP log."""
    out: Positional[Path]
    """File to write; its ending chooses the format."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Export."""
        from marlbc_mj.recording.reader import export_log

        export_log(self.log, self.out, overwrite=self.overwrite)
        print(self.out)


@dataclass(frozen=True)
class Log:
    """Look into, salvage or convert MCAP logs."""

    action: OmitSubcommandPrefixes[
        Annotated[LogInfo, subcommand("info")]
        | Annotated[LogRecover, subcommand("recover")]
        | Annotated[LogExport, subcommand("export")]
    ]

    def run(self) -> None:
        """Hand over to the action."""
        self.action.run()


@dataclass(frozen=True)
class ListAll:
    """List everything that can be selected, one line each."""

    def run(self) -> None:
        """Print every registry."""
        from marlbc_mj.listing import selectable

        for kind, entries in selectable().items():
            print(f"{kind}:")
            width = max(map(len, entries))
            for name, line in entries.items():
                print(f"  {name:<{width}}  {line}")


@dataclass(frozen=True)
class Perf:
    """Measure this machine: bare mj_step, the closed loop, the Python loop, batches, an episode, a log."""

    json: Path | None = None
    """File for the figures."""
    rounds: int = 9
    """Rounds, each running every variant once; medians are reported."""

    def run(self) -> None:
        """Measure, print, and write if asked."""
        from marlbc_mj.files import write_json
        from marlbc_mj.perf import measure_perf, perf_lines
        from marlbc_mj.provenance import provenance

        figures = measure_perf(self.rounds, progress=lambda message: print(f"measuring {message}", file=sys.stderr))
        print("\n".join(perf_lines(figures)))
        if self.json is not None:
            write_json(self.json, {**figures, **provenance()})
            print(self.json)


@dataclass(frozen=True)
class Ablation:
    """Measure what SORLC's basis is worth: printed, scaled, off, the exact model, and the sweep of the scaled gains."""

    out: Path | None = None
    """Markdown file for the tables."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Run the studies and print their tables."""
        from marlbc_mj.ablation import basis_study, gain_sweep, markdown
        from marlbc_mj.files import staged_file

        with progress_bars() as progress:
            text = markdown(basis_study(progress)) + "\n\n" + markdown(gain_sweep(progress)) + "\n"
        print(text)
        if self.out is not None:
            with staged_file(self.out, overwrite=self.overwrite) as staging:
                staging.write_text(text)


@dataclass(frozen=True)
class OracleSearch:
    """Search the best safe switch times on the simulator, for the oracle supervisor; takes minutes."""

    scenario: str = "paper"
    """Scenario."""
    controller: str = "sorlc"
    """Controller that tracks the references."""
    seed: int = 0
    """Of the search."""
    budget: int = 4096
    """Episodes that may be simulated."""
    threads: int = 2
    """Worlds are shared out over this many."""
    out: Path | None = None
    """Cache to add the schedule to; the one that comes with the package by default."""

    def run(self) -> None:
        """Search, save, and say what was found."""
        from marlbc_mj.scenarios import make_scenario
        from marlbc_mj.supervisors.oracle import save, search

        scenario = make_scenario(self.scenario)
        with progress_bars() as progress:
            found = search(
                scenario,
                self.controller,
                seed=self.seed,
                budget=self.budget,
                threads=self.threads,
                progress=lambda done, total: progress("search", done, self.budget),
            )
        save(found, scenario, self.controller, self.out)
        print(f"return {found.total:.0f} after {found.episodes} episodes (scripted: {found.scripted})")


Command = (
    Annotated[Bench, subcommand("bench")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Video, subcommand("video")]
    | Annotated[View, subcommand("view")]
    | Annotated[Log, subcommand("log")]
    | Annotated[ListAll, subcommand("list")]
    | Annotated[Perf, subcommand("perf")]
    | Annotated[Ablation, subcommand("ablation")]
    | Annotated[OracleSearch, subcommand("oracle")]
)

DESCRIPTION = "Benchmark of mission supervisors and controllers for robot teams on MuJoCo physics. Start with: marlbc bench paper"


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 for a wrong setting, 3 for a failed run."""
    command = tyro.cli(Command, prog="marlbc", description=DESCRIPTION, args=arguments)
    try:
        prepare_gl(strict=isinstance(command, Video))
        command.run()
    except MarlbcError as error:
        print(f"marlbc: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        print("marlbc: interrupted", file=sys.stderr)
        sys.exit(130)
