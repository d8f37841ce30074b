"""A training run on disk: evaluations, curves, best and last checkpoints, and the state that ``--resume`` continues from."""

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
"""What a run's memory depends on, for messages."""
TrainingScores = dict[str, float]
"""A line of eval.csv or progress.csv."""
TrainingProgress = Callable[[BaseTrainer, TrainingScores], None]
"""What a run calls after every decision, with its last evaluation."""


@dataclass(frozen=True)
class Interrupted:
    """A run that a signal asked to stop and that has saved itself."""

    signal: int  # number of the signal


class Stopper:
    """Signal handler that takes note of SIGINT or SIGTERM; the run then saves itself after the present decision."""

    def __init__(self) -> None:
        self.signal = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.signal = number


@contextmanager
def stopper() -> Iterator[Stopper]:
    """A block inside which SIGINT and SIGTERM are noted instead of obeyed."""
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
        """Write the state that the run can be resumed from."""


def decide_and_save(run: SavedRun, decide: Callable[[], None]) -> Interrupted | None:
    """Decide until the budget is spent or a signal arrives; the run is saved at intervals and at the end.

    Args:
        run: the training run.
        decide: makes one decision in every world, and what follows from it.

    Returns:
        What interrupted the run, if anything did.
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
    """The trainer of the configuration's method.

    Raises:
        ConfigurationError: a method, scenario, controller or device that cannot be used.
    """
    return MAPPO(config) if config.method == "mappo" else Trainer(config)


def train(
    config: TrainConfig, out: Path, *, overwrite: bool = False, progress: TrainingProgress | None = None
) -> Interrupted | list[TrainingScores]:
    """Train from scratch; returns the evaluations, or what interrupted the run.

    Args:
        config: configuration of the run.
        out: folder of the run.
        overwrite: whether ``out`` may hold something.
        progress: called after every decision.

    Raises:
        ConfigurationError: a setting that cannot be run, ``out`` is not empty, or another process trains there.
        SimulationError: a world diverged.
    """
    with training_in(out, overwrite=overwrite):
        run = TrainingRun(make_trainer(config), out)
        begin_folder(out, run.origin, config)
        return run.go(progress)


@contextmanager
def training_in(out: Path, *, overwrite: bool) -> Iterator[None]:
    """A block that trains in a folder, as the only process that does; a lack of memory is one line."""
    with alone_in(out, overwrite=overwrite), enough_memory(MEMORY_SETTINGS):
        yield


def begin_folder(out: Path, origin: Mapping[str, Any], config: Any) -> None:
    """Make a folder that of a new run: without what another one left there, and with the configuration of this one."""
    with writing(out):
        remove_run(out)
    write_json(out / CONFIG_FILE, {**origin, "train": config})


def remove_run(out: Path) -> None:
    """Remove what a run left in its folder, beginning with what :func:`resume` would take for a new run's."""
    for name in (RESUME, CONFIG_FILE, *TABLES):
        (out / name).unlink(missing_ok=True)
    for name in (CHECKPOINT, TENSORBOARD):
        if (out / name).is_dir():
            shutil.rmtree(out / name)
    remove_leftovers(out)


def resume(out: Path, *, progress: TrainingProgress | None = None) -> Interrupted | list[TrainingScores]:
    """Continue a run where it was last saved, bit for bit; returns the evaluations, or what interrupted the run.

    Args:
        out: folder of the run.
        progress: called after every decision.

    Raises:
        ConfigurationError: ``out`` holds no run, or another process is at it; or its saved state is damaged, of other versions
            of the code, or of another configuration than the one beside it.
        SimulationError: a world diverged.
    """
    path = saved_run(out)
    with training_in(out, overwrite=True):
        return _restored(path).go(progress)


def _restored(path: Path) -> "TrainingRun":
    """The run that was saved in a file, in the file's folder, without what a killed process left there."""
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
    """Whether ``out`` holds a whole saved run of this version of the code, so that :func:`resume` continues it."""
    try:
        check_origin(out / RESUME, read_arrays(out / RESUME)[1])
    except ConfigurationError:
        return False
    return True


class TrainingRun:
    """A trainer with its folder: evaluates, logs and saves at set intervals.

    Args:
        trainer: what learns.
        out: folder of the run.
    """

    def __init__(self, trainer: BaseTrainer, out: Path) -> None:
        self.trainer = trainer
        self.config = trainer.config
        self.out = out
        self.origin = provenance()
        self.evaluations: list[TrainingScores] = []
        self.curve: list[TrainingScores] = []
        self.wall = 0.0  # time of training so far, in all processes [s]
        self.world = World(trainer.scenario, make_controller(self.config.controller), record=True)

    def go(self, progress: TrainingProgress | None = None) -> Interrupted | list[TrainingScores]:
        """Train to the end of the budget, or until a signal arrives."""
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
        """Fly one deterministic episode with the greedy policy; write the tables, the last checkpoint and perhaps the best."""
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
        """Metrics of one episode of the policy on the scenario, seed 0."""
        return measure(run_episode(self.world, Learned(policy, self.signature(), self.out)))

    def signature(self) -> dict[str, Any]:
        """The signature of the run's policies."""
        config = self.config
        return signature(self.trainer.scenario, config.state, config.actions, config.interval)

    def describe(self, row: TrainingScores) -> dict[str, Any]:
        """The description in a checkpoint's header."""
        return {**self.origin, "signature": self.signature(), "train": self.config, "evaluation": row}

    def write_rows(self) -> None:
        """Write eval.csv and progress.csv anew."""
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
    """The columns of eval.csv after wall_s and mission_steps: violation and clearance are those of the worst agent."""
    agents = metrics["agents"]
    return {
        "return": metrics["team"]["return"],
        **{f"switches_{i + 1}": float(a["switches"]) for i, a in enumerate(agents)},
        "violation_time": SCORES["violation_time_worst"].read(metrics),
        "clearance_min": SCORES["clearance_min_worst"].read(metrics),
    }


def rank(row: TrainingScores) -> tuple[float, float]:
    """Sort key of evaluations, best last: by violation of the worst agent first, then by the return minus 100 per switch."""
    switches = sum(value for name, value in row.items() if name.startswith("switches_"))
    return -row["violation_time"], row["return"] - 100.0 * switches


def write_table(path: Path, rows: Sequence[TrainingScores]) -> None:
    """Write rows as CSV, with one column per key of the first."""
    with staged_file(path, overwrite=True) as staging, staging.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows({key: f"{value:.6g}" for key, value in row.items()} for row in rows)
