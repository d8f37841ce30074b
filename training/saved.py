"""Checks before a saved run is resumed: it was written by the same versions, is complete, and has the contents of a new run."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from marlbc_mj.training.config import Configuration, config_from_json, flat_settings
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import UNKNOWN, plain_data, provenance

SAME = ("marlbc-mj", "torch", "numpy", "numba", "mujoco")
"""Packages that must have the same versions for a run to continue bit for bit; the revision, if known, must match too."""
SAVED_KINDS: dict[str, type | tuple[type, ...]] = {
    "versions": dict,
    "git_revision": str,
    "train": dict,
    "scalars": dict,
    "evaluations": list,
    "curve": list,
    "wall_s": (int, float),
}
"""Required entries in the description of a saved run for one team, with their types."""
CONFIG_FILE = "config.json"

Snapshot = tuple[dict[str, np.ndarray], dict[str, Any]]
"""State of a trainer: arrays, and the remaining values as JSON data."""


class Restorable(Protocol):
    """A trainer whose state can be saved and restored bit for bit."""

    def snapshot(self) -> Snapshot:
        """The state that resumes the run."""

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a run with the same configuration."""


def check_origin(path: Path, description: Mapping[str, Any], kinds: Mapping[str, Any] = SAVED_KINDS) -> None:
    """Raise ConfigurationError unless a description is of a run saved by the same versions and revision of the code.

    Args:
        path: file of the saved run.
        description: description in the file's header.
        kinds: required entries of the description, with their types.
    """
    for name, kind in kinds.items():
        if not isinstance(description.get(name), kind):
            raise ConfigurationError(f"{path} is not a saved run: its description has no {name}")
    here = provenance()
    revisions = description["git_revision"], here["git_revision"]
    pairs = {name: (description["versions"].get(name), here["versions"][name]) for name in SAME}
    if UNKNOWN not in revisions:
        pairs["revision"] = revisions
    for name, (there, now) in pairs.items():
        if there != now:
            raise ConfigurationError(
                f"{path} was saved with {name} {there}, but {now} is in use; a run resumes only with the same versions"
            )


def saved_config(path: Path, train: dict[str, Any], kind: type[Configuration]) -> Configuration:
    """The configuration that a run was saved with.

    Args:
        path: file of the saved run.
        train: JSON data of the configuration in the file.
        kind: class of the configuration.

    Raises:
        ConfigurationError: its settings are not those of this version, or its values differ from ``config.json`` beside it.
    """
    config, found = config_from_json(train, kind), flat_settings(train)
    odd = sorted(found.keys() ^ flat_settings(plain_data(config)).keys())
    if odd:
        raise ConfigurationError(f"{path} was saved by another version, whose settings differ in {', '.join(odd)}")
    beside = path.with_name(CONFIG_FILE)
    try:
        said = flat_settings(json.loads(beside.read_text())["train"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"cannot read the configuration of the run from {beside}: {error}") from error
    odd = sorted(name for name in found.keys() | said.keys() if found.get(name) != said.get(name))
    if odd:
        differences = ", ".join(f"{name} {said.get(name)} instead of {found.get(name)}" for name in odd)
        raise ConfigurationError(f"{beside} does not belong to the run saved in {path.name}: it has {differences}")
    return config


def saved_rows(path: Path, rows: list[Any], columns: Iterable[str]) -> list[dict[str, float]]:
    """The rows of a saved run's table from JSON data: at least one, all with the same columns.

    Args:
        path: file of the saved run.
        rows: rows of the table in the file.
        columns: columns that every row must have; others are allowed.

    Raises:
        ConfigurationError: the data are not a table of this kind.
    """
    try:
        found = [{str(name): float(value) for name, value in row.items()} for row in rows]
        names = set(found[0])
        if not names.issuperset(columns) or any(set(row) != names for row in found):
            raise ValueError(f"their rows must all have the same columns, including {', '.join(columns)}")
    except (ArithmeticError, AttributeError, IndexError, TypeError, ValueError) as error:
        raise ConfigurationError(f"{path} is not a saved run: its tables are damaged, {error}") from error
    return found


def restore_trainer(path: Path, trainer: Restorable, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
    """Restore a saved snapshot into a new ``trainer``.

    Raises:
        ConfigurationError: the snapshot does not fit the trainer.
    """
    check_snapshot(path, (arrays, scalars), trainer.snapshot())
    try:
        trainer.restore(arrays, scalars)
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:  # a random generator's own checks
        raise ConfigurationError(f"{path} does not fit the run that it was saved from: {error}") from error


def check_snapshot(path: Path, found: Snapshot, new: Snapshot) -> None:
    """Raise ConfigurationError, naming the first difference, unless a saved snapshot has the structure of a ``new`` run's: the
    same names, shapes and types of arrays, and the same names of other values.
    """
    (arrays, scalars), (like, numbers) = found, new
    fault = ""
    for name in sorted(arrays.keys() | like.keys()):
        if name not in arrays or name not in like:
            fault = f"array {name} is {'missing' if name in like else 'unexpected'}"
        elif (arrays[name].shape, arrays[name].dtype) != (like[name].shape, like[name].dtype):
            a, b = arrays[name], like[name]
            fault = f"array {name} is {a.dtype} {a.shape}, not {b.dtype} {b.shape}"
        if fault:
            break
    fault = fault or _difference(scalars, numbers, "scalars")
    if fault:
        raise ConfigurationError(f"{path} does not fit the run that it was saved from: {fault}")


def _difference(found: Any, like: Any, where: str) -> str:
    """Describe the first difference in structure between two pieces of JSON data; empty if there is none. Integers are counts,
    so a negative one is also a difference.
    """
    if isinstance(like, dict):
        if not isinstance(found, dict) or found.keys() != like.keys():
            return f"{where} must have {', '.join(like)}"
        return next(filter(None, (_difference(found[name], like[name], f"{where}.{name}") for name in like)), "")
    if isinstance(like, list):
        if not isinstance(found, list) or len(found) != len(like):
            return f"{where} must have {len(like)} entries"
        pairs = enumerate(zip(found, like, strict=True))
        return next(filter(None, (_difference(a, b, f"{where}[{k}]") for k, (a, b) in pairs)), "")
    if isinstance(like, float):
        fits = isinstance(found, int | float) and abs(found) < math.inf
    elif isinstance(like, int):
        fits = isinstance(found, int) and found >= 0
    else:
        fits = bool(found == like)
    return "" if fits and not isinstance(found, bool) else f"{where} is {found!r}"
