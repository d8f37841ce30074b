"""What the command line shows on the terminal, progress bars and results, and the choice of a renderer before anything else."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any

from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.progress import Progress

SELDOM = 60.0  # where there is no terminal [s]
LEAST_WIDTH = 112  # least width of the table of results [characters]


def prepare_gl(strict: bool) -> None:
    """Make sure, before MuJoCo is imported, that a MUJOCO_GL that does not work stops only the commands that render.

    Args:
        strict: the command renders, so that it must stop.

    Raises:
        ConfigurationError: ``strict``, and no renderer works.
    """
    if not strict and "MUJOCO_GL" not in os.environ:
        return
    from marlbc_mj.recording.gl import SWITCHED_OFF, choose_gl, switched_off

    try:
        choose_gl()
    except ConfigurationError as error:
        if strict:
            raise
        if not switched_off():
            print(f"marlbc: {error}; going on without it", file=sys.stderr)
        os.environ["MUJOCO_GL"] = SWITCHED_OFF  # with another, MuJoCo itself could not be imported


def suggest_cache() -> None:
    """Say where compiled code could be kept, if this command has compiled some that it could not keep."""
    compiling = sys.modules.get("marlbc_mj.core.compiling")  # not imported for this: most commands compile nothing
    if compiling is not None and compiling.compiled_in_vain():
        said = "compiled code cannot be kept here and is compiled by every command; set NUMBA_CACHE_DIR to a folder to write into"
        print(f"marlbc: {said}", file=sys.stderr)


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A bar per stage, with rate and time left, on a terminal; elsewhere a line now and then of work that takes minutes."""
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
    if not console.is_terminal:
        yield seldom()
        return
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, Any] = {}

        def update(what: str, done: float, total: float) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, completed=int(done), rate="")  # what was done before has no rate
            task = bars.tasks[tasks[what]]
            rate = f"{task.finished_speed or task.speed or 0.0:.3g} /s"
            bars.update(tasks[what], completed=done, total=total, rate=rate)

        yield update


def seldom(every: float = SELDOM) -> Progress:
    """A line on the stage that is told of, with its rate and the time left, at most every so many seconds."""
    began: dict[str, tuple[float, float]] = {}
    last = monotonic()

    def tell(what: str, done: float, total: float) -> None:
        nonlocal last
        now = monotonic()
        start, before = began.setdefault(what, (now, done))
        if now < last + every or done <= before:
            return
        last = now
        rate = (done - before) / (now - start)
        print(f"{what}: {done:g} of {total:g}, {rate:.3g} /s, {(total - done) / rate:.0f} s left", file=sys.stderr, flush=True)

    return tell


def progress_lines(before: str = "") -> Progress:
    """A line for everything that is told, also where there is no terminal."""

    def tell(what: str, done: float, total: float) -> None:
        print(f"{before}{what}", file=sys.stderr, flush=True)

    return tell


def print_results(results: list[Any]) -> None:
    """A table with one line per method (:class:`~marlbc_mj.results.summary.Result`), and why a method failed."""
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    from marlbc_mj.report.formats import score_cell, score_column
    from marlbc_mj.results.scores import switches_text

    shown = ("return", "violation_time_worst", "clearance_min_worst", "effort_integral_sum")
    columns = [score_column(name) for name in shown]
    heads = [f"{column.group}\n{column.second}" for column in columns]
    heads.insert(1, "switches\neach agent")
    table = Table(*(Column(Text(head), no_wrap=True) for head in ("method", *heads)))  # Text: [m] is no markup
    for result in results:
        if result.metrics is None:
            table.add_row(result.key, "failed")
            continue
        first, *others = (score_cell(name, result.metrics) for name in shown)
        table.add_row(result.key, first, switches_text(result.metrics), *others)
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
            last = f"return {row['return']:.0f}  switches {switches}  violation of the worst agent {row['violation_time']:.2f} s"
            if row["mission_steps"] != seen:
                seen = row["mission_steps"]
                console.print(f"{seen / 1e6:6.2f} M steps {row['wall_s']:6.0f} s  {last}", highlight=False)
            rate = f"{(bars.tasks[task].speed or 0.0):.0f} steps/s"
            bars.update(task, completed=trainer.steps, total=trainer.config.budget, rate=rate, last=last)

        yield update


@contextmanager
def general_display() -> Iterator[Callable[[Any, dict[str, float]], None]]:
    """A line per evaluation of a run of the general policy: success rate and median return of each family."""
    seen = -1.0

    def update(trainer: Any, row: dict[str, float]) -> None:
        nonlocal seen
        if row["mission_steps"] == seen:
            return
        seen = row["mission_steps"]
        families = [name.removeprefix("success_") for name in row if name.startswith("success_")]
        cells = [f"{name} {100 * row[f'success_{name}']:.0f} % {row[f'return_{name}']:.0f}" for name in families]
        print(f"{seen / 1e6:6.2f} M steps {row['wall_s']:6.0f} s  " + "  ".join(cells), file=sys.stderr, flush=True)

    yield update
