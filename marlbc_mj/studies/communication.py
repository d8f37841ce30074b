"""The cost of imperfect communication for a distributed supervisor, and the time that agents need to agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.communication import Communication
from marlbc_mj.report.table import Column, Table, to_markdown, write_rows
from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.outcomes import outcome_rates
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.formations import column, grid
from marlbc_mj.studies.draws import DrawsJob, fly_draws
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.supervisors.communication import Consensus, Flooding, Layer, Radio
from marlbc_mj.util.files import write_json
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance

RANGES = (np.inf, 2.0, 1.2)  # in multiples of the neighbor distance
DELAYS = (0.0, 0.1, 0.3)  # [s]
LOSSES = (0.0, 0.2, 0.5)


class NetworkCase(NamedTuple):
    """Communication of a team in one row of the table."""

    range: float  # in multiples of the neighbor distance
    delay: float  # [s]
    loss: float  # share of messages
    silent: bool = False  # whether the first agent never sends

    def settings(self, scenario: Scenario) -> Communication:
        """The communication settings for the team of a scenario, with the range in metres."""
        reach = self.range * neighbor_distance(scenario)
        return Communication(range=reach, delay=self.delay, loss=self.loss, silent=(0,) if self.silent else ())


CASES = (
    *(NetworkCase(*numbers) for numbers in product(RANGES, DELAYS, LOSSES)),
    NetworkCase(np.inf, 0.0, 0.0, silent=True),
    NetworkCase(1.2, 0.1, 0.2, silent=True),
)
"""Every combination of range, delay and loss; then a silent agent under good and under poor communication."""


def neighbor_distance(scenario: Scenario) -> float:
    """Greatest distance from a slot of the first formation to its nearest neighbor [m]."""
    slots = scenario.formations[0]
    gaps = np.linalg.norm(slots[:, None] - slots[None], axis=-1) + np.diag(np.full(len(slots), np.inf))
    return float(gaps.min(axis=1).max())


@dataclass(frozen=True)
class CommunicationStudy:
    """One distributed supervisor in every :class:`NetworkCase` on the same draws of every mission."""

    missions: tuple[Scenario, ...]
    supervisor: str
    seeds: tuple[int, ...]
    controller: str = "sorlc"
    shield: bool = False
    cases: tuple[NetworkCase, ...] = CASES

    def __post_init__(self) -> None:
        make_supervisor(self.supervisor, self.controller)
        self.jobs()  # raises for a case that a mission does not support

    def pairs(self) -> list[tuple[Scenario, NetworkCase]]:
        """The mission and case of every job."""
        return list(product(self.missions, self.cases))

    def jobs(self) -> list[DrawsJob]:
        flown = [replace(mission, communication=case.settings(mission)) for mission, case in self.pairs()]
        return [DrawsJob(scenario, self.supervisor, self.controller, self.seeds, self.shield) for scenario in flown]

    def run(self, job: DrawsJob, watch: Watch) -> list[Metrics | None]:
        return [run.metrics for run in fly_draws(job, watch.progress).runs]

    def report(self, results: Sequence[list[Metrics | None]], out: Path | None, progress: Progress = silent) -> Report:
        rows = [case_row(mission, case, metrics) for (mission, case), metrics in zip(self.pairs(), results, strict=True)]
        if out is not None:
            write_rows(rows, out / "communication.csv")
            facts = {"supervisor": self.supervisor, "controller": self.controller, "seeds": self.seeds, "shield": self.shield}
            write_json(out / "config.json", {**facts, "missions": self.missions, **provenance()})
        return Report(to_markdown(case_table(rows)), rows)


def case_row(mission: Scenario, case: NetworkCase, metrics: Sequence[Metrics | None]) -> dict[str, Any]:
    """The numbers of one row; success and violation come with Wilson intervals."""
    rates = outcome_rates(metrics, mission)
    flown = [one for one in metrics if one is not None]
    shares = {name: rates[name] for name in ("success", "violation", "reached", "collided")}
    return {
        "mission": mission.name,
        **case._asdict(),
        "runs": len(metrics),
        **{name: share.value for name, share in shares.items()},
        **{f"{name}_{end}": getattr(shares[name], end) for name in ("success", "violation") for end in ("low", "high")},
        "switches": float(np.mean([sum(agent["switches"] for agent in one["agents"]) for one in flown])) if flown else np.nan,
        "return": float(np.median([one["team"]["return"] for one in flown])) if flown else np.nan,
    }


def case_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Rows of :func:`case_row`, formatted as a table."""
    columns = (
        *(Column("", name, unit) for name, unit in (("mission", ""), ("range", "neighbor distances"), ("delay", "s"))),
        *(Column("", name, unit) for name, unit in (("loss", "%"), ("silent", ""), ("success", "%"), ("violation", "%"))),
        *(Column("", name) for name in ("reached", "switches per team", "median return")),
    )
    cells = []
    for row in rows:
        success, violation = (
            f"{100 * row[name]:.1f} [{100 * row[f'{name}_low']:.0f}, {100 * row[f'{name}_high']:.0f}]"
            for name in ("success", "violation")
        )
        reach = "full" if row["range"] == np.inf else f"{row['range']:g}"
        network = reach, f"{row['delay']:g}", f"{100 * row['loss']:g}", "agent 1" if row["silent"] else "–"
        counts = f"{row['runs'] * row['reached']:.0f} of {row['runs']}", f"{row['switches']:.1f}", f"{row['return']:.0f}"
        cells.append((row["mission"], *network, success, violation, *counts))
    return Table("communication", "A distributed supervisor under worse and worse communication", columns, tuple(cells))


# Agreement ----------------------------------------------------------------------------------------------------------------------

TEAMS = (
    ("16 agents in a grid, neighbors 6 m apart", grid(16, 6.0), 9.0),
    ("64 agents in a grid, neighbors 6 m apart", grid(64, 6.0), 9.0),
    ("64 agents in a column, 3 m apart", column(grid(64, 6.0), 3.0), 4.0),
)
"""Name, positions (N, 2) [m] and range [m] of teams at rest."""
RATE = 0.05  # between two broadcasts [s]
AGREED = 0.01  # consensus is reached when every estimate is this close to the mean position [m]
PATIENCE = 4000  # mission steps after which the measurement gives up


def time_to_agree(place: np.ndarray, settings: Communication, seed: int = 0) -> float:
    """Time until agents at positions (N, 2) [m] that broadcast their own agree [s]; infinite beyond ``PATIENCE``.

    Under flooding every agent must know all positions; under consensus every estimate of their mean must be within ``AGREED``.
    """
    radio = Radio(settings, len(place), RATE)
    layer: Layer = Consensus(radio) if settings.protocol == "consensus" else Flooding(radio)
    memory, mean = layer.start(1, 2), place.mean(axis=0)
    for k in range(PATIENCE):
        (heard, stamp), memory = layer.exchange(np.array([k * RATE]), place[None], place[None], memory, np.array([seed]))
        flooded = settings.protocol == "flooding" and np.isfinite(stamp).all()
        close = settings.protocol == "consensus" and np.linalg.norm(heard[0, :, 0] - mean, axis=-1).max() <= AGREED
        if flooded or close:
            return k * RATE
    return float("inf")


def agreement_table() -> Table:
    """Times to agree under both protocols for all ``TEAMS``, without loss and with a fifth of the messages lost."""
    rows = []
    for (name, place, reach), loss in product(TEAMS, (0.0, 0.2)):
        times = [
            time_to_agree(place, Communication(protocol=protocol, range=reach, loss=loss))
            for protocol in ("flooding", "consensus")
        ]
        shown = (f"{seconds:.2f}" if np.isfinite(seconds) else f"> {PATIENCE * RATE:.0f}" for seconds in times)
        rows.append((name, f"{reach:g}", f"{100 * loss:g}", *shown))
    columns = (Column("", "team"), Column("", "range", "m"), Column("", "loss", "%"))
    times_to = (Column("time to agree", "flooding", "s"), Column("time to agree", "consensus, to 1 cm", "s"))
    return Table("agreement", "Time to agree, one broadcast every 0.05 s", (*columns, *times_to), tuple(rows))
