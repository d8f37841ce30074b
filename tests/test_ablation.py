"""The questions of `marlbc ablation` on shorter runs: whether the basis learns, and what the other choices are worth."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from marlbc_mj.cli import main
from marlbc_mj.controllers import SORLC
from marlbc_mj.core.disturbances import PaperDrag
from marlbc_mj.scenarios import Scenario, cruise, paper
from marlbc_mj.studies.ablation import (
    QUESTIONS,
    AblationRow,
    AblationStudy,
    Case,
    Question,
    ablation_table,
    run_ablation,
    select_questions,
    write_ablation_page,
)
from marlbc_mj.studies.ablation.questions import _largest_changes, half_mission, variants
from marlbc_mj.util.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("coarse_figures")


def rows_of(question: Question) -> list[AblationRow]:
    """Run one question and return its rows."""
    return AblationStudy((question,)).rows(run_ablation([question]).results)[question.name][1]


def compare(scenario: Scenario) -> dict[str, AblationRow]:
    """Row of every variant of the controller in one scenario, by variant."""
    cases = [Case((name,), scenario, controller) for name, controller in variants().items()]
    study = replace(QUESTIONS["basis"], parameters=("controller",), block=0, cases=lambda: cases)
    return {row.settings[0]: row for row in rows_of(study)}


def shortened(question: Question, duration: float) -> Question:
    """The same question with every episode cut to ``duration`` [s]."""
    return replace(
        question, cases=lambda: [c._replace(scenario=replace(c.scenario, duration=duration)) for c in question.cases()]
    )


def test_scaled_learns_and_published_does_not() -> None:
    """At 20 times the drag, `scaled` has at most a fifth of the RMS velocity error of `off`, `published` has the same error."""
    rows = compare(cruise(disturbance=PaperDrag(20.0), duration=40.0))
    assert (rows["scaled"].first_over_this or 0.0) >= 5.0
    assert abs((rows["published"].first_over_this or 0.0) - 1.0) < 0.01


def test_nothing_beats_the_known_model() -> None:
    """On the mission's first half `scaled` gains at least a factor of 1.5, but less than perfect knowledge of the drag."""
    rows = compare(half_mission(20.0))
    assert 1.5 < (rows["scaled"].first_over_this or 0.0) < (rows["exact model"].first_over_this or 0.0)


def test_whole_case_study_cannot_be_flown_at_drag_20() -> None:
    """Even the exact model diverges within 2 s, as the table says: the cause is the force limit, not the identifier."""
    rows = list(compare(paper(disturbance=PaperDrag(20.0), duration=2.0)).values())
    assert all(row.figures is None and row.first_over_this is None for row in rows)
    assert all(row.failure.startswith("diverged: agent ") and "t = 1." in row.failure for row in rows)
    table = ablation_table(replace(QUESTIONS["basis"], parameters=("controller",), block=0), rows)
    assert [row[-1] for row in table.rows] == [row.failure for row in rows]
    assert table.notes[-1] == f"{len(rows)} of {len(rows)} rows have no figures."


@pytest.mark.slow
def test_default_gains_are_the_best_of_the_sweep() -> None:
    """`SORLC.scaled` has the gains with the smallest RMS velocity error of the sweep, and the table's note says so."""
    rows = rows_of(QUESTIONS["sweep"])
    best = max(rows, key=lambda row: row.first_over_this or 0.0)
    default = SORLC.scaled()
    assert best.settings == (f"{default.identifier_rate:g}", f"{default.width:g}")
    notes = ablation_table(QUESTIONS["sweep"], rows).notes
    assert f"Smallest error: rate {best.settings[0]}, width {best.settings[1]}; `sorlc-scaled` has rate" in notes[2]


def test_studies_cover_every_choice() -> None:
    """All combinations of basis, sign and drag scale; both reference modes; both sides; four substeps; no setting twice."""
    settings = {name: [case.settings for case in study.cases()] for name, study in QUESTIONS.items()}
    assert all(len(set(rows)) == len(rows) for rows in settings.values())
    signs = {(c.settings, c.controller.tau_sign) for c in QUESTIONS["sorlc"].cases() if isinstance(c.controller, SORLC)}
    assert {sign for (_, _, mark), sign in signs if mark == "+"} == {1}
    assert len(signs) == 4 * 3 * 2
    assert settings["reference"] == [("virtual",), ("actual",)]
    assert settings["avoidance"] == [("one-sided",), ("two-sided",)]
    assert [case.scenario.substep for case in QUESTIONS["substep"].cases()] == [0.010, 0.005, 0.002, 0.001]
    for study in QUESTIONS.values():
        assert all(len(case.settings) == len(study.parameters) for case in study.cases())


def test_rows_are_compared_within_their_block() -> None:
    """The first row of each drag scale has ratio 1; the effect of the sign compares rows that differ in nothing else."""
    study = shortened(QUESTIONS["sorlc"], 1.0)
    rows = rows_of(study)
    firsts = [row for k, row in enumerate(rows) if k == 0 or row.settings[0] != rows[k - 1].settings[0]]
    assert [row.settings for row in firsts] == [(scale, "off", "−") for scale in ("0", "1", "5", "20")]
    assert all(row.first_over_this == 1.0 for row in firsts)
    errors = {row.settings: row.figures.rms_velocity_error for row in rows if row.figures}
    pairs = [(errors[scale, basis, "−"], errors[scale, basis, "+"]) for scale, basis, _ in errors]
    worth = max(abs(minus - plus) / min(minus, plus) for minus, plus in pairs)
    assert _largest_changes(rows, 2)[0] == pytest.approx(worth)
    assert ablation_table(study, rows).rules == (6, 12, 18)


def test_a_substep_beyond_the_limit_is_a_row() -> None:
    """The refused substep is a row that names the limit; the other row has figures, but no ratio to the refused one."""
    cases: Sequence[Case] = [Case((f"{1e3 * h:g}",), paper(substep=h, duration=1.0), SORLC()) for h in (0.025, 0.005)]
    study = replace(QUESTIONS["substep"], cases=lambda: cases)
    refused, ran = rows_of(study)
    assert refused.failure.startswith("refused: substep 25 ms is beyond the stability limit 19.8 ms")
    assert ran.figures is not None
    assert ran.first_over_this is None
    assert "19.8 ms" in ablation_table(study, [refused, ran]).notes[2]


def test_page_and_csv_hold_every_row(tmp_path: Path) -> None:
    """Three files are written; the CSV has a column for every parameter of any study, and figures exact to the last bit."""
    studies = [shortened(QUESTIONS[name], 1.0) for name in ("reference", "avoidance", "substep")]
    results = {study.name: (study, rows_of(study)) for study in studies}
    write_ablation_page(results, tmp_path, {"revision": "<abc>"})
    assert {path.name for path in tmp_path.iterdir()} == {"ablation.md", "ablation.csv", "index.html"}
    with open(tmp_path / "ablation.csv", newline="", encoding="utf-8") as stream:
        lines = list(csv.DictReader(stream))
    rows = [row for _, made in results.values() for row in made]
    assert [float(line["effort_integral_N_s"]) for line in lines] == [row.figures.effort for row in rows if row.figures]
    assert [line["reference"] for line in lines] == ["virtual", "actual", *[""] * 6]
    text, page = (tmp_path / "ablation.md").read_text(), (tmp_path / "index.html").read_text()
    for study in studies:
        assert study.caption in text
        assert f'id="table-{study.name}"' in page
    assert "&lt;abc&gt;" in page
    assert "$" not in page


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A study writes into a folder; an unknown study, one named twice and a folder that is not empty give one-line errors."""
    out = tmp_path / "out"
    main(["ablation", "--study", "avoidance", "--out", str(out)])
    assert "two-sided" in capsys.readouterr().out
    wrong = {
        ("--study", "avoidance", "foo"): f"marlbc: unknown study 'foo'; choose from: {', '.join(QUESTIONS)}\n",
        ("--study", "sweep", "sweep"): "marlbc: a study is named twice: sweep, sweep\n",
        ("--out", str(out)): f"marlbc: output folder {out} is not empty; choose another or add --overwrite\n",
    }
    for arguments, said in wrong.items():
        with pytest.raises(SystemExit) as stopped:
            main(["ablation", *arguments])
        assert stopped.value.code == 2
        assert capsys.readouterr().err == said


def test_selection_keeps_the_order_given() -> None:
    assert [study.name for study in select_questions(("substep", "basis"))] == ["substep", "basis"]
    assert [study.name for study in select_questions(())] == list(QUESTIONS)
    with pytest.raises(ConfigurationError, match="twice"):
        select_questions(("basis", "basis"))
