"""Terminal output of the command line, progress bars and results, and the check of the renderer before anything else."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any, NamedTuple

from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.method_names import display_key
from marlbc_mj.util.progress import Progress, note
from marlbc_mj.util.text import one_line

SELDOM = 60.0  # time between progress lines if there is no terminal [s]
LEAST_WIDTH = 112  # least width of the table of results [characters]


def prepare_gl(strict: bool) -> None:
    """Make sure, before MuJoCo is imported, that an unusable MUJOCO_GL stops only commands that render.

    Args:
        strict: whether the command renders, so that it must stop.

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
            note(f"{error}; continuing without it")
        os.environ["MUJOCO_GL"] = SWITCHED_OFF  # with the unusable value, MuJoCo could not be imported


class Told(NamedTuple):
    """Callbacks by which a command reports its progress."""

    progress: Progress
    line: Callable[[str], None]
    """Prints one line, above the bars if there are any."""


@contextmanager
def progress_bars(*, ends: bool = True) -> Iterator[Told]:
    """Show a bar per stage, with rate and time left; without a terminal, print lines instead.

    Args:
        ends: whether to print a line at the end of a stage if there is no terminal.
    """
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
        yield Told(seldom(ends=ends), lambda line: print(line, file=sys.stderr, flush=True))
        return
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, Any] = {}

        def update(what: str, done: float, total: float) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(
                    display_key(what), total=total, completed=int(done), rate=""
                )  # earlier work does not count for the rate
            task = bars.tasks[tasks[what]]
            rate = f"{task.finished_speed or task.speed or 0.0:.3g} /s"
            bars.update(tasks[what], completed=done, total=total, rate=rate)

        yield Told(update, lambda line: console.print(line, highlight=False, markup=False))


def seldom(every: float = SELDOM, *, ends: bool = True) -> Progress:
    """Progress callback that prints a line when a stage ends and, now and then, one with the rate and the time left of a stage.

    A stage of which less is done than before has begun again.

    Args:
        every: least time between two lines on running stages [s].
        ends: whether to print a line when a stage ends.
    """
    stages: dict[str, tuple[float, float, float]] = {}  # when each began, how much was done then, and how much at the last call
    last = monotonic()

    def tell(what: str, done: float, total: float) -> None:
        nonlocal last
        now = monotonic()
        start, before, reached = stages.get(what, (now, done, -1.0))
        if done < reached:
            start, before, reached = now, done, -1.0
        stages[what] = start, before, done
        if ends and total > 1 and done >= total:
            if reached < total:
                print(f"{display_key(what)}: {done:g} of {total:g} in {now - start:.1f} s", file=sys.stderr, flush=True)
            return
        if now < last + every or done <= before:
            return
        last = now
        rate = (done - before) / (now - start)
        print(
            f"{display_key(what)}: {done:g} of {total:g}, {rate:.3g} /s, {(total - done) / rate:.0f} s left",
            file=sys.stderr,
            flush=True,
        )

    return tell


def progress_lines(before: str = "") -> Progress:
    """Progress callback that prints a line per call, also if there is no terminal; ``before`` is its prefix."""

    def tell(what: str, done: float, total: float) -> None:
        print(f"{before}{what}", file=sys.stderr, flush=True)

    return tell


def result_line(result: Any, ended: int, total: int) -> str:
    """One line on a result (:class:`~marlbc_mj.results.summary.Result`), the ``ended``-th of ``total``."""
    from marlbc_mj.report.formats import score_cell
    from marlbc_mj.results.scores import switches_text

    if result.metrics is None:
        return f"{ended}/{total}  {result.display}: failed: {one_line(result.failure)}"
    said = f"return {score_cell('return', result.metrics)}, switches {switches_text(result.metrics)}"
    violation = f"violation of the worst agent {score_cell('violation_time_worst', result.metrics)} s"
    return f"{ended}/{total}  {result.display}: {said}, {violation}"


def print_results(results: list[Any]) -> None:
    """Print results (:class:`~marlbc_mj.results.summary.Result`) in tables of supervisors and controllers, then the failures."""
    from marlbc_mj.report.method_groups import method_groups

    for group in method_groups(results, lambda result: (result.supervisor, result.controller)):
        _print_group(group)
    for result in results:
        if result.failure is not None:
            print(f"{result.display} failed: {result.failure}")


def _print_group(group: Any) -> None:
    """Print a table of methods that differ in one part (:class:`~marlbc_mj.report.method_groups.MethodGroup`)."""
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    from marlbc_mj.report.formats import score_cell, score_column
    from marlbc_mj.results.scores import switches_text

    shown = ("return", "violation_time_worst", "clearance_min_worst", "effort_integral_sum")
    columns = [score_column(name) for name in shown]
    heads = [f"{column.group}\n{column.second}" for column in columns]
    heads.insert(1, "switches\neach agent")
    first_head = Text(f"{group.kind}\n{group.words}")  # Text, since a string with [m] would be read as markup
    table = Table(*(Column(head, no_wrap=True) for head in (first_head, *map(Text, heads))))
    for name, result in group.rows:
        if result.metrics is None:
            table.add_row(Text(name), "failed")
            continue
        first, *others = (score_cell(score, result.metrics) for score in shown)
        table.add_row(Text(name), first, switches_text(result.metrics), *others)
    console = Console()
    Console(width=max(console.width, LEAST_WIDTH)).print(table)


@contextmanager
def training_display() -> Iterator[Callable[[Any, dict[str, float]], None]]:
    """Show a training run: a line per evaluation and, on a terminal, a bar with rate, time left and the last evaluation."""
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


def no_display(trainer: Any, row: dict[str, float]) -> None:
    """The display of a training run that shows nothing."""


@contextmanager
def general_display() -> Iterator[Callable[[Any, dict[str, float]], None]]:
    """Print a line per evaluation of a run of the general policy: success rate and median return of each family."""
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
