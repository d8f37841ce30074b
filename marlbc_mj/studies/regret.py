"""The share of the best known return that supervisors reach, with the best schedule of every layout found by an offline search.

The search knows the layout and simulates every candidate schedule to its end, see :mod:`marlbc_mj.supervisors.oracle`. It starts
from the best schedule that a supervisor flew, so it never ends with a worse one. Its result is a lower bound of the best possible
return.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.report.formats import fixed
from marlbc_mj.report.table import Column, Table, to_markdown, write_rows
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seeds import seed_range
from marlbc_mj.scenarios import Obstacle, Perturbation, Scenario, held_out, make_scenario
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.supervisors.oracle import POPULATION, search, windows_of
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import write_json
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance


class RegretJob(NamedTuple):
    """One layout, with the supervisors to run on it and the budget of the search."""

    mission: str
    seed: int
    supervisors: tuple[str, ...]
    controller: str
    budget: int


class LayoutReturns(NamedTuple):
    """Returns reached on one layout."""

    best: float  # of the best known schedule without a violation
    flown: tuple[float, ...]  # of each supervisor, with or without violations


@dataclass(frozen=True)
class RegretStudy:
    """Supervisors and a search on held-out layouts of families with obstacles at rest, under the set-based composition.

    Raises:
        ConfigurationError: no or unknown missions or supervisors, obstacles that move, no layouts, or a budget below one
            population.
    """

    missions: tuple[str, ...] = ("field", "forest", "gates", "corridor")
    supervisors: tuple[str, ...] = ("marlms-general", "rollout", "lookahead", "fixed")
    layouts: int = 50
    seed: int = 90_000
    """Seed of the first layout."""
    budget: int = 512
    """Episodes that the search may simulate on each layout."""
    controller: str = "sorlc"

    def __post_init__(self) -> None:
        if not self.missions or not self.supervisors:
            raise ConfigurationError("name at least one mission and one supervisor")
        if self.budget < POPULATION:
            raise ConfigurationError(f"budget must be at least {POPULATION}, one population, got {self.budget}")
        make_controller(self.controller)
        for name in self.missions:
            scenario = frozen(_mission(name), self.seed)
            for supervisor in self.supervisors:
                make_supervisor(supervisor).start(scenario, 1)
        seed_range(self.layouts, self.seed)

    def jobs(self) -> list[RegretJob]:
        """All jobs, ordered by layout first, so that a stopped study covers all missions."""
        return [
            RegretJob(mission, seed, self.supervisors, self.controller, self.budget)
            for seed in seed_range(self.layouts, self.seed)
            for mission in self.missions
        ]

    def run(self, job: RegretJob, watch: Watch) -> LayoutReturns:
        scenario = frozen(_mission(job.mission), job.seed)
        world = World(scenario, make_controller(job.controller), record=True)
        flown = []
        for name in job.supervisors:
            trajectory = run_episode(world, make_supervisor(name))
            metrics = measure(trajectory)
            safe = SCORES["violation_time_worst"].read(metrics) == 0.0
            flown.append((safe, SCORES["return"].read(metrics), trajectory.command))
        start = windows_of(max(flown, key=itemgetter(0, 1))[2], scenario)
        found = search(scenario, job.controller, seed=job.seed, budget=job.budget, start=start)
        return LayoutReturns(found.total, tuple(total for _, total, _ in flown))

    def report(self, results: Sequence[LayoutReturns], out: Path | None, progress: Progress = silent) -> Report:
        """Write regret.csv, regret.md and config.json."""
        rows = [
            {
                "mission": job.mission,
                "seed": job.seed,
                "best": result.best,
                **dict(zip(self.supervisors, result.flown, strict=True)),
            }
            for job, result in zip(self.jobs(), results, strict=True)
        ]
        text = to_markdown(regret_table(rows, self.supervisors))
        if out is not None:
            write_rows(rows, out / "regret.csv")
            (out / "regret.md").write_text(text + "\n", encoding="utf-8")
            write_json(out / "config.json", {"study": self, **provenance()})
        return Report(text, rows)


def frozen(scenario: Scenario, seed: int) -> Scenario:
    """The instance that a seed draws, as a scenario in which nothing is random.

    Raises:
        ConfigurationError: the scenario has obstacles that move, which the search cannot plan around.
    """
    draw = scenario.draw_of(seed)
    if len(draw.motions):
        raise ConfigurationError(f"mission {scenario.name!r} has moving obstacles; the search needs obstacles at rest")
    return replace(
        scenario,
        starts=tuple((x, y) for x, y in draw.starts.tolist()),
        obstacles=tuple(Obstacle(*each) for each in draw.obstacles.tolist()),
        layout=None,
        perturbation=Perturbation(),
    )


def regret_table(rows: Sequence[dict[str, Any]], supervisors: Sequence[str]) -> Table:
    """Per mission: the median best known return, and each supervisor's median and least share of the best of a layout."""
    cells = []
    for mission in dict.fromkeys(row["mission"] for row in rows):
        lines = [row for row in rows if row["mission"] == mission]
        shares = [np.array([100.0 * row[name] / row["best"] for row in lines]) for name in supervisors]
        each = (f"{np.median(share):.1f} [{share.min():.1f}]" for share in shares)
        cells.append((mission, str(len(lines)), fixed(float(np.median([row["best"] for row in lines])), 0), *each))
    columns = (
        *(Column("", "mission"), Column("", "layouts"), Column("best known return", "median")),
        *(Column("share of the best", display_name(name), "%") for name in supervisors),
    )
    notes = (
        "Shares are medians over layouts, in brackets the least. Schedules violate nowhere; supervisors count as they flew.",
    )
    return Table("regret", "Return against the best schedule that a search found for each layout", columns, tuple(cells), notes)


def _mission(name: str) -> Scenario:
    return held_out(make_scenario(name, composition="set-based"))
