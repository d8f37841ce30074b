"""Methods on common draws: pairing, independence of order, failures as outcomes, and the files that a report writes."""

import csv
import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.controllers import make_controller
from marlbc_mj.core.disturbances import ConstantWind, PaperDrag
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.report.seed_files import seed_summary, write_seed_csv
from marlbc_mj.report.seed_page import write_seed_report
from marlbc_mj.report.seed_tables import make_seed_tables
from marlbc_mj.report.table import to_latex, to_markdown
from marlbc_mj.report.tables import markdown
from marlbc_mj.report.templates import render
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seed_statistics import analyse, group, supervisor_of
from marlbc_mj.results.seeds import Instance, MethodRuns, SeedResults, SeedRun, seed_range
from marlbc_mj.results.summary import AGENT_KEYS, TEAM_KEYS
from marlbc_mj.scenarios import Perturbation, Scenario, paper
from marlbc_mj.studies.draws import CASE_STUDY_PERTURBATION, DrawsStudy, growing_page, perturbed, run_methods
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("coarse_figures")


def run_seeds(scenario, supervisors, controllers, seeds, progress=None, **options) -> SeedResults:
    """Run every supervisor with every controller."""
    return run_methods(scenario, list(product(supervisors, controllers)), seeds, progress, **options)


CLOCK = {"decision_ms_median", "decision_ms_p99"}
CONFIG = {"versions": {"mujoco": "3.17"}, "git_revision": "abc", "command": "marlbc bench paper --seeds 4 <&>"}


@pytest.fixture(scope="module")
def results() -> SeedResults:
    """Results of two supervisors and two controllers on four draws of two seconds."""
    return run_seeds(paper(duration=2.0), ("scripted", "fsams"), ("sorlc", "pd"), seed_range(4))


@pytest.fixture(scope="module")
def failing() -> SeedResults:
    """One method without failures, and one with failures inserted on the first and third of four seeds."""
    whole = run_seeds(paper(duration=1.0), ("scripted",), ("pd", "sorlc"), seed_range(4, first=3))
    runs = tuple(
        SeedRun(r.seed, r.instance, failure=f"seed {r.seed}: | 100% of <limit>\nsecond line") if k in (0, 2) else r
        for k, r in enumerate(whole.methods[1].runs)
    )
    return SeedResults(whole.scenario, whole.seeds, (whole.methods[0], MethodRuns("scripted", "sorlc", runs)), "scripted+pd")


def without_clock(run: SeedRun) -> object:
    """A run's scalars without its decision times."""
    assert run.metrics is not None
    return run.metrics["agents"], {key: value for key, value in run.metrics["team"].items() if key not in CLOCK}


def same(a: Instance, b: Instance) -> bool:
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in zip(a, b, strict=True))


def test_all_methods_see_the_same_draws_and_seeds_differ(results: SeedResults) -> None:
    for method in results.methods[1:]:
        assert all(same(a.instance, b.instance) for a, b in zip(method.runs, results.methods[0].runs, strict=True))
    first, second = (run.instance for run in results.methods[0].runs[:2])
    assert not np.array_equal(first.starts, second.starts) and not np.array_equal(first.obstacles, second.obstacles)
    assert first.disturbance_scale != second.disturbance_scale


def test_draws_stay_within_the_documented_ranges(results: SeedResults) -> None:
    scenario = results.scenario
    assert scenario.perturbation == CASE_STUDY_PERTURBATION == Perturbation(1.0, 0.5, (0.0, 2.0))
    for run in results.methods[0].runs:
        assert np.abs(run.instance.starts - scenario.starts).max() <= 1.0
        assert np.abs(run.instance.obstacles - scenario.obstacle_array()).max() <= 0.5
        assert 0.0 <= run.instance.disturbance_scale <= 2.0


def test_a_scenario_keeps_its_own_perturbation() -> None:
    own = paper(perturbation=Perturbation(start_spread=0.1))
    assert perturbed(own) == own and perturbed(paper()).perturbation == CASE_STUDY_PERTURBATION


def test_results_depend_on_neither_order_nor_company_nor_a_reused_world(results: SeedResults) -> None:
    """The methods and seeds reversed, and each episode alone in a fresh world, give the same scalars."""
    reverse = run_seeds(paper(duration=2.0), ("fsams", "scripted"), ("pd", "sorlc"), (3, 2, 1, 0))
    again = {(m.key, r.seed): without_clock(r) for m in reverse.methods for r in m.runs}
    assert again == {(m.key, r.seed): without_clock(r) for m in results.methods for r in m.runs}
    world = World(results.scenario, make_controller("pd"), record=True)
    alone = measure(run_episode(world, make_supervisor("fsams"), seed=2))
    assert alone["agents"] == results.methods[3].runs[2].metrics["agents"]  # type: ignore[index]


@pytest.mark.slow
def test_workers_change_nothing(results: SeedResults) -> None:
    """They change neither results nor the progress of a method, only the order in which methods alternate."""
    told = []
    shared = run_seeds(
        paper(duration=2.0),
        ("scripted", "fsams"),
        ("pd",),
        (0, 1),
        lambda what, done, total: told.append((what, done)),
        workers=2,
    )
    assert [m.key for m in shared.methods] == ["scripted+pd", "fsams+pd"] and len(told) == 4
    for key in ("scripted+pd", "fsams+pd"):  # the workers' progress arrives here, in order for each method
        assert [step for step in told if step[0] == key] == [(key, 1), (key, 2)]
    for method, here in zip(shared.methods, results.methods[1::2], strict=True):
        assert [without_clock(r) for r in method.runs] == [without_clock(r) for r in here.runs[:2]]


def test_progress_and_rows_grow_with_methods_times_seeds(results: SeedResults, tmp_path: Path) -> None:
    told = []
    small = run_seeds(paper(duration=0.5), ("scripted",), ("pd", "sorlc"), (5, 6, 7), lambda *step: told.append(step))
    assert told == [(key, k, 3) for key in ("scripted+pd", "scripted+sorlc") for k in (1, 2, 3)]
    for matrix, methods, seeds in ((small, 2, 3), (results, 4, 4)):
        with write_seed_csv(matrix, tmp_path / "episodes.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == methods * seeds * 4
        assert len({(row["supervisor"], row["controller"], row["seed"], row["agent"]) for row in rows}) == len(rows)


def test_divergence_is_an_outcome_on_every_seed_it_happens() -> None:
    """A drag a million times the published one drives every episode out of the physical range; each is reported as failed."""
    wild: Scenario = paper(duration=2.0, disturbance=PaperDrag(1e6))
    results = run_seeds(wild, ("scripted",), ("pd", "sorlc"), seed_range(3))
    for method in results.methods:
        assert [run.seed for run in method.failed] == [0, 1, 2] and len(method.runs) == 3
        assert all("world 0, agent" in str(run.failure) and run.violated for run in method.runs)
    methods = analyse(results)
    content = seed_summary(results, methods, {})
    assert content["methods"]["scripted+pd"]["violation_rate"] == 1.0
    assert set(content["methods"]["scripted+pd"]["failures"]) == {"0", "1", "2"}
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    return_table, *_, failures = make_seed_tables(results, methods)
    assert return_table.rows[1][:2] == ("SORLC", "failed")
    assert failures.rows[0] == ("Schedule + Saturated PD", "3/3", "0 to 2")


def test_a_limited_law_that_never_leaves_its_limit_has_failed() -> None:
    """A wind of 300 N exceeds the limit of 200 N; an unlimited law withstands it and finishes."""
    windy = paper(duration=5.0, disturbance=ConstantWind(force=(300.0, 0.0)), perturbation=Perturbation(start_spread=0.1))
    limited, unlimited = run_seeds(windy, ("scripted",), ("pd", "finite-time"), (0, 1)).methods
    assert all("saturated forever: agent 1, 2, 3, 4 at the force limit of 200 N" in str(run.failure) for run in limited.runs)
    assert not unlimited.failed


def test_failures_are_left_out_of_medians_and_count_as_violation_and_loss(failing: SeedResults) -> None:
    whole, half = analyse(failing)
    kept = [run.metrics["agents"][0]["effort_integral"] for run in half.runs.runs if run.metrics]
    assert half.agents[0]["effort_integral"].value == np.median(kept) and len(kept) == 2
    assert half.violation.value == 0.5 and whole.violation.value == 0.0
    assert half.improvement.value <= 0.5 and whole.improvement == (0.5, 0.5, 0.5)
    (together,) = group(failing, supervisor_of)
    assert (together.name, together.methods, together.draws) == ("scripted", 2, 2)
    assert together.violation.value == 0.25


def test_tables_name_who_failed_and_why(failing: SeedResults) -> None:
    tables = make_seed_tables(failing, analyse(failing))
    assert tables[-1].rows == (("Schedule + SORLC", "2/4", "3, 5"),)
    assert "Schedule + SORLC on seed 3: seed 3: | 100% of <limit> second line." in tables[-1].notes
    assert tables[1].rows[1][:2] == ("SORLC", "2/4")
    for table in tables:
        assert r"\toprule" in to_latex(table) and "?" not in to_latex(table)
        assert "<limit>" not in render("table.html", table=table) and "<limit>" not in to_markdown(table)


def test_summary_has_medians_with_intervals_beside_them(results: SeedResults) -> None:
    """Keys are those of one episode, each also with ``_ci``; every median equals NumPy's."""
    content = seed_summary(results, analyse(results), {"mujoco": "3.17"})
    assert content["schema"] == 1 and content["seeds"] == [0, 1, 2, 3] and content["reference"] == "scripted+sorlc"
    assert list(content["methods"]) == ["scripted+sorlc", "scripted+pd", "fsams+sorlc", "fsams+pd"]
    for method in results.methods:
        entry = content["methods"][method.key]
        assert set(entry["team"]) == {name for key in TEAM_KEYS for name in (key, f"{key}_ci")}
        assert len(entry["agents"]) == 4 and entry["failures"] == {} and entry["runs"] == 4
        for i, agent in enumerate(entry["agents"]):
            assert set(agent) == {name for key in AGENT_KEYS for name in (key, f"{key}_ci")}
            for key in AGENT_KEYS:
                values = [run.metrics["agents"][i][key] for run in method.runs]  # type: ignore[index,literal-required]
                low, high = agent[f"{key}_ci"]
                assert agent[key] == np.median(values) and min(values) <= low <= agent[key] <= high <= max(values)
        for name, score in SCORES.items():
            assert entry["scores"][name]["median"] == np.median([score.read(run.metrics) for run in method.runs if run.metrics])
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_one_draw_has_no_interval(tmp_path: Path) -> None:
    single = run_seeds(paper(duration=0.5), ("scripted",), ("pd",), seed_range(1))
    methods = analyse(single)
    assert seed_summary(single, methods, {})["methods"]["scripted+pd"]["team"]["return_ci"] == [None, None]
    assert "[" not in make_seed_tables(single, methods)[0].rows[0][1]
    write_seed_report(single, tmp_path, config=CONFIG)


def test_report_leaves_whole_files(failing: SeedResults, tmp_path: Path) -> None:
    """The folder has every file; the page names failures and needs no other file, and there is a figure."""
    page = write_seed_report(failing, tmp_path, config=CONFIG)
    names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {"summary.json", "episodes.csv", "tables.md", "tables.tex", "index.html"} | {
        f"figures/intervals.{kind}" for kind in ("pdf", "png")
    }
    text = page.read_text(encoding="utf-8")
    assert "2 of 4 runs failed" in text and "&lt;limit&gt;" in text and "--seeds 4 &lt;&amp;&gt;" in text
    assert "data:image/png;base64," in text and "http" not in text.split("<footer>")[0]
    with (tmp_path / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 4 * 4 and sum(bool(row["failure"]) for row in rows) == 2 * 4


def test_the_page_grows_as_methods_end(results: SeedResults, tmp_path: Path) -> None:
    """A method is shown once all its draws have ended; until the reference's have, the first finished method replaces it."""
    results = replace(results, methods=results.methods[:2])
    study = DrawsStudy(results.scenario, tuple((m.supervisor, m.controller) for m in results.methods), results.seeds)
    tell = growing_page(study, tmp_path, CONFIG)
    folder, shown = tmp_path / ".jobs" / "so_far", []
    for job, runs in reversed(list(zip(study.jobs(), results.methods, strict=True))):
        tell(job, runs)
        shown.append(re.findall(r"(\d) of 2 methods so far", (folder / "index.html").read_text()))
    assert shown == [["1"], ["2"]]
    assert (folder / "tables.md").read_text() == markdown(make_seed_tables(results, analyse(results)))
    assert {path.name for path in folder.iterdir()} == {"index.html", "tables.md"}


def test_report_without_figures(failing: SeedResults, tmp_path: Path) -> None:
    page = write_seed_report(failing, tmp_path, config=CONFIG, figures=False)
    assert not (tmp_path / "figures").exists() and "Not drawn" in page.read_text(encoding="utf-8")


def test_a_method_that_cannot_start_is_a_row_on_every_seed(tmp_path: Path) -> None:
    """The oracle has no schedule for a draw, and a step of 25 ms is too long for some laws; the other methods run."""
    methods = [("scripted", "lqr"), ("oracle", "lqr"), ("scripted", "pd")]
    results = run_methods(paper(duration=0.5, substep=0.025), methods, (0, 1))
    ran, oracle, unstable = results.methods
    assert not ran.failed
    assert all("no schedule" in str(run.failure) for run in oracle.runs) and len(oracle.runs) == 2
    assert all("25 ms" in str(run.failure) and run.instance is None for run in unstable.runs)
    statistics = analyse(results)
    assert [row[:2] for row in make_seed_tables(results, statistics)[-1].rows] == [
        ("Oracle + LQR", "2/2"),
        (unstable.display, "2/2"),
    ]
    write_seed_report(results, tmp_path, config=CONFIG, figures=False)
    assert "no schedule" in (tmp_path / "tables.md").read_text()


def test_captions_flag_too_few_draws(results: SeedResults) -> None:
    """Four draws give intervals that are too narrow, and every caption states it."""
    tables = make_seed_tables(results, analyse(results))
    assert all("(only 4 draws: intervals are too narrow)" in table.caption for table in tables)


def test_groups_are_shown_only_where_two_can_be_compared(results: SeedResults, failing: SeedResults) -> None:
    """One supervisor with two controllers gives a single pooled row, with nothing to compare."""
    assert "seeds-groups" in [table.name for table in make_seed_tables(results, analyse(results))]
    assert "seeds-groups" not in [table.name for table in make_seed_tables(failing, analyse(failing))]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: seed_range(0), "seeds must be at least 1, got 0"),
        (lambda: seed_range(2**63), "seeds must be at most 10000000 in one run, got 9223372036854775808"),
        (lambda: seed_range(3, first=-1), "seed must not be negative, got -1"),
        (lambda: run_seeds(paper(), (), ("pd",), (0,)), "at least one supervisor"),
        (lambda: run_seeds(paper(), ("scripted",), ("pd",), ()), "at least one seed"),
        (lambda: run_seeds(paper(), ("scripted",), ("pd",), (1, 1)), r"got \[1, 1\]"),
        (lambda: run_seeds(paper(), ("scripted", "scripted"), ("pd",), (0,)), "named twice"),
        (lambda: run_seeds(paper(), ("nobody",), ("pd",), (0,)), "unknown supervisor 'nobody'; choose from: scripted"),
        (lambda: run_seeds(paper(), ("scripted",), ("nothing",), (0,)), "unknown controller 'nothing'"),
        (
            lambda: run_seeds(paper(), ("scripted",), ("pd",), (0,), reference="a+b"),
            "'a\\+b' is not among the methods; choose from: scripted",
        ),
        (lambda: run_seeds(paper(), ("scripted",), ("pd",), (0,), workers=0), "workers must be at least 1, got 0"),
    ],
)
def test_bad_input_is_one_line(call, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        call()
