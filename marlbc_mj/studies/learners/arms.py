"""Ablations of the general policy, one change at a time, each trained on several seeds and flown on held-out layouts.

The values of different learners have different scales, so a common switching margin would favor some of them. Each policy is
flown with the margin of MARGINS with which it succeeds most often on a few validation layouts, which are not part of the results.
There is no dwell time and no deadline, so that the results show what was learned.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from marlbc_mj.policies.general import GeneralPolicy, mean_policy
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.figures import save_figure
from marlbc_mj.report.formats import fixed
from marlbc_mj.report.table import Column, Table, to_markdown, write_rows
from marlbc_mj.results.seeds import seed_range
from marlbc_mj.scenarios.teams import read_team, team_mission
from marlbc_mj.studies.learners.records import lines_by
from marlbc_mj.studies.protocol import Report, Stopped, Watch
from marlbc_mj.training.general.config import DRAWN, JUDGED_WITH, GeneralConfig
from marlbc_mj.training.general.judging import VALIDATION_SEED, Judge
from marlbc_mj.training.general.run import make_general_trainer
from marlbc_mj.util.errors import ConfigurationError, check_named_once, unknown
from marlbc_mj.util.files import write_json
from marlbc_mj.util.palette import METHOD_COLORS
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance


class Arm(NamedTuple):
    """One way to train the general policy."""

    title: str
    line: str
    changes: Mapping[str, Any] = {}


ARMS: dict[str, Arm] = {
    "full": Arm("VDN, the default", "one TD error for the mean of a team's values"),
    "no-pooling": Arm("no pooling", "an agent hears nobody", {"hide": ("pooled",)}),
    "no-lanes": Arm("no lanes", "no clearance along the lanes of the slots, own or heard", {"hide": ("lanes",)}),
    "no-ways": Arm("no ways", "no clearance of the ways to the slots, own or heard", {"hide": ("ways",)}),
    "no-consensus": Arm("no consensus", "every agent decides by its own values", {"consensus": False}),
    "hysteretic": Arm(
        "hysteretic", "every agent learns by itself, and half of each negative TD error counts", {"learner": "hysteretic"}
    ),
    "lenient": Arm("lenient", "every agent learns by itself, and overlooks some negative TD errors", {"learner": "lenient"}),
    "plain": Arm("plain", "every agent learns by itself, and all TD errors count", {"learner": "plain"}),
    "qmix": Arm("QMIX", "one TD error for a monotonic mixture of the team's values", {"learner": "qmix"}),
    # random actions switch all the time, so a switch cost teaches agents never to switch, which they do not unlearn
    "mappo": Arm(
        "MAPPO",
        "one actor for all agents, a critic that sees the team, and no cost of a switch",
        {"learner": "mappo", "switch_cost": 0.0},
    ),
    "imitation": Arm(
        "imitation alone",
        "no rewards; in all episodes the look-ahead that guides a quarter is imitated",
        {"learner": "imitation"},
    ),
    "no-guide": Arm("no guide", "no episodes under a look-ahead", {"guided": 0.0}),
    "no-joint-exploration": Arm("no joint exploration", "every agent explores by itself", {"together": 0.0}),
    "no-switch-cost": Arm("no switch cost", "a switch costs nothing while learning", {"switch_cost": 0.0}),
    "all-heard": Arm("no silent agents", "no episodes with a silent agent", {"silent": 0.0}),
    "null-space": Arm(
        "null-space composition",
        "learns and flies under the composition of the paper: an agent also decides whether avoidance is on top",
        {"composition": "null-space"},
    ),
    "two-families": Arm("two families", "gates and corridor alone", {"families": ("gates", "corridor", "gates", "corridor")}),
    **{
        f"without-{left}": Arm(
            f"without {left}", f"never trained on {left}", {"families": tuple(f for f in GeneralConfig().families if f != left)}
        )
        for left in DRAWN
    },
}
"""All arms by name; each of the last five leaves out one family."""
MISSIONS = (*((family, "wedge-4", "straight") for family in DRAWN), ("corridor", "grid-9", "line"))
"""The missions on which every policy is flown: family, team and approach to the column."""
MARGINS = (0.0, 0.05, 0.3)
"""Switching margins that are tried for every policy."""
TRIED = 8
"""Number of validation layouts per mission on which the margins are tried."""


class ArmJob(NamedTuple):
    """One training run, and the layouts on which its policy is flown."""

    arm: str
    config: GeneralConfig
    first: int  # seed of the first layout of every mission
    layouts: int


class ArmScore(NamedTuple):
    """Outcomes of one policy on one mission: numbers of layouts, successes and violations, medians of return and switches."""

    mission: str
    layouts: int
    succeeded: int
    violated: int
    total: float  # median return
    switches: float  # median, per agent
    margin: float  # switching margin of the policy


@dataclass(frozen=True)
class ArmStudy:
    """Study that trains every arm on seeds 1 to ``seeds`` and flies all policies on the same held-out layouts.

    Each policy is the last one of its training run, with the switching margin of MARGINS that is best on validation layouts.

    Raises:
        ConfigurationError: an unknown or repeated arm, or a number below 1.
    """

    arms: tuple[str, ...] = ()
    """Names in ARMS; empty: all arms."""
    seeds: int = 5
    budget: int = 400_000
    """Mission steps per training run."""
    layouts: int = 40
    """Number of held-out layouts per mission."""
    first: int = 70_000
    """Seed of the first held-out layout."""

    def __post_init__(self) -> None:
        for name in self.arms:
            if name not in ARMS:
                raise unknown("arm", name, ARMS)
        check_named_once("arm", self.arms)
        if self.layouts < 1:
            raise ConfigurationError(f"layouts must be at least 1, got {self.layouts}")
        self.jobs()  # raises if a number is invalid

    def jobs(self) -> list[ArmJob]:
        """All training runs, seed by seed, so that a stopped study has results of all arms."""
        return [
            ArmJob(name, GeneralConfig(**ARMS[name].changes, seed=seed, budget=self.budget), self.first, self.layouts)
            for seed in seed_range(self.seeds, 1)
            for name in self.arms or ARMS
        ]

    def run(self, job: ArmJob, watch: Watch) -> list[ArmScore]:
        trainer = make_general_trainer(job.config)
        while not trainer.finished:
            trainer.advance()
            if watch.stopping():
                raise Stopped
        policy = trainer.policy()
        composition = job.config.composition
        judges = _judges(TRIED, composition)
        tried = {margin: _fly(policy, margin, judges, VALIDATION_SEED) for margin in MARGINS}
        best = max(tried, key=lambda margin: _standing(tried[margin]))
        return _fly(policy, best, _judges(job.layouts, composition), job.first)

    def report(self, results: Sequence[list[ArmScore]], out: Path | None, progress: Progress = silent) -> Report:
        """Write arms.csv, arms.md, arms.pdf, arms.png and config.json."""
        rows = [
            {"arm": job.arm, "seed": job.config.seed, "mission_steps": job.config.budget, **flown._asdict()}
            for job, flights in zip(self.jobs(), results, strict=True)
            for flown in flights
        ]
        text = to_markdown(arms_table(rows))
        if out is not None:
            write_rows(rows, out / "arms.csv")
            (out / "arms.md").write_text(text + "\n", encoding="utf-8")
            save_figure(lambda: draw_arms(rows), out / "arms")
            write_json(out / "config.json", {"study": self, **provenance()})
        return Report(text, rows)


def _judges(layouts: int, composition: str) -> dict[str, Judge]:
    """One judge per mission under the given composition, by family and team."""
    return {
        f"{family}, {team}": Judge(
            team_mission(family, *read_team(team), composition=composition, split="test", column_approach=approach),
            JUDGED_WITH,
            layouts,
        )
        for family, team, approach in MISSIONS
    }


def _fly(policy: GeneralPolicy, margin: float, judges: Mapping[str, Judge], first: int) -> list[ArmScore]:
    """Fly all missions from seed ``first`` on with the given switching margin, without the policy's dwell time and deadline."""
    flown = mean_policy([policy], margin)
    return [ArmScore(mission, *judge.score(flown, first), margin) for mission, judge in judges.items()]


def _standing(scores: Sequence[ArmScore]) -> tuple[int, float]:
    """Sort key with the best last: by successes, then by returns."""
    return sum(score.succeeded for score in scores), sum(score.total for score in scores)


def _missions(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Names of all missions, and of the first of them, one per family."""
    missions = list(dict.fromkeys(row["mission"] for row in rows))
    return missions, missions[: len(DRAWN)]


def success_of_seeds(lines: Sequence[Mapping[str, Any]], missions: Sequence[str]) -> list[float]:
    """Success rate of every training run over the given missions together [%]."""
    shares = []
    for seed in dict.fromkeys(row["seed"] for row in lines):
        own = [row for row in lines if row["seed"] == seed and row["mission"] in missions]
        shares.append(100.0 * sum(row["succeeded"] for row in own) / sum(row["layouts"] for row in own))
    return shares


def arms_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """A table with a row per arm: mean success [%] over its seeds, for all families and per mission, and all violations."""
    missions, families = _missions(rows)
    arms, cells = lines_by("arm", ARMS, rows), []
    for name, lines in arms.items():
        every = success_of_seeds(lines, families)
        each = [fixed(float(np.mean(success_of_seeds(lines, [mission]))), 1) for mission in missions]
        violated, flights = (sum(row[key] for row in lines) for key in ("violated", "layouts"))
        spread = f"{np.mean(every):.1f} [{min(every):.1f}, {max(every):.1f}]"
        cells.append((ARMS[name].title, str(len(every)), spread, *each, f"{violated} of {flights}"))
    columns = (
        *(Column("", "arm"), Column("", "trainings"), Column("five families", "mean (least to greatest)", "%")),
        *(Column("success", mission, "%") for mission in missions),
        Column("", "violated"),
    )
    notes = tuple(f"{ARMS[name].title}: {ARMS[name].line}" for name in arms)
    return Table("arms", "Ablations of the general policy", columns, tuple(cells), notes)


def draw_arms(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Figure of the failures over the five families: one line per arm, a dot per training run, a bar at the mean."""
    arms, (_, families) = lines_by("arm", ARMS, rows), _missions(rows)
    figure = Figure(figsize=(pl.SINGLE, 0.55 + 0.17 * len(arms)), layout="constrained")
    axes = figure.add_subplot(xlabel="layouts that failed [%]")
    for k, lines in enumerate(arms.values()):
        failed = [100.0 - share for share in success_of_seeds(lines, families)]
        axes.plot(failed, [k] * len(failed), "o", color=METHOD_COLORS[0], markersize=3, alpha=0.6, markeredgewidth=0)
        axes.plot(np.mean(failed), k, "|", color=METHOD_COLORS[1], markersize=9, markeredgewidth=1.4)
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_xticks([0, 0.5, 1, 10, 100], ["0", "0.5", "1", "10", "100"])
    axes.set_xlim(-0.08, 110)
    axes.set_yticks(range(len(arms)), [ARMS[name].title for name in arms])
    axes.set_ylim(len(arms) - 0.5, -0.5)
    axes.grid(axis="x", linewidth=0.3)
    return figure
