"""The safety study: its cells, their scores in its tables, and the command."""

import csv
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.results.layouts import CellScores, LayoutMark, Marks, MissionCell, mark
from marlbc_mj.results.outcomes import FAILED_MISSION, MissionOutcome
from marlbc_mj.scenarios import Scenario, held_out, make_scenario
from marlbc_mj.scenarios.base import COMPOSITIONS
from marlbc_mj.studies import safety
from marlbc_mj.studies.protocol import Watch
from marlbc_mj.studies.safety import (
    DRAG_DRAWS,
    DRAWS_EACH,
    SEARCHES,
    SafetyStudy,
    ground,
)
from marlbc_mj.supervisors import OWN, VELOCITY_SUPERVISORS
from marlbc_mj.util.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("coarse_figures")

GOOD = MissionOutcome(reached=True, violated=False, struck=False, collided=False)
CELL = MissionCell("field", "set-based", False, "fixed")


def test_every_layout_of_every_cell_is_in_one_job() -> None:
    """Supervisors that output velocities have one composition; searches fly fewer layouts."""
    study = SafetyStudy(layouts=250, searched=20)
    jobs = pickle.loads(pickle.dumps(study)).jobs()
    cells = study.cells()
    assert len(set(jobs)) == len(jobs) and len(set(cells)) == len(cells)
    assert [cell for job in jobs for cell in job.cells if job.seeds[0] == study.seed] == cells
    for cell in cells:
        seeds = [seed for job in jobs if cell in job.cells for seed in job.seeds]
        assert seeds == list(range(80_000, 80_000 + (20 if cell.supervisor in SEARCHES else 250)))
        assert (cell.composition == OWN) == (cell.supervisor in VELOCITY_SUPERVISORS)
    assert {cell.composition for cell in cells} == {*COMPOSITIONS, OWN}


@pytest.mark.parametrize(("supervisor", "composition", "touched"), [("fixed", "set-based", False), ("fsams", "null-space", True)])
def test_a_layout_that_the_shield_leaves_alone_is_flown_once(
    supervisor: str, composition: str, touched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its reported results without a shield are identical to those of flying it without one."""
    short = make_scenario("paper", duration=20.0) if touched else held_out(make_scenario("field", duration=2.0))
    monkeypatch.setattr(safety, "ground", lambda name: short)
    flown: list[tuple[bool, int]] = []
    fly = safety.evaluate_batch

    def counted(scenario: Scenario, seeds: Any, *names: str, shield: bool, **rest: Any) -> Any:
        flown.extend((shield, seed) for seed in seeds)
        return fly(scenario, seeds, *names, shield=shield, **rest)

    monkeypatch.setattr(safety, "evaluate_batch", counted)
    study = SafetyStudy(("field",), (supervisor,), (composition,), layouts=2)
    (job,) = study.jobs()
    both = study.run(job, Watch())
    assert [marks.cell.shield for marks in both] == [False, True]
    for marks in both:
        runs = fly(short, job.seeds, supervisor, composition=composition, shield=marks.cell.shield)
        assert marks.layouts == tuple(mark(run, short) for run in runs)
    assert [one.intervened for one in both[1].layouts] == [touched] * 2
    assert flown.count((True, job.seeds[1])) == 1 and ((False, job.seeds[1]) in flown) == touched


def test_draws_around_the_case_study_are_the_published_ones() -> None:
    """There are 67 consecutive seeds for each drag."""
    jobs = SafetyStudy(missions=tuple(DRAG_DRAWS), supervisors=("fsams",), shields=(False,), compositions=("null-space",)).jobs()
    assert [seed for job in jobs for seed in job.seeds] == list(range(3 * DRAWS_EACH))
    for name, (drag, _) in DRAG_DRAWS.items():
        assert ground(name).perturbation.drag_scale == (drag, drag)


def test_layouts_are_held_out() -> None:
    assert ground("gates") == make_scenario("gates", split="test")


def test_scores_of_a_cell_are_those_of_its_layouts() -> None:
    """A failure counts against the supervisor in every rate and is left out of medians."""
    late = GOOD._replace(reached=False)
    layouts = (
        LayoutMark(0, GOOD, True, 100.0, 4, 10.0),
        LayoutMark(1, late, False, 50.0, 2, 30.0),
        LayoutMark(2, FAILED_MISSION, False, failure="no plan"),
    )
    scores = CellScores.of(CELL, [Marks(CELL, layouts[:2], 1.0), Marks(CELL, layouts[2:], np.nan)])
    assert (scores.layouts, scores.failed, scores.switches, scores.effort, scores.decision_ms) == (3, 1, 3.0, 20.0, 1.0)
    rates = (scores.success, scores.reached, scores.violation, scores.struck, scores.collided, scores.intervention)
    assert [round(3 * share.value) for share in rates] == [1, 1, 1, 1, 1, 1]
    assert scores.total.value == 75.0 and scores.reason == "no plan" and not scores.refused


def test_the_command_writes_tables_and_all_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One supervisor outputs orders, one refuses and one outputs velocities, each with and without a shield."""
    out = tmp_path / "safety"
    names = ["fixed", "scripted", "orca"]
    main(["safety", "field", "--supervisors", *names, "--compositions", "set-based", "--layouts", "1", "--out", str(out)])
    said = capsys.readouterr().out
    assert "| Fixed priority | set-based | yes | 1 |" in said and "Not run: Schedule: scenario 'field' has no schedule" in said
    with (out / "safety.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["supervisor"], row["composition"], row["shield"]) for row in rows] == [
        (name, composition, shield)
        for name, composition in (("fixed", "set-based"), ("scripted", "set-based"), ("orca", OWN))
        for shield in ("False", "True")
    ]
    fixed = next(row for row in rows if row["composition"] == "set-based" and row["shield"] == "True")
    assert fixed["success"] == "1" and 0.0 < float(fixed["success_low"]) < 1.0 == float(fixed["success_high"])
    assert all(row["failed"] == "1" and "no schedule" in row["reason"] for row in rows if row["supervisor"] == "scripted")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"missions": ()}, "at least one of missions"),
        ({"missions": ("paper",)}, "draws no layouts"),
        ({"missions": ("jungle",)}, "unknown scenario 'jungle'"),
        ({"supervisors": ("nobody",)}, "unknown supervisor 'nobody'"),
        ({"compositions": ("mixed",)}, "unknown composition 'mixed'"),
        ({"layouts": 0}, "layouts must be at least 1, got 0"),
    ],
)
def test_wrong_settings_of_the_study_are_refused(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        SafetyStudy(**setting)
