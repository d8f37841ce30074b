"""The command line: the files that commands write, and one clear line for everything that cannot be done."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.cli.scenario_options import FIXED_TEAMS, ScenarioOptions
from marlbc_mj.controllers import CONTROLLERS
from marlbc_mj.engine.world import World
from marlbc_mj.recording import writer
from marlbc_mj.results.summary import AGENT_KEYS, TEAM_KEYS
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import FAMILIES, SCENARIOS, Perturbation, Scenario, make_scenario, paper
from marlbc_mj.studies.bench import matrix
from marlbc_mj.studies.episodes import Stopwatch
from marlbc_mj.supervisors import MPCMS, ON_REQUEST, SUPERVISORS, make_supervisor
from marlbc_mj.training.config import PRESETS
from marlbc_mj.training.methods import METHODS
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import MANIFEST

pytestmark = pytest.mark.usefixtures("coarse_figures")

SHORT = ("--duration", "1.0")


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str], status: int = 2) -> str:
    """Run a command that must fail with ``status``, and return its one line on standard error."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == status
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of a 2 s mission, with a small video."""
    out = tmp_path_factory.mktemp("bench") / "out"
    methods = ["--supervisors", "scripted", "--controllers", "sorlc", "pd"]
    main(["bench", "paper", *methods, "--out", str(out), "--duration", "2.0"])
    return out


def test_bench_leaves_what_it_promises(results: Path) -> None:
    """The output folder has exactly the expected files, and there is nothing next to it."""
    names = {p.name for p in results.iterdir()}
    files = {MANIFEST, "config.json", "summary.json", "episodes.csv", "tables.md", "tables.tex", "index.html"}
    assert names == files | {"figures", "logs", "video"}
    assert {p.stem for p in (results / "logs").iterdir()} == {"scripted+sorlc", "scripted+pd"}
    assert [p.name for p in (results / "video").iterdir()] == ["scripted+sorlc.mp4"]
    assert {p.suffix for p in (results / "figures").iterdir()} == {".pdf", ".png"}
    assert [p.name for p in results.parent.iterdir()] == ["out"]


def test_summary_and_config_hold_what_the_design_fixes(results: Path) -> None:
    """summary.json has all keys per method, agent and team; config.json has versions, CPU, revision, seed and settings."""
    summary = json.loads((results / "summary.json").read_text())
    assert (summary["schema"], summary["scenario"]) == (1, "paper")
    for method in summary["methods"].values():
        assert len(method["agents"]) == 4
        assert all(set(agent) == set(AGENT_KEYS) for agent in method["agents"])
        assert set(method["team"]) == set(TEAM_KEYS)
    config = json.loads((results / "config.json").read_text())
    assert {"versions", "cpu", "git_revision", "seed", "scenario", "bench", "command"} <= set(config)
    assert config["scenario"]["force_limit"] == 200.0


def test_results_are_not_overwritten_by_accident(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder that is not empty is refused and left unchanged, except with --overwrite."""
    before = (results / "summary.json").read_bytes()
    line = refused(["bench", "paper", "--out", str(results), *SHORT], capsys)
    assert str(results) in line
    assert "--overwrite" in line
    assert (results / "summary.json").read_bytes() == before
    quick = ["--supervisors", "scripted", "--controllers", "pd", "--video", "none", "--no-figures", "--no-logs"]
    copy = results.parent / "copy"
    main(["bench", "paper", "--out", str(copy), *quick, *SHORT])
    said = capsys.readouterr()
    assert "1/1  Schedule + Saturated PD: return " in said.err and f"{copy}/.jobs/so_far/index.html is updated" in said.err
    assert "Saturated PD" in said.out and "scripted" not in said.out
    main(["bench", "paper", "--out", str(copy), *quick, *SHORT, "--overwrite", "--quiet"])
    assert capsys.readouterr() == ("", "")
    assert set(json.loads((copy / "summary.json").read_text())["methods"]) == {"scripted+pd"}
    assert not [p for p in results.parent.iterdir() if p.name.startswith("copy.")]


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["bench", "papers"], ("scenario 'papers'", "paper")),
        (["bench", "--supervisors", "oracl"], ("supervisor 'oracl'", "scripted, fsams")),
        (["bench", "--controllers", "sorlc", "pid"], ("controller 'pid'", "sorlc")),
        (["bench", "--controllers", "pd", "pd"], ("twice", "pd")),
        (["run", "--reference", "real"], ("reference mode 'real'", "virtual, actual")),
        (["run", "--disturbance", "fog"], ("disturbance 'fog'", "paper, linear")),
        (["run", "--substep", "0.003"], ("0.05", "0.003")),
        (["run", "--substep", "0.025"], ("25 ms", "19.8 ms")),
        (["run", "--force-limit", "-1"], ("force_limit", "-1")),
        (["run", "--drag-scale", "nan"], ("nan",)),
        (["run", "--seed", "-1"], ("seed", "-1")),
        (["perf", "--rounds", "2"], ("rounds", "2")),
        (["bench", "--no-logs"], ("video", "logs")),
        (["bench", "--seeds", "0"], ("seeds", "0")),
        (["bench", "--drag-range", "5", "5"], ("--drag-range 5 5", "--seeds")),
        (["bench", "--seeds", "1", "--drag-range", "5", "2"], ("drag_scale", "5", "2")),
        (["bench", "--workers", "0"], ("workers", "0")),
        (["bench", "--supervisors"], ("at least one supervisor", "scripted")),
        (["bench", "--controllers"], ("at least one controller", "sorlc")),
        (["run", "--supervisor", "oracle", "--duration", "3"], ("no schedule", "marlbc oracle")),
    ],
)
def test_wrong_settings_are_one_line(
    arguments: list[str], fragments: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The line names the wrong value and the valid ones; the exit status is 2, and nothing is written."""
    out = [] if arguments[0] == "perf" else ["--out", str(tmp_path / "out")]
    line = refused([*arguments, *out], capsys)
    assert all(fragment in line for fragment in fragments), line
    assert list(tmp_path.iterdir()) == []


def test_a_failed_run_is_status_3_and_a_failed_method_a_row(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """If the drag is too strong, `run` stops and reports agent and time, and `bench` reports them in the method's row."""
    line = refused(["run", "--drag-scale", "20", "--duration", "5", "--out", str(tmp_path / "run")], capsys, status=3)
    assert "agent 1, t = 1.31" in line
    quick = [
        "--supervisors",
        "scripted",
        "--controllers",
        "pd",
        "--video",
        "none",
        "--no-figures",
        "--out",
        str(tmp_path / "bench"),
    ]
    main(["bench", *quick, "--drag-scale", "20", "--duration", "5"])
    summary = json.loads((tmp_path / "bench" / "summary.json").read_text())
    assert "agent 1, t = 1.31" in summary["methods"]["scripted+pd"]["failure"]
    assert "1.31" in (tmp_path / "bench" / "tables.md").read_text()


def test_the_matrix_is_all_supervisors_and_all_controllers() -> None:
    """Each method once, that of the video first; named ones are all combined, with sorlc or scripted if one kind is not named."""
    methods, usual = matrix(), set(SUPERVISORS) - set(ON_REQUEST)
    assert methods[0] == ("scripted", "sorlc") and len(set(methods)) == len(methods) == len(usual) + len(CONTROLLERS) - 1
    assert {s for s, c in methods if c == "sorlc"} == usual
    assert {c for s, c in methods if s == "scripted"} == set(CONTROLLERS)
    assert matrix(("fsams", "fms")) == [("fsams", "sorlc"), ("fms", "sorlc")]
    assert matrix(None, ("pd", "lqr")) == [("scripted", "pd"), ("scripted", "lqr")]
    assert matrix(("fsams", "fms"), ("pd",)) == [("fsams", "pd"), ("fms", "pd")]


def test_some_supervisors_run_only_where_they_are_named() -> None:
    """MPCMS that simulates its candidates is not in the default matrix, as it takes minutes per episode."""
    assert "mpcms-mujoco" in ON_REQUEST and not set(ON_REQUEST) & {s for s, _ in matrix()}
    assert matrix(("mpcms", "mpcms-mujoco")) == [("mpcms", "sorlc"), ("mpcms-mujoco", "sorlc")]
    slow = make_supervisor("mpcms-mujoco")
    assert isinstance(slow, MPCMS) and slow.prediction == "mujoco"
    assert slow.start(paper(duration=1.0), 1).worlds is not None


@pytest.mark.parametrize("seeds", [[], ["--seeds", "2"]], ids=["one", "seeds"])
def test_a_method_that_cannot_start_is_a_row(seeds: list[str], tmp_path: Path) -> None:
    """The oracle has no schedule for this mission: its row has the reason, and the other methods have results."""
    quick = ["--supervisors", "scripted", "oracle", "--controllers", "pd", "--video", "none", "--no-figures", "--no-logs"]
    main(["bench", *quick, "--out", str(tmp_path / "out"), *seeds, *SHORT])
    methods = json.loads((tmp_path / "out" / "summary.json").read_text())["methods"]
    assert "no schedule" in methods["oracle+pd"]["failure"] and "team" in methods["scripted+pd"]
    for name in ("tables.md", "index.html", "episodes.csv"):
        assert "no schedule" in (tmp_path / "out" / name).read_text()


def test_a_stopwatch_reads_what_a_supervisor_tells() -> None:
    """It reads the solver's share of decision times, None if the memory has none; its own start serves one episode."""
    starts = []

    class Memory(NamedTuple):
        solver_ms: float

    class Solver:
        def start(self, scenario: Scenario, teams: int) -> Memory:
            starts.append(scenario)
            return Memory(0.0)

        def decide(self, observation: Any, memory: Memory) -> tuple[np.ndarray, Memory]:
            return np.zeros((1, 4), dtype=int), Memory(3.0)

    watch = Stopwatch(Solver(), paper())
    memory = watch.start(paper(), 1)
    for _ in range(2):
        _, memory = watch.decide(None, memory)  # type: ignore[arg-type]
    assert watch.share(np.array([4.0, 8.0])) == 0.5 and len(starts) == 1
    watch.start(paper(), 1)
    assert len(starts) == 2  # another episode has its own memory
    assert Stopwatch(make_supervisor("scripted"), paper()).share(np.ones(2)) is None


def test_a_run_assembles_no_model_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run makes one World and starts the supervisor once, and the log uses the model of the World."""
    made: list[str] = []
    for kind, method in ((World, "__init__"), (MPCMS, "start")):
        original = getattr(kind, method)

        def counted(self, *arguments, _original=original, _name=f"{kind.__name__}.{method}", **options):
            made.append(_name)
            return _original(self, *arguments, **options)

        monkeypatch.setattr(kind, method, counted)
    monkeypatch.setattr(writer, "make_plan", None)
    main(["run", "paper", "--supervisor", "mpcms", "--out", str(tmp_path / "run"), *SHORT])
    assert made == ["World.__init__", "MPCMS.start"]


def test_seeds_leave_medians_and_intervals(tmp_path: Path) -> None:
    """`bench --seeds` writes all draws of each method, and medians with intervals, but no logs."""
    quick = ["--supervisors", "scripted", "fsams", "--controllers", "pd", "--seeds", "3", "--no-figures"]
    main(["bench", *quick, "--out", str(tmp_path / "out"), "--duration", "2.0"])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    team = summary["methods"]["fsams+pd"]["team"]
    assert team["return_ci"][0] <= team["return"] <= team["return_ci"][1]
    rows = (tmp_path / "out" / "episodes.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 3 * 4
    assert not (tmp_path / "out" / "logs").exists()


def test_run_leaves_log_metrics_and_config(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The log works with info, export and video. A truncated log is refused in one line until `recover` repairs it."""
    out = tmp_path / "run"
    main(["run", "--out", str(out), *SHORT])
    capsys.readouterr()
    assert "--overwrite" in refused(["run", "--out", str(out), *SHORT], capsys)
    main(["run", "--out", str(out), *SHORT, "--overwrite"])
    log = out / "logs" / "scripted+sorlc.mcap"
    assert {p.name for p in out.iterdir()} == {"logs", "metrics.json", "config.json"}
    capsys.readouterr()
    main(["log", "info", str(log)])
    assert json.loads(capsys.readouterr().out)["metadata"]["marlbc"]["supervisor"] == "scripted"
    main(["log", "export", str(log), str(out / "episode.npz")])
    assert np.load(out / "episode.npz")["position"].shape == (20, 4, 2)
    main(["video", str(log), "--size", "320x180", "--fps", "5"])
    assert log.with_suffix(".mp4").stat().st_size > 1000
    torn = out / "torn.mcap"
    torn.write_bytes(log.read_bytes()[:-100])
    capsys.readouterr()
    assert "truncated" in refused(["log", "export", str(torn), str(out / "x.csv")], capsys)
    main(["log", "recover", str(torn), str(out / "saved.mcap")])
    main(["log", "export", str(out / "saved.mcap"), str(out / "saved.csv")])
    assert "exists" in refused(["log", "export", str(log), str(out / "saved.csv")], capsys)


def test_json_is_one_document_and_quiet_is_silent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With --json, standard output is one document and notes go to standard error; with --quiet there is no output."""
    line = ["run", "paper", "--controller", "pd", *SHORT, "--seed", "3", "--out", str(tmp_path / "run")]
    main([*line, "--json"])
    said = capsys.readouterr()
    assert said.err == "marlbc: paper has nothing random: seed 3 gives the same episode as any other seed\n"
    recorded = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert {key: json.loads(said.out)["methods"]["scripted+pd"][key] for key in recorded} == recorded
    main([*line, "--overwrite", "--quiet"])
    assert capsys.readouterr() == ("", "")
    log = str(tmp_path / "run" / "logs" / "scripted+pd.mcap")
    main(["log", "info", log, "--metrics", "--json"])
    again = json.loads(capsys.readouterr().out)
    assert again["agents"] == recorded["agents"]


def test_a_team_and_a_robot_of_another_kind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They can be set by options and in files; a scenario with a fixed team refuses them and says why."""
    options = ScenarioOptions(agents=6, formation="circle", robot="omni")
    scenario, scale = options.build("field"), make_robot("omni").scale()
    assert scenario.agents == 6 and "circle" in scenario.description
    assert all(getattr(scenario, name) == value for name, value in scale.items())
    for option in (["--agents", "6"], ["--formation", "line"], ["--room"]):
        said = refused(["run", *option, "--out", str(tmp_path / "run")], capsys)
        assert f"paper has a fixed team; {option[0]} works with families: open, exchange, field" in said
    assert set(SCENARIOS) - set(FAMILIES) == set(FIXED_TEAMS)
    with pytest.raises(ConfigurationError, match="has a fixed team of 4 agents"):
        paper(agents=6)
    (tmp_path / "mine.toml").write_text('family = "open"\nrobot = "omni"\nagents = 3\n')
    from_file = make_scenario(str(tmp_path / "mine.toml"))
    assert all(getattr(from_file, name) == value for name, value in scale.items() if value != float("inf"))


def test_what_a_scenario_draws() -> None:
    """A scenario can draw starts, obstacles, drag, layouts, noise or lost messages; the published mission draws nothing."""
    assert not paper().draws and make_scenario("field").draws and paper(perturbation=Perturbation(start_spread=1.0)).draws
    for setting in ("imperfections.position_noise=0.1", "communication.loss=0.2"):
        assert ScenarioOptions(set=(setting,)).build("paper").draws


def test_unwritable_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder inside a file cannot be created; one line names it."""
    (tmp_path / "file").touch()
    assert "file" in refused(["bench", "--out", str(tmp_path / "file" / "out"), *SHORT], capsys)


def test_view_without_a_display(results: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """`view` fails with one line that names the command to use instead."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "marlbc video" in refused(["view", str(results / "logs" / "scripted+pd.mcap")], capsys)


def test_list_names_everything(capsys: pytest.CaptureFixture[str]) -> None:
    """`list` prints the names of all registries, each with a description."""
    main(["list"])
    text = capsys.readouterr().out
    for name in ("paper", "fsams-hysteresis", "sorlc-scaled", "finite-time-limited", "actual", "quadratic", "point_mass"):
        assert f"  {name} " in text
    for kind, names in (("training methods", METHODS), ("training presets", PRESETS)):
        lines = text.split(f"{kind}:\n")[1].splitlines()[: len(names)]
        assert [line.split()[0] for line in lines] == list(names)


def test_a_broken_gl_loses_the_video_and_nothing_else(tmp_path: Path) -> None:
    """If MUJOCO_GL is not a backend, `bench` still writes all other results, and `video` fails with the valid values."""
    environment = {**os.environ, "MUJOCO_GL": "nothing"}
    quick = ["--supervisors", "scripted", "--controllers", "pd", "--no-figures", "--duration", "0.5"]
    command = [sys.executable, "-m", "marlbc_mj", "bench", *quick, "--out", str(tmp_path / "out")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "MUJOCO_GL" in done.stderr
    assert (tmp_path / "out" / "index.html").exists()
    video = [sys.executable, "-m", "marlbc_mj", "video", str(tmp_path / "out" / "logs" / "scripted+pd.mcap")]
    failed = subprocess.run(video, env=environment, capture_output=True, text=True, timeout=120)
    assert failed.returncode == 2
    assert "choose from: egl, osmesa" in failed.stderr
    assert len(failed.stderr.strip().splitlines()) == 1
