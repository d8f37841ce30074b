"""What the command line shows on the terminal: progress bars and results; and the choice of a renderer before all else."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.progress import Progress

LEAST_WIDTH = 112  # of the table of results [characters]


def prepare_gl(strict: bool) -> None:
    """See to it, before MuJoCo is imported, that a MUJOCO_GL that does not work stops only what renders."""
    if not strict and "MUJOCO_GL" not in os.environ:
        return
    from marlbc_mj.recording.gl import choose_gl

    try:
        choose_gl()
    except ConfigurationError as error:
        if strict:
            raise
        del os.environ["MUJOCO_GL"]  # with it, MuJoCo itself could not be imported
        print(f"marlbc: {error}; going on without it", file=sys.stderr)


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A bar per stage, with rate and time left, on a terminal; silent elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %  {task.fields[rate]:>8}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def update(what: str, done: float, total: float) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, rate="")
            task = bars.tasks[tasks[what]]
            rate = f"{task.finished_speed or task.speed or 0.0:.3g} /s"
            bars.update(tasks[what], completed=done, total=total, rate=rate)

        yield update


def progress_lines(before: str = "") -> Progress:
    """A line for everything that is told, also where there is no terminal."""

    def tell(what: str, done: float, total: float) -> None:
        print(f"{before}{what}", file=sys.stderr, flush=True)

    return tell


def print_results(results: list[Any]) -> None:
    """A table with one line a method (:class:`~marlbc_mj.results.summary.Result`), and why a method failed."""
    from rich.console import Console
    from rich.table import Column, Table

    names = ("method", "return", "switches", "violation s", "clearance m", "effort N s")
    table = Table(*(Column(name, no_wrap=True) for name in names))
    for result in results:
        key = result.key
        if result.metrics is None:
            table.add_row(key, "failed")
            continue
        agents, team = result.metrics["agents"], result.metrics["team"]
        table.add_row(
            key,
            f"{team['return']:.0f}",
            "/".join(str(a["switches"]) for a in agents),
            f"{sum(a['violation_time'] for a in agents):.2f}",
            f"{min(a['clearance_min'] for a in agents):.3f}",
            f"{sum(a['effort_integral'] for a in agents):.0f}",
        )
    console = Console()
    Console(width=max(console.width, LEAST_WIDTH)).print(table)
    for result in results:
        if result.failure is not None:
            print(f"{result.key} failed: {result.failure}")


@contextmanager
def training_display() -> Iterator[Callable[[Any, dict[str, float]], None]]:
    """Progress of a training run: mission steps, rate, time left and the last evaluation; elsewhere a line per evaluation."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        BarColumn(20),
        TextColumn("{task.percentage:>3.0f} %  {task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[last]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        task = bars.add_task("training", rate="", last="")
        seen = -1.0

        def update(trainer: Any, row: dict[str, float]) -> None:
            nonlocal seen
            switches = "/".join(f"{value:.0f}" for name, value in row.items() if name.startswith("switches_"))
            last = f"return {row['return']:.0f}  switches {switches}  violation {row['violation_time']:.2f} s"
            if row["mission_steps"] != seen:
                seen = row["mission_steps"]
                console.print(f"{seen / 1e6:6.2f} M steps {row['wall_s']:6.0f} s  {last}", highlight=False)
            rate = f"{(bars.tasks[task].speed or 0.0):.0f} steps/s"
            bars.update(task, completed=trainer.steps, total=trainer.config.budget, rate=rate, last=last)

        yield update
