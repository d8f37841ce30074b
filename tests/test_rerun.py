"""Export of a log to Rerun: Rerun's own reader finds the log's values in the recording."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.controllers import PD
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.scenarios import Scenario, make_scenario
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError


@pytest.fixture(scope="module", autouse=True)
def rerun() -> None:
    """Load Rerun only where these tests run, not in every process that collects them."""
    pytest.importorskip("rerun.chunk")


def logged(path: Path, scenario: Scenario) -> Path:
    with LogWriter(path, scenario, PD(), names=("fsams", "pd"), seed=0, config={}) as log:
        run_episode(World(scenario, PD(), record=True), make_supervisor("fsams"), on_frame=log.write)
    return path


def entities(path: Path) -> dict[str, dict[str, Any]]:
    """Temporal and static columns by entity and name."""
    found: dict[str, dict[str, Any]] = {}
    chunk: Any = pytest.importorskip("rerun.chunk")
    for each in chunk.RrdReader(str(path)).stream():
        batch = each.to_record_batch()
        for name in batch.schema.names:
            if name.startswith("RecordingInfo"):
                continue  # when the recording was made
            column = batch.column(name)
            found.setdefault(each.entity_path, {})[name] = column.to_numpy() if name == "mission" else column.to_pylist()
    return found


@pytest.mark.parametrize(
    ("name", "changes"), [("paper", {"duration": 20.0}), ("traffic", {"duration": 2.0}), ("open", {"duration": 1.0})]
)
def test_state_force_priorities_and_scene(tmp_path, name, changes):
    source = logged(tmp_path / "a.mcap", make_scenario(name, **changes))
    main(["log", "export", str(source), str(tmp_path / "a.rrd")])
    log, seen = read_log(source), entities(tmp_path / "a.rrd")
    steps, agents = log.position.shape[:2]
    for i in range(agents):
        for entity, values in (
            (f"/state/agent{i + 1}/position", log.position),
            (f"/state/agent{i + 1}/velocity", log.velocity),
            (f"/reference/agent{i + 1}/reference", log.reference),
            (f"/force/agent{i + 1}/force", log.force),
        ):
            assert (np.array(seen[entity]["Scalars:scalars"]) == values[:, i]).all()
            assert np.allclose(seen[entity]["mission"] / np.timedelta64(1, "s"), log.time, atol=1e-8)
            assert seen[entity]["SeriesLines:names"] == [["x", "y"]]
        texts = [text for (text,) in seen[f"/priorities/agent{i + 1}/command"]["TextLog:text"]]
        commands = [log.commands[k] for k in log.command[:, i]]
        assert texts == [c for k, c in enumerate(commands) if k == 0 or c != commands[k - 1]]
    places = np.array(seen["/scene/agents"]["Points3D:positions"])
    assert places.shape == (steps, agents, 3) and np.allclose(places[..., :2], log.position, rtol=1e-6, atol=1e-5)
    assert len(seen["/scene/paths"]["LineStrips3D:strips"][0]) == agents
    if len(log.obstacles):
        centers = np.array(seen["/scene/obstacles"]["Cylinders3D:centers"])
        moments = log.time if len(log.motions) else [0.0]
        expected = np.array([log.obstacles_at(time)[:, :2] for time in moments])
        assert np.allclose(centers[..., :2], expected, rtol=1e-6, atol=1e-4)
    else:
        assert "/scene/obstacles" not in seen


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    source = logged(tmp_path / "a.mcap", make_scenario("open", duration=0.5))

    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr("marlbc_mj.recording.rerun_file.import_module", missing)
    with pytest.raises(SystemExit):
        main(["log", "export", str(source), str(tmp_path / "a.rrd")])
    from marlbc_mj.recording.exports import export_log

    with pytest.raises(ConfigurationError, match="pip install rerun-sdk"):
        export_log(source, tmp_path / "a.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
