"""Results of a learner study as lines of its two CSV files, study.csv and curves.csv."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.studies.learners.variants import VARIANTS
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.training.config import TrainConfig, from_json
from marlbc_mj.training.run import rank
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.files import staged_file

DONE_MARK, FAILED_MARK = "DONE", "FAILED"
"""Names of the files that mark the folder of a finished run and of a failed run."""
GOAL_SWITCHES = (4, 2, 2, 4)
"""Most switches per agent that meet the goal on the case study, which also requires no violation and at least the scripted
supervisor's return."""
UNFINISHED = "unfinished"
"""Entry in the column ``failure`` for an interrupted run that can be resumed."""

CsvLine = dict[str, str]
"""A line of a CSV file as text, so that tables and figures show exactly what the file contains."""
Line = TypeVar("Line", bound=Mapping[str, Any])
"""A line of any table."""
RUN_COLUMNS = (
    *("variant", "seed", "budget", "goal_return", "best_mission_steps"),
    *("best_return", "best_switches", "best_violation_time", "best_clearance_min", "goal_mission_steps", "goal_wall_s"),
    *(
        "final_mission_steps",
        "final_return",
        "final_switches",
        "final_violation_time",
        "final_clearance_min",
        "wall_s",
        "failure",
    ),
)
"""Columns of study.csv. Switches per agent, clearances [m], times [s]; ``goal_*`` is empty for a run that never met the goal."""
CURVE_COLUMNS = ("variant", "seed", "mission_steps", "return", "violation_time", "switches")
"""Columns of curves.csv: violation of the worst agent [s], switches of the whole team."""


def lines_by(column: str, names: Iterable[str], lines: Sequence[Line]) -> dict[str, list[Line]]:
    """Lines grouped by the value of a column, in the order of ``names``; names without lines are left out."""
    found = {name: [line for line in lines if line[column] == name] for name in names}
    return {name: own for name, own in found.items() if own}


def read_json(path: Path, key: str) -> Any:
    """An entry of the JSON object in a file; raises ConfigurationError if there is none."""
    try:
        return json.loads(path.read_text())[key]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(f"cannot read {key} from {path}: {error}") from error


@cache
def scripted_return(scenario: str, controller: str) -> float:
    """Return of the scripted supervisor on the scenario, rounded to six digits as in eval.csv: the goal for learners."""
    world = World(make_scenario(scenario), make_controller(controller), record=True)
    return float(f"{measure(run_episode(world, make_supervisor('scripted', controller)))['team']['return']:.6g}")


def collect(out: Path) -> tuple[list[CsvLine], list[CsvLine]]:
    """Lines of study.csv and curves.csv from all runs in the study's folder, including runs of earlier calls.

    Raises:
        ConfigurationError: a file of a run cannot be read.
    """
    rows: list[CsvLine] = []
    curves: list[CsvLine] = []
    for name in VARIANTS:
        for folder in sorted((p for p in (out / name).glob("*") if p.name.isdigit()), key=lambda p: int(p.name)):
            failed = (folder / FAILED_MARK).is_file()
            if not failed and not (folder / "config.json").is_file():
                continue
            config = from_json(read_json(folder / (FAILED_MARK if failed else "config.json"), "train"))
            ended = read_json(folder / FAILED_MARK, "failure") if failed else "" if (folder / DONE_MARK).is_file() else UNFINISHED
            evaluations = read_csv(folder / "eval.csv", ("return",)) if (folder / "eval.csv").is_file() else []
            rows.append(_row(name, config, evaluations, ended))
            for e in evaluations:
                team = f"{sum(float(s) for s in _switches(e)):.0f}"
                line = (name, str(config.seed), e["mission_steps"], e["return"], e["violation_time"], team)
                curves.append(dict(zip(CURVE_COLUMNS, line, strict=True)))
    return rows, curves


def _row(name: str, config: TrainConfig, evaluations: Sequence[CsvLine], failure: str) -> CsvLine:
    goal = scripted_return(config.scenario, config.controller)
    row = dict.fromkeys(RUN_COLUMNS, "")
    row |= {"variant": name, "seed": str(config.seed), "budget": str(config.budget), "goal_return": f"{goal:.6g}"}
    row["failure"] = failure
    if evaluations:
        best = max(evaluations, key=lambda e: rank({key: float(value) for key, value in e.items()}))
        for which, e in (("best", best), ("final", evaluations[-1])):
            row |= {f"{which}_{key}": e[key] for key in ("mission_steps", "return", "violation_time", "clearance_min")}
            row[f"{which}_switches"] = "/".join(_switches(e))
        row["wall_s"] = evaluations[-1]["wall_s"]
        met = next((e for e in evaluations if meets_goal(e, goal)), None)
        row |= {f"goal_{key}": met[key] for key in ("mission_steps", "wall_s")} if met else {}
    return row


def meets_goal(evaluation: CsvLine, least_return: float) -> bool:
    """Whether no agent violates, none exceeds its number of GOAL_SWITCHES, and the return is at least ``least_return``."""
    few = [float(s) <= limit for s, limit in zip(_switches(evaluation), GOAL_SWITCHES, strict=False)]
    return all(few) and float(evaluation["violation_time"]) == 0.0 and float(evaluation["return"]) >= least_return


def _switches(evaluation: CsvLine) -> list[str]:
    return [value for key, value in evaluation.items() if key.startswith("switches_")]


def read_csv(path: Path, columns: Sequence[str]) -> list[CsvLine]:
    """Lines of a CSV file with at least these columns; raises ConfigurationError if a column or all lines are missing."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = [dict(line) for line in csv.DictReader(file)]
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error
    if not lines or any(line.get(column) is None for line in lines for column in columns):
        raise ConfigurationError(f"{path} is not a study file: it needs lines with columns {', '.join(columns)}")
    return lines


def read_study(folder: Path) -> tuple[list[CsvLine], list[CsvLine]]:
    """Read study.csv and curves.csv as :func:`write_csvs` wrote them.

    Raises:
        ConfigurationError: a file is missing or incomplete, names an unknown variant, or has text instead of numbers.
    """
    rows = read_csv(folder / "study.csv", RUN_COLUMNS)
    curves = read_csv(folder / "curves.csv", CURVE_COLUMNS) if any(row["wall_s"] for row in rows) else []
    for line in (*rows, *curves):
        if line["variant"] not in VARIANTS:
            raise unknown("variant", line["variant"], VARIANTS)
        texts = [text for key, text in line.items() if key not in ("variant", "failure")]
        if not all(_is_number(part) for text in texts for part in text.split("/") if part):
            raise ConfigurationError(f"a line in {folder} is not a record of a learner study: {', '.join(line.values())}")
    return rows, curves


def _is_number(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def write_csvs(folder: Path, rows: Sequence[CsvLine], curves: Sequence[CsvLine]) -> None:
    """Write study.csv with one line per run and curves.csv with one line per evaluation."""
    for name, columns, lines in (("study.csv", RUN_COLUMNS, rows), ("curves.csv", CURVE_COLUMNS, curves)):
        with staged_file(folder / name, overwrite=True) as staging, staging.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
