"""Copying checkpoints of the general policy into the package, with their model cards."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from marlbc_mj.policies.general import GeneralPolicy, mean_policy, read_general, write_general
from marlbc_mj.policies.general_inputs import FEATURES, INPUTS, SENT
from marlbc_mj.policies.shipped import FOLDER
from marlbc_mj.report.table import pipe_table
from marlbc_mj.training.general.config import GENERAL, JUDGED_WITH, GeneralConfig, as_flown
from marlbc_mj.training.ship import changed_settings, put_in_package
from marlbc_mj.util.files import check_target, staged_file
from marlbc_mj.util.provenance import provenance

_DECIDES = {
    "set-based": "between formation and column",
    "null-space": "between formation and column and whether avoidance is on top",
}
"""Wording in the model card for an agent's decision, by the composition that the policy needs."""
_BY_CONSENSUS = (
    "It also sends how far the value of the column exceeds that of the formation, and goes by the mean of these leads, so agents "
    "that hear each other take the same. "
)
"""Sentence in the model card of a policy that decides by consensus."""


def ship_general(run: Path, name: str, folder: Path = FOLDER, *, overwrite: bool = False) -> Path:
    """Copy the best checkpoint of a run and write its model card, ``<name>.md``; returns the checkpoint's path.

    Args:
        run: folder of the training run.
        name: name of the shipped checkpoint.
        folder: folder of the shipped checkpoints.
        overwrite: whether a checkpoint of that name may be replaced.

    Raises:
        ConfigurationError: there is no such run, its checkpoint is damaged, or a file may not be replaced.
    """
    return put_in_package(run, name, folder, overwrite=overwrite, read=read_general, write_card=general_card)


def ship_mean(checkpoints: Sequence[Path], name: str, folder: Path = FOLDER, *, overwrite: bool = False) -> Path:
    """Write the mean of several policies and its model card; returns the checkpoint's path.

    Args:
        checkpoints: checkpoints of general policies; one that is listed twice counts twice.
        name: name of the shipped checkpoint.
        folder: folder of the shipped checkpoints.
        overwrite: whether a checkpoint of that name may be replaced.

    Raises:
        ConfigurationError: a checkpoint is damaged, the networks cannot be averaged, or a file may not be replaced.
    """
    parts = [read_general(path) for path in checkpoints]
    config = GeneralConfig()
    mean = mean_policy([part for part, _ in parts], config.switching_margin)
    policy = as_flown(mean, config)._replace(consensus=mean.consensus)
    target = folder / f"{name}.safetensors"
    check_target(target, overwrite=overwrite)
    runs = [run for _, part in parts for run in trainings(part)]
    write_general(target, policy, {**provenance(), "mean_of": runs})
    with staged_file(target.with_suffix(".md"), overwrite=True) as staging:
        staging.write_text(_mean_card(name, policy, runs))
    return target


def trainings(description: dict[str, Any]) -> list[dict[str, Any]]:
    """Command, configuration, evaluation and revision of each training behind a checkpoint, from its header: one training
    unless the checkpoint is a mean. File paths in a configuration are cut to their last three parts.
    """
    if "mean_of" in description:
        return list(description["mean_of"])
    run: dict[str, Any] = {
        key: description[key] for key in ("command", "train", "evaluation", "git_revision") if key in description
    }
    files = {
        "start": _within(run["train"].get("start", "")),
        "teachers": [_within(path) for path in run["train"].get("teachers", ())],
    }
    return [{**run, "train": {**run["train"], **files}}]


def _within(path: str) -> str:
    return "/".join(Path(path).parts[-3:])


def _what(train: dict[str, Any], *, consensus: bool) -> str:
    """The introduction of a model card: method, decisions, inputs and requirements of a training's policy."""
    composition = train.get("composition", "set-based")
    method = "Policy distillation into" if train.get("teachers") else "Dueling Q-learning of"
    return (
        f"{method} one policy that every agent of every team shares. Every 1.2 settling times each agent decides "
        f"{_DECIDES[composition]}, from {FEATURES} numbers of its own, of which it sends {SENT}, and {INPUTS - FEATURES} "
        f"that it pools of what it heard. {_BY_CONSENSUS if consensus else ''}It needs the {composition} "
        "composition, a formation with a column and a path that moves."
    )


def _mean_card(name: str, policy: GeneralPolicy, runs: list[dict[str, Any]]) -> str:
    """The model card of a mean policy in Markdown, with one table row per network."""
    lines = [
        f"# {name}",
        "",
        f"{_what(runs[0]['train'], consensus=policy.consensus)} Its action values are the mean of those of {_introduced(runs)}",
        "",
        _rules(policy.network.margin, policy.dwell, policy.deadline),
        "",
        _table_of_runs(runs),
    ]
    return "\n".join(lines) + "\n"


def _introduced(runs: list[dict[str, Any]]) -> str:
    """The sentences that introduce a table of trainings."""
    return (
        f"{len(runs)} networks, each trained by a command of its own at the revision beside it"
        + ("; a file named in `start` is the checkpoint of another run" if any(run["train"]["start"] for run in runs) else "")
        + ". Commands name the settings that differ from the defaults at that revision; the header of the checkpoint has all."
    )


def _rules(margin: float, dwell: int, deadline: float) -> str:
    """The sentences about when an agent leaves its order."""
    return (
        f"An agent leaves its order only for one whose value is higher by more than {margin:g}"
        + (f", and keeps a new one for at least {dwell} decisions." if dwell > 1 else ".")
        + (
            " It goes back to the formation when the time left, in settling times, is at most "
            f"{deadline:g} times its way, in safe distances."
            if deadline
            else ""
        )
    )


def _table_of_runs(runs: list[dict[str, Any]]) -> str:
    """A table with the command of each training, its length and its revision."""
    rows = [
        (
            f"`{_command(run)}`",
            f"{run['evaluation']['mission_steps']:.0f}",
            f"{run['evaluation'].get('cpu_s', np.nan):.0f}",
            run["git_revision"],
        )
        for run in runs
    ]
    return pipe_table(("trained by", "mission steps", "processor time [s]", "revision"), rows)


def general_card(name: str, description: dict[str, Any], rows: list[dict[str, str]]) -> str:
    """The model card in Markdown: the checkpoint's purpose, its training, and its learning curve on held-out layouts.

    Args:
        name: name of the shipped checkpoint.
        description: description in the checkpoint's header.
        rows: rows of the run's eval.csv.
    """
    train, evaluation, versions = description["train"], description["evaluation"], description["versions"]
    families = [key.removeprefix("success_") for key in rows[0] if key.startswith("success_")]
    teachers = description.get("teachers", [])
    lines = [
        f"# {name}",
        "",
        _what(train, consensus=description.get("consensus", False))
        + (f" It learned the mean values of {_introduced(teachers)}" if teachers else ""),
        "",
        _rules(description["margin"], description.get("dwell", 1), description.get("deadline", 0.0)),
        "",
        f"- Trained on {_counted(train['families'])} with the teams {', '.join(train['teams'])}, point masses, drag times 0 "
        f"to {train['most_drag']:g}; controller {train['controller']}, substep {1e3 * train['substep']:g} ms. No layout is used "
        "twice.",
        f"- Command: `{_command(description)}`",
        f"- The checkpoint is the best of {len(rows)} evaluations: {evaluation['mission_steps']:.0f} mission steps, "
        f"{evaluation['cpu_s']:.0f} s of processor time on {train['threads']} thread(s) of {description['cpu']}.",
        f"- Evaluations: {train['layouts']} held-out layouts of each family and team, controller {JUDGED_WITH}; success at "
        "mission steps, median return.",
        f"- Revision {description['git_revision']}; " + ", ".join(f"{k} {v}" for k, v in versions.items()) + ".",
        "",
        pipe_table(("mission steps", *families), [_curve_cells(row, families) for row in rows]),
        *(("", "The teachers:", "", _table_of_runs(teachers)) if teachers else ()),
    ]
    return "\n".join(lines) + "\n"


def _counted(names: list[str]) -> str:
    """The distinct names, with the number of occurrences if there are several."""
    return ", ".join(name if n == 1 else f"{name} ({n} times)" for name, n in Counter(names).items())


def _curve_cells(row: dict[str, str], families: list[str]) -> tuple[str, ...]:
    """One evaluation as a row of the card's table."""
    cells = [f"{100 * float(row[f'success_{name}']):.0f} % / {float(row[f'return_{name}']):.0f}" for name in families]
    return (f"{float(row['mission_steps']):.0f}", *cells)


def training_command(train: dict[str, Any]) -> str:
    """The command for a training with these settings: ``--set`` lists those that differ from this version's defaults."""
    return " ".join([f"marlbc train {GENERAL} --seed {train['seed']}", *changed_settings(train, GeneralConfig(), given={"seed"})])


def _command(run: dict[str, Any]) -> str:
    """The command in a checkpoint's header; for older checkpoints, which have none, one made from the settings."""
    return str(run.get("command") or training_command(run["train"]))
