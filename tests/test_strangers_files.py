"""Third-party scenario files, logs and checkpoints: read within bounds or refused in one line, never run as code."""

import io
import json
import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import digest, read_arrays, write_arrays
from marlbc_mj.recording import mcap_file
from marlbc_mj.recording.exports import export_log
from marlbc_mj.recording.mcap_file import recover_log
from marlbc_mj.recording.reader import log_info, read_log
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.robots import make_robot, trial
from marlbc_mj.scenarios import load_scenario, make_scenario
from marlbc_mj.util.errors import ConfigurationError

OPEN = 'family = "open"\nagents = 4\n'
CUSTOM = 'family = "custom"\nstarts = [[0, -1], [0, 1]]\nslots = [[0, -1], [0, 1]]\ncolumn = [[1, 0], [-1, 0]]\nduration = 12.0\n'
CART = """<mujoco model="cart"><worldbody><body name="cart" pos="0 0 0.1">
<joint name="east" type="slide" axis="1 0 0"/><joint name="north" type="slide" axis="0 1 0"/>
<geom type="cylinder" size="0.15 0.05" mass="3"/></body></worldbody>
<actuator><motor name="push_e" joint="east" ctrllimited="true" ctrlrange="-12 12"/>
<motor name="push_n" joint="north" ctrllimited="true" ctrlrange="-12 12"/></actuator></mujoco>"""


def toml(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "cell.toml"
    path.write_bytes(text.encode(encoding))
    return path


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path):
    assert load_scenario(toml(tmp_path, OPEN, "utf-8-sig")) == load_scenario(toml(tmp_path, OPEN))


@pytest.mark.parametrize("text", ["\r\n".join(OPEN.splitlines()), OPEN + "\n" * 3])
def test_line_ends_of_other_systems(tmp_path, text):
    assert load_scenario(toml(tmp_path, text)).agents == 4


WRONG_TOML = {
    "a window that ends before it starts": (CUSTOM + 'schedule = [[9.0, 3.0, -1, "FR"]]\n', "ends before it starts"),
    "nested lists": (OPEN + "x = " + "[" * 5000 + "]" * 5000, "nested"),
    "nested tables": (OPEN + "x = " + "{a=" * 3000 + "1" + "}" * 3000, "nested"),
    "a key of many parts": (OPEN + "a." * 20_000 + "b = 1\n", "nested"),
    "a table of many parts": (OPEN + "[" + "a." * 20_000 + "b]\n", "nested"),
    "a huge whole number": (OPEN + f"length = 1{'0' * 30}\n", "cell.toml"),
    "a number of thousands of digits": (OPEN + f"length = 1{'0' * 6000}\n", "cell.toml"),
    "a huge number of agents": (OPEN.replace("4", f"1{'0' * 30}"), "cell.toml"),
    "a kind that is a list": (OPEN + "[disturbance]\nkind = []\n", "disturbance"),
    "a mission step of zero": (OPEN + "mission_step = 0.0\n", "cell.toml"),
    "a denormal substep": (OPEN + "substep = 1e-320\n", "cell.toml"),
    "a huge speed": (OPEN + "speed = 1e308\n", "cell.toml"),
    "a huge length": (OPEN + "length = 1e300\n", "cell.toml"),
    "a robot that is a program": (OPEN + 'robot = "cart.py"\n', "--allow-code"),
    "a robot that is a program elsewhere": (OPEN + 'robot = "/any/cart.py"\n', "--allow-code"),
    "a robot that is no text": (OPEN + "robot = 3\n", "robot"),
    "an unknown robot": (OPEN + 'robot = "tank"\n', "omni"),
    "no text at all": ("\x00\x01\x02", "TOML"),
}


@pytest.mark.parametrize("name", WRONG_TOML)
def test_a_wrong_scenario_file_is_one_line(tmp_path, name):
    text, fragment = WRONG_TOML[name]
    began = time.monotonic()
    with pytest.raises(ConfigurationError) as error:
        load_scenario(toml(tmp_path, text))
    assert fragment in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 2000
    assert time.monotonic() - began < 5.0


def test_other_things_than_files_are_refused(tmp_path):
    for name in ("pipe.toml", "pipe.mcap"):
        os.mkfifo(tmp_path / name)  # reading one would block forever
    for read, name in ((load_scenario, "pipe.toml"), (read_log, "pipe.mcap"), (load_scenario, ".toml")):
        with pytest.raises(ConfigurationError):
            read(tmp_path / name)


def test_code_runs_only_where_it_is_allowed(tmp_path, capsys):
    """A robot's Python file named in a scenario file runs only with `--allow-code`."""
    (tmp_path / "cart.py").write_text(f"import pathlib\npathlib.Path({str(tmp_path / 'ran')!r}).touch()\nROBOT = None\n")
    path = toml(tmp_path, OPEN + 'robot = "cart.py"\n')
    with pytest.raises(SystemExit) as stopped:
        main(["run", str(path), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2 and "--allow-code" in capsys.readouterr().err and not (tmp_path / "ran").exists()
    with pytest.raises(SystemExit):
        main(["run", str(path), "--out", str(tmp_path / "out"), "--allow-code"])
    assert "defines neither ROBOT" in capsys.readouterr().err and (tmp_path / "ran").exists()


def test_a_robot_is_found_beside_its_file_and_gives_its_scale(tmp_path, monkeypatch):
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "cart.xml").write_text(CART)
    path = toml(tmp_path / "robot", OPEN + 'robot = "cart.xml"\n')
    monkeypatch.chdir(tmp_path)
    scenario = load_scenario(path.relative_to(tmp_path))
    scale = make_robot(scenario.robot).scale()
    assert scale["mass"] == 3.0 and all(getattr(scenario, name) == value for name, value in scale.items())
    lighter = load_scenario(toml(tmp_path / "robot", OPEN + 'robot = "cart.xml"\nforce_limit = 6.0\n'))
    assert (lighter.force_limit, lighter.mass) == (6.0, 3.0)
    omni = make_scenario(str(toml(tmp_path, OPEN + 'robot = "omni"\n')))
    assert omni.mass == make_robot("omni").mass


@pytest.fixture(scope="module")
def log(episode, tmp_path_factory) -> Path:
    """The path of a short log."""
    from marlbc_mj.controllers import PD
    from marlbc_mj.engine.world import World
    from marlbc_mj.episode import run_episode
    from marlbc_mj.recording.writer import LogWriter
    from marlbc_mj.scenarios import paper
    from marlbc_mj.supervisors import make_supervisor

    path, scenario = tmp_path_factory.mktemp("log") / "a.mcap", paper(duration=0.5)
    with LogWriter(path, scenario, PD(), names=("scripted", "pd"), seed=0, config={}) as writer:
        run_episode(World(scenario, PD(), record=True), make_supervisor("scripted"), on_frame=writer.write)
    return path


def rewritten(log: Path, out: Path, change=lambda topic, message: message, **metadata: str) -> Path:
    """Write a copy of a log with valid checksums, its messages changed by ``change`` and its metadata replaced."""
    from mcap.reader import make_reader

    with open(log, "rb") as source, open(out, "wb") as target:
        read, write = make_reader(source), Writer(target, compression=CompressionType.ZSTD)
        write.start()
        for record in read.iter_metadata():
            write.add_metadata(record.name, {**record.metadata, **(metadata if record.name == "marlbc" else {})})
        for record in read.iter_attachments():
            data = metadata["model"].encode() if "model" in metadata and record.name == "model.xml" else record.data
            write.add_attachment(0, 0, record.name, record.media_type, data)
        channels: dict[str, int] = {}
        for schema, channel, message in read.iter_messages():
            if channel.topic not in channels:
                number = write.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = write.register_channel(channel.topic, channel.message_encoding, number)
            data = message.data
            if channel.message_encoding == "json":
                data = json.dumps(change(channel.topic, json.loads(data))).encode()
            write.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        write.finish()
    return out


def edit(topic: str, name: str, value):
    """A change to one field of every agent, or of the message, on one topic."""

    def change(at: str, message):
        if at == topic and name in message:
            message[name] = value
        elif at == topic:
            message["agents"] = [{**row, name: value} for row in message["agents"]]
        return message

    return change


def deep(at: str, message):
    nested = 0
    for _ in range(900):
        nested = [nested]
    return {**message, "agents": nested}


WRONG_CONTENT = {
    "a command beyond the list": edit("/priorities", "index", 99),
    "a negative command": edit("/priorities", "index", -1),
    "a command that is a fraction": edit("/priorities", "index", 0.5),
    "a command that is a text": edit("/priorities", "index", "FM"),
    "positions that are texts": edit("/state", "x", "here"),
    "positions that are lists": edit("/state", "x", [1.0]),
    "positions that are nothing": edit("/state", "x", None),
    "positions that are not finite": edit("/state", "x", float("nan")),
    "huge whole numbers": edit("/state", "x", 10**400),
    "times that stand still": edit("/state", "time", 0.0),
    "no agents": edit("/state", "agents", []),
    "agents that are a number": edit("/force", "agents", 3),
    "agents that are texts": edit("/force", "agents", ["a", "b"]),
    "agents of other messages": edit("/force", "agents", [{"x": 0.0, "y": 0.0}]),
    "a message that is a list": lambda topic, message: [message],
    "a message that is nothing": lambda topic, message: None,
    "deep nesting": deep,
    "a reward that is a table": edit("/metrics", "reward", {}),
}


@pytest.mark.parametrize("name", WRONG_CONTENT)
def test_a_log_of_wrong_content_is_one_line(log, tmp_path, name):
    wrong = rewritten(log, tmp_path / "b.mcap", WRONG_CONTENT[name])
    for read in (read_log, lambda p: export_log(p, tmp_path / "b.csv"), lambda p: main(["video", str(p)])):
        with pytest.raises((ConfigurationError, SystemExit)) as error:
            read(wrong)
        assert "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"]
    assert log_info(wrong)["messages"] > 0


@pytest.mark.parametrize(
    "metadata",
    [
        {"seed": "x"},
        {"mission_step": "0"},
        {"mission_step": "nan"},
        {"safe_distance": "-1"},
        {"commands": "{}"},
        {"commands": "[1, 2, 3, 4]"},
        {"commands": "[" * 5000},
        {"obstacles": "[[1, 2]]"},
        {"obstacles": '[["a", 2, 3]]'},
        {"obstacles": "[[NaN, 2, 3]]"},
        {"motions": "[[1, 2, 3, 4, 5, 6]]"},
        {"force_limit": "much"},
    ],
)
def test_wrong_metadata_is_one_line(log, tmp_path, metadata):
    with pytest.raises(ConfigurationError) as error:
        read_log(rewritten(log, tmp_path / "b.mcap", **metadata))
    assert "\n" not in str(error.value) and "damaged" in str(error.value)


def test_a_rewritten_log_is_the_same_log(log, tmp_path):
    """Rewriting alone changes nothing, so the tests above change only what they name."""
    assert np.array_equal(read_log(log).position, read_log(rewritten(log, tmp_path / "b.mcap")).position)


MESH = '<mujoco><asset><mesh name="m" file="{0}"/></asset><worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'


@pytest.mark.parametrize(
    "model",
    [
        MESH,
        '<mujoco><include file="{0}"/></mujoco>',
        '<mujoco><asset><texture name="t" type="cube" fileright="{0}"/></asset></mujoco>',
        '<mujoco><asset><model name="t" file="{0}"/></asset></mujoco>',
        '<mujoco><asset><hfield name="t" size="1 1 1 1" file="{0}"/></asset></mujoco>',
        '<mujoco><worldbody><flexcomp name="f" type="gmsh" file="{0}"/></worldbody></mujoco>',
        '<mujoco><deformable><skin name="s" file="{0}"/></deformable></mujoco>',
        '<mujoco><extension><plugin plugin="mujoco.sdf.torus"/></extension></mujoco>',
        '<!DOCTYPE x [<!ENTITY a "b">]><mujoco/>',
        '<mujoco><worldbody><replicate count="10000000"><geom size="1"/></replicate></worldbody></mujoco>',
        '<mujoco><custom><numeric name="robot" data="nan 1"/></custom></mujoco>',
        "<mujoco",
        "",
    ],
)
def test_a_logs_model_reads_no_file(log, tmp_path, model):
    outside = tmp_path / "outside.stl"
    os.mkfifo(outside)  # opening it would block forever
    found = read_log(rewritten(log, tmp_path / "b.mcap", model=model.format(outside)))
    with pytest.raises(ConfigurationError, match="the log's model cannot be shown") as error:
        make_stage(found)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("robot", ["point_mass", "disc", "omni", "diff_drive", "crazyflie"])
def test_our_own_models_are_shown(robot):
    from marlbc_mj.controllers import PD
    from marlbc_mj.engine.world import World
    from marlbc_mj.recording.log import from_world
    from marlbc_mj.scenarios import robot_gate

    make_stage(from_world(World(robot_gate(robot, duration=1.0), PD(*make_robot(robot).gains))))


def bomb(path: Path, compress, kind: CompressionType, size: int, said: int) -> Path:
    """Write a small MCAP with one chunk of ``size`` zeros that is declared to hold ``said`` bytes."""
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    data = compress(bytes(size))
    record = RecordBuilder()
    Chunk(kind.name.lower(), data, 0, 0, 0, said).write(record)
    with io.BytesIO() as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
        whole = stream.getvalue()
    header = 8 + 9 + struct.unpack("<Q", whole[9:17])[0]
    path.write_bytes(whole[:header] + record.end() + whole[header:])
    return path


@pytest.mark.parametrize(
    ("compress", "kind"), [(zstandard.compress, CompressionType.ZSTD), (lz4.frame.compress, CompressionType.LZ4)]
)
@pytest.mark.parametrize("honest", [True, False])
def test_a_bomb_is_not_opened(tmp_path, compress, kind, honest, monkeypatch):
    """It is refused whether or not it declares its true size."""
    size = 2 * mcap_file.MOST_CHUNK
    path = bomb(tmp_path / "b.mcap", compress, kind, size, size if honest else 100)
    monkeypatch.setattr(zstandard, "decompress", None)
    monkeypatch.setattr(lz4.frame, "decompress", None)
    for read in (read_log, log_info, lambda p: recover_log(p, tmp_path / "c.mcap")):
        with pytest.raises(ConfigurationError, match=r"holds|nothing to recover|wrong checksum"):
            read(path)


def test_chunks_together_have_a_limit_too(log, monkeypatch):
    monkeypatch.setattr(mcap_file, "MOST_UNPACKED", 1000)
    with pytest.raises(ConfigurationError, match="unpack to more than 1000 bytes"):
        read_log(log)


def test_what_a_checkpoint_says_cannot_be_changed(tmp_path):
    """The digest covers margins, times and the state of random generators as well as the arrays."""
    path, arrays = tmp_path / "a.safetensors", {"x": np.arange(3.0)}
    write_arrays(path, arrays, {"margin": 0.25, "wall_s": 12.0, "rng": {"state": 17}})
    _, description = read_arrays(path)
    content = path.read_bytes()
    for old, new in (
        (b"0.25", b"0.75"),
        (b"12.0", b"92.0"),
        (b"17", b"18"),
        (b"margin", b"morgin"),
        (b'format\\": 3', b'format\\": 2'),
    ):
        assert content.count(old) == 1
        path.write_bytes(content.replace(old, new))
        with pytest.raises(ConfigurationError, match="damaged|format 2"):
            read_arrays(path)
    assert description["sha256"] == digest(arrays, description) != digest(arrays, {**description, "margin": 0.75})


def test_openings_as_wide_as_the_way_leave_no_walls():
    draw = make_scenario("gates", width=40.0).draw(np.random.default_rng(0))
    assert draw.obstacles.shape == (0, 3)


def test_a_force_limit_that_mujoco_takes_for_zero_is_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["run", str(toml(tmp_path, OPEN + "force_limit = 5e-324\n")), "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err.strip()
    assert stopped.value.code == 2 and "invalid force range" in said and len(said.splitlines()) == 1


def test_files_are_tried_out_by_one_server_of_each_process(tmp_path):
    """It loads MuJoCo once; a killed server is replaced, a forked process has its own, and none outlives its process."""
    path = tmp_path / "ball.xml"
    path.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    limits = trial.Limits(20.0, 5, 8 * 2**30)
    assert trial.try_out(path, limits) == (0, "")
    first = trial._server.process.pid
    assert trial.try_out(path, limits) == (0, "") and trial._server.process.pid == first
    os.kill(first, signal.SIGKILL)
    assert trial.try_out(path, limits) == (0, "") and trial._server.process.pid != first
    code = (
        "import os, sys; from pathlib import Path; from marlbc_mj.robots import trial as t; l = t.Limits(20.0, 5, 2**33)\n"
        "p = Path(sys.argv[1]); a = t.try_out(p, l); print(t._server.process.pid, flush=True)\n"
        "if os.fork() == 0: b = t.try_out(p, l); print(t._server.process.pid, flush=True); sys.exit(a != b)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code, path], capture_output=True, text=True, check=True)
    servers = done.stdout.split()
    assert len(set(servers)) == 2 and done.stderr == ""
    assert not any(Path(f"/proc/{server}").exists() for server in servers)
