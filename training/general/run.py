"""Training runs of the general policy on disk: evaluations on held-out layouts, learning curve, best and last checkpoints."""

import json
from collections.abc import Callable
from pathlib import Path
from time import monotonic, process_time
from typing import Any

from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.policies.general import write_general
from marlbc_mj.training.general.config import JUDGED_WITH, GeneralConfig, judging_scenarios
from marlbc_mj.training.general.judging import Judge, judge_policy
from marlbc_mj.training.general.ppo import PPOTrainer
from marlbc_mj.training.general.shipping import training_command, trainings
from marlbc_mj.training.general.trainer import GeneralTrainer
from marlbc_mj.training.resuming import RESUME, saved_run
from marlbc_mj.training.run import (
    CHECKPOINT,
    COUNTED,
    Interrupted,
    TrainingScores,
    begin_folder,
    decide_and_save,
    training_in,
    write_table,
)
from marlbc_mj.training.saved import CONFIG_FILE, SAVED_KINDS, check_origin, restore_trainer, saved_config, saved_rows
from marlbc_mj.util.files import remove_leftovers
from marlbc_mj.util.provenance import plain_data, provenance

CURVE = "eval.csv"
_SAVED = {**{name: kind for name, kind in SAVED_KINDS.items() if name != "curve"}, "cpu_s": (int, float)}
"""Required entries in the description of a saved run, with their types."""
GeneralProgress = Callable[[GeneralTrainer, TrainingScores], None]
"""Callback after every decision from the first evaluation on, with the trainer and its last evaluation."""


def make_general_trainer(config: GeneralConfig) -> GeneralTrainer:
    """The trainer for the configuration's learner.

    Raises:
        ConfigurationError: the scenario, controller or device cannot be used.
    """
    return PPOTrainer(config) if config.learner == "mappo" else GeneralTrainer(config)


def train_general(
    config: GeneralConfig, out: Path, *, overwrite: bool = False, progress: GeneralProgress | None = None
) -> Interrupted | list[TrainingScores]:
    """Train from scratch; returns the evaluations, or the interruption.

    Args:
        config: configuration of the run.
        out: folder of the run.
        overwrite: whether ``out`` may contain files.
        progress: called after every decision from the first evaluation on.

    Raises:
        ConfigurationError: a setting is invalid, ``out`` is not empty, or another process is training there.
        SimulationError: a world diverged.
    """
    with training_in(out, overwrite=overwrite):
        run = GeneralRun(config, out)
        begin_folder(out, run.origin, config)
        return run.go(progress)


def resume_general(out: Path, *, progress: GeneralProgress | None = None) -> Interrupted | list[TrainingScores]:
    """Continue a run from its last save, bit for bit; returns the evaluations, or the interruption.

    Args:
        out: folder of the run.
        progress: called after every decision from the first evaluation on.

    Raises:
        ConfigurationError: as for :func:`marlbc_mj.training.run.resume`.
        SimulationError: a world diverged.
    """
    path = saved_run(out)
    with training_in(out, overwrite=True):
        return _restored(path).go(progress)


def _restored(path: Path) -> "GeneralRun":
    """Load the run saved in a file, and remove from its folder the leftovers of a killed process."""
    arrays, description = read_arrays(path)
    check_origin(path, description, _SAVED)
    run = GeneralRun(saved_config(path, description["train"], GeneralConfig), path.parent)
    restore_trainer(path, run.trainer, arrays, description["scalars"])
    if description["evaluations"]:
        run.evaluations = saved_rows(path, description["evaluations"], (*COUNTED, "cpu_s"))
    times = saved_rows(path, [{name: description[name] for name in ("wall_s", "cpu_s")}], ())[0]
    run.wall, run.cpu = times["wall_s"], times["cpu_s"]
    remove_leftovers(run.out)
    return run


def is_general_run(out: Path) -> bool:
    """Whether a folder's configuration file is that of a training of the general policy."""
    try:
        return bool(json.loads((out / CONFIG_FILE).read_text())["train"]["type"] == GeneralConfig.__name__)
    except (OSError, ValueError, KeyError, TypeError):
        return False


class GeneralRun:
    """A trainer and its output folder; evaluates and saves at fixed intervals.

    Args:
        config: configuration of the run.
        out: folder of the run.
    """

    def __init__(self, config: GeneralConfig, out: Path) -> None:
        self.config, self.out = config, out
        self.trainer = make_general_trainer(config)
        scenarios = judging_scenarios(config)
        self.judges = {k: Judge(each, JUDGED_WITH, config.layouts, config.threads) for k, each in scenarios.items()}
        self.origin = provenance()
        self.origin["command"] = training_command(plain_data(config))
        if self.trainer.teachers:
            self.origin["teachers"] = [run for _, header in self.trainer.teachers for run in trainings(header)]
        self.evaluations: list[TrainingScores] = []
        self.wall = 0.0  # training time so far, without evaluations [s]
        self.cpu = 0.0  # processor time of that training, which a busy machine does not lengthen [s]

    def go(self, progress: GeneralProgress | None = None) -> Interrupted | list[TrainingScores]:
        """Train until the budget is spent or a signal arrives; the run then saves itself."""
        trainer = self.trainer

        def decide() -> None:
            began, used = monotonic(), process_time()
            trainer.advance()
            self.wall, self.cpu = self.wall + monotonic() - began, self.cpu + process_time() - used
            if trainer.steps // self.config.evaluate_every > len(self.evaluations) or trainer.finished:
                self.evaluate()
            if progress and self.evaluations:
                progress(trainer, self.evaluations[-1])

        return decide_and_save(self, decide) or self.evaluations

    def save(self) -> None:
        """Write the state that :func:`resume_general` continues from."""
        arrays, scalars = self.trainer.snapshot()
        times = {"wall_s": self.wall, "cpu_s": self.cpu}
        description = {**self.origin, "train": self.config, "scalars": scalars, "evaluations": self.evaluations, **times}
        write_arrays(self.out / RESUME, arrays, description)

    def evaluate(self) -> None:
        """Fly the held-out layouts; write the learning curve, the last checkpoint, and perhaps the best."""
        policy = self.trainer.policy()
        row = {
            "wall_s": self.wall,
            "cpu_s": self.cpu,
            "mission_steps": float(self.trainer.steps),
            "updates": float(self.trainer.learner.updates),
        }
        row |= {"td_error": self.trainer.error, **judge_policy(policy, self.judges)}
        best = max((judged_rank(each) for each in self.evaluations), default=None)
        self.evaluations.append(row)
        write_table(self.out / CURVE, self.evaluations)
        description: dict[str, Any] = {**self.origin, "train": self.config, "evaluation": row}
        write_general(self.out / CHECKPOINT / "last.safetensors", policy, description)
        if best is None or judged_rank(row) >= best:
            write_general(self.out / CHECKPOINT / "best.safetensors", policy, description)


def judged_rank(row: TrainingScores) -> tuple[float, float]:
    """Sort key of evaluations, best last: by the mean success rate first, then by the mean return."""
    means = []
    for prefix in ("success_", "return_"):
        values = [value for name, value in row.items() if name.startswith(prefix)]
        means.append(sum(values) / len(values))
    return means[0], means[1]
