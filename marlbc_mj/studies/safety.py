"""Safety and performance of supervisors on missions that they were not tuned for: mission families under both compositions, with
and without a shield.

Only a few numbers are kept per layout, see :mod:`marlbc_mj.results.layouts`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from marlbc_mj.report.safety_tables import safety_tables, write_cells
from marlbc_mj.report.table import to_markdown
from marlbc_mj.results.layouts import CellScores, LayoutMark, Marks, MissionCell, mark
from marlbc_mj.results.seeds import SeedRun, seed_range
from marlbc_mj.scenarios import FAMILIES, Scenario, held_out, make_scenario
from marlbc_mj.scenarios.base import COMPOSITIONS
from marlbc_mj.scenarios.teams import read_team, team_mission
from marlbc_mj.studies.batches import evaluate_batch
from marlbc_mj.studies.draws import SEEDS_PER_JOB, with_drag_range
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.supervisors import OWN, VELOCITY_SUPERVISORS, make_supervisor
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.files import write_json
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance

MISSION_FAMILIES = ("field", "forest", "gates", "corridor", "traffic")
"""Mission families that draw layouts."""
DRAG_DRAWS = {"paper-drag-0": (0.0, 0), "paper-drag-2": (2.0, 67), "paper-drag-5": (5.0, 134)}
"""Draws around the case study: drag factor and first seed of each."""
DRAWS_EACH = 67
ORDER_SUPERVISORS = (
    "fixed",
    "scripted",
    "fsams",
    "fsams-hysteresis",
    "fms",
    "set-based-rule",
    "lookahead",
    "lookahead-distributed",
    "mpcms",
    "rollout",
    "marlms",
    "marlms-general",
)
"""Supervisors that give orders, run under either composition; the last one supports the set-based composition only."""
SEARCHES = ("mpcms", "rollout")
"""Supervisors that take about a second per layout."""
LINES = "-lines"
"""Suffix of the name of a team that approaches its column along the lines of its slots."""
FIRST_SEED = 80_000


class SafetyJob(NamedTuple):
    """The cells of one supervisor on some layouts of one mission under one composition; they differ only in the shield."""

    cells: tuple[MissionCell, ...]
    controller: str
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class SafetyStudy:
    """Every supervisor on every mission, under every composition, without a shield and with one.

    Raises:
        ConfigurationError: an empty setting, an unknown name, or a number below 1.
    """

    missions: tuple[str, ...] = MISSION_FAMILIES
    """Scenarios that draw layouts, of which the held-out ones are used, or keys of :data:`DRAG_DRAWS`."""
    supervisors: tuple[str, ...] = (*ORDER_SUPERVISORS, *VELOCITY_SUPERVISORS)
    compositions: tuple[str, ...] = COMPOSITIONS
    shields: tuple[bool, ...] = (False, True)
    layouts: int = 1000
    """Layouts per cell; at most 67 for missions of :data:`DRAG_DRAWS`."""
    searched: int = 100
    """Layouts per cell of a supervisor of :data:`SEARCHES`, at most."""
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

    def cells(self) -> list[MissionCell]:
        """All cells, mission by mission; supervisors that give velocities run under their own composition only."""
        return [
            MissionCell(mission, composition, shield, supervisor)
            for mission in self.missions
            for composition in (*self.compositions, OWN)
            for supervisor in self.supervisors
            if (composition == OWN) == (supervisor in VELOCITY_SUPERVISORS)
            for shield in self.shields
        ]

    def jobs(self) -> list[SafetyJob]:
        return [
            SafetyJob(tuple(cells), self.controller, seeds[first : first + SEEDS_PER_JOB])
            for _, group in groupby(self.cells(), lambda cell: cell._replace(shield=False))
            for cells in [list(group)]
            for seeds in [self._seeds(cells[0])]
            for first in range(0, len(seeds), SEEDS_PER_JOB)
        ]

    def _seeds(self, cell: MissionCell) -> tuple[int, ...]:
        count = min(self.layouts, self.searched) if cell.supervisor in SEARCHES else self.layouts
        first = self.seed
        if cell.mission in DRAG_DRAWS:
            count, first = min(count, DRAWS_EACH), DRAG_DRAWS[cell.mission][1]
        return seed_range(count, first)

    def run(self, job: SafetyJob, watch: Watch) -> tuple[Marks, ...]:
        """Marks of every cell. A run in which the shield never acts is identical to one without it, so its layout runs once."""
        first = job.cells[0]
        alone = fly_cell(first, job.controller, job.seeds[:1], silent)[0]
        decision_ms = np.nan if alone.metrics is None else float(alone.metrics["team"]["decision_ms_median"])
        untouched: dict[int, LayoutMark] = {}
        marks: dict[MissionCell, Marks] = {}
        for cell in sorted(job.cells, key=lambda cell: not cell.shield):
            rest = [seed for seed in job.seeds if seed not in untouched]
            runs = fly_cell(cell, job.controller, rest, watch.progress)
            flown = {run.seed: mark(run, ground(cell.mission)) for run in runs}
            marks[cell] = Marks(cell, tuple((flown | untouched)[seed] for seed in job.seeds), decision_ms)
            untouched = {seed: one for seed, one in flown.items() if not (one.intervened or one.failure)}
        return tuple(marks[cell] for cell in job.cells)

    def report(self, results: Sequence[tuple[Marks, ...]], out: Path | None, progress: Progress = silent) -> Report:
        parts: dict[MissionCell, list[Marks]] = {}
        for marks in chain.from_iterable(results):
            parts.setdefault(marks.cell, []).append(marks)
        rows = [CellScores.of(cell, each) for cell, each in parts.items()]
        text = "\n".join(map(to_markdown, safety_tables(rows)))
        if out is not None:
            write_json(out / "config.json", {**provenance(), "study": self})
            write_cells(rows, out / "safety.csv")
            (out / "safety.md").write_text(text, encoding="utf-8")
        return Report(text, rows)


def fly_cell(cell: MissionCell, controller: str, seeds: Sequence[int], progress: Progress) -> tuple[SeedRun, ...]:
    """Run the layouts of a cell with these seeds; no runs for no seeds."""
    if not seeds:
        return ()
    label = " ".join((cell.mission, cell.composition, "shielded" if cell.shield else "free", display_name(cell.supervisor)))
    return evaluate_batch(
        ground(cell.mission),
        seeds,
        cell.supervisor,
        controller,
        composition=None if cell.composition == OWN else cell.composition,
        shield=cell.shield,
        progress=lambda _, done, of: progress(label, done, of),
    )


def ground(name: str) -> Scenario:
    """The scenario of a mission: held-out layouts of a family (``gates``) or of a family with a team (``gates-grid-9``, see
    :mod:`marlbc_mj.scenarios.teams`), or draws around the case study. A team with the suffix ``-lines`` approaches its column
    along the lines of its slots.

    Raises:
        ConfigurationError: an unknown scenario or team, or a scenario that draws no layouts.
    """
    if name in DRAG_DRAWS:
        drag = DRAG_DRAWS[name][0]
        return with_drag_range(make_scenario("paper"), (drag, drag))
    family, _, team = name.partition("-")
    if team and family in FAMILIES:
        approach = "line" if team.endswith(LINES) else "straight"
        return held_out(team_mission(family, *read_team(team.removesuffix(LINES)), column_approach=approach))
    return held_out(make_scenario(name))
