"""Copying the best checkpoint of a training run into the package, with a model card."""

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from marlbc_mj.policies.checkpoint import read_policy
from marlbc_mj.policies.shipped import FOLDER
from marlbc_mj.report.table import pipe_table
from marlbc_mj.results.scores import SCORES
from marlbc_mj.training.config import flat_settings, make_config
from marlbc_mj.training.methods import METHODS
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import check_target, staged_file, write_json
from marlbc_mj.util.provenance import plain_data

CHOICE = {"commands": "one of the commands", "orders": "one of all orders", "avoidance": "formation with or without avoidance"}
"""Wording in the model card for a choice from each action set."""
_SAFETY = ("violation_time_worst", "clearance_min_worst")


def ship(run: Path, name: str, folder: Path = FOLDER, *, overwrite: bool = False) -> Path:
    """Copy the best checkpoint of a run and write its model card, ``<name>.md``; returns the checkpoint's path.

    Args:
        run: folder of the training run.
        name: name of the shipped checkpoint.
        folder: folder of the shipped checkpoints.
        overwrite: whether a checkpoint of that name may be replaced.

    Raises:
        ConfigurationError: there is no such run, its checkpoint is damaged, or a file may not be replaced.
    """
    return put_in_package(run, name, folder, overwrite=overwrite, read=read_policy, write_card=card)


def put_in_package(
    run: Path,
    name: str,
    folder: Path,
    *,
    overwrite: bool,
    read: Callable[[Path], tuple[Any, dict[str, Any]]],
    write_card: Callable[[str, dict[str, Any], list[dict[str, str]]], str],
) -> Path:
    """:func:`ship` for any kind of policy: ``read`` returns a checkpoint's policy and description, ``write_card`` the text."""
    source = run / "checkpoint" / "best.safetensors"
    _, description = read(source)
    try:
        with (run / "eval.csv").open() as file:
            text = write_card(name, description, list(csv.DictReader(file)))
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigurationError(f"{run} is not a finished training run: {error!r}") from error
    target = folder / source.with_stem(name).name
    check_target(target, overwrite=overwrite)
    with staged_file(target, overwrite=True) as staging:
        shutil.copyfile(source, staging)
    write_json(target.with_suffix(".json"), description)
    with staged_file(target.with_suffix(".md"), overwrite=True) as staging:
        staging.write_text(text)
    return target


def card(name: str, description: dict[str, Any], rows: list[dict[str, str]]) -> str:
    """The model card in Markdown: the checkpoint's purpose, its training, its scores on the case study and its learning curve.

    Args:
        name: name of the shipped checkpoint.
        description: description in the checkpoint's header.
        rows: rows of the run's eval.csv.
    """
    train, versions, evaluation = description["train"], description["versions"], description["evaluation"]
    command = f"marlbc train {train['method']} --preset {train['preset']} --seed {train['seed']} --budget {train['budget']}"
    command += f" --threads {train['threads']}" + "".join(f" {setting}" for setting in _settings(train))
    switches = "/".join(f"{value:.0f}" for key, value in evaluation.items() if key.startswith("switches_"))
    lines = [
        f"# {name}",
        "",
        f"Greedy policy of a team on scenario `{train['scenario']}` with controller `{train['controller']}`: every "
        f"{train['interval']} mission steps {CHOICE[train['actions']]} for each agent, from the {train['state']} state. "
        "Trained on the unperturbed scenario alone; it knows no other team, slots or mission step, and refuses them.",
        "",
        f"- Command: `{command}`",
        f"- The checkpoint is the best of {len(rows)} evaluations: {evaluation['mission_steps']:.0f} mission steps, "
        f"{evaluation['wall_s']:.0f} s on {train['threads']} thread(s) of {description['cpu']}.",
        f"- On the case study: return {evaluation['return']:.0f}, switches {switches}, "
        f"violation of the worst agent {evaluation['violation_time']:.3f} s, "
        f"least clearance {evaluation['clearance_min']:.3f} m.",
        f"- Revision {description['git_revision']}; " + ", ".join(f"{k} {v}" for k, v in versions.items()) + ".",
        "",
        pipe_table(("mission steps", "return", "switches", *(SCORES[name].label for name in _SAFETY)), list(map(_cells, rows))),
    ]
    return "\n".join(lines) + "\n"


def _cells(row: dict[str, str]) -> tuple[str, ...]:
    """One evaluation as a row of the card's table."""
    counts = "/".join(f"{float(value):.0f}" for key, value in row.items() if key.startswith("switches_"))
    violation, clearance = (f"{float(row[key]):.3f}" for key in ("violation_time", "clearance_min"))
    return (f"{float(row['mission_steps']):.0f}", f"{float(row['return']):.0f}", counts, violation, clearance)


def _settings(train: dict[str, object]) -> list[str]:
    """``--set`` and the settings that differ from the method's preset; empty if none differ."""
    preset = make_config(str(train["preset"]), **METHODS[str(train["method"])][0])
    return changed_settings(train, preset, given={"method", "preset", "seed", "budget", "threads"})


def changed_settings(train: dict[str, Any], preset: Any, given: set[str]) -> list[str]:
    """``--set`` and the settings of a run that differ from those of a preset; empty if none differ.

    Args:
        train: JSON data of the run's configuration.
        preset: configuration to compare with.
        given: settings that the command gives in other options.
    """
    usual = flat_settings(plain_data(preset))
    changed = [
        f"{name}={_text(value)}" for name, value in flat_settings(train).items() if usual.get(name) != value and name not in given
    ]
    return ["--set", *changed] if changed else []


def _text(value: object) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)
