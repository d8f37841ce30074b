"""Training runs on disk: evaluations, curves, best and last checkpoints, and the state that ``--resume`` continues from."""

import csv
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Any, Protocol

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.policies.checkpoint import read_arrays, signature, write_arrays, write_policy
from marlbc_mj.policies.greedy import Policy
from marlbc_mj.results.metrics import Metrics, measure
from marlbc_mj.results.scores import SCORES
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.training.base import BaseTrainer
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.curves import TensorBoard
from marlbc_mj.training.mappo import MAPPO
from marlbc_mj.training.resuming import RESUME, saved_run
from marlbc_mj.training.saved import CONFIG_FILE, check_origin, restore_trainer, saved_config, saved_rows
from marlbc_mj.training.trainer import Trainer
from marlbc_mj.util.errors import ConfigurationError, enough_memory
from marlbc_mj.util.files import alone_in, remove_leftovers, staged_file, write_json, writing
from marlbc_mj.util.provenance import provenance

TABLES = ("eval.csv", "progress.csv")
COUNTED = ("wall_s", "mission_steps")
"""First columns of both tables."""
CHECKPOINT, TENSORBOARD = "checkpoint", "tensorboard"
MEMORY_SETTINGS = "these settings (worlds, hidden, copies, capacity, batch)"
"""Settings that determine the memory of a run, as worded in messages."""
TrainingScores = dict[str, float]
"""A line of eval.csv or progress.csv."""
TrainingProgress = Callable[[BaseTrainer, TrainingScores], None]
"""Callback after every decision, with the trainer and its last evaluation."""


@dataclass(frozen=True)
class Interrupted:
    """Result of a run that saved itself and stopped on a signal."""

    signal: int  # number of the signal


class Stopper:
    """Signal handler that records SIGINT or SIGTERM; the run then saves itself after the current decision."""

    def __init__(self) -> None:
        self.signal = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.signal = number


@contextmanager
def stopper() -> Iterator[Stopper]:
    """Record SIGINT and SIGTERM inside the block instead of stopping the process."""
    stop = Stopper()
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class SavedRun(Protocol):
    """A training run that saves itself."""

    trainer: Any
    config: Any

    def save(self) -> None:
        """Write the state from which the run can be resumed."""


def decide_and_save(run: SavedRun, decide: Callable[[], None]) -> Interrupted | None:
    """Make decisions until the budget is spent or a signal arrives; save the run at intervals and at the end.

    Args:
        run: the training run.
        decide: makes one decision in every world and learns from it.

    Returns:
        The signal that interrupted the run; None if the budget is spent.
    """
    saved = monotonic()
    with stopper() as stop:
        while not run.trainer.finished:
            decide()
            number = stop.signal  # read once: a signal that arrives from here on waits for the next decision
            if number or monotonic() - saved > run.config.save_every:
                run.save()
                saved = monotonic()
            if number:
                return Interrupted(number)
    run.save()
    return None


def make_trainer(config: TrainConfig) -> BaseTrainer:
    """The trainer for the configuration's method.

    Raises:
        ConfigurationError: the method, scenario, controller or device cannot be used.
    """
    return MAPPO(config) if config.method == "mappo" else Trainer(config)


def train(
    config: TrainConfig, out: Path, *, overwrite: bool = False, progress: TrainingProgress | None = None
) -> Interrupted | list[TrainingScores]:
    """Train from scratch; returns the evaluations, or the interruption.

    Args:
        config: configuration of the run.
        out: folder of the run.
        overwrite: whether ``out`` may contain files.
        progress: called after every decision.

    Raises:
        ConfigurationError: a setting is invalid, ``out`` is not empty, or another process is training there.
        SimulationError: a world diverged.
    """
    with training_in(out, overwrite=overwrite):
        run = TrainingRun(make_trainer(config), out)
        begin_folder(out, run.origin, config)
        return run.go(progress)


@contextmanager
def training_in(out: Path, *, overwrite: bool) -> Iterator[None]:
    """Lock a folder for training in the block, and turn a lack of memory into a ConfigurationError of one line."""
    with alone_in(out, overwrite=overwrite), enough_memory(MEMORY_SETTINGS):
        yield


def begin_folder(out: Path, origin: Mapping[str, Any], config: Any) -> None:
    """Prepare a folder for a new run: remove the files of a previous run, and write the configuration of the new one."""
    with writing(out):
        remove_run(out)
    write_json(out / CONFIG_FILE, {**origin, "train": config})


def remove_run(out: Path) -> None:
    """Remove a run's files from its folder, first those that :func:`resume` could mistake for a new run's."""
    for name in (RESUME, CONFIG_FILE, *TABLES):
        (out / name).unlink(missing_ok=True)
    for name in (CHECKPOINT, TENSORBOARD):
        if (out / name).is_dir():
            shutil.rmtree(out / name)
    remove_leftovers(out)


def resume(out: Path, *, progress: TrainingProgress | None = None) -> Interrupted | list[TrainingScores]:
    """Continue a run from its last save, bit for bit; returns the evaluations, or the interruption.

    Args:
        out: folder of the run.
        progress: called after every decision.

    Raises:
        ConfigurationError: ``out`` holds no run, or another process uses it; or the saved state is damaged, was written by
            other versions of the code, or differs from the configuration file beside it.
        SimulationError: a world diverged.
    """
    path = saved_run(out)
    with training_in(out, overwrite=True):
        return _restored(path).go(progress)


def _restored(path: Path) -> "TrainingRun":
    """Load the run saved in a file, and remove from its folder the leftovers of a killed process."""
    out = path.parent
    arrays, description = read_arrays(path)
    check_origin(path, description)
    run = TrainingRun(make_trainer(saved_config(path, description["train"], TrainConfig)), out)
    restore_trainer(path, run.trainer, arrays, description["scalars"])
    run.evaluations = saved_rows(path, description["evaluations"], (*COUNTED, "return", "violation_time"))
    run.curve = saved_rows(path, description["curve"], COUNTED)
    run.wall = saved_rows(path, [{"wall_s": description["wall_s"]}], ())[0]["wall_s"]
    remove_leftovers(out)
    run.write_rows()
    return run


def resumable(out: Path) -> bool:
    """Whether ``out`` holds a complete saved run of this version of the code, which :func:`resume` can continue."""
    try:
        check_origin(out / RESUME, read_arrays(out / RESUME)[1])
    except ConfigurationError:
        return False
    return True


class TrainingRun:
    """A trainer and its output folder; evaluates, logs and saves at fixed intervals.

    Args:
        trainer: the trainer to run.
        out: folder of the run.
    """

    def __init__(self, trainer: BaseTrainer, out: Path) -> None:
        self.trainer = trainer
        self.config = trainer.config
        self.out = out
        self.origin = provenance()
        self.evaluations: list[TrainingScores] = []
        self.curve: list[TrainingScores] = []
        self.wall = 0.0  # training time so far, over all resumed processes [s]
        self.world = World(trainer.scenario, make_controller(self.config.controller), record=True)

    def go(self, progress: TrainingProgress | None = None) -> Interrupted | list[TrainingScores]:
        """Train until the budget is spent or a signal arrives; the run then saves itself."""
        trainer, began = self.trainer, monotonic() - self.wall
        board = TensorBoard(self.out / TENSORBOARD)

        def decide() -> None:
            trainer.advance()
            self.wall = monotonic() - began
            if trainer.steps // self.config.evaluate_every >= len(self.evaluations) or trainer.finished:
                self.evaluate()
                board.write(trainer.steps, {**self.curve[-1], **self.evaluations[-1]})
            if progress:
                progress(trainer, self.evaluations[-1])

        interrupted = decide_and_save(self, decide)
        if interrupted:
            return interrupted
        board.close()
        return self.evaluations

    def evaluate(self) -> None:
        """Fly one deterministic episode with the greedy policy; write the tables, the last checkpoint, and perhaps the best."""
        trainer = self.trainer
        policy = trainer.policy()
        row = {"wall_s": self.wall, "mission_steps": float(trainer.steps), **episode_scores(self.measure(policy))}
        best = max((rank(r) for r in self.evaluations), default=None)
        self.evaluations.append(row)
        self.curve.append(self.progress())
        self.write_rows()
        description = self.describe(row)
        write_policy(self.out / CHECKPOINT / "last.safetensors", policy, description)
        if best is None or rank(row) > best:
            write_policy(self.out / CHECKPOINT / "best.safetensors", policy, description)

    def progress(self) -> TrainingScores:
        """The next line of progress.csv."""
        trainer = self.trainer
        return {
            "wall_s": self.wall,
            "mission_steps": float(trainer.steps),
            "updates": float(trainer.updates),
            "td_error": trainer.error,
            "temperature": trainer.temperature,
            "exploration": trainer.explored,
            "steps_per_s": trainer.steps / max(self.wall, 1e-9),
        }

    def measure(self, policy: Policy) -> Metrics:
        """Metrics of one episode of the policy on the scenario, with seed 0."""
        return measure(run_episode(self.world, Learned(policy, self.signature(), self.out)))

    def signature(self) -> dict[str, Any]:
        """The signature of the run's policies."""
        config = self.config
        return signature(self.trainer.scenario, config.state, config.actions, config.interval)

    def describe(self, row: TrainingScores) -> dict[str, Any]:
        """The description in a checkpoint's header."""
        return {**self.origin, "signature": self.signature(), "train": self.config, "evaluation": row}

    def write_rows(self) -> None:
        """Rewrite eval.csv and progress.csv."""
        for name, rows in zip(TABLES, (self.evaluations, self.curve), strict=True):
            write_table(self.out / name, rows)

    def save(self) -> None:
        """Write the state that :func:`resume` continues from."""
        arrays, scalars = self.trainer.snapshot()
        description = {
            **self.origin,
            "train": self.config,
            "scalars": scalars,
            "evaluations": self.evaluations,
            "curve": self.curve,
            "wall_s": self.wall,
        }
        write_arrays(self.out / RESUME, arrays, description)


def episode_scores(metrics: Metrics) -> TrainingScores:
    """The columns of eval.csv after wall_s and mission_steps; violation and clearance are the worst agent's."""
    agents = metrics["agents"]
    return {
        "return": metrics["team"]["return"],
        **{f"switches_{i + 1}": float(a["switches"]) for i, a in enumerate(agents)},
        "violation_time": SCORES["violation_time_worst"].read(metrics),
        "clearance_min": SCORES["clearance_min_worst"].read(metrics),
    }


def rank(row: TrainingScores) -> tuple[float, float]:
    """Sort key of evaluations, best last: the worst agent's violation first, then the return minus 100 per switch."""
    switches = sum(value for name, value in row.items() if name.startswith("switches_"))
    return -row["violation_time"], row["return"] - 100.0 * switches


def write_table(path: Path, rows: Sequence[TrainingScores]) -> None:
    """Write rows as CSV, with one column per key of the first row."""
    with staged_file(path, overwrite=True) as staging, staging.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows({key: f"{value:.6g}" for key, value in row.items()} for row in rows)
