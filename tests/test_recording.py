"""Recording: logs are read back exactly, and a log truncated anywhere can be recovered as a shorter one."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from marlbc_mj.cli import main
from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Trajectory, run_episode
from marlbc_mj.recording import schemas
from marlbc_mj.recording.exports import export_log
from marlbc_mj.recording.log import EpisodeLog, from_trajectory
from marlbc_mj.recording.mcap_file import recover_log
from marlbc_mj.recording.reader import log_info, read_log
from marlbc_mj.recording.writer import LogWriter, partial_name
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.summary import json_numbers
from marlbc_mj.scenarios import Perturbation, Scenario, paper
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.provenance import config_hash

CONFIG = {"steps": 3, "nested": {"a": [1.5, None, "µ"]}}
TOPICS_EACH = 9  # messages per mission step
JSON_TOPICS = [topic.name for topic in schemas.TOPICS]


def writer(path: Path, scenario: Scenario, controller: str = "sorlc", **changes) -> LogWriter:
    names = {"names": ("scripted", controller), "seed": 0, "config": CONFIG}
    return LogWriter(path, scenario, make_controller(controller), **{**names, **changes})


def record(path: Path, scenario: Scenario, controller: str = "sorlc", seed: int = 0) -> Trajectory:
    world = World(scenario, make_controller(controller), record=True)
    with writer(path, scenario, controller, seed=seed) as log:
        return run_episode(world, make_supervisor("scripted"), seed=seed, names=("scripted", controller), on_frame=log.write)


def assert_same(one: EpisodeLog, other: EpisodeLog) -> None:
    """Assert that two logs are equal in every field, to the last bit."""
    for field in fields(EpisodeLog):
        assert_equal(getattr(one, field.name), getattr(other, field.name), field.name)


def assert_equal(a: Any, b: Any, name: str) -> None:
    """Assert that two values are equal; arrays, also those in named tuples, exactly."""
    if hasattr(a, "_fields"):
        for inner in a._fields:
            assert_equal(getattr(a, inner), getattr(b, inner), f"{name}.{inner}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)
    else:
        assert a == b, name


def messages(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with open(path, "rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
    return found


def strict_json(data: bytes):
    """Parse JSON and refuse the constants that only Python accepts, such as NaN."""

    def refuse(constant: str):
        raise AssertionError(f"{constant} in {data!r}")

    return json.loads(data, parse_constant=refuse)


def matches(value, schema: dict) -> bool:
    """Whether a value matches a schema, for the part of JSON Schema that the topics use."""
    kind = schema["type"]
    if kind == "object":
        known = all(name in schema["properties"] and matches(v, schema["properties"][name]) for name, v in value.items())
        return known and all(name in value for name in schema["required"])
    if kind == "array":
        return isinstance(value, list) and all(matches(v, schema["items"]) for v in value)
    python = {"number": (int, float), "integer": int, "string": str}[kind]
    return isinstance(value, python) and not isinstance(value, bool)


@pytest.fixture(scope="session")
def short(tmp_path_factory) -> tuple[Path, Trajectory]:
    path = tmp_path_factory.mktemp("logs") / "short.mcap"
    return path, record(path, paper(duration=2.0))


@pytest.fixture(scope="session")
def empty_field(tmp_path_factory) -> tuple[Path, Trajectory]:
    """A log without obstacles, so that every clearance is infinite, and with a controller that has no network weights."""
    path = tmp_path_factory.mktemp("logs") / "empty.mcap"
    return path, record(path, paper(duration=1.0, obstacles=()), "pd")


@pytest.mark.parametrize(("name", "controller"), [("short", "sorlc"), ("empty_field", "pd")])
def test_round_trip_is_exact(name, controller, request):
    path, trajectory = request.getfixturevalue(name)
    assert_same(read_log(path), from_trajectory(trajectory, make_controller(controller)))


def test_round_trip_of_a_drawn_episode(tmp_path):
    """The log has the obstacles drawn for this seed, not the scenario's."""
    scenario = paper(duration=1.0, perturbation=Perturbation(start_spread=0.5, obstacle_spread=1.0, drag_scale=(0.5, 2.0)))
    trajectory = record(tmp_path / "a.mcap", scenario, seed=7)
    log = read_log(tmp_path / "a.mcap")
    assert_same(log, from_trajectory(trajectory, make_controller("sorlc")))
    assert not np.array_equal(log.obstacles, scenario.obstacle_array())


@given(values=st.lists(st.tuples(st.floats(), st.floats(), st.floats(), st.floats()), min_size=1, max_size=4))
def test_encoded_numbers_are_json_and_exact(values):
    """Finite floats are restored to the last bit; NaN and infinity are omitted."""
    rows = strict_json(schemas.encode(schemas.STATE_TOPIC, np.array(values), time=0.1))["agents"]
    for row, expected in zip(rows, values, strict=True):
        finite = {n: x for n, x in zip(schemas.STATE_TOPIC.columns, expected, strict=True) if math.isfinite(x)}
        assert row == finite


def test_every_channel_has_a_schema(short):
    topics = log_info(short[0])["topics"]
    assert set(topics) == {"/scene", "/tf", *JSON_TOPICS}
    for name, topic in topics.items():
        kind = ("protobuf", "protobuf") if name in ("/scene", "/tf") else ("jsonschema", "json")
        assert (topic["schema_encoding"], topic["message_encoding"]) == kind
        assert topic["schema"]
        assert topic["messages"] == 40


@pytest.mark.parametrize("name", ["short", "empty_field"])
def test_json_messages_match_their_schemas(name, request):
    path, _ = request.getfixturevalue(name)
    found = messages(path)
    for topic in schemas.TOPICS:
        for data in found.get(topic.name, []):
            assert matches(strict_json(data), schemas.json_schema(topic)), (topic.name, data)


def test_schemas_are_simple_enough_for_viewers():
    """Every field has one plain type, and there is no array of arrays, as Foxglove's schema parser requires."""

    def check(schema: dict) -> None:
        assert isinstance(schema["type"], str)
        for child in schema.get("properties", {}).values():
            check(child)
        if schema["type"] == "array":
            assert schema["items"]["type"] == "object"
            check(schema["items"])

    for topic in schemas.TOPICS:
        check(schemas.json_schema(topic))


def test_topics_that_do_not_apply_are_absent(empty_field):
    assert "/weights" not in log_info(empty_field[0])["topics"]
    assert all(row == {} for row in strict_json(messages(empty_field[0])["/metrics"][0])["agents"])


def test_scene_shows_agents_references_and_obstacles(short):
    path, _ = short
    log, found = read_log(path), messages(path)
    for k in (0, 17, 39):
        scene, transforms = SceneUpdate.FromString(found["/scene"][k]), FrameTransforms.FromString(found["/tf"][k])
        entities = {entity.id: entity for entity in scene.entities}
        assert set(entities) == {"obstacles", "agent1", "agent2", "agent3", "agent4"}
        assert len(entities["obstacles"].cylinders) == len(entities["obstacles"].lines) == 6
        for i, transform in enumerate(transforms.transforms):
            entity = entities[f"agent{i + 1}"]
            body, reference = (s.pose.position for s in entity.spheres)
            assert (body.x, body.y) == tuple(log.position[k, i])
            assert (reference.x, reference.y) == tuple(log.reference[k, i])
            assert [(p.x, p.y) for p in entity.lines[0].points] == [(body.x, body.y), (reference.x, reference.y)]
            assert (transform.parent_frame_id, transform.child_frame_id) == ("world", f"agent{i + 1}")
            assert (transform.translation.x, transform.translation.y) == (body.x, body.y)
            assert transform.timestamp.ToNanoseconds() == entity.timestamp.ToNanoseconds() == round(log.time[k] * 1e9)


def test_rings_are_at_the_safe_distance(short):
    scene = SceneUpdate.FromString(messages(short[0])["/scene"][0])
    obstacles = next(entity for entity in scene.entities if entity.id == "obstacles")
    for obstacle, ring in zip(read_log(short[0]).obstacles, obstacles.lines, strict=True):
        assert (ring.pose.position.x, ring.pose.position.y) == tuple(obstacle[:2])
        assert [math.hypot(p.x, p.y) for p in ring.points] == pytest.approx([obstacle[2] + 2.0] * len(ring.points))


def test_metadata_and_attachments(short):
    path, trajectory = short
    info = log_info(path)
    about = info["metadata"]["marlbc"]
    assert about["config_sha256"] == config_hash(CONFIG)
    assert (about["scenario"], about["supervisor"], about["controller"], about["seed"]) == ("paper", "scripted", "sorlc", "0")
    assert {"python", "mujoco", "numpy", "numba", "mcap"} <= set(info["metadata"]["versions"])
    assert info["duration_s"] == pytest.approx(1.95)
    with open(path, "rb") as stream:
        attached = {a.name: a.data for a in make_reader(stream).iter_attachments()}
    assert json.loads(attached["config.json"]) == CONFIG
    assert attached["model.xml"].decode() == from_trajectory(trajectory, make_controller("sorlc")).mjcf
    layout = json.loads(attached["foxglove-layout.json"])
    assert set(layout["configById"]) == {"3D!scene", "Plot!force", "Plot!clearance", "StateTransitions!priorities"}


def test_layout_plots_fields_that_exist(short):
    """Every message path of the layout, ``/topic.agents[i].field``, is in the topic's schema."""
    with open(short[0], "rb") as stream:
        layout = next(a.data for a in make_reader(stream).iter_attachments() if a.name == "foxglove-layout.json")
    known = {f"{t.name}.agents[{i}].{column}" for t in schemas.TOPICS for i in range(4) for column in t.columns}
    panels = json.loads(layout)["configById"].values()
    assert {path["value"] for panel in panels for path in panel.get("paths", [])} <= known


def test_existing_files_are_kept_unless_told(tmp_path):
    """Neither a finished log nor a partial one, which may still be recovered, is overwritten."""
    scenario, path = paper(duration=1.0), tmp_path / "a.mcap"
    for taken in (path, partial_name(path)):
        taken.write_bytes(b"precious")
        with pytest.raises(ConfigurationError, match="exists"):
            writer(path, scenario)
        assert taken.read_bytes() == b"precious"
        taken.unlink()
    path.write_bytes(b"old")
    writer(path, scenario, overwrite=True).close()
    assert log_info(path)["messages"] == 0


def test_paths_that_cannot_be_written(tmp_path):
    scenario = paper(duration=1.0)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.mcap").mkdir()
    for path in (tmp_path / "file" / "a.mcap", tmp_path / "folder.mcap", tmp_path / "a.txt", Path("/proc/a.mcap")):
        with pytest.raises(ConfigurationError) as error:
            writer(path, scenario)
        assert "\n" not in str(error.value)


def test_a_run_that_fails_leaves_a_readable_partial_log(tmp_path, short):
    frames = 5

    def fail_after(log: LogWriter):
        def on_frame(frame):
            if len(written) == frames:
                raise SimulationError("diverged")
            written.append(frame)
            log.write(frame)

        return on_frame

    written: list = []
    scenario, path = paper(duration=2.0), tmp_path / "a.mcap"
    world = World(scenario, record=True)
    with pytest.raises(SimulationError), writer(path, scenario) as log:
        run_episode(world, make_supervisor("scripted"), on_frame=fail_after(log))
    assert not path.exists()
    np.testing.assert_array_equal(read_log(partial_name(path)).position, read_log(short[0]).position[:frames])


@pytest.fixture(scope="session")
def chunked(tmp_path_factory) -> Path:
    """A log with many chunks, as a run in real time writes it."""
    path = tmp_path_factory.mktemp("logs") / "chunked.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("marlbc_mj.recording.writer.CHUNK_SIZE", 20_000)
        record(path, paper(duration=2.0))
    assert log_info(path)["chunks"] >= 5
    return path


def recovered(path: Path, out: Path) -> int:
    """Recover a log and return the number of messages; 0 if there is nothing to recover."""
    try:
        return recover_log(path, out)
    except ConfigurationError as error:
        if not str(error).endswith("holds no complete message, so there is nothing to recover"):
            raise
        return 0


@settings(max_examples=25)
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_torn_anywhere(chunked, share):
    """Reading raises one clear error; recovery saves whole mission steps, metadata and attachments."""
    data, whole = chunked.read_bytes(), read_log(chunked)
    with tempfile.TemporaryDirectory() as folder:
        torn, out = Path(folder) / "torn.mcap.partial", Path(folder) / "out.mcap"
        torn.write_bytes(data[: int(share * len(data))])
        for read in (read_log, log_info):
            with pytest.raises(ConfigurationError, match=r"is truncated; `marlbc log recover .*` salvages the intact messages"):
                read(torn)
        saved = recovered(torn, out)
        if not saved:
            assert [path.name for path in Path(folder).iterdir()] == [torn.name]
            return
        info, log = log_info(out), read_log(out)
        assert info["messages"] == saved > 0
        assert saved % TOPICS_EACH == 0
        np.testing.assert_array_equal(log.position, whole.position[: saved // TOPICS_EACH])
        assert measure(log)["team"]["return"] == whole.reward[: saved // TOPICS_EACH].sum()
        assert log.mjcf == whole.mjcf
        assert len(info["attachments"]) == 3


@settings(max_examples=25)
@given(share=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_damaged_anywhere(chunked, share, flip):
    """With one wrong byte anywhere, reading raises one clear error; recovery still ends and saves no wrong motion."""
    data, whole = bytearray(chunked.read_bytes()), read_log(chunked)
    place = int(share * len(data))
    data[place] ^= flip
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "damaged.mcap", Path(folder) / "out.mcap"
        path.write_bytes(data)
        with pytest.raises(ConfigurationError, match=r"^.*(damaged|truncated|not an MCAP).*$"):
            read_log(path)
        if place < 8:
            with pytest.raises(ConfigurationError, match="not an MCAP"):
                recover_log(path, out)
            return
        if recovered(path, out):
            with suppress(ConfigurationError):  # the model or metadata was hit: the log is refused
                assert np.isin(read_log(out).position, whole.position).all()


def test_a_damaged_attachment_is_left_out(chunked, tmp_path):
    """Its checksum reveals it; the rest is recovered, and the recovered log is refused because its model is missing."""
    data, damaged, out = chunked.read_bytes(), tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    before = len(log_info(chunked)["attachments"])
    place = data.index(b"<mujoco") + 1
    damaged.write_bytes(data[:place] + b"N" + data[place + 1 :])
    assert recover_log(damaged, out) == log_info(chunked)["messages"]
    assert len(log_info(out)["attachments"]) == before - 1
    with pytest.raises(ConfigurationError, match="has no attachment .*; it was damaged, or not written by marlbc"):
        read_log(out)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_with_nothing_to_recover_is_refused(chunked, tmp_path, capsys, overwrite):
    """An empty file or a log cut before its first whole chunk gives a one-line error; existing files are unchanged."""
    out = tmp_path / "out.mcap"
    for data in (b"", chunked.read_bytes()[:40]):
        torn = tmp_path / "torn.mcap.partial"
        torn.write_bytes(data)
        if overwrite:
            out.write_bytes(b"precious")
        with pytest.raises(SystemExit) as stopped:
            main(["log", "recover", str(torn), str(out), *(["--overwrite"] if overwrite else [])])
        assert stopped.value.code == 2
        said = capsys.readouterr()
        assert said.err == f"marlbc: {torn} holds no complete message, so there is nothing to recover\n"
        assert said.out == ""
        assert sorted(p.name for p in tmp_path.iterdir()) == (["out.mcap"] if overwrite else []) + [torn.name]
        assert not overwrite or out.read_bytes() == b"precious"


def test_video_names_its_backend_only_once_it_draws(short, tmp_path, capsys):
    """A wrong argument gives a one-line error alone."""
    with pytest.raises(SystemExit):
        main(["video", str(short[0]), "--speed", "0"])
    assert capsys.readouterr().err == "marlbc: speed must be positive, got 0.0\n"
    small = ["--size", "128x96", "--fps", "2", "--end", "1"]
    main(["video", str(short[0]), "--out", str(tmp_path / "a.mp4"), *small])
    assert capsys.readouterr().err.startswith("marlbc: off-screen rendering with ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bnch"], r"unknown command 'bnch'; perhaps 'bench'; choose from: bench, run, .*; see `marlbc --help`"),
        (
            ["log", "rec"],
            r"unknown command 'rec'; perhaps 'recover'; choose from: info, recover, export; see `marlbc log --help`",
        ),
        (["run", "--sed", "1"], r"Unrecognized options: --sed, 1; perhaps --seed; see `marlbc run --help`"),
        (["run", "--seed", "x"], r"--seed must be a whole number, got 'x'"),
        (["bench", "--video", "x"], r"invalid choice 'x' for argument '--video'.*'all', 'none'\); see `marlbc bench --help`"),
        (["log", "recover", "a"], r"Missing from marlbc log recover: PATH .*; see `marlbc log recover --help`"),
        ([], r"Expected one of \{bench, .*\}; see `marlbc --help`"),
    ],
)
def test_arguments_that_cannot_be_parsed_are_one_line(arguments, said, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert re.fullmatch(f"marlbc: {said}\n", capsys.readouterr().err)


def test_help_is_printed_as_it_is(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["log", "--help"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out.startswith("usage: marlbc log")


def test_recovering_a_whole_log_changes_nothing(short, tmp_path):
    assert recover_log(short[0], tmp_path / "out.mcap") == TOPICS_EACH * 40
    assert_same(read_log(tmp_path / "out.mcap"), read_log(short[0]))
    assert log_info(tmp_path / "out.mcap")["metadata"] == log_info(short[0])["metadata"]


def test_recovery_beside_the_torn_log(short, tmp_path):
    """Recovering ``a.mcap.partial`` to ``a.mcap``, the obvious call, leaves the partial file unchanged."""
    torn = tmp_path / "a.mcap.partial"
    data = short[0].read_bytes()[:-100]
    torn.write_bytes(data)
    recover_log(torn, tmp_path / "a.mcap")
    assert torn.read_bytes() == data
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.mcap.partial"]


SLOW_RUN = """
import sys, time
from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors import make_supervisor

scenario, controller = paper(), make_controller("sorlc")
log = LogWriter(sys.argv[1], scenario, controller, names=("scripted", "sorlc"), seed=0, config={})

def slowly(frame):
    log.write(frame)
    print(time.monotonic(), flush=True)
    time.sleep(0.02)

run_episode(World(scenario, controller, record=True), make_supervisor("scripted"), on_frame=slowly)
"""


def test_killed_run_loses_at_most_its_last_second(tmp_path):
    """After ``kill -9``, frames older than a second are saved; the monotonic clock, shared by all processes, dates them."""
    path = tmp_path / "killed.mcap"
    with subprocess.Popen([sys.executable, "-c", SLOW_RUN, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        written = [float(process.stdout.readline())]
        while written[-1] < written[0] + 2.3:
            written.append(float(process.stdout.readline()))
        os.kill(process.pid, signal.SIGKILL)
        killed = time.monotonic()
        written += [float(line) for line in process.stdout]
    assert process.returncode == -signal.SIGKILL
    assert not path.exists()
    recover_log(partial_name(path), path)
    log = read_log(path)
    assert len(log.time) >= sum(moment < killed - 1.0 for moment in written) > 0
    np.testing.assert_array_equal(log.time, np.arange(len(log.time)) * 0.05)


def test_unreadable_inputs(tmp_path):
    text, foreign = tmp_path / "a.txt", tmp_path / "foreign.mcap"
    text.write_text("no log at all, but long enough to have a footer")
    with open(foreign, "wb") as stream:
        other = Writer(stream)
        other.start()
        schema = other.register_schema("x", "jsonschema", b'{"type":"object"}')
        other.add_message(other.register_channel("/x", "json", schema), 0, b"{}", 0)
        other.finish()
    cases = [(tmp_path / "missing.mcap", "cannot read"), (tmp_path, "cannot read"), (text, "is not an MCAP file")]
    for path, text_of_error in cases:
        for read in (read_log, log_info, lambda p: recover_log(p, tmp_path / "out.mcap")):
            with pytest.raises(ConfigurationError, match=text_of_error):
                read(path)
    with pytest.raises(ConfigurationError, match="not written by marlbc"):
        read_log(foreign)
    assert log_info(foreign)["topics"]["/x"]["messages"] == 1
    assert not (tmp_path / "out.mcap").exists()


def test_csv_is_the_log(short, tmp_path):
    log = read_log(short[0])
    export_log(short[0], tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(float(r["time"]), int(r["agent"])) for r in rows] == [(t, i) for t in log.time for i in (1, 2, 3, 4)]
    for name in ("position", "velocity", "reference", "reference_velocity", "force"):
        table = np.array([[float(row[f"{name}_x"]), float(row[f"{name}_y"])] for row in rows])
        np.testing.assert_array_equal(table.reshape(-1, 4, 2), getattr(log, name))
    np.testing.assert_array_equal([float(row["clearance"]) for row in rows], log.clearance.ravel())
    assert [row["command"] for row in rows] == [log.commands[c] for c in log.command.ravel()]
    for name in ("formation", "reward", "decision_ms"):
        np.testing.assert_array_equal([float(row[name]) for row in rows[::4]], getattr(log, name))


def test_npz_is_the_log(empty_field, tmp_path):
    log = read_log(empty_field[0])
    export_log(empty_field[0], tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert log.substeps is not None
        rows = {f"substep_{name}": row for name, row in log.substeps._asdict().items() if name != "course"}
        whole = {field.name: getattr(log, field.name) for field in fields(EpisodeLog) if field.name != "substeps"} | rows
        assert set(arrays) == set(whole)
        for name in arrays:
            np.testing.assert_array_equal(arrays[name], whole[name])


def test_json_lines_and_parquet_hold_the_rows_of_the_csv(empty_field, tmp_path):
    """Numbers are identical; a clearance without obstacles is null in JSON and infinite in the other formats."""
    for name in ("a.csv", "a.jsonl", "a.parquet"):
        main(["export", str(empty_field[0]), str(tmp_path / name), "--quiet"])
    with open(tmp_path / "a.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    table = pyarrow.parquet.read_table(tmp_path / "a.parquet")
    assert table.schema.metadata[b"supervisor"] == b"scripted"
    assert len(rows) == len(lines) == table.num_rows == 4 * len(read_log(empty_field[0]).time)
    for row, line, other in zip(rows, lines, table.to_pylist(), strict=True):
        assert list(row) == list(line) == list(other) and line["clearance"] is None and other["clearance"] == np.inf
        for key in row:
            assert row[key] == str(other[key]) and line[key] in (other[key], None)


def test_parquet_needs_its_package(short, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ConfigurationError, match=r"Parquet needs pyarrow: pip install 'marlbc-mj\[parquet\]'"):
        export_log(short[0], tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []


def test_metrics_of_a_log_are_those_of_its_episode(short, empty_field):
    """Metrics are exactly equal, for SORLC among obstacles and for PD without obstacles."""
    for path, trajectory in (short, empty_field):
        assert measure(read_log(path)) == measure(trajectory)


@pytest.mark.parametrize(("scenario", "controller"), [("traffic", "pd"), ("paper", "lqr")])
def test_metrics_of_other_logs(tmp_path, scenario, controller):
    out = tmp_path / "run"
    shield = ["--shield"] if scenario == "traffic" else []
    line = ["run", scenario, "--supervisor", "fixed", "--controller", controller, "--duration", "1", "--seed", "3", *shield]
    main([*line, "--out", str(out), "--quiet"])
    recorded = json.loads((out / "metrics.json").read_text())
    assert json_numbers(measure(read_log(out / "logs" / f"fixed+{controller}.mcap"))) == recorded


def test_a_log_of_mission_steps_only_has_no_metrics(short):
    with pytest.raises(ConfigurationError, match="metrics need every substep"):
        measure(replace(read_log(short[0]), substeps=None))


def test_outputs_are_not_overwritten_and_formats_are_checked(short, tmp_path):
    with pytest.raises(ConfigurationError, match=r"unknown export format '\.xlsx'; choose from: \.csv, \.jsonl, \.parquet"):
        export_log(short[0], tmp_path / "a.xlsx")
    for name, write in (("a.csv", export_log), ("a.npz", export_log), ("a.mcap", recover_log)):
        out = tmp_path / name
        out.write_text("precious")
        with pytest.raises(ConfigurationError, match="exists"):
            write(short[0], out)
        assert out.read_text() == "precious"
        write(short[0], out, overwrite=True)
        assert out.stat().st_size > 1000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.mcap", "a.npz"]
