"""The report package: files follow their schema, tables hold the metrics, figures have their size, the page is self-contained."""

import csv
import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from importlib import resources
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from jinja2 import UndefinedError
from PIL import Image

from marlbc_mj.cli.terminal import print_results, result_line
from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.report import curves, figures, paper_values, plotting
from marlbc_mj.report.arena import trajectories
from marlbc_mj.report.bundle import write_report
from marlbc_mj.report.findings import claims, oracle_gap, predictions, same_actuator
from marlbc_mj.report.formats import significant, spans
from marlbc_mj.report.page import write_benchmark_page
from marlbc_mj.report.paper_values import order_mark
from marlbc_mj.report.pareto import pareto
from marlbc_mj.report.so_far import write_so_far
from marlbc_mj.report.table import Column, Table, latex, to_latex, to_markdown
from marlbc_mj.report.tables import latex_document, make_tables, markdown
from marlbc_mj.report.templates import render
from marlbc_mj.results.metrics import AgentMetrics, TeamMetrics
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.summary import Result, summary, write_csv
from marlbc_mj.scenarios import paper
from marlbc_mj.studies.so_far import PartialPage
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.method_names import display_name

HEADINGS = {
    *("return, team", "switches, each agent", "violation, worst agent [s]"),
    *("clearance, worst agent [m]", "effort, sum [N s]"),
}
"""Headings of the columns that the terminal shows."""
REASON = "world 0, agent 3, t = 1.25 s: force | 100% of <limit> & more_so\nsecond line"


@pytest.fixture(scope="module")
def results() -> list[Result]:
    """Three short episodes and a failure."""
    made = []
    for names in (("scripted", "sorlc"), ("scripted", "pd"), ("fsams", "sorlc")):
        world = World(paper(duration=3.0), make_controller(names[1]), record=True)
        made.append(Result.of(run_episode(world, make_supervisor(names[0]), names=names)))
    return [*made, Result.failed("mpcms", "sorlc", REASON)]


@pytest.fixture(scope="module")
def drawn(results: list[Result], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """Figures of a method that ran and one that failed."""
    folder = tmp_path_factory.mktemp("report") / "figures"
    return folder, figures.write_figures([results[0], results[3]], folder)


def test_summary_has_the_schema_and_no_nan(results: list[Result]) -> None:
    """Keys are those of the metrics and scores, a failed method has its reason, and strict JSON can express it all."""
    content = summary(results, "paper", {"mujoco": "3.17"})
    assert set(content) == {"schema", "scenario", "versions", "methods"} and content["schema"] == 1
    assert list(content["methods"]) == ["scripted+sorlc", "scripted+pd", "fsams+sorlc", "mpcms+sorlc"]
    method = content["methods"]["scripted+sorlc"]
    assert set(method) == {"agents", "team", "scores"} and len(method["agents"]) == 4
    assert set(method["agents"][0]) == set(AgentMetrics.__annotations__)
    assert set(method["team"]) == set(TeamMetrics.__annotations__)
    assert set(method["scores"]) == set(SCORES)
    assert {"agents": method["agents"], "team": method["team"]} == results[0].metrics
    assert content["methods"]["mpcms+sorlc"] == {"failure": REASON}
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_summary_turns_what_is_not_finite_into_null(results: list[Result]) -> None:
    """Without obstacles the clearance is infinite, which JSON cannot express."""
    metrics = json.loads(json.dumps(results[0].metrics))
    metrics["agents"][0]["clearance_min"] = np.float64("inf")
    content = summary([Result("a", "b", None, metrics)], "paper", {})
    assert content["methods"]["a+b"]["agents"][0]["clearance_min"] is None


def test_results_that_make_no_sense_are_refused(results: list[Result]) -> None:
    """A result is either metrics or a failure, and a method has one result."""
    with pytest.raises(ConfigurationError, match="either metrics or a failure"):
        Result("a", "b")
    with pytest.raises(ConfigurationError, match="more than one result"):
        summary([results[0], results[0]], "paper", {})


def test_csv_has_one_row_per_method_and_agent(results: list[Result], tmp_path: Path) -> None:
    """Values read back equal the metrics; the failed method has one row with its reason in one line."""
    with write_csv(results, tmp_path / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 4 + 1
    metrics = results[1].metrics
    assert metrics is not None
    row = rows[4 + 2]  # second method, agent 3
    assert (row["controller"], row["agent"]) == ("pd", "3")
    assert float(row["cost_integral"]) == metrics["agents"][2]["cost_integral"]
    assert float(row["team_return"]) == metrics["team"]["return"]
    assert rows[-1]["failure"] == " ".join(REASON.split()) and rows[-1]["agent"] == ""


def cells(text: str) -> list[list[str]]:
    """Rows of a pipe table, header first."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return [rows[0], *rows[2:]]


def test_table_cells_are_the_metrics(results: list[Result]) -> None:
    """Tables read back from Markdown hold the metrics, rounded, and the published values beside them."""
    tables = {table.name: cells(to_markdown(table)) for table in make_tables(results, "paper")}
    ran = [result.metrics for result in results if result.metrics is not None]
    head, *rows = tables["switches"]
    assert head == ["supervisor", "agent 1", "agent 2", "agent 3", "agent 4"]
    assert [row[0] for row in rows] == ["Schedule", "FSAMS", "FSAMS, published", "MPCMS", "MPCMS, published"]
    assert [int(cell) for cell in rows[1][1:]] == [agent["switches"] for agent in ran[2]["agents"]]
    assert [int(cell) for cell in rows[2][1:]] == list(paper_values.PUBLISHED_SWITCHES.values["fsams"])
    assert rows[3][1] == "failed"
    rows = tables["control-cost"][1:]
    assert [row[0] for row in rows] == ["SORLC", "MARLBC, published", "Saturated PD"]
    ours = [agent["cost_max"] for agent in ran[0]["agents"]] + [agent["cost_sum"] for agent in ran[0]["agents"]]
    np.testing.assert_allclose([float(cell) for cell in rows[0][1:9]], np.array(ours) * 1e-4, atol=0.05)
    assert rows[1][5] == "382†" and rows[0][9] == "1.00"
    rows = tables["control-input"][1:]
    assert [float(cell) for cell in rows[0][1:5]] == [round(agent["force_max_inf"]) for agent in ran[0]["agents"]]
    rows = tables["decision-time"][1:]
    assert float(rows[0][1]) == float(significant(ran[0]["team"]["decision_ms_median"]))
    assert [row[0] for row in tables["metrics-supervisors-sorlc"]] == ["supervisor", "Schedule", "FSAMS", "MPCMS"]
    assert [row[0] for row in tables["metrics-controllers-scripted"]] == ["controller", "SORLC", "Saturated PD"]
    assert tables["metrics-supervisors-sorlc"][-1][1] == "failed"


def test_published_values_belong_to_the_paper_scenario_only(results: list[Result]) -> None:
    """Other scenarios have one row per method and no mention of published values."""
    switches = next(table for table in make_tables(results, "other") if table.name == "switches")
    assert [row[0] for row in switches.rows] == ["Schedule", "FSAMS", "MPCMS"]
    assert not any("ublished" in note for note in switches.notes)


def test_one_word_means_one_aggregation(results: list[Result]) -> None:
    """Tables with the same heading show the same cell for the same method; a heading names the aggregation over agents."""
    run = [*results, scaled("oracle+sorlc", results[0], 1.0), scaled("oracle+pd", results[1], 1.0)]
    said: dict[tuple[str, str], str] = {}
    for table in make_tables(run, "paper"):
        law = table.name.removeprefix("metrics-supervisors-")
        for row in table.rows:
            method = row[0] if law == table.name else f"{row[0]} + {display_name(law)}"
            for column, cell in zip(table.columns, row, strict=True):
                if column.group in {score.quantity for score in SCORES.values()}:
                    assert column[1:3] in {score[1:3] for score in SCORES.values()}
                    assert said.setdefault((method, column.text), cell) in (cell, "failed", "–")
    assert ("Schedule + SORLC", "violation, worst agent [s]") in said


def test_latex_units_have_a_line_of_their_own() -> None:
    """They are below the labels, so that they do not widen the column."""
    table = Table("t", "c", (Column("", "x"), Column("g", "a", "m"), Column("g", "b")), (("r", "1", "2"),))
    lines = to_latex(table).splitlines()
    assert lines[lines.index(r"x & a & b \\") + 1] == r" & [m] &  \\"
    assert to_markdown(table).splitlines()[2] == "| x | g, a [m] | g, b |"


@pytest.mark.parametrize(
    ("ours", "mark"),
    [
        ({"a": 1.0, "b": 5.0, "c": 9.0}, "yes"),
        ({"a": 5.0, "b": 1.0, "c": 9.0}, "no (1 of 3)"),
        ({"a": 9.0, "b": 5.0, "c": 1.0}, "no (3 of 3)"),
        ({"a": 5.0, "b": 5.0, "c": 9.0}, "no (1 of 3)"),
        ({"a": 1.0, "x": 2.0}, "–"),
        ({}, "–"),
    ],
)
def test_order_mark(ours: dict[str, float], mark: str) -> None:
    """Methods that both sides have are compared in pairs; a tie of ours between different published values is a mismatch."""
    assert order_mark(ours, {"a": 10.0, "b": 20.0, "c": 30.0}) == mark


def test_order_mark_ignores_published_ties() -> None:
    """Pairs with a published tie are not compared."""
    assert order_mark({"a": 2.0, "b": 1.0}, {"a": 4.0, "b": 4.0}) == "–"
    assert order_mark({"a": 2.0, "b": 1.0, "c": 3.0}, {"a": 4.0, "b": 4.0, "c": 6.0}) == "yes"


def test_published_values_cover_four_agents() -> None:
    """Every published quantity has four agents, and its methods are named in the paper."""
    supervisors = (paper_values.PUBLISHED_SWITCHES, paper_values.PUBLISHED_DECISION_MS)
    costs = (paper_values.PUBLISHED_COST_MAX, paper_values.PUBLISHED_COST_TOTAL)
    controllers = (*costs, paper_values.PUBLISHED_INPUT_MAX, paper_values.PUBLISHED_INPUT_TOTAL)
    for names, group in ((paper_values.PAPER_SUPERVISORS, supervisors), (paper_values.PAPER_CONTROLLERS, controllers)):
        for published in group:
            assert set(published.values) == set(names)
            assert {len(values) for values in published.values.values()} == {4}


def test_latex_is_balanced_and_rectangular(results: list[Result]) -> None:
    """Braces balance, every row has the table's number of columns, and the text is ASCII."""
    text = latex_document(make_tables(results, "paper"))
    assert text.isascii()
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    assert text.count(r"\begin{table*}") == text.count(r"\end{table*}") == 7
    for body in re.findall(r"\\begin{tabular}{@{}(l r*|lr*)@{}}(.*?)\\end{tabular}", text, re.DOTALL):
        rows = [line for line in body[1].splitlines() if line.endswith(r"\\")]
        for row in rows:
            spans = [int(n) for n in re.findall(r"\\multicolumn{(\d+)}", row)]
            assert len(re.findall(r"(?<!\\)&", row)) + 1 + sum(spans) - len(spans) == len(body[0])
    assert r"100\% of \textless{}limit\textgreater{} \& more\_so second line" in text


@pytest.mark.parametrize(
    ("plain", "escaped"),
    [
        ("a_b & 5 %", r"a\_b \& 5 \%"),
        ("max ‖u‖∞", r"max $\|u\|_\infty$"),
        ("−2.1", "$-$2.1"),
        ("C:\\x{y}^~", r"C:\textbackslash{}x\{y\}\textasciicircum{}\textasciitilde{}"),
        ("é→", "e?"),
    ],
)
def test_latex_escaping(plain: str, escaped: str) -> None:
    """Special characters are escaped, symbols set in math mode, and all others replaced by ASCII."""
    assert latex(plain) == escaped


def test_html_escapes_and_spans() -> None:
    """Cell text is escaped, and groups span their columns."""
    table = Table("t", "c<d", (Column("", "x"), Column("g", "a"), Column("g", "b")), (("<i>", "1", "2"),))
    text = render("table.html", table=table)
    assert "<i>" not in text and "&lt;i&gt;" in text and "c&lt;d" in text
    assert 'colspan="2">g</th>' in text
    with pytest.raises(ValueError, match="1 cells in a row of 3"):
        Table("t", "c", table.columns, (("1",),))


def test_templates_escape_everything_and_know_every_name() -> None:
    """No template marks text as safe; a missing value raises an error."""
    folder = Path(str(resources.files("marlbc_mj.report")))
    assert {path.name for path in folder.glob("*.html")} >= {"base.html", "page.html", "seed_page.html", "table.html"}
    assert not [path.name for path in folder.glob("*.html") if re.search(r"\|\s*safe|autoescape", path.read_text())]
    with pytest.raises(UndefinedError, match="'table' is undefined"):
        render("table.html")


def test_the_terminal_says_what_the_tables_say(results: list[Result], capsys: pytest.CaptureFixture[str]) -> None:
    """Headings, aggregations and digits are those of the table of all metrics; a failure has its reason."""
    print_results(results)
    out = capsys.readouterr().out
    assert "worst agent [s]" in out and "worst agent [m]" in out and "sum [N s]" in out
    parts = out.split("┃ controller")
    for table, kind, part in zip(make_tables(results, "paper")[:2], ("supervisor", "controller"), parts, strict=True):
        shown = [k for k, column in enumerate(table.columns) if column.text == kind or column.text in HEADINGS]
        assert len(shown) == 1 + len(HEADINGS)
        for row in table.rows[:2]:
            (line,) = [line for line in part.splitlines() if line.startswith(f"│ {row[0]} ")]
            assert [cell.strip() for cell in line.split("│")[1:-1]] == [row[k] for k in shown]
    assert "with SORLC" in out and "with supervisor Schedule" in out
    assert f"MPCMS + SORLC failed: {REASON}" in out


def test_a_line_per_method_says_what_came_of_it(results: list[Result]) -> None:
    assert result_line(results[2], 3, 26).startswith("3/26  FSAMS + SORLC: return ")
    assert result_line(results[3], 4, 26) == f"4/26  MPCMS + SORLC: failed: {' '.join(REASON.split())}"


def test_the_page_grows_as_methods_end(results: list[Result], tmp_path: Path) -> None:
    """It is complete at any time and states the total number of methods; the last version does not reload itself."""
    facts = {"scenario": paper(), "versions": {"numpy": "2"}, "git_revision": "abc", "seed": 0, "command": "marlbc bench"}
    page = PartialPage(tmp_path, [result.key for result in results], partial(write_so_far, config=facts))
    folder = tmp_path / ".jobs" / "so_far"
    shown = []
    for result in (results[1], results[0], results[3], results[2]):
        page.add(result.key, result)
        page._next = -np.inf
        text = (folder / "index.html").read_text()
        shown.append((re.findall(r"(\d) of 4 methods so far", text), "refresh" in text))
        assert {path.name for path in folder.iterdir()} == {"index.html", "tables.md"}
    assert shown == [(["1"], True), (["2"], True), (["3"], True), (["4"], False)]
    assert (folder / "tables.md").read_text() == markdown(make_tables(results, "paper"))


def test_failures_appear_in_every_form(results: list[Result]) -> None:
    """A failed method is a row with its reason, in Markdown and in LaTeX."""
    tables = make_tables(results, "paper")
    assert "MPCMS + SORLC failed: world 0, agent 3" in markdown(tables)
    assert "MPCMS + SORLC failed: world 0, agent 3" in latex_document(tables)
    assert make_tables([results[3]], "paper")[0].rows[0][:2] == ("MPCMS", "failed")


def scaled(name: str, result: Result, cost: float, violation: float = 0.0) -> Result:
    """The result under another method's name, with costs multiplied by ``cost`` and this violation time."""
    metrics = json.loads(json.dumps(result.metrics))
    for agent in metrics["agents"]:
        for key in ("cost_max", "cost_sum", "cost_integral", "effort_sum", "force_max_inf"):
            agent[key] *= cost
        agent["violation_time"] = violation
    supervisor, controller = name.split("+")
    return Result(supervisor, controller, None, metrics)


def test_orders_hold_and_differ_by_the_numbers(results: list[Result]) -> None:
    """A costlier baseline keeps all published orders of Tables 5 and 6, a cheaper one none; published ties give no order."""
    sorlc = results[0]
    for factor, holds in ((2.0, True), (0.5, False)):
        found = claims([sorlc, scaled("scripted+finite-time", sorlc, factor)])
        assert {(c.table, c.quantity) for c in found} == {
            (5, "max cost"),
            (5, "total cost"),
            (6, "max input"),
            (6, "total input"),
        }
        for claim in found:
            assert (claim.lower, claim.higher) == ("sorlc", "finite-time")
            assert (claim.holds, claim.differs) == (((1, 2, 3, 4), ()) if holds else ((), (1, 2, 3, 4)))
    tables = {t.name: t for t in make_tables([sorlc, scaled("scripted+finite-time", sorlc, 0.5)], "paper")}
    assert {row[1] for row in tables["orderings"].rows} == {"no"}
    assert any("erratum 16" in note for note in tables["orderings"].notes)
    assert tables["control-cost"].rows[-1][:2] == ("same order", "no (1 of 1)")
    assert "orderings" not in {t.name for t in make_tables([sorlc], "paper")}


def test_no_count_of_reproduced_orders_depends_on_the_time_that_decisions_take(results: list[Result]) -> None:
    """Table 4 shows published times too, but its order is neither counted nor compared."""
    run = [scaled(f"{name}+sorlc", results[0], 1.0) for name in ("marlms", "fsams", "mpcms")]

    def said(slowest: int) -> tuple[object, ...]:
        for k, result in enumerate(run):
            assert result.metrics is not None
            result.metrics["team"]["decision_ms_median"] = 1e3 if k == slowest else 1.0
        tables = {table.name: table for table in make_tables(run, "paper")}
        assert not any("same order" in row for row in tables["decision-time"].rows)
        return claims(run), tables["orderings"]

    assert said(0) == said(2)


def test_the_paragraph_follows_the_numbers(results: list[Result]) -> None:
    """It says whether baselines with the same actuator are cheaper, and whether LQR is safe."""
    sorlc = results[0]
    run = [sorlc, scaled("scripted+finite-time", sorlc, 2.0)]
    cheap = same_actuator([*run, scaled("scripted+finite-time-limited", sorlc, 0.25), scaled("scripted+lqr", sorlc, 0.125, 1.7)])
    assert "every baseline is cheaper: Finite-time" in cheap and "(0.25 times)" in cheap
    assert "LQR is the floor" in cheap and "violates the safe distance for 1.70 s" in cheap
    assert "is reversed for Finite-time" in cheap
    dear = same_actuator([*run, scaled("scripted+finite-time-limited", sorlc, 1.5), scaled("scripted+lqr", sorlc, 3.0)])
    assert "no baseline is cheaper: Finite-time" in dear and "LQR costs" in dear and "keeps the safe distance" in dear
    assert "reversed" not in dear and "stands" in dear
    assert same_actuator(results) == ""


def test_limited_rivals_and_lqr_are_a_block_of_their_own(results: list[Result]) -> None:
    """They follow the mark, in the order of the run, with the ratio of their total to SORLC's."""
    names = ("lqr", "finite-time", "finite-time-limited")
    table = make_tables([results[0], *(scaled(f"scripted+{name}", results[0], 0.5) for name in names)], "paper")[3]
    labels = [row[0] for row in table.rows]
    assert labels == [
        "SORLC",
        "MARLBC, published",
        "Finite-time",
        "finite-time, published",
        "same order",
        "LQR",
        "Finite-time, limited",
    ]
    assert table.rules == (4, 5) and table.rows[-1][-1] == "0.50"


def test_gap_to_the_oracle(results: list[Result]) -> None:
    """The gap is per controller, a failure has a row, and without an oracle there is no table."""
    assert oracle_gap(results) is None
    best = scaled("oracle+sorlc", results[0], 1.0)
    assert best.metrics is not None and results[2].metrics is not None
    best.metrics["team"]["return"] = 1e4
    table = oracle_gap([*results, best])
    assert table is not None
    assert [row[0] for row in table.rows] == ["Schedule + SORLC", "FSAMS + SORLC", "MPCMS + SORLC"]
    assert table.rows[1][2] == f"{1e4 - results[2].metrics['team']['return']:.0f}" and table.rows[2][1] == "failed"


def test_no_mark_covers_another(results: list[Result]) -> None:
    """Of two methods with equal numbers, one mark is moved aside, with a line to its true place; the others stay in place."""
    sorlc = results[0]
    twin, other = scaled("scripted+sorlc-off", sorlc, 1.0), scaled("scripted+lqr", sorlc, 0.1)
    figure = pareto([sorlc, other, twin])
    figure.draw_without_rendering()
    for axes in figure.axes:
        marks = [line for line in axes.lines if line.get_marker() in tuple("os^") and line.get_markersize() > 3.0]
        places = [72.0 / figure.dpi * line.get_transform().transform(line.get_xydata())[0] for line in marks]
        true = [72.0 / figure.dpi * axes.transData.transform(line.get_xydata())[0] for line in marks]
        assert len(places) == 3 and min(np.hypot(*(a - b)) for a, b in combinations(places, 2)) > 6.0
        aside = [not np.allclose(place, at) for place, at in zip(places, true, strict=True)]
        assert aside == [False, False, True] and sum(text.arrow_patch is not None for text in axes.texts) == 1
        assert np.hypot(*(places[2] - true[2])) < 7.0
        (dot,) = (line for line in axes.lines if line.get_markersize() < 3.0 and line.get_marker() == "o")
        np.testing.assert_allclose(dot.get_xydata(), marks[2].get_xydata())


def test_other_missions_do_not_speak_of_the_paper() -> None:
    """Captions and notes mention neither the paper, nor its figures, nor published values."""
    made = []
    for names in (("scripted", "sorlc"), ("scripted", "rlc"), ("fsams", "sorlc")):
        world = World(replace(paper(duration=1.0), name="mine"), make_controller(names[1]), record=True)
        made.append(Result.of(run_episode(world, make_supervisor(names[0]), names=names)))
    captions = [plot.caption for plot in figures.plots(made)]
    tables = make_tables(made, "mine")
    said = [*captions, *(table.caption for table in tables), *(note for table in tables for note in table.notes)]
    assert len(captions) > 10 and not [text for text in said if re.search(r"[Pp]aper|Figure \d|[Pp]ublished", text)]


def test_spans_of_numbers() -> None:
    """Three or more consecutive numbers make a span."""
    assert spans([7, 0, 2, 3, 4, 6]) == "0, 2 to 4, 6, 7"


def test_predictions_and_solver_share(results: list[Result]) -> None:
    """Two kinds of MPCMS are compared; a supervisor that reports its solver's time has a share in Table 4 and the summary."""
    kinds = [scaled(f"{name}+sorlc", results[0], 1.0) for name in ("mpcms", "mpcms-mujoco")]
    table = predictions(kinds)
    assert table is not None and [row[0] for row in table.rows] == ["MPCMS + SORLC", "MPCMS, simulated + SORLC"]
    assert predictions(kinds[:1]) is None
    told = replace(kinds[0], solver_share=0.75)
    times = make_tables([results[0], told], "paper")[2]
    at = next(k for k, column in enumerate(times.columns) if "solver" in column.group)
    assert [row[at] for row in times.rows[:2]] == ["–", "75"]
    assert summary([told], "paper", {})["methods"]["mpcms+sorlc"]["solver_share"] == 0.75


def test_bands_hold_every_sample() -> None:
    """Bands are the extremes and means of bins; the last bin may be shorter."""
    time, values = np.arange(10.0), np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 100.0])
    starts, low, mean, high = plotting.bands(time, values, bins=3)
    assert (starts.tolist(), low.tolist()) == ([0, 4, 8], [0, 4, 8])
    assert (mean.tolist(), high.tolist()) == ([1.5, 5.5, 54.0], [3, 7, 100])


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex")
def test_latex_compiles(results: list[Result], tmp_path: Path) -> None:
    """tables.tex compiles unchanged in a document with the packages that it names, and no table is wider than the text."""
    wide = Table("wide", "c", tuple(Column("g", f"column {k}", "m/s") for k in range(24)), (("123 456.78",) * 24,))
    (tmp_path / "tables.tex").write_text(latex_document([*make_tables(results, "paper"), wide], "100 % of x_y."))
    (tmp_path / "all.tex").write_text(
        r"\documentclass[twocolumn]{article}\usepackage{booktabs,graphicx}\begin{document}\input{tables}\end{document}"
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-1000:]
    assert "Overfull" not in done.stdout


def test_envelope_keeps_peaks_and_ends() -> None:
    """Decimation loses no extreme value and stays in order."""
    time = np.arange(20_000) * 0.005
    values = np.sin(time)
    values[12_345], values[777] = 50.0, -60.0
    short_time, short = plotting.envelope(time, values, bins=300)
    assert len(short) <= 602 and short.max() == 50.0 and short.min() == -60.0
    assert (short_time[0], short_time[-1]) == (time[0], time[-1])
    assert np.all(np.diff(short_time) > 0)
    assert plotting.bin_maxima(time, values, bins=300)[1].max() == 50.0


def test_figures_are_written_at_their_size(drawn: tuple[Path, list[Path]]) -> None:
    """Figures are one or two columns wide at 300 dpi; PDFs are small and embed TrueType (Type 42) fonts only."""
    folder, paths = drawn
    own = {f"{kind}_scripted_sorlc" for kind in ("trajectories", "priorities", "forces", "errors", "weights")}
    papers = {"figure4_weights_sorlc", "figure5_weight_errors_sorlc", "figure6_tracking_sorlc"}
    assert {path.stem for path in paths} == own | papers and len(paths) == 2 * len(own | papers)
    assert sorted(folder.iterdir()) == sorted(paths)
    for path in paths:
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert image.width in (round(300 * plotting.SINGLE), round(300 * plotting.DOUBLE))
                assert image.info["dpi"] == pytest.approx((300, 300), abs=0.1)
        else:
            data = path.read_bytes()
            assert b"/CIDFontType2" in data and b"/FontFile2" in data and b"/Type3" not in data
            assert len(data) < 400_000


def test_comparison_figures(results: list[Result]) -> None:
    """All methods in one figure of double width; a method without weights has no weight figure."""
    episodes = [result.trajectory for result in results if result.trajectory is not None]
    figure = trajectories(episodes)
    assert figure.get_figwidth() == plotting.DOUBLE
    assert sum(axes.axison for axes in figure.axes) == len(episodes) == 3 and figure.axes[3].get_legend() is not None
    assert len(pareto(results[:2]).axes) == 3 and len(pareto(results).axes) == 6  # supervisors above, controllers below
    assert curves.has_weights(episodes[0]) and not curves.has_weights(episodes[1])
    for draw in (curves.weight_norms, curves.weight_errors):
        with pytest.raises(ValueError, match="'pd' has no network weights"):
            draw(episodes[1])
    assert len(curves.priorities(episodes).axes) == 4
    assert len(curves.control(episodes, 3).axes) == 2 * len(episodes)


def test_page_stands_alone(results: list[Result], drawn: tuple[Path, list[Path]], tmp_path: Path) -> None:
    """The only address is the citation's; figures and video are embedded, failures and files named, the command escaped."""
    video = tmp_path / "paper.mp4"
    video.write_bytes(b"not really a video")
    config = {"scenario": paper(), "versions": {"mujoco": "3.17"}, "seed": 7, "git_revision": "abc1234"}
    page = write_benchmark_page(
        tmp_path / "index.html",
        results=results,
        config={**config, "command": "marlbc bench --out <here>"},
        tables=make_tables(results, "paper"),
        figures=drawn[0],
        video=video,
        links=[tmp_path / "logs" / "a b.mcap"],
    ).read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\s\"<]+", page)) == {paper_values.DOI}
    assert not re.search(r"(?:src|href)=\"?(?:/|\.\./|file:)|<script|@import|url\(", page)
    assert page.count('src="data:image/png;base64,') == 5 + 3
    assert 'src="data:video/mp4;base64,' in page
    assert not re.search(r"\$|{{|{%|{#", re.sub(r"base64,[^\"]*", "", page))
    for text in (
        "MPCMS + SORLC",
        "abc1234",
        "--out &lt;here&gt;",
        'href="logs/a%20b.mcap"',
        "Schedule + Saturated PD",
        "&lt;limit&gt;",
    ):
        assert text in page


def test_report_folder(results: list[Result], tmp_path: Path) -> None:
    """One call writes every file of the report; the page also works without figures."""
    config = {"scenario": paper(), "versions": {"numpy": "2"}, "git_revision": "abc", "seed": 0, "command": "marlbc bench"}
    page = write_report(results, tmp_path, config=config, figures=False)
    assert page == tmp_path / "index.html"
    names = {"summary.json", "episodes.csv", "tables.md", "tables.tex", "index.html"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert json.loads((tmp_path / "summary.json").read_text())["methods"]["mpcms+sorlc"] == {"failure": REASON}
    assert 'href="tables.tex"' in page.read_text(encoding="utf-8")
