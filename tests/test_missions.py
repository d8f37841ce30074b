"""Outcomes of missions, their evaluation on held-out layouts, and the cost of teams of any size."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.outcomes import FAILED_MISSION, outcome, outcome_rates
from marlbc_mj.results.statistics import rate
from marlbc_mj.scenarios import held_out, make_scenario
from marlbc_mj.scenarios.families import Gates
from marlbc_mj.studies import scale
from marlbc_mj.studies.draws import perturbed, run_methods
from marlbc_mj.supervisors import UNLEARNED, make_supervisor
from marlbc_mj.util.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("coarse_figures")


@pytest.fixture(scope="module")
def flown():
    """A scripted mission through one gate, and its metrics."""
    scenario = Gates(gates=1, length=40.0).build()
    return scenario, measure(run_episode(World(scenario, record=True), make_supervisor("scripted")))


def test_a_mission_through_a_gate_succeeds(flown):
    """With the family's own schedule, the team ends in formation without violation or collision."""
    scenario, metrics = flown
    assert outcome(metrics, scenario) == (True, False, False, False) and outcome(metrics, scenario).success
    assert metrics["team"]["end_error"] < 0.05


def test_every_part_of_an_outcome_can_fail(flown):
    """Each part can fail alone; a run that failed, without metrics, fails in every part."""
    scenario, metrics = flown
    agents, team = metrics["agents"], metrics["team"]
    late = outcome({"agents": agents, "team": {**team, "end_error": 0.51}}, scenario)
    violated = outcome({"agents": [*agents[1:], {**agents[0], "violation_time": 0.005}], "team": team}, scenario)
    struck = outcome({"agents": [*agents[1:], {**agents[0], "clearance_min": 0.5}], "team": team}, scenario)
    collided = outcome({"agents": agents, "team": {**team, "agent_distance_min": 1.0}}, scenario)
    assert (late, violated) == ((False, False, False, False), (True, True, False, False))
    assert (struck, collided) == ((True, False, True, False), (True, False, False, True))
    assert not any(one.success for one in (late, violated, struck, collided, FAILED_MISSION))
    assert outcome(None, scenario) == FAILED_MISSION


def test_the_end_is_absolute(flown):
    """A team that keeps its formation but does not follow its path has not arrived."""
    scenario = make_scenario("open", duration=2.0)
    world = World(scenario, record=True)
    trajectory = run_episode(world, make_supervisor("scripted"))
    still = np.broadcast_to(trajectory.position[0], trajectory.position.shape)
    team = measure(replace(trajectory, position=still))["team"]
    assert team["formation_error"] < 1e-9 and team["end_error"] == pytest.approx(2.0)


def test_a_scenario_that_draws_layouts_is_not_perturbed_on_top():
    """Gaps between obstacles stay as the family guarantees; every method runs on the layouts of the held-out seeds."""
    scenario = held_out(make_scenario("field", duration=0.5))
    assert perturbed(scenario) is scenario
    runs = run_methods(scenario, [("fsams", "sorlc"), ("fms", "sorlc")], (0, 1)).methods
    for first, second in zip(runs[0].runs, runs[1].runs, strict=True):
        np.testing.assert_array_equal(first.instance.obstacles, second.instance.obstacles)
    assert not np.array_equal(runs[0].runs[0].instance.obstacles, runs[0].runs[1].instance.obstacles)
    drawn = scenario.draw(np.random.default_rng(np.random.SeedSequence([1, 0])))
    assert drawn.layout % 2 == 1
    np.testing.assert_array_equal(runs[0].runs[1].instance.obstacles, drawn.obstacles)


def test_evaluate_reports_every_supervisor(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """All supervisors without learning run on two held-out layouts; those without a schedule for them report the reason."""
    out = tmp_path / "evaluation"
    main(["evaluate", "field", "--seeds", "2", "--duration", "1", "--out", str(out)])
    assert "success, rate [%]" in capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text())
    assert set(summary["methods"]) == {f"{name}+sorlc" for name in UNLEARNED}
    assert summary["split"] == "test"
    assert "no schedule" in summary["methods"]["scripted+sorlc"]["failure"]
    assert "marlbc oracle" in summary["methods"]["oracle+sorlc"]["failure"]
    for name in ("fsams", "fms", "mpcms", "layered", "motor-schema", "fuzzy-blend"):
        entry = summary["methods"][f"{name}+sorlc"]
        assert 0 <= entry["success_rate_ci"][0] <= entry["success_rate"] <= entry["success_rate_ci"][1] <= 1
    assert "Outcome of the mission" in (out / "index.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["evaluate", "paper"], "draws no layouts"),
        (["evaluate", "field", "--supervisors", "nobody"], "unknown supervisor 'nobody'"),
        (["evaluate", "field", "--supervisors"], "name at least one supervisor"),
        (["bench", "nowhere.toml"], "cannot read nowhere.toml"),
        (["run", "field", "--split", "validation"], "unknown split 'validation'"),
        (["scale", "--rounds", "3"], "rounds must be at least 5"),
    ],
)
def test_wrong_settings_are_one_line(arguments, fragment, tmp_path, monkeypatch, capsys):
    """The exit status is 2 and no file is left behind."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and fragment in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_run_of_a_file_leaves_a_log(tmp_path: Path):
    """The command line runs a TOML mission with moving obstacles and wind."""
    file = tmp_path / "mine.toml"
    file.write_text('family = "traffic"\nagents = 3\n[disturbance]\nkind = "gusts"\n')
    main(["run", str(file), "--supervisor", "fsams-hysteresis", "--duration", "2", "--out", str(tmp_path / "run")])
    assert (tmp_path / "run" / "logs" / "fsams-hysteresis+sorlc.mcap").stat().st_size > 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["scenario"]["name"] == "mine" and config["scenario"]["disturbance"]["type"] == "WindGusts"


@pytest.mark.slow
def test_a_small_scale_run_has_every_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Table, plots and numbers are written; the values themselves depend on the machine."""
    for name, value in {"SIZES": (4, 16), "AGENT_STEPS": 64, "MEMORY_AGENTS": 64, "LEAST_WORLDS": 8}.items():
        monkeypatch.setattr(scale, name, value)
    figures = scale.ScaleStudy(5).gather(scale.run_scale(5, tmp_path / "out").results)
    assert figures["growth"]["4"] == 1.0
    for key in ("us_per_agent_and_mission_step", "kib_per_world", "kib_per_agent", "growth"):
        assert set(figures[key]) == {"4", "16"} and min(figures[key].values()) > 0
    assert {path.name for path in tmp_path.rglob("*.*")} == {
        "scale.md",
        "scale.json",
        "scale.pdf",
        "scale.png",
        ".marlbc-files.json",
    }


def test_256_agents_run_under_every_supervisor_that_decides_per_agent():
    """All agents share one world; MPCMS, which would be too expensive, is refused."""
    scenario = replace(scale.mission(256), duration=0.2)
    world = World(scenario, record=True)
    assert world.data[0].narena > 2 * 133_000
    for name in scale.SCALED_SUPERVISORS:
        assert np.isfinite(run_episode(world, make_supervisor(name)).position).all()
    with pytest.raises(ConfigurationError, match="256 agents"):
        make_supervisor("mpcms").start(scenario, 1)


def test_the_outcome_in_summary_json(tmp_path: Path):
    """Every method has its number of runs and six shares in [0, 1] with intervals; without a shield, intervention is 0."""
    out, parts = tmp_path / "evaluation", ("success", "reached", "violation", "struck", "collided", "intervention")
    quick = ["--seeds", "3", "--seed", "7", "--duration", "1", "--agents", "3", "--formation", "line", "--out", str(out)]
    main(["evaluate", "field", "--supervisors", "fixed", "set-based-rule", "scripted", *quick])
    summary = json.loads((out / "summary.json").read_text())
    assert summary["seeds"] == [7, 8, 9]
    for method, entry in summary["methods"].items():
        found = entry["outcome"]
        assert set(found) == {"runs", *parts, *(f"{part}_ci" for part in parts)} and found["runs"] == 3, method
        for part in parts:
            low, high = found[f"{part}_ci"]
            assert 0.0 <= low <= found[part] <= high <= 1.0
        assert found["success"] == entry["success_rate"] and found["intervention"] == 0.0
    failed = summary["methods"]["scripted+sorlc"]["outcome"]
    assert [failed[part] for part in parts] == [0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    config = json.loads((out / "config.json").read_text())
    assert len(config["scenario"]["starts"]) == 3


def test_outcome_rates_by_hand(flown):
    """Rates of one success, one late run in which a shield intervened, and one failed run."""
    scenario, metrics = flown
    late = {
        **metrics,
        "team": {**metrics["team"], "end_error": 0.51},
        "agents": [{**agent, "intervention_share": 0.1} for agent in metrics["agents"]],
    }
    rates = outcome_rates([metrics, late, None], scenario)
    values = {name: estimate.value for name, estimate in rates.items()}
    third = pytest.approx(1 / 3)
    assert values == {**dict.fromkeys(("success", "violation", "struck", "collided", "intervention"), third), "reached": third}
    assert rates["success"] == rate([True, False, False])
