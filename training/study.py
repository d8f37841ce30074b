"""A study of learners: its variants, and what their runs came to as CSV files, a table and a figure."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.errors import ConfigurationError, unknown
from marlbc_mj.files import staged_file
from marlbc_mj.metrics import measure
from marlbc_mj.palette import AGENT_COLORS
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.formats import DASH, fixed, grouped, interval
from marlbc_mj.report.table import Column, Table, to_latex, to_markdown
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.statistics import Estimate, Statistic, bootstrap, iqm, median
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.training.config import CARE, METHODS, PRESETS, TrainConfig, from_json, make_config
from marlbc_mj.training.run import rank

DONE, FAILED = "DONE", "FAILED"
GOAL_SWITCHES = (4, 2, 2, 4)
"""Switches per agent that meet the goal on the case study; with no violation and at least the scripted supervisor's return."""
UNFINISHED = "unfinished"
"""The failure of a run that was interrupted and can go on."""

WIDE = 6
"""Variants of a group at most, and panels side by side in the figure."""
REFERENCE = "marlms"
"""The variant that every panel shows beside its own."""
COLOR, REFERENCE_COLOR, FAILED_COLOR = AGENT_COLORS[0], "#9A9A9A", "#C8102E"
_GOAL: dict[str, Any] = {"color": AGENT_COLORS[1], "marker": "v", "markersize": 3, "linestyle": "none"}
_END: dict[str, Any] = {"color": FAILED_COLOR, "marker": "x", "markersize": 4, "linestyle": "none"}

Record = dict[str, str]
"""A line of a CSV file: what is shown of a run is exactly what its file says."""
COLUMNS = (
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
"""Of study.csv. Switches per agent, clearances in m, times in s; ``goal_*`` is empty for a run that never met the goal."""
CURVE_COLUMNS = ("variant", "seed", "mission_steps", "return", "violation_time", "switches")
"""Of curves.csv: violation of the worst agent [s], switches of the whole team."""


@dataclass(frozen=True)
class Variant:
    """One way to learn: a method and a preset with changes. A group has at most ``WIDE`` variants, a row of the figure."""

    line: str
    group: str
    """What it is compared for: learner, preset or rival."""
    method: str = "marlms"
    preset: str = "fast"
    changes: Mapping[str, Any] = field(default_factory=dict)

    def config(self, seed: int, budget: int) -> TrainConfig:
        """The run's configuration, on one thread, so that runs do not compete for cores."""
        changes = {**METHODS[self.method][0], **self.changes, "method": self.method, "seed": seed, "budget": budget}
        return make_config(self.preset, **changes, threads=1)


_UNCENTRED = {"shaping": replace(PRESETS["fast"][0].shaping, centre=0.0)}
VARIANTS: dict[str, Variant] = {
    "marlms": Variant("MARLMS with the fast preset", "learner"),
    "no-leniency": Variant("every negative TD error counts", "learner", "iql"),
    "no-averaging": Variant("targets from one past network", "learner", changes={"copies": 1}),
    "no-dueling": Variant("Q-values straight from the last layer", "learner", changes={"dueling": False}),
    "plain-hash": Variant("states hashed as they are, without auto-encoder", "learner", changes={"hash": "plain"}),
    "no-risk": Variant("no learned risks: an own cost makes the policy careful", "learner", changes=CARE),
    "no-exploring-starts": Variant("every episode begins at the mission's start", "preset", changes={"exploring_starts": 0.0}),
    "no-held-exploration": Variant(
        "a random order lasts one decision, of one agent", "preset", changes={"hold": 1, "together": 0.0}
    ),
    "printed-state": Variant("the printed state", "preset", changes={"state": "printed"}),
    "no-centring": Variant("rewards are not centred", "preset", changes=_UNCENTRED),
    "paper": Variant("the printed hyper-parameters, state, reward and orders", "preset", preset="paper"),
    "hysteretic": Variant("a negative TD error counts half", "rival", "hysteretic"),
    "vdn": Variant("value decomposition", "rival", "vdn"),
    "qmix": Variant("monotonic mixture of values", "rival", "qmix"),
    "central": Variant("one network over joint orders", "rival", "central"),
    "rlms": Variant("single agents side by side", "rival", "rlms"),
    "mappo": Variant("multi-agent PPO", "rival", "mappo"),
}
"""Method, preset and changes by name."""


def read_json(path: Path, key: str) -> Any:
    """An entry of a JSON object; ConfigurationError where the file holds none."""
    try:
        return json.loads(path.read_text())[key]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(f"cannot read {key} from {path}: {error}") from error


@cache
def scripted_return(scenario: str, controller: str) -> float:
    """Return of the scripted supervisor on the scenario, to the six digits of eval.csv; the goal for learned ones."""
    world = World(make_scenario(scenario), make_controller(controller), record=True)
    return float(f"{measure(run_episode(world, make_supervisor('scripted', controller)))['team']['return']:.6g}")


def collect(out: Path) -> tuple[list[Record], list[Record]]:
    """Lines of study.csv and curves.csv from all runs in the study's folder, also those of earlier calls.

    Raises:
        ConfigurationError: a file of a run that cannot be read.
    """
    rows: list[Record] = []
    curves: list[Record] = []
    for name in VARIANTS:
        for folder in sorted((p for p in (out / name).glob("*") if p.name.isdigit()), key=lambda p: int(p.name)):
            failed = (folder / FAILED).is_file()
            if not failed and not (folder / "config.json").is_file():
                continue
            config = from_json(read_json(folder / (FAILED if failed else "config.json"), "train"))
            ended = read_json(folder / FAILED, "failure") if failed else "" if (folder / DONE).is_file() else UNFINISHED
            evaluations = read_csv(folder / "eval.csv", ("return",)) if (folder / "eval.csv").is_file() else []
            rows.append(_row(name, config, evaluations, ended))
            for e in evaluations:
                team = f"{sum(float(s) for s in _switches(e)):.0f}"
                line = (name, str(config.seed), e["mission_steps"], e["return"], e["violation_time"], team)
                curves.append(dict(zip(CURVE_COLUMNS, line, strict=True)))
    return rows, curves


def _row(name: str, config: TrainConfig, evaluations: Sequence[Record], failure: str) -> Record:
    goal = scripted_return(config.scenario, config.controller)
    row = dict.fromkeys(COLUMNS, "")
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


def meets_goal(evaluation: Record, least_return: float) -> bool:
    """Whether no agent violates, none switches more than GOAL_SWITCHES says, and the return is not below the goal's."""
    few = [float(s) <= limit for s, limit in zip(_switches(evaluation), GOAL_SWITCHES, strict=False)]
    return all(few) and float(evaluation["violation_time"]) == 0.0 and float(evaluation["return"]) >= least_return


def _switches(evaluation: Record) -> list[str]:
    return [value for key, value in evaluation.items() if key.startswith("switches_")]


def read_csv(path: Path, columns: Sequence[str]) -> list[Record]:
    """Lines of a CSV file that has at least these columns; ConfigurationError where it does not."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = [dict(line) for line in csv.DictReader(file)]
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error
    if not lines or any(line.get(column) is None for line in lines for column in columns):
        raise ConfigurationError(f"{path} is no file of a study: it needs lines with columns {', '.join(columns)}")
    return lines


def read_study(folder: Path) -> tuple[list[Record], list[Record]]:
    """What :func:`write_csvs` wrote.

    Raises:
        ConfigurationError: study.csv or curves.csv is missing, torn, or names an unknown variant.
    """
    rows = read_csv(folder / "study.csv", COLUMNS)
    curves = read_csv(folder / "curves.csv", CURVE_COLUMNS) if any(row["wall_s"] for row in rows) else []
    for line in (*rows, *curves):
        if line["variant"] not in VARIANTS:
            raise unknown("variant", line["variant"], VARIANTS)
        texts = [text for key, text in line.items() if key not in ("variant", "failure")]
        if not all(_is_number(part) for text in texts for part in text.split("/") if part):
            raise ConfigurationError(f"a line of {folder} is no record of a study: {', '.join(line.values())}")
    return rows, curves


def _is_number(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def write_csvs(folder: Path, rows: Sequence[Record], curves: Sequence[Record]) -> None:
    """study.csv, a line a run, and curves.csv, a line an evaluation."""
    for name, columns, lines in (("study.csv", COLUMNS, rows), ("curves.csv", CURVE_COLUMNS, curves)):
        with staged_file(folder / name, overwrite=True) as staging, staging.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)


def write_report(folder: Path, rows: Sequence[Record], curves: Sequence[Record]) -> None:
    """study.md, study.tex, curves.pdf and curves.png, from the lines of the CSV files alone."""
    table = study_table(rows)
    figure_note = "`curves.pdf`: median and range over the runs that got that far; violation is linear below 0.1 s.\n"
    named = "".join(f"- `{name}`: {VARIANTS[name].line}\n" for name in by_variant(rows))
    for name, text in (("study.md", f"{to_markdown(table)}\n{named}\n{figure_note}"), ("study.tex", to_latex(table) + "\n")):
        with staged_file(folder / name, overwrite=True) as staging:
            staging.write_text(text, encoding="utf-8")
    with pl.style():
        figure = draw_curves(rows, curves)
        for name, metadata in (("curves.pdf", {"CreationDate": None}), ("curves.png", {})):
            with staged_file(folder / name, overwrite=True) as staging:
                figure.savefig(staging, metadata=metadata)


def by_variant(lines: Sequence[Record]) -> dict[str, list[Record]]:
    """Lines by variant, in the order of VARIANTS."""
    found = {name: [line for line in lines if line["variant"] == name] for name in VARIANTS}
    return {name: lines for name, lines in found.items() if lines}


def study_table(rows: Sequence[Record]) -> Table:
    """A row a variant: how many runs met the goal and when, their best evaluation and their last."""
    labels: tuple[tuple[str, str], ...] = (
        ("", "runs"),
        ("goal", "met"),
        ("goal", "steps [10⁶]"),
        ("goal", "time [min]"),
        ("best", "return, median"),
    )
    labels += ("best", "return, IQM"), ("best", "violation [s]"), ("best", "switches"), ("last", "return, IQM")
    runs = by_variant(rows)
    groups = [VARIANTS[name].group for name in runs]
    budgets = " and ".join(grouped(b) for b in sorted({int(row["budget"]) for row in rows}))
    goals = " and ".join(f"{g:.0f}" for g in sorted({float(row["goal_return"]) for row in rows}))
    notes = [
        f"Goal: no violation, at most {'/'.join(map(str, GOAL_SWITCHES))} switches, and at least the scripted supervisor's "
        f"return, {goals}; a run that never meets it counts as ∞. Budget: {budgets} mission steps, one thread a run.",
        "Medians and interquartile means (IQM) over runs, with 95 % bootstrap intervals, too narrow for so few runs. Best and "
        "last evaluation: of runs that ended well. Violation of the worst agent, switches of the team.",
        *(f"{row['variant']} seed {row['seed']}: {row['failure']}" for row in rows if row["failure"]),
    ]
    return Table(
        "study",
        "Learners of mission supervisors on the case study",
        (Column("", "variant"), *(Column(*label) for label in labels)),
        tuple((name, *_cells(lines)) for name, lines in runs.items()),
        tuple(notes),
        tuple(k for k in range(1, len(groups)) if groups[k] != groups[k - 1]),
    )


def _cells(rows: Sequence[Record]) -> tuple[str, ...]:
    ended = [row for row in rows if row["failure"] != UNFINISHED]
    well = [row for row in rows if not row["failure"]]

    def of(column: str, statistic: Statistic = median) -> Estimate:
        return bootstrap([np.array([float(row[column]) for row in well])], statistic)

    def until(column: str, unit: float) -> Estimate:
        return bootstrap([np.array([float(row[column] or inf) for row in ended]) / unit])

    switches = bootstrap([np.array([sum(map(float, row["best_switches"].split("/"))) for row in well])])
    return (
        str(len(ended)) if len(ended) == len(well) else f"{len(ended)}, {len(ended) - len(well)} failed",
        f"{sum(bool(row['goal_mission_steps']) for row in ended)} of {len(ended)}",
        _until(until("goal_mission_steps", 1e6), 2),
        _until(until("goal_wall_s", 60.0), 1),
        interval(of("best_return"), 0),
        interval(of("best_return", iqm), 0),
        interval(of("best_violation_time"), 2),
        fixed(switches.value, 0),
        interval(of("final_return", iqm), 0),
    )


def _until(estimate: Estimate, digits: int) -> str:
    """``value [low, high]`` where any of them may be infinite."""
    if np.isnan(estimate.value):
        return DASH
    value, low, high = ("∞" if number == inf else fixed(number, digits) for number in estimate)
    return value if np.isnan(estimate.low) or value == low == high else f"{value} [{low}, {high}]"


def draw_curves(rows: Sequence[Record], curves: Sequence[Record]) -> Figure:
    """Return and violation time against mission steps, a pair of panels a variant on common axes; a row a group of variants."""
    runs, evaluations = by_variant(rows), by_variant(curves)
    blocks = [[name for name in runs if VARIANTS[name].group == g] for g in dict.fromkeys(VARIANTS[n].group for n in runs)]
    blocks = [list(runs)] if len(runs) <= WIDE else blocks
    columns = max(3, *map(len, blocks))
    left, right, top, bottom, gap, inner, between = 0.48, 0.1, 0.42, 0.36, 0.1, 0.09, 0.46
    heights = 0.85, 0.6
    width = (pl.DOUBLE - left - right - (columns - 1) * gap) / columns
    block = sum(heights) + inner
    total = top + bottom + len(blocks) * block + (len(blocks) - 1) * between
    figure = Figure(figsize=(pl.DOUBLE, total))
    returns = [float(line["return"]) / 1e3 for line in curves] + [float(row["goal_return"]) / 1e3 for row in rows]
    high = max(1.0, *returns)
    limits = {
        "return": (max(min(*returns, 0.0), -high) - 0.08 * high, 1.16 * high),
        "violation_time": (-0.012, 1.6 * max([1.0, *(float(line["violation_time"]) for line in curves)])),
    }
    steps = max([float(line["mission_steps"]) for line in curves] + [max(float(row["budget"]) for row in rows)]) / 1e6
    for b, names in enumerate(blocks):
        for c, name in enumerate(names):
            corner = total - top - b * (block + between)
            for key, height in zip(limits, heights, strict=True):
                corner -= height
                at = ((left + c * (width + gap)) / pl.DOUBLE, corner / total, width / pl.DOUBLE, height / total)
                axes = figure.add_axes(at, xlim=(0, 1.03 * steps), ylim=limits[key])
                corner -= inner
                _draw_panel(
                    axes, key, runs[name], evaluations.get(name, []), [] if name == REFERENCE else evaluations.get(REFERENCE, [])
                )
                axes.tick_params(labelleft=c == 0, labelbottom=key == "violation_time")
                if key == "return":
                    axes.set_title(name, loc="left", fontsize=6.5)
                if c == 0:
                    axes.set_ylabel({"return": "return [10³]", "violation_time": "violation [s]"}[key])
                    axes.yaxis.set_label_coords(-0.36 / width, 0.5, transform=axes.transAxes)
    figure.supxlabel("mission steps [10⁶]", fontsize=8, y=0.0, va="bottom")
    pl.legend_above(figure, _handles(), columnspacing=1.0)
    return figure


def _draw_panel(axes: Axes, key: str, rows: Sequence[Record], curves: Sequence[Record], reference: Sequence[Record]) -> None:
    unit = 1e3 if key == "return" else 1.0
    for lines, color, span in ((reference, REFERENCE_COLOR, False), (curves, COLOR, True)):
        at = sorted({float(line["mission_steps"]) for line in lines})
        values = [[float(line[key]) / unit for line in lines if float(line["mission_steps"]) == step] for step in at]
        x = np.array(at) / 1e6
        if span and values:
            axes.fill_between(x, [min(v) for v in values], [max(v) for v in values], color=color, alpha=0.25, linewidth=0)
        axes.plot(x, [np.median(v) for v in values], color=color, linewidth=1.0 if span else 0.8)
    if key == "return":
        axes.axhline(float(rows[0]["goal_return"]) / unit, color=pl.GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
        met = [float(row["goal_mission_steps"]) / 1e6 for row in rows if row["goal_mission_steps"]]
        axes.plot(met, [0.97] * len(met), **_GOAL, transform=axes.get_xaxis_transform(), clip_on=False)
        failed = sum(row["failure"] not in ("", UNFINISHED) for row in rows)
        ended = sum(row["failure"] != UNFINISHED for row in rows)
        axes.text(0.97, 0.04, f"goal {len(met)} of {ended}", transform=axes.transAxes, ha="right", fontsize=6.5)
        if failed:
            axes.text(0.97, 0.2, f"{failed} failed", transform=axes.transAxes, ha="right", fontsize=6.5, color=FAILED_COLOR)
    else:
        axes.set_yscale("symlog", linthresh=0.1, linscale=0.8)
        axes.set_yticks([0, 0.1, 1, 10], ["0", "0.1", "1", "10"])
    for row in rows:
        if row["failure"] not in ("", UNFINISHED) and row["final_mission_steps"]:
            value = float(row[f"final_{key}"]) / unit
            axes.plot(float(row["final_mission_steps"]) / 1e6, np.clip(value, *axes.get_ylim()), **_END, clip_on=False)


def _handles() -> list[Line2D | Patch]:
    return [
        Line2D([], [], color=COLOR, label="median"),
        Patch(color=COLOR, alpha=0.25, linewidth=0, label="range of runs"),
        Line2D([], [], color=REFERENCE_COLOR, label=f"median of {REFERENCE}"),
        Line2D([], [], color=pl.GREY, linewidth=0.6, linestyle=(0, (3, 2)), label="scripted supervisor"),
        Line2D([], [], **_GOAL, label="a run meets the goal"),
        Line2D([], [], **_END, label="a run fails"),
    ]
