"""Results on many layouts: the few numbers kept per layout, and the scores computed from them.

A *cell* is one supervisor on one mission, under one composition, with a shield or without.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marlbc_mj.results.outcomes import MissionOutcome, intervened, outcome
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seeds import SeedRun
from marlbc_mj.results.statistics import Estimate, bootstrap, rate
from marlbc_mj.scenarios import Scenario


class MissionCell(NamedTuple):
    """One supervisor on one mission, under one composition, with a shield or without."""

    mission: str
    composition: str
    shield: bool
    supervisor: str


class LayoutMark(NamedTuple):
    """The numbers kept from a run on one layout."""

    seed: int
    outcome: MissionOutcome
    intervened: bool
    total: float = np.nan  # return
    switches: int = 0  # sum over agents
    effort: float = np.nan  # sum over agents [N s]
    failure: str = ""


def mark(run: SeedRun, scenario: Scenario) -> LayoutMark:
    """The numbers kept from a run."""
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


class Marks(NamedTuple):
    """The results of one job on one cell."""

    cell: MissionCell
    layouts: tuple[LayoutMark, ...]
    decision_ms: float  # median over mission steps of the decision time, from the first layout run alone [ms]


class CellScores(NamedTuple):
    """The scores of a cell for tables. Rates count a failed run against the supervisor; medians leave it out."""

    cell: MissionCell
    layouts: int
    failed: int
    success: Estimate
    reached: Estimate
    violation: Estimate
    struck: Estimate
    collided: Estimate
    intervention: Estimate
    total: Estimate  # median return
    switches: float  # median of the sum over agents
    effort: float  # median of the sum over agents [N s]
    decision_ms: float
    reason: str  # reason of the first failure

    @classmethod
    def of(cls, cell: MissionCell, parts: Sequence[Marks]) -> "CellScores":
        """The scores of a cell from the results of its jobs."""
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
        """Whether the runs on all layouts failed."""
        return self.failed == self.layouts


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")
