"""How safe and how good supervisors are where nobody tuned them: families of missions under both compositions, shield on and off.

A *cell* is one supervisor on one mission, under one composition, with a shield or without. Of every layout few numbers are kept.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from marlbc_mj.report.formats import fixed, interval, percent, significant
from marlbc_mj.report.table import Column, Table, to_markdown
from marlbc_mj.results.outcomes import MissionOutcome, intervened, outcome
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seeds import SeedRun
from marlbc_mj.results.statistics import Estimate, bootstrap, rate
from marlbc_mj.scenarios import Scenario, held_out, make_scenario
from marlbc_mj.scenarios.base import COMPOSITIONS
from marlbc_mj.studies.batches import evaluate_batch
from marlbc_mj.studies.draws import SEEDS_PER_JOB, with_drag_range
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.files import write_json
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance

GROUNDS = ("field", "forest", "gates", "corridor", "traffic")
"""Families with layouts to draw."""
DRAG_DRAWS = {"paper-drag-0": (0.0, 0), "paper-drag-2": (2.0, 67), "paper-drag-5": (5.0, 134)}
"""Draws around the case study: the factor of the drag and the first seed of each."""
DRAWS_EACH = 67
ORDER_GIVERS = ("fixed", "scripted", "fsams", "fsams-hysteresis", "fms", "set-based-rule", "lookahead", "mpcms", "rollout")
"""Supervisors whose orders are composed, under either composition."""
VELOCITY_GIVERS = ("layered", "motor-schema", "fuzzy-blend", "orca", "cbf-qp")
"""Supervisors that give velocities, so that the composition does not matter."""
SEARCHES = ("mpcms", "rollout")
"""Supervisors that take seconds a layout."""
OWN = "own"
"""In the place of a composition: the supervisor's own velocities."""
FIRST_SEED = 70_000


class Cell(NamedTuple):
    """One supervisor on one mission."""

    mission: str
    composition: str
    shield: bool
    supervisor: str


class SafetyJob(NamedTuple):
    """A cell on some seeds."""

    cell: Cell
    controller: str
    seeds: tuple[int, ...]


class LayoutMark(NamedTuple):
    """What is kept of one layout."""

    seed: int
    outcome: MissionOutcome
    intervened: bool
    total: float = np.nan  # return
    switches: int = 0  # of all agents
    effort: float = np.nan  # of all agents [N s]
    failure: str = ""


class Marks(NamedTuple):
    """The result of a job."""

    cell: Cell
    layouts: tuple[LayoutMark, ...]
    decision_ms: float  # median of the first layout flown alone: what one team takes for a decision [ms]


@dataclass(frozen=True)
class SafetyStudy:
    """Every supervisor on every mission, under every composition, without a shield and with one.

    Raises:
        ConfigurationError: no missions or supervisors, unknown ones, or numbers below 1.
    """

    missions: tuple[str, ...] = GROUNDS
    """Scenarios that draw layouts, of which held-out ones are taken, or draws of :data:`DRAG_DRAWS`."""
    supervisors: tuple[str, ...] = (*ORDER_GIVERS, *VELOCITY_GIVERS)
    compositions: tuple[str, ...] = COMPOSITIONS
    shields: tuple[bool, ...] = (False, True)
    layouts: int = 1000
    """Per cell; :data:`DRAG_DRAWS` have 67 each."""
    searched: int = 100
    """Per cell of a supervisor that searches."""
    seed: int = FIRST_SEED
    controller: str = "sorlc"

    def __post_init__(self) -> None:
        for name in ("missions", "supervisors", "compositions", "shields"):
            if not getattr(self, name):
                raise ConfigurationError(f"name at least one of {name}")
        for name in ("layouts", "searched"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {getattr(self, name)}")
        for composition in self.compositions:
            if composition not in COMPOSITIONS:
                raise unknown("composition", composition, COMPOSITIONS)
        for supervisor in self.supervisors:
            make_supervisor(supervisor, self.controller)
        for mission in self.missions:
            ground(mission)

    def cells(self) -> list[Cell]:
        """All cells, mission by mission; a supervisor that gives velocities has one composition."""
        return [
            Cell(mission, composition, shield, supervisor)
            for mission in self.missions
            for composition in (*self.compositions, OWN)
            for supervisor in self.supervisors
            if (composition == OWN) == (supervisor in VELOCITY_GIVERS)
            for shield in self.shields
        ]

    def jobs(self) -> list[SafetyJob]:
        return [
            SafetyJob(cell, self.controller, seeds[first : first + SEEDS_PER_JOB])
            for cell in self.cells()
            for seeds in [self._seeds(cell)]
            for first in range(0, len(seeds), SEEDS_PER_JOB)
        ]

    def _seeds(self, cell: Cell) -> tuple[int, ...]:
        count = min(self.layouts, self.searched) if cell.supervisor in SEARCHES else self.layouts
        first = self.seed
        if cell.mission in DRAG_DRAWS:
            count, first = min(count, DRAWS_EACH), DRAG_DRAWS[cell.mission][1]
        return tuple(range(first, first + count))

    def run(self, job: SafetyJob, watch: Watch) -> Marks:
        scenario, cell = ground(job.cell.mission), job.cell
        composition = None if cell.composition == OWN else cell.composition
        label = " ".join((cell.mission, cell.composition, "shielded" if cell.shield else "free", cell.supervisor))

        def fly(seeds: Sequence[int], progress: Progress) -> tuple[SeedRun, ...]:
            return evaluate_batch(
                scenario,
                seeds,
                cell.supervisor,
                job.controller,
                composition=composition,
                shield=cell.shield,
                progress=lambda _, done, of: progress(label, done, of),
            )

        (alone,), runs = fly(job.seeds[:1], silent), fly(job.seeds, watch.progress)
        decision_ms = np.nan if alone.metrics is None else alone.metrics["team"]["decision_ms_median"]
        return Marks(cell, tuple(mark(run, scenario) for run in runs), float(decision_ms))

    def report(self, results: Sequence[Marks], out: Path | None, progress: Progress = silent) -> Report:
        rows = [CellScores.of(cell, list(parts)) for cell, parts in groupby(results, lambda marks: marks.cell)]
        text = "\n".join(map(to_markdown, safety_tables(rows)))
        if out is not None:
            write_json(out / "config.json", {**provenance(), "study": self})
            write_cells(rows, out / "safety.csv")
            (out / "safety.md").write_text(text, encoding="utf-8")
        return Report(text)


def ground(name: str) -> Scenario:
    """The scenario of a mission: held-out layouts of a family, or draws around the case study.

    Raises:
        ConfigurationError: an unknown scenario, or one that draws no layouts.
    """
    if name in DRAG_DRAWS:
        drag = DRAG_DRAWS[name][0]
        return with_drag_range(make_scenario("paper"), (drag, drag))
    return held_out(make_scenario(name))


def mark(run: SeedRun, scenario: Scenario) -> LayoutMark:
    """What is kept of one layout."""
    ended, metrics = outcome(run.metrics, scenario), run.metrics
    if metrics is None:
        return LayoutMark(run.seed, ended, False, failure=str(run.failure))
    return LayoutMark(
        run.seed,
        ended,
        intervened(metrics),
        SCORES["return"].read(metrics),
        sum(agent["switches"] for agent in metrics["agents"]),
        SCORES["effort_integral_sum"].read(metrics),
    )


class CellScores(NamedTuple):
    """What a table says of a cell. Rates count a failure against the supervisor, medians leave it out."""

    cell: Cell
    layouts: int
    failed: int
    success: Estimate
    reached: Estimate
    violation: Estimate
    struck: Estimate
    collided: Estimate
    intervention: Estimate
    total: Estimate  # median return
    switches: float  # median, of all agents
    effort: float  # median, of all agents [N s]
    decision_ms: float
    reason: str  # of the first failure

    @classmethod
    def of(cls, cell: Cell, parts: Sequence[Marks]) -> "CellScores":
        """From the jobs of one cell."""
        layouts = [layout for part in parts for layout in part.layouts]
        flown = [layout for layout in layouts if not layout.failure]
        ended = [layout.outcome for layout in layouts]
        times = [part.decision_ms for part in parts if np.isfinite(part.decision_ms)]
        return cls(
            cell,
            len(layouts),
            len(layouts) - len(flown),
            rate([one.success for one in ended]),
            rate([one.reached for one in ended]),
            rate([one.violated for one in ended]),
            rate([one.struck for one in ended]),
            rate([one.collided for one in ended]),
            rate([layout.intervened for layout in layouts]),
            bootstrap([np.array([layout.total for layout in flown])]),
            _median([layout.switches for layout in flown]),
            _median([layout.effort for layout in flown]),
            _median(times),
            next((layout.failure for layout in layouts if layout.failure), ""),
        )

    @property
    def refused(self) -> bool:
        """Whether no layout was flown to its end."""
        return self.failed == self.layouts


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def write_cells(rows: Sequence[CellScores], path: Path) -> None:
    """A line per cell: shares in [0, 1] and medians, intervals beside them; empty where there is no number."""
    columns: list[tuple[str, list[str]]] = [(name, [str(row.cell[k]) for row in rows]) for k, name in enumerate(Cell._fields)]
    for name in CellScores._fields[1:]:
        values = [getattr(row, name) for row in rows]
        if rows and isinstance(values[0], Estimate):
            ends = zip((name, f"{name}_low", f"{name}_high"), zip(*values, strict=True), strict=True)
            columns += [(head, [_number(value) for value in column]) for head, column in ends]
        else:
            columns.append((name, [value if isinstance(value, str) else _number(value) for value in values]))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([head for head, _ in columns])
        writer.writerows(zip(*(cells for _, cells in columns), strict=True))


def _number(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""


def safety_tables(rows: Sequence[CellScores]) -> list[Table]:
    """One table per mission."""
    return [_mission_table(mission, list(each)) for mission, each in groupby(rows, lambda row: row.cell.mission)]


def _mission_table(mission: str, rows: Sequence[CellScores]) -> Table:
    columns = (
        Column("", "supervisor"),
        Column("", "composition"),
        Column("", "shield"),
        Column("", "layouts"),
        Column("success", "rate", "%"),
        Column("violation", "rate", "%"),
        Column("agents collided", "rate", "%"),
        Column("return", "team, median"),
        Column("switches", "sum, median"),
        Column("effort", "sum, median", "N s"),
        Column("decision", "median", "ms"),
    )
    flown = [row for row in rows if not row.refused]
    reasons = {row.reason: row.cell.supervisor for row in rows if row.refused}
    notes = tuple(f"Not flown: {supervisor}: {reason}." for reason, supervisor in reasons.items())
    return Table(f"safety-{mission}", mission, columns, tuple(map(_cells, flown)), notes)


def _cells(row: CellScores) -> tuple[str, ...]:
    rates = (interval(percent(one), 1) for one in (row.success, row.violation, row.collided))
    names = row.cell.supervisor, row.cell.composition, "yes" if row.cell.shield else "no"
    numbers = (interval(row.total, 0), fixed(row.switches, 0), fixed(row.effort, 0), significant(row.decision_ms, 2))
    return (*names, str(row.layouts), *rates, *numbers)
