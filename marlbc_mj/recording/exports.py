"""Export of a log: a table as CSV, JSON lines or Parquet, arrays for NumPy, or a recording for Rerun."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from marlbc_mj.recording.log import EpisodeLog, Substeps
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.rerun_file import write_rerun
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.files import staged_file

_PAIRS = ("position", "velocity", "reference", "reference_velocity", "force")


def export_log(path: str | Path, out: str | Path, overwrite: bool = False) -> None:
    """Write a log as a table, as arrays, or for Rerun (``.rrd``).

    A table (``.csv``, ``.jsonl``, or ``.parquet``, which needs pyarrow) has a row per mission step and agent. Arrays (``.npz``)
    are the fields of EpisodeLog and those of its substeps.

    Raises:
        ConfigurationError: an unknown suffix, a log that cannot be read, a package that is not installed, or an output that
            cannot or must not be written.
    """
    suffix = Path(out).suffix
    if suffix not in WRITERS:
        raise unknown("export format", suffix or str(out), WRITERS)
    log = read_log(path)
    with staged_file(Path(out), overwrite=overwrite) as staging, open(staging, "wb") as stream:
        WRITERS[suffix](log, stream)


def table_columns() -> tuple[str, ...]:
    """Names of the columns of a table."""
    plane = [f"{name}_{axis}" for name in _PAIRS for axis in ("x", "y")]
    return ("time", "agent", *plane, "clearance", "command", "formation", "reward", "decision_ms")


def table_rows(log: EpisodeLog) -> Iterator[list[Any]]:
    """One row per mission step and agent, in the order of :func:`table_columns`."""
    motion = np.concatenate([getattr(log, name) for name in _PAIRS], axis=-1).tolist()
    scalars = zip(log.formation.tolist(), log.reward.tolist(), log.decision_ms.tolist(), strict=True)
    for k, (time, shared) in enumerate(zip(log.time.tolist(), scalars, strict=True)):
        for i, numbers in enumerate(motion[k]):
            command = log.commands[log.command[k, i]]
            yield [time, i + 1, *numbers, float(log.clearance[k, i]), command, *shared]


def _write_csv(log: EpisodeLog, stream: BinaryIO) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(table_columns())
    table.writerows(table_rows(log))
    text.detach()


def _write_json_lines(log: EpisodeLog, stream: BinaryIO) -> None:
    """Write one object per row; a clearance without obstacles is null, since JSON has no infinity."""
    names = table_columns()
    for row in table_rows(log):
        cells = (None if isinstance(cell, float) and not math.isfinite(cell) else cell for cell in row)
        stream.write(json.dumps(dict(zip(names, cells, strict=True))).encode() + b"\n")


def _write_parquet(log: EpisodeLog, stream: BinaryIO) -> None:
    """Write the table, with scenario, supervisor, controller and seed as metadata of its schema."""
    try:
        arrow: Any = import_module("pyarrow")
        parquet: Any = import_module("pyarrow.parquet")
    except ImportError as error:
        raise ConfigurationError("Parquet needs pyarrow: pip install 'marlbc-mj[parquet]'") from error
    columns = zip(table_columns(), zip(*table_rows(log), strict=True), strict=True)
    about = {name: str(getattr(log, name)) for name in ("scenario", "supervisor", "controller", "seed")}
    table = arrow.table({name: list(cells) for name, cells in columns})
    parquet.write_table(table.replace_schema_metadata(about), stream)


def _write_npz(log: EpisodeLog, stream: BinaryIO) -> None:
    arrays: dict[str, Any] = {each.name: np.asarray(getattr(log, each.name)) for each in fields(log) if each.name != "substeps"}
    if log.substeps is not None:
        _, *rows = log.substeps
        arrays.update({f"substep_{name}": row for name, row in zip(Substeps._fields[1:], rows, strict=True)})
    np.savez_compressed(stream, **arrays)


WRITERS: dict[str, Callable[[EpisodeLog, BinaryIO], None]] = {
    ".csv": _write_csv,
    ".jsonl": _write_json_lines,
    ".parquet": _write_parquet,
    ".npz": _write_npz,
    ".rrd": write_rerun,
}
"""Export functions by file suffix."""
