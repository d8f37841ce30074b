"""How commands end: closed pipes, full disks, terminals without Unicode, signals, and folders that cannot be written."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_files import small_disk

from marlbc_mj.cli import main
from marlbc_mj.cli.robot import RobotGateCommand
from marlbc_mj.recording.video import VideoStyle, _encode
from marlbc_mj.studies import robot_gate
from marlbc_mj.util.errors import SimulationError

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
COMMAND = [sys.executable, "-m", "marlbc_mj"]
QUICK = ["--supervisors", "scripted", "--controllers", "pd", "--no-figures", "--video", "none", "--duration", "0.5"]
AS_ROOT = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting takes root")


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a line of shell, with ``marlbc`` replaced by the command, and return the completed process."""
    line = line.replace("marlbc", " ".join(COMMAND))
    return subprocess.run(
        ["bash", "-c", line], env={**ENVIRONMENT, **environment}, capture_output=True, text=True, check=False, timeout=300
    )


@pytest.mark.skipif(sys.platform == "win32", reason="no such shell")
@pytest.mark.parametrize("arguments", ["list", "--help", "bench --help", "run --help"])
def test_closed_pipe_is_silent(arguments):
    done = shell(f"marlbc {arguments} | head -1; exit ${{PIPESTATUS[0]}}")
    assert done.stdout.strip() and done.stderr == "" and done.returncode in (0, 141)
    assert shell(f"marlbc {arguments} | true").stderr == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("arguments", ["list", "--help"])
def test_output_into_a_full_disk_is_one_line(arguments):
    done = shell(f"marlbc {arguments} > /dev/full")
    assert done.returncode == 3 and len(done.stderr.splitlines()) == 1 and "standard output: No space left" in done.stderr


@pytest.mark.parametrize("arguments", ["list", "--help", "nothing"])
def test_a_terminal_without_our_characters(arguments):
    done = shell(f"marlbc {arguments}", PYTHONIOENCODING="ascii", LC_ALL="C")
    assert "Traceback" not in done.stderr and done.stdout + done.stderr


def test_a_command_that_is_interrupted_while_it_is_read(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("marlbc_mj.cli.parse", interrupted)
    with pytest.raises(SystemExit) as stopped:
        main(["list"])
    assert stopped.value.code == 130 and capsys.readouterr().err == "marlbc: interrupted\n"


LONG = ["--supervisors", "mpcms", "fsams", "--substep", "0.001"]  # runs much longer than the wait for the signal


@pytest.fixture(scope="module")
def compiled_before(tmp_path_factory):
    """Run the command once, so that signals arrive during episodes and not during compilation."""
    main(["bench", *QUICK, *LONG, "--out", str(tmp_path_factory.mktemp("before") / "out"), "--quiet"])


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
@pytest.mark.usefixtures("compiled_before")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("workers", [[], ["--seeds", "40", "--workers", "2"]])
def test_a_signal_leaves_nothing_half_written(tmp_path, number, status, workers):
    """With and without workers, the interrupted command leaves no files and no process, and prints one line last."""
    command = [*COMMAND, "bench", *QUICK[:-2], *LONG, *workers, "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        until = time.monotonic() + 120
        while not any(tmp_path.iterdir()) and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(1.0 if workers else 0.3)
        os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
        try:
            _, said = process.communicate(timeout=100)
        finally:
            if process.poll() is None:  # end it in any case
                os.killpg(process.pid, signal.SIGKILL)
        assert process.returncode == status
    assert said.strip().splitlines()[-1] in ("marlbc: terminated", "marlbc: interrupted") and "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


DROPPED = """
import ctypes, signal, sys, time
from marlbc_mj.cli.ending import in_one_line
with in_one_line("marlbc"):
    try:
        if sys.argv[2] == "dropped":  # as where the compiler calls back when it has made code
            ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(int(sys.argv[1])))()
        else:
            signal.raise_signal(int(sys.argv[1]))
        time.sleep(20.0)
        print("went on")
    finally:
        time.sleep(0.7)
        print("removed")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
@pytest.mark.parametrize(("number", "status", "said"), [(signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "interrupted")])
@pytest.mark.parametrize("way", ["dropped", "through"])
def test_a_signal_is_not_lost_in_a_callback_and_does_not_stop_the_removal(number, status, said, way):
    """An exception raised in a callback from C is dropped, so it is raised again; one that propagates is raised only once."""
    began = time.monotonic()
    command = [sys.executable, "-c", DROPPED, str(int(number)), way]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (status, "removed\n", f"marlbc: {said}\n")
    assert time.monotonic() - began < 15.0


def test_a_full_disk_anywhere_is_status_3(monkeypatch, capsys):
    """This also holds where no code expects it; the line names the file if the system does."""
    error = OSError(errno.ENOSPC, "No space left on device", "figure.pdf")
    monkeypatch.setattr("marlbc_mj.cli.ListCommand.run", lambda _: (_ for _ in ()).throw(error))
    with pytest.raises(SystemExit) as stopped:
        main(["list"])
    assert stopped.value.code == 3 and capsys.readouterr().err == "marlbc: cannot use figure.pdf: No space left on device\n"


def pictures(count: int, size: int):
    """Frames of noise, which no encoder can compress."""
    rng = np.random.default_rng(0)
    yield from (rng.integers(256, size=(size, size, 3), dtype=np.uint8) for _ in range(count))


@AS_ROOT
def test_a_video_that_does_not_fit_is_an_error(tmp_path):
    """ffmpeg writes as much as fits and ends; only its exit status shows the error."""
    with small_disk(tmp_path / "disk") as disk:
        with pytest.raises(SimulationError, match="encoder failed.*No space left"):
            _encode(pictures(40, 128), disk / "a.mp4", VideoStyle(size=(128, 128)), 40)
        (disk / "a.mp4").unlink()
        _encode(pictures(1, 64), disk / "a.mp4", VideoStyle(size=(64, 64)), 1)


def test_an_encoder_that_ends_early_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: "true")  # reads nothing, and exits with status 0
    with pytest.raises(SimulationError, match="encoder failed"):
        _encode(pictures(40, 256), tmp_path / "a.mp4", VideoStyle(size=(256, 256)), 40)


def test_an_interrupted_video_ends_its_encoder(tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _encode(pictures(3, 64), tmp_path / "a.mp4", VideoStyle(size=(64, 64)), 3, stop)


def test_rendering_that_is_switched_off_renders_nothing(tmp_path):
    """With MUJOCO_GL=off a benchmark writes everything but videos, and `video` fails with one line."""
    quick = [each if each != "none" else "first" for each in QUICK]
    done = shell(f"marlbc bench {' '.join(quick)} --out {tmp_path / 'out'}", MUJOCO_GL="off")
    assert done.returncode == 0 and not list(tmp_path.rglob("*.mp4")) and "switches rendering off" in done.stderr
    (log,) = tmp_path.rglob("*.mcap")
    failed = shell(f"marlbc video {log}", MUJOCO_GL="off")
    assert failed.returncode == 2 and len(failed.stderr.splitlines()) == 1


def test_a_robot_that_flies_off_is_status_3(monkeypatch, tmp_path, capsys):
    numbers = (8.0, 1.0, 0.0, 0, 1.0, 9514.0, 0.0, (0,), 0.0, None, None)
    row = robot_gate.GateRow("disc", "scripted", "null-space", *numbers, "lost: 9514 m")
    monkeypatch.setattr(robot_gate.GateStudy, "run", lambda *_: row)
    with pytest.raises(SystemExit, match="3"):
        RobotGateCommand(("disc",), ("scripted",), out=tmp_path / "out", no_clips=True).run()
    assert json.loads((tmp_path / "out" / "gate.json").read_text())["rows"][0]["error"] == 9514.0
    assert "lost: 9514 m" in capsys.readouterr().out


def test_perf_does_not_overwrite(tmp_path, capsys):
    (tmp_path / "perf.json").write_text("mine")
    with pytest.raises(SystemExit):
        main(["perf", "--out", str(tmp_path / "perf.json")])
    assert "--overwrite" in capsys.readouterr().err and (tmp_path / "perf.json").read_text() == "mine"


UNSTABLE = """
import numpy as np
from marlbc_mj import PD, World, paper
from marlbc_mj.core.disturbances import make_disturbance
world = World(paper(disturbance=make_disturbance("paper", 20.0), duration=5.0), PD())
try:
    while True:
        world.step(np.zeros((1, 4), dtype=int))
except RuntimeError as error:
    print(error)
import mujoco
model = world.plan.model
data = mujoco.MjData(model)
world.data[0].qpos[:] = np.nan
world.advance(np.zeros((1, 4), dtype=int))
"""


def test_mujoco_writes_neither_to_the_terminal_nor_into_the_folder(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", UNSTABLE], env=ENVIRONMENT, capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert "agent" in done.stdout and done.stderr == "" and list(tmp_path.iterdir()) == []


@AS_ROOT
def test_package_and_home_that_cannot_be_written(tmp_path):
    """As in a container: compiled code cannot be cached, everything works, and one line says what to set."""
    package = Path(sys.modules["marlbc_mj"].__file__).resolve().parents[1]
    line = (
        f"mount --bind {package} {package} && mount -o remount,ro,bind {package} && mkdir {tmp_path}/home && "
        f"mount -t tmpfs -o ro tmpfs {tmp_path}/home && cd / && HOME={tmp_path}/home {sys.executable} -c "
        "'from marlbc_mj.supervisors import prediction; from marlbc_mj.scenarios import SCENARIOS; "
        "from marlbc_mj.cli import main; "
        '[make() for make in SCENARIOS.values()]; main(["list"])\''
    )
    done = subprocess.run(["unshare", "-m", "sh", "-c", line], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    if "unshare" in done.stderr or "mount" in done.stderr:
        pytest.skip("no mounts here")
    assert done.returncode == 0 and "scripted" in done.stdout
    assert done.stderr.startswith("marlbc: compiled code cannot be cached here") and done.stderr.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in done.stderr


def test_no_home_at_all(tmp_path):
    environment = {name: value for name, value in ENVIRONMENT.items() if name not in ("HOME", "USER", "LOGNAME")}
    done = subprocess.run([*COMMAND, "list"], env=environment, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0 and done.stderr == ""
