"""The suite: a fixed definition, rows restored from their files, and one command from a supervisor to a leaderboard."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from marlbc_mj.cli import main
from marlbc_mj.report.leaderboard import LEADERBOARD_PAGE
from marlbc_mj.results.layout_runs import LAYOUT_SCORES, LayoutRun, Method, MissionRuns, read_layout_rows, write_layout_rows
from marlbc_mj.studies.suite import definition
from marlbc_mj.studies.suite.definition import FROZEN, SUITE_SEED, TRACKS, choose_missions, missions_of, suite_hash, track_hash
from marlbc_mj.studies.suite.entries import Choice, entrants, meant_for
from marlbc_mj.studies.suite.files import read_suite
from marlbc_mj.studies.suite.flights import BLOCK, suite_jobs
from marlbc_mj.supervisors import SUPERVISORS
from marlbc_mj.util.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("coarse_figures")


def test_the_suite_is_the_frozen_one() -> None:
    """Any change to a mission, by a default for example, makes another suite, which needs another version."""
    assert {name: track_hash(name) for name in TRACKS} == FROZEN


def test_the_tracks_are_those_that_are_described() -> None:
    counts = {name: sorted({len(mission.seeds) for mission in missions_of(name)}) for name in TRACKS}
    assert counts == {"paper": [1, 201], "families": [1000], "teams": [200], "robots": [200], "control": [1, 201]}
    assert [len(missions_of(name)) for name in TRACKS] == [2, 6, 15, 8, 2]
    assert all(mission.seeds[0] == SUITE_SEED for name in TRACKS for mission in missions_of(name))
    names = [mission.name for name in TRACKS for mission in missions_of(name)]
    assert len(set(names)) == len(names)


def test_layouts_are_held_out() -> None:
    """This holds for every mission that draws layouts."""
    drawn = [mission.scenario for name in TRACKS for mission in missions_of(name) if mission.scenario.layout is not None]
    assert len(drawn) == 5 + 15 + 4 and {scenario.split for scenario in drawn} == {"test"}


def test_the_hash_sees_every_number_of_a_mission(monkeypatch: pytest.MonkeyPatch) -> None:
    """It ignores only descriptions and the last bits of numbers, which differ between machines."""
    (mission, *_) = missions_of("paper")

    def hash_with(**changes: object) -> str:
        changed = mission._replace(scenario=replace(mission.scenario, **changes))
        monkeypatch.setattr(definition, "missions_of", lambda name: (changed,))
        return track_hash.__wrapped__("paper")

    before = hash_with()
    assert hash_with(safe_distance=2.01) != before
    assert hash_with(safe_distance=2.0 * (1 + 1e-15)) == hash_with(description="other words") == before


def test_every_supervisor_flies_under_what_it_is_meant_for() -> None:
    methods = [one.method for one in entrants("families", Choice())]
    assert {method.supervisor for method in methods} == set(SUPERVISORS) - {"mpcms-mujoco"}
    assert meant_for("lookahead") == ("set-based",) and meant_for("orca") == ("null-space",)
    assert [method.composition for method in methods if method.supervisor == "fsams"] == ["null-space", "set-based"]
    quick = {one.method.supervisor for one in entrants("families", Choice(quick=True))}
    assert quick == set(SUPERVISORS) - {"mpcms", "mpcms-mujoco", "rollout"}
    assert [one.method.key for one in entrants("families", Choice(("fixed",), shield=True))] == [
        "fixed+sorlc+set-based",
        "fixed+sorlc+set-based+shield",
    ]


def test_a_quick_run_is_a_part_of_the_whole() -> None:
    """Its jobs are among those of the whole suite, so nothing is flown twice."""
    choice = Choice(("fixed",))
    quick = suite_jobs(choose_missions(["families"], ["field"], BLOCK), choice)
    whole = suite_jobs(choose_missions(["families"], ["field"]), choice)
    assert len(quick) == 1 and len(whole) == 1000 // BLOCK and quick[0] == whole[0]
    assert [seed for job in whole for seed in job.seeds] == list(range(SUITE_SEED, SUITE_SEED + 1000))


def test_rows_come_back_from_their_file(tmp_path: Path) -> None:
    scores = tuple(round(0.1 * k, 3) for k in range(len(LAYOUT_SCORES)))
    runs = (
        LayoutRun(3, "", True, False, False, False, True, 4.0, 0.0123, scores),
        LayoutRun(4, 'diverged, with "quotes"', False, True, True, True, False, math.nan, math.nan, (math.nan,) * len(scores)),
    )
    group = [MissionRuns("families", "field", Method("fsams", "sorlc", "set-based", True), runs)]
    (back,) = read_layout_rows(write_layout_rows(group, tmp_path / "rows.csv"), "families")
    assert back[:3] == group[0][:3] and str(back.runs) == str(runs)
    text = (tmp_path / "rows.csv").read_text()
    (tmp_path / "twice.csv").write_text(text + text.splitlines(keepends=True)[1])
    with pytest.raises(ConfigurationError, match=r"twice\.csv, line 4: field, fsams.*, seed 3 has a row already"):
        read_layout_rows(tmp_path / "twice.csv", "families")
    (tmp_path / "rows.csv").write_text(text[:-30])
    with pytest.raises(ConfigurationError, match=r"rows\.csv, line 3"):
        read_layout_rows(tmp_path / "rows.csv", "families")


SAID = {
    "track": (["suite", "--track", "familys"], "unknown track 'familys'; perhaps 'families'; choose from: paper, families"),
    "mission": (["suite", "--missions", "meadow"], "unknown mission 'meadow'"),
    "supervisor": (["suite", "--supervisors", "nobody"], "unknown supervisor 'nobody'"),
    "controller": (["suite", "--track", "control", "--controllers", "none"], "unknown controller 'none'"),
    "composition": (["suite", "--compositions", "both"], "unknown composition 'both'"),
    "twice": (["suite", "--supervisors", "fixed", "fixed"], "a supervisor is named twice"),
    "layouts": (["suite", "--layouts", "0"], "layouts must be at least 1"),
    "page": (["suite", "--page"], "--page needs --from"),
    "from": (["suite", "--page", "--from", "nowhere"], "nowhere holds no results of the suite"),
}


@pytest.mark.parametrize("case", SAID)
def test_a_wrong_option_is_one_line(case: str, tmp_path: Path, monkeypatch, capsys) -> None:
    """Nothing is flown or written."""
    monkeypatch.chdir(tmp_path)
    arguments, said = SAID[case]
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and said in line
    assert list(tmp_path.iterdir()) == []


FLY = ["suite", "--track", "families", "--missions", "field", "--layouts", "2", "--compositions", "set-based"]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of two supervisors on two layouts; one of them cannot start."""
    out = tmp_path_factory.mktemp("suite") / "out"
    main([*FLY, "--supervisors", "fixed", "marlms", "--out", str(out)])
    return out


def test_a_run_leaves_rows_and_a_summary(flown: Path) -> None:
    content = json.loads((flown / "suite.json").read_text())
    assert content["suite"] == {"version": "v1", "hash": suite_hash()} and {"versions", "cpu", "code", "date"} <= set(content)
    mission = content["tracks"]["families"]["field"]
    assert (mission["first_seed"], mission["layouts"]) == (SUITE_SEED, 2)
    fixed, learned = mission["methods"].values()
    assert fixed["shares"]["success"][0] in (0.0, 0.5, 1.0) and fixed["failures"] == {}
    assert learned["shares"]["violated"][0] == 1.0 and sum(learned["failures"].values()) == 2
    assert len((flown / "families.csv").read_text().splitlines()) == 1 + 2 * 2
    assert r"\begin{tabular}" in (flown / "leaderboard.tex").read_text()


def test_the_page_needs_nothing_else(flown: Path) -> None:
    page = (flown / LEADERBOARD_PAGE).read_text()
    assert "Fixed priority" in page and "Antonelli and Chiaverini 2006" in page and "aria-sort" in page
    assert "2 of 2 runs could not be finished" in page and "worst layout of families" in page
    assert 'src="http' not in page and '<link rel="stylesheet' not in page


def test_a_page_from_files_is_the_same_page(flown: Path, tmp_path: Path) -> None:
    main(["suite", "--page", "--from", str(flown), "--out", str(tmp_path / "page")])
    assert (tmp_path / "page" / LEADERBOARD_PAGE).read_text() == (flown / LEADERBOARD_PAGE).read_text()
    assert (tmp_path / "page" / "families.csv").read_bytes() == (flown / "families.csv").read_bytes()


def test_new_rows_merge_with_others(flown: Path, tmp_path: Path) -> None:
    """Methods that are flown again replace their old rows."""
    main([*FLY, "--supervisors", "lookahead", "fixed", "--from", str(flown), "--out", str(tmp_path / "more")])
    merged = read_suite(tmp_path / "more")
    assert [each.method.supervisor for each in merged.groups] == ["lookahead", "fixed", "marlms"]
    assert merged.groups[1].runs[0].scores == read_suite(flown).groups[0].runs[0].scores


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"suite": {"version": "v0", "hash": "0" * 64}}, "belongs to suite v0 000000000000, this code has v1"),
        ({"form": 99}, "has format 99, but this code reads format 1"),
        ({"suite": 3}, "is not a file of the suite"),
    ],
)
def test_another_suite_is_refused(flown: Path, tmp_path: Path, change: dict, said: str, capsys) -> None:
    content = json.loads((flown / "suite.json").read_text())
    (tmp_path / "suite.json").write_text(json.dumps({**content, **change}))
    with pytest.raises(SystemExit) as ended:
        main(["suite", "--page", "--from", str(tmp_path), "--out", str(tmp_path / "out")])
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and said in line


def test_rows_of_other_code_are_named(flown: Path, tmp_path: Path, capsys) -> None:
    """The warning is one line, and the page is still written."""
    for path in flown.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    content = json.loads((flown / "suite.json").read_text())
    (tmp_path / "suite.json").write_text(json.dumps({**content, "code": "older"}))
    main(["suite", "--page", "--from", str(tmp_path), "--out", str(tmp_path / "out")])
    (line,) = capsys.readouterr().err.splitlines()
    assert "some rows come from other code (older) than this" in line
    assert (tmp_path / "out" / LEADERBOARD_PAGE).exists()


def test_clips_show_the_flights_of_the_rows(flown: Path, tmp_path: Path, monkeypatch) -> None:
    """The worst and the median layout are flown again, and the page links to them; a method that never flew has no clips."""
    logs = {}

    def write(log, path, style, overwrite) -> None:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"clip")
        logs[path.name] = log

    monkeypatch.setattr("marlbc_mj.studies.suite.clips.render_video", write)
    main(["suite", "--page", "--from", str(flown), "--clips", "--out", str(tmp_path / "page")])
    (fixed, _) = read_suite(flown).groups
    returns = sorted(run.score("return") for run in fixed.runs)
    assert list(logs) == [f"families-fixed+sorlc+set-based-{kind}.mp4" for kind in ("worst", "median")]
    assert sorted(log.reward.sum() for log in logs.values()) == pytest.approx(returns)
    page = (tmp_path / "page" / LEADERBOARD_PAGE).read_text()
    assert page.count('href="clips/families-fixed%2Bsorlc%2Bset-based-') == 2
