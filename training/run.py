"""A training run on disk: evaluations, curves, best and last checkpoints, and what ``--resume`` continues from."""

import csv
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Any

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
from marlbc_mj.training.saved import CONFIG, check_origin, check_snapshot, saved_config, saved_rows
from marlbc_mj.training.trainer import Trainer
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import check_folder, remove_leftovers, staged_file, write_json, writing
from marlbc_mj.util.provenance import provenance

RESUME = "resume.safetensors"
TABLES = ("eval.csv", "progress.csv")
CHECKPOINT, TENSORBOARD = "checkpoint", "tensorboard"
Row = dict[str, float]


@dataclass(frozen=True)
class Interrupted:
    """A run that was asked to stop and has saved itself."""

    signal: int


class Stopper:
    """Notes SIGINT and SIGTERM; the run saves itself at the next decision."""

    def __init__(self) -> None:
        self.signal = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.signal = number


@contextmanager
def stopper() -> Iterator[Stopper]:
    """Signals are noted instead of acted on inside the block."""
    stop = Stopper()
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def make_trainer(config: TrainConfig) -> BaseTrainer:
    """The trainer of the configuration's method.

    Raises:
        ConfigurationError: a method, scenario, controller or device that cannot be used.
    """
    return MAPPO(config) if config.method == "mappo" else Trainer(config)


def train(
    config: TrainConfig, out: Path, *, overwrite: bool = False, progress: Callable[[BaseTrainer, Row], None] | None = None
) -> Interrupted | list[Row]:
    """Train from scratch into ``out``; returns the evaluations, or what interrupted the run.

    Raises:
        ConfigurationError: a setting, or ``out`` is not empty.
        SimulationError: a world diverged.
    """
    check_folder(out, overwrite=overwrite)
    run = Run(make_trainer(config), out)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        remove_run(out)
    write_json(out / CONFIG, {**run.origin, "train": config})
    return run.go(progress)


def remove_run(out: Path) -> None:
    """Remove what a run leaves in its folder, first of all what a later :func:`resume` would take for the new run's."""
    for name in (RESUME, CONFIG, *TABLES):
        (out / name).unlink(missing_ok=True)
    for name in (CHECKPOINT, TENSORBOARD):
        if (out / name).is_dir():
            shutil.rmtree(out / name)
    remove_leftovers(out)


def resume(out: Path, *, progress: Callable[[BaseTrainer, Row], None] | None = None) -> Interrupted | list[Row]:
    """Continue the run in ``out`` where it was last saved, bit for bit.

    Raises:
        ConfigurationError: no run to continue there, torn, not of this code, or not of the configuration beside it.
    """
    path = out / RESUME
    if not path.is_file():
        raise ConfigurationError(f"{out} holds no run to resume: there is no {RESUME}")
    arrays, description = read_arrays(path)
    check_origin(path, description)
    run = Run(make_trainer(saved_config(path, description["train"])), out)
    check_snapshot(path, (arrays, description["scalars"]), run.trainer.snapshot())
    try:
        run.trainer.restore(arrays, description["scalars"])
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:  # a random stream's own checks
        raise ConfigurationError(f"{path} does not fit the run that it was saved from: {error}") from error
    run.evaluations, run.curve = (saved_rows(path, description[name]) for name in ("evaluations", "curve"))
    run.wall = description["wall_s"]
    remove_leftovers(out)
    run.write_rows()
    return run.go(progress)


def resumable(out: Path) -> bool:
    """Whether ``out`` holds a whole saved run of this code; of any other, a study begins anew."""
    try:
        check_origin(out / RESUME, read_arrays(out / RESUME)[1])
    except ConfigurationError:
        return False
    return True


class Run:
    """A trainer with its folder: evaluates, logs and saves at set intervals."""

    def __init__(self, trainer: BaseTrainer, out: Path) -> None:
        self.trainer = trainer
        self.config = trainer.config
        self.out = out
        self.origin = provenance()
        self.evaluations: list[Row] = []
        self.curve: list[Row] = []
        self.wall = 0.0  # seconds of training before this process
        self.world = World(trainer.scenario, make_controller(self.config.controller), record=True)

    def go(self, progress: Callable[[BaseTrainer, Row], None] | None = None) -> Interrupted | list[Row]:
        """Run to the end of the budget, or until a signal."""
        config, trainer = self.config, self.trainer
        began, saved = monotonic() - self.wall, monotonic()
        board = TensorBoard(self.out / TENSORBOARD)
        with stopper() as stop:
            while not trainer.finished:
                outcome = trainer.advance()
                self.wall = monotonic() - began
                if trainer.steps // config.evaluate_every >= len(self.evaluations) or trainer.finished:
                    row = self.evaluate()
                    board.write(trainer.steps, {**self.curve[-1], **row})
                    if progress:
                        progress(trainer, row)
                elif progress:
                    progress(trainer, self.evaluations[-1])
                number = stop.signal  # read once: a signal that arrives from here on waits for the next decision
                if number or monotonic() - saved > config.save_every:
                    self.save()
                    saved = monotonic()
                if number:
                    return Interrupted(number)
                del outcome
        self.save()
        board.close()
        return self.evaluations

    def evaluate(self) -> Row:
        """One deterministic episode of the greedy policy; writes the curves, the last checkpoint and perhaps the best."""
        trainer = self.trainer
        policy = trainer.policy()
        row = {"wall_s": self.wall, "mission_steps": float(trainer.steps), **scores(self.measure(policy))}
        best = max((rank(r) for r in self.evaluations), default=None)
        self.evaluations.append(row)
        self.curve.append(
            {
                "wall_s": self.wall,
                "mission_steps": float(trainer.steps),
                "updates": float(trainer.updates),
                "td_error": trainer.error,
                "temperature": trainer.temperature,
                "exploration": trainer.explored,
                "steps_per_s": trainer.steps / max(self.wall, 1e-9),
            }
        )
        self.write_rows()
        description = self.describe(row)
        write_policy(self.out / CHECKPOINT / "last.safetensors", policy, description)
        if best is None or rank(row) > best:
            write_policy(self.out / CHECKPOINT / "best.safetensors", policy, description)
        return row

    def measure(self, policy: Policy) -> Metrics:
        """Metrics of the policy on the scenario, seed 0."""
        return measure(run_episode(self.world, Learned(policy, self.signature(), self.out)))

    def signature(self) -> dict[str, Any]:
        """What the policy is tied to."""
        config = self.config
        return signature(self.trainer.scenario, config.state, config.actions, config.interval)

    def describe(self, row: Row) -> dict[str, Any]:
        """What a checkpoint says of itself."""
        return {**self.origin, "signature": self.signature(), "train": self.config, "evaluation": row}

    def write_rows(self) -> None:
        """eval.csv and progress.csv, each replaced by a whole one."""
        for name, rows in zip(TABLES, (self.evaluations, self.curve), strict=True):
            write_table(self.out / name, rows)

    def save(self) -> None:
        """What :func:`resume` continues from."""
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


def scores(metrics: Metrics) -> Row:
    """The columns of eval.csv behind wall_s and mission_steps."""
    agents = metrics["agents"]
    return {
        "return": metrics["team"]["return"],
        **{f"switches_{i + 1}": float(a["switches"]) for i, a in enumerate(agents)},
        "violation_time": SCORES["violation_time_worst"].read(metrics),
        "clearance_min": SCORES["clearance_min_worst"].read(metrics),
    }


def rank(row: Row) -> tuple[float, float]:
    """What makes one evaluation better than another: less violation first, then return less 100 a switch."""
    switches = sum(value for name, value in row.items() if name.startswith("switches_"))
    return -row["violation_time"], row["return"] - 100.0 * switches


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Rows as CSV, one column a key of the first."""
    with staged_file(path, overwrite=True) as staging, staging.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows({key: f"{value:.6g}" for key, value in row.items()} for row in rows)
