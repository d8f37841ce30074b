"""The report package: files in their schema, tables that hold the metrics, figures of their size, a page that stands alone."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.errors import ConfigurationError
from marlbc_mj.metrics import AgentMetrics, TeamMetrics
from marlbc_mj.report import figures, paper_values, plotting, write_report
from marlbc_mj.report.arena import trajectories
from marlbc_mj.report.page import write_page
from marlbc_mj.report.paper_values import order_mark
from marlbc_mj.report.pareto import pareto
from marlbc_mj.report.results import Result, summary, write_csv
from marlbc_mj.report.table import Column, Table, latex, to_html, to_markdown
from marlbc_mj.report.tables import latex_document, make_tables, markdown, significant
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors import make_supervisor

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
    """Figures of one method that ran, of one that failed and of all together."""
    folder = tmp_path_factory.mktemp("report") / "figures"
    return folder, figures.write_figures([results[0], results[3]], folder)


def test_summary_has_the_schema_and_no_nan(results: list[Result]) -> None:
    """Keys are those of design.md section 7, a failed method is its reason, and JSON takes it strictly."""
    content = summary(results, "paper", {"mujoco": "3.17"})
    assert set(content) == {"schema", "scenario", "versions", "methods"} and content["schema"] == 1
    assert list(content["methods"]) == ["scripted+sorlc", "scripted+pd", "fsams+sorlc", "mpcms+sorlc"]
    method = content["methods"]["scripted+sorlc"]
    assert set(method) == {"agents", "team"} and len(method["agents"]) == 4
    assert set(method["agents"][0]) == set(AgentMetrics.__annotations__)
    assert set(method["team"]) == set(TeamMetrics.__annotations__)
    assert content["methods"]["mpcms+sorlc"] == {"failure": REASON}
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_summary_turns_what_is_not_finite_into_null(results: list[Result]) -> None:
    """Without obstacles the clearance is infinite, which JSON has no number for."""
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
    """Tables read back from Markdown hold the metrics, rounded, and the printed values beside them."""
    tables = {table.name: cells(to_markdown(table)) for table in make_tables(results, "paper")}
    ran = [result.metrics for result in results if result.metrics is not None]
    head, *rows = tables["switches"]
    assert head[1:6] == ["scripted, here", "fsams, here", "fsams, paper", "mpcms, here", "mpcms, paper"]
    assert [int(row[2]) for row in rows] == [agent["switches"] for agent in ran[2]["agents"]]
    assert [int(row[3]) for row in rows] == list(paper_values.SWITCHES.values["fsams"])
    assert {row[4] for row in rows} == {"failed"}
    head, *rows = tables["control-cost"]
    assert head[1:4] == ["sorlc, here", "sorlc, paper", "pd, here"]
    ours = [agent["cost_max"] for agent in ran[0]["agents"]] + [agent["cost_sum"] for agent in ran[0]["agents"]]
    np.testing.assert_allclose([float(row[1]) for row in rows], np.array(ours) * 1e-4, atol=0.05)
    assert rows[4][2] == "382†"
    rows = tables["control-input"][1:]
    assert [float(row[1]) for row in rows[:4]] == [round(agent["force_max_inf"]) for agent in ran[0]["agents"]]
    rows = tables["decision-time"][1:]
    assert float(rows[0][1]) == float(significant(ran[0]["team"]["decision_ms_median"]))
    rows = tables["all-metrics"][1:]
    assert [row[0] for row in rows] == [result.key for result in results]
    assert rows[-1][1] == "failed"


def test_printed_values_belong_to_the_paper_scenario_only(results: list[Result]) -> None:
    """Elsewhere there is one column a method and no mark."""
    switches = next(table for table in make_tables(results, "other") if table.name == "switches")
    assert [column.group for column in switches.columns] == ["", "scripted", "fsams", "mpcms"]
    assert not switches.grouped and not any("paper's" in note for note in switches.notes)


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
    """Pairs among the methods that both have; a tie of ours where the printed differ is a mismatch."""
    assert order_mark(ours, {"a": 10.0, "b": 20.0, "c": 30.0}) == mark


def test_order_mark_ignores_printed_ties() -> None:
    """A printed tie orders nothing."""
    assert order_mark({"a": 2.0, "b": 1.0}, {"a": 4.0, "b": 4.0}) == "–"
    assert order_mark({"a": 2.0, "b": 1.0, "c": 3.0}, {"a": 4.0, "b": 4.0, "c": 6.0}) == "yes"


def test_printed_values_cover_four_agents() -> None:
    """Every printed quantity has four agents, and its methods are named in the paper."""
    supervisors = (paper_values.SWITCHES, paper_values.DECISION_MS)
    controllers = (paper_values.COST_MAX, paper_values.COST_TOTAL, paper_values.INPUT_MAX, paper_values.INPUT_TOTAL)
    for names, group in ((paper_values.SUPERVISORS, supervisors), (paper_values.CONTROLLERS, controllers)):
        for printed in group:
            assert set(printed.values) == set(names)
            assert {len(values) for values in printed.values.values()} == {4}


def test_latex_is_balanced_and_rectangular(results: list[Result]) -> None:
    """Braces balance, every row has the table's number of columns, and only ASCII is left."""
    text = latex_document(make_tables(results, "paper"))
    assert text.isascii()
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    assert text.count(r"\begin{table*}") == text.count(r"\end{table*}") == 5
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
    """Specials are escaped, symbols set in math mode, the rest made ASCII."""
    assert latex(plain) == escaped


def test_html_escapes_and_spans() -> None:
    """Cells are text, groups span their columns."""
    table = Table("t", "c<d", (Column("", "x"), Column("g", "a"), Column("g", "b")), (("<i>", "1", "2"),))
    text = to_html(table)
    assert "<i>" not in text and "&lt;i&gt;" in text and "c&lt;d" in text
    assert "colspan=2>g</th>" in text
    with pytest.raises(ValueError, match="1 cells in a row of 3"):
        Table("t", "c", table.columns, (("1",),))


def test_failures_appear_in_every_form(results: list[Result]) -> None:
    """A failed method is a row with its reason, in Markdown and in LaTeX."""
    tables = make_tables(results, "paper")
    assert "mpcms+sorlc failed: world 0, agent 3" in markdown(tables)
    assert "mpcms+sorlc failed: world 0, agent 3" in latex_document(tables)
    assert make_tables([results[3]], "paper")[0].rows[0][:2] == ("mpcms+sorlc", "failed")


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


def test_runs_cover_the_sequence() -> None:
    """Stretches of equal values, end exclusive."""
    assert list(plotting.runs(np.array([1, 1, 0, 2, 2]))) == [(0, 2, 1), (2, 3, 0), (3, 5, 2)]
    assert list(plotting.runs(np.array([], dtype=int))) == []


def test_figures_are_written_at_their_size(drawn: tuple[Path, list[Path]]) -> None:
    """One column or two wide at 300 dpi; PDFs are small and embed TrueType (Type 42) fonts only."""
    folder, paths = drawn
    assert {path.name for path in paths} == {
        f"{kind}_scripted_sorlc{suffix}" for kind in figures.KINDS for suffix in (".pdf", ".png")
    }
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
    assert sum(axes.get_visible() for axes in figure.axes) == len(episodes)
    assert len(pareto(results).axes) == 3
    assert figures.has_weights(episodes[0]) and not figures.has_weights(episodes[1])
    with pytest.raises(ValueError, match="'pd' has no network weights"):
        figures.weight_norms(episodes[1])


def test_page_stands_alone(results: list[Result], drawn: tuple[Path, list[Path]], tmp_path: Path) -> None:
    """No address but the citation's, figures and video embedded, failures and files named, command escaped."""
    video = tmp_path / "paper.mp4"
    video.write_bytes(b"not really a video")
    page = write_page(
        tmp_path / "index.html",
        results=results,
        scenario=paper(),
        versions={"mujoco": "3.17"},
        seed=7,
        revision="abc1234",
        command="marlbc bench --out <here>",
        tables=make_tables(results, "paper"),
        figures=drawn[0],
        video=video,
        links=[tmp_path / "logs" / "a b.mcap"],
    ).read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\s\"<]+", page)) == {paper_values.DOI}
    assert not re.search(r"(?:src|href)=\"?(?:/|\.\./|file:)|<script|@import|url\(", page)
    assert page.count('src="data:image/png;base64,') == len(figures.KINDS)
    assert 'src="data:video/mp4;base64,' in page
    assert "$" not in re.sub(r"base64,[^\"]*", "", page)
    for text in ("mpcms+sorlc", "abc1234", "--out &lt;here&gt;", 'href="logs/a%20b.mcap"', "scripted+pd", "&lt;limit&gt;"):
        assert text in page


def test_report_folder(results: list[Result], tmp_path: Path) -> None:
    """One call writes every file of the report; without figures the page still stands."""
    config = {"scenario": paper(), "versions": {"numpy": "2"}, "git_revision": "abc", "seed": 0, "command": "marlbc bench"}
    page = write_report(results, tmp_path, config=config, figures=False)
    assert page == tmp_path / "index.html"
    names = {"summary.json", "episodes.csv", "tables.md", "tables.tex", "index.html"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert json.loads((tmp_path / "summary.json").read_text())["methods"]["mpcms+sorlc"] == {"failure": REASON}
    assert 'href="tables.tex"' in page.read_text(encoding="utf-8")
