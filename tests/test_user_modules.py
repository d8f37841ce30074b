"""Users' Python files: the same in every process and folder, reloaded after an edit, every mistake reported in one line."""

import json
import linecache
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cloudpickle
import numba
import numpy as np
import pytest

from marlbc_mj.controllers import PD, make_controller
from marlbc_mj.core import compiling, laws
from marlbc_mj.engine.world import World
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.results.summary import method_key
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import make_scenario, paper
from marlbc_mj.studies.bench import BenchConfig
from marlbc_mj.studies.robot_check import checklist
from marlbc_mj.studies.robot_truth import all_plain
from marlbc_mj.supervisors import Learned, OneTeam, make_supervisor
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.matplotlib_folder import prepare_matplotlib

SKATE = """<mujoco model="skate"><compiler autolimits="true"/><worldbody><body name="deck" pos="0 0 0.08">
<joint name="sx" type="slide" axis="1 0 0"/><joint name="sy" type="slide" axis="0 1 0"/>
<geom type="box" size="0.2 0.1 0.03" mass="4" contype="0" conaffinity="0"/><site name="fan"/></body></worldbody>
<actuator><motor site="fan" gear="2 0 0 0 0 0" ctrlrange="-10 10"/>
<motor site="fan" gear="0 2 0 0 0 0" ctrlrange="-10 10"/></actuator>
</mujoco>"""
SKATE_PY = '''"""A skate with two fans."""
from pathlib import Path

import helper
from marlbc_mj.core import laws
from marlbc_mj.robots import Robot


@laws.drive
def skate_drive(gains, state, qpos, qvel, force, h, ctrl_out):
    ctrl_out[0] = helper.SHARE * force[0]
    ctrl_out[1] = helper.half(force[1])


@laws.reading
def skate_reading(gains, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    for axis in range(2):
        p_out[axis], v_out[axis] = qpos[axis], qvel[axis]
        force_out[axis] = 2.0 * actuator_force[axis]


ROBOT = Robot(
    name="skate", mjcf=Path(__file__).with_name("skate.xml"), description="two fans", joints=("sx", "sy"), body="deck",
    radius=0.23, drive=skate_drive, reading=skate_reading, mass=4.0, force_limit=15.0, speed_limit=1.5,
    acceleration_limit=1.5, gains=(36.0, 12.0), length=0.5, substep=0.005,
)
'''
HELPER = """from marlbc_mj.core import laws
SHARE = 0.5
@laws.allocation_free
def half(x):
    return 0.5 * x
"""
SCRIPT = """
import json, sys
import numpy as np
from marlbc_mj.core import laws
from marlbc_mj.robots import make_robot
robot = make_robot(sys.argv[1])
laws.address(robot.drive, laws.DRIVE)
laws.address(robot.reading, laws.READING)
ctrl, none = np.zeros(2), np.zeros(0)
robot.drive(none, none, np.zeros(2), np.zeros(2), np.ones(2), 0.1, ctrl)
print(json.dumps(ctrl.tolist()))
"""


@pytest.fixture
def skate(tmp_path: Path) -> Path:
    """The path of a robot's file that imports another file beside it."""
    folder = tmp_path / "skate"
    folder.mkdir()
    (folder / "skate.xml").write_text(SKATE)
    (folder / "skate.py").write_text(SKATE_PY)
    (folder / "helper.py").write_text(HELPER)
    return folder / "skate.py"


def in_a_process(name: str, cwd: Path) -> list[float]:
    """Controls that a new process computes for a force of 1 N along both axes."""
    environment = {**os.environ, "PYTHONPATH": ":".join(p for p in sys.path if p)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, name], capture_output=True, text=True, cwd=cwd, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_a_users_robot_is_the_same_in_every_process(skate, tmp_path):
    """This includes later processes, other folders and other spellings; after an edit of a helper, the edited one is used."""
    assert in_a_process(str(skate), tmp_path) == [0.5, 0.5]
    assert in_a_process("skate.py", skate.parent) == in_a_process("skate/skate.py:ROBOT", tmp_path) == [0.5, 0.5]
    skate.with_name("helper.py").write_text(HELPER.replace("0.5", "0.8"))
    assert in_a_process("skate.py", skate.parent) == [0.8, 0.8]
    moved = shutil.copytree(skate.parent, tmp_path / "moved")
    (moved / "helper.py").write_text(HELPER.replace("0.5", "0.3"))
    assert in_a_process(str(moved / "skate.py"), tmp_path) == [0.3, 0.3]
    assert in_a_process(str(skate), tmp_path) == [0.8, 0.8]


def test_a_robot_is_made_anew_after_an_edit_or_in_another_folder(skate, tmp_path, monkeypatch):
    """In one process, as in a notebook, its file, a helper or its MJCF is edited; without an edit it is the same object."""
    monkeypatch.chdir(skate.parent)

    def made() -> tuple[float, float, float]:
        robot, ctrl, none = make_robot("skate.py"), np.zeros(2), np.zeros(0)
        assert make_robot("skate.py") is robot
        all_plain(robot.drive)(none, none, np.zeros(2), np.zeros(2), np.ones(2), 0.1, ctrl)
        return robot.speed_limit, ctrl[0], robot.spec().compile().body("deck").mass[0]

    assert made() == (1.5, 0.5, 4.0)
    skate.write_text(SKATE_PY.replace("speed_limit=1.5", "speed_limit=1.0"))
    assert made() == (1.0, 0.5, 4.0)
    skate.with_name("helper.py").write_text(HELPER.replace("0.5", "0.25"))
    assert made() == (1.0, 0.25, 4.0)
    skate.with_name("skate.xml").write_text(SKATE.replace('mass="4"', 'mass="3"'))
    assert made() == (1.0, 0.25, 3.0)
    moved = shutil.copytree(skate.parent, tmp_path / "moved")
    (moved / "skate.py").write_text(SKATE_PY)
    monkeypatch.chdir(moved)
    assert made() == (1.5, 0.25, 3.0)


@pytest.mark.slow
def test_torn_files_of_the_cache_are_compiled_anew(skate, tmp_path):
    """Any content that another program left there is replaced."""
    assert in_a_process(str(skate), tmp_path) == [0.5, 0.5]
    for file in (skate.parent / "__pycache__").glob("*.nb?"):
        file.write_bytes(b"torn")
    assert in_a_process(str(skate), tmp_path) == [0.5, 0.5]


def test_helpers_of_one_name_in_two_folders_are_two(skate, tmp_path):
    """In one process, each file imports the helper beside it."""
    moved = shutil.copytree(skate.parent, tmp_path / "moved")
    (moved / "helper.py").write_text(HELPER.replace("0.5", "0.3"))
    found = []
    for path in (skate, moved / "skate.py"):
        ctrl, none = np.zeros(2), np.zeros(0)
        make_robot(str(path)).drive(none, none, np.zeros(2), np.zeros(2), np.ones(2), 0.1, ctrl)
        found.append(ctrl[0])
    assert found == [0.5, 0.3]


def add_up(count):
    """0 + 1 + ... + (count - 1), in a loop that threads may share."""
    total = 0
    for k in numba.prange(count):
        total += k
    return total


def test_without_a_folder_for_the_cache_code_is_compiled_in_memory(monkeypatch):
    """This happens in a container with a read-only package and home; it is slower, but otherwise the same."""
    njit = compiling.numba.njit

    def refuse(*, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available for file")
        return njit(**options)

    monkeypatch.setattr(compiling.numba, "njit", refuse)
    for make in (compiling.compiled, compiling.threaded, compiling.allocation_free):
        assert make(add_up)(4) == 6


def test_matplotlib_gets_a_folder_where_its_own_cannot_be_written(monkeypatch, tmp_path):
    """A home that is a file cannot hold its folder; a folder that is already set, or can be created, is kept."""
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    prepare_matplotlib()
    assert "MPLCONFIGDIR" not in os.environ and not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    monkeypatch.setenv("MPLCONFIGDIR", "")
    prepare_matplotlib()
    folder = Path(os.environ["MPLCONFIGDIR"])
    assert folder.is_dir()
    prepare_matplotlib()
    assert os.environ["MPLCONFIGDIR"] == str(folder)


MINE = """
from dataclasses import dataclass
import numpy as np
from marlbc_mj.controllers import PD
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors import Scripted
@dataclass(frozen=True)
class Careful:
    def start(self, scenario):
        return np.zeros(scenario.agents, dtype=np.int64)
    def decide(self, observation, memory):
        return memory, memory
def soft():
    return PD(25.0, 10.0)
STIFF = PD(64.0, 16.0)
SCRIPT = Scripted()
SHORT = paper(duration=2.0)
def longer():
    return paper(duration=4.0)
number = 3
def leaves(): raise SystemExit(5)
def breaks(): raise KeyError("gain")
"""


@pytest.fixture
def mine(tmp_path: Path) -> str:
    """The path of a file with supervisors, controllers and scenarios."""
    (tmp_path / "mine.py").write_text(MINE)
    return str(tmp_path / "mine.py")


def test_names_in_a_users_file_are_taken(mine):
    """Objects, classes and functions of every kind can be named; keys of methods leave out the file's folder."""
    assert make_controller(f"{mine}:soft") == PD(25.0, 10.0) and make_controller(f"{mine}:STIFF") == PD(64.0, 16.0)
    assert isinstance(make_supervisor(f"{mine}:Careful"), OneTeam)
    assert type(make_supervisor(f"{mine}:SCRIPT")).__name__ == "Scripted"
    assert make_scenario(f"{mine}:SHORT").duration == 2.0
    assert make_scenario(f"{mine}:longer", force_limit=99.0).force_limit == 99.0
    assert method_key(f"{mine}:Careful", f"{mine}:soft") == "mine.Careful+mine.soft"
    assert BenchConfig((f"{mine}:Careful",), (f"{mine}:soft",)).methods == [(f"{mine}:Careful", f"{mine}:soft")]
    assert make_controller(f"{mine}:STIFF") is make_controller(f"{mine}:STIFF")


def test_what_is_in_a_users_file_goes_to_another_process(mine, tmp_path):
    """A pickle finds the file again wherever the package is installed; without the file, the error names the missing module."""
    kept = pickle.dumps(make_supervisor(f"{mine}:Careful"))
    code = "import pickle, sys; print(type(pickle.load(sys.stdin.buffer)).__name__)"
    environment = {**os.environ, "PYTHONPATH": ":".join(p for p in sys.path if p)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, input=kept, capture_output=True, env=environment, check=False, cwd=tmp_path.parent)
    assert done.stdout == b"OneTeam\n", done.stderr
    Path(mine).unlink()
    gone = subprocess.run(command, input=kept, capture_output=True, env=environment, check=False)
    assert b"ModuleNotFoundError: No module named 'marlbc_user_mine_" in gone.stderr


NOTEBOOK = """
from dataclasses import dataclass
import numpy as np
from marlbc_mj.core import laws

@laws.controller(gains="push")
def pushed(gains, state, p, v, p_r, v_r, drag, h, force_out):
    force_out[0], force_out[1] = gains.push, 0.0

@dataclass(frozen=True)
class Push:
    push: float = 2.0
    limited = True
    linear_gains = None
    law = staticmethod(pushed)
    def params(self, agent, limit):
        return laws.gains_of(self)
    def initial_state(self, agent):
        return {}
"""


def test_a_law_of_a_notebook_runs_and_travels(monkeypatch, tmp_path):
    """A law in a ``__main__`` without a file runs compiled, and a copy made by cloudpickle is compiled anew."""
    main, paths = ModuleType("__main__"), ModuleType("IPython.paths")
    vars(paths)["get_ipython_cache_dir"] = lambda: str(tmp_path)  # numba calls it
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.paths", paths)
    monkeypatch.setitem(sys.modules, "__main__", main)
    cell, lines = "<ipython-input-3-0123456789ab>", NOTEBOOK.splitlines(keepends=True)
    monkeypatch.setitem(linecache.cache, cell, (len(NOTEBOOK), None, lines, cell))  # as IPython stores a cell
    exec(compile(NOTEBOOK, cell, "exec"), vars(main))
    world = World(paper(duration=0.5), main.Push())
    orders = np.zeros((1, 4), dtype=np.int64)
    world.step(orders)
    data = cloudpickle.dumps(world)
    expected = world.step(orders).observation.position
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))  # as in another process
    twin = pickle.loads(data)
    assert world.native and twin.native and (twin.step(orders).observation.position == expected).all()


def test_a_checkpoint_is_a_supervisor_by_its_path():
    """Shipped checkpoints are supervisors by their names, other checkpoints by their paths."""
    path = str(shipped("marlms"))
    assert isinstance(make_supervisor(path), Learned) and method_key(path, "sorlc") == "marlms+sorlc"
    with pytest.raises(ConfigurationError, match=r"gone.safetensors"):
        make_supervisor("gone.safetensors")


@pytest.mark.parametrize(
    ("make", "attribute", "message"),
    [
        (make_controller, "Careful", "is not a controller: Careful lacks law, limited"),
        (make_supervisor, "STIFF", "is not a supervisor: PD lacks start, decide"),
        (make_scenario, "STIFF", "is not a Scenario but PD"),
        (make_controller, "leaves", r"leaves\(\) fails: it calls sys.exit\(5\)"),
        (make_supervisor, "breaks", r"breaks\(\) fails: KeyError: 'gain'"),
        (make_controller, "number", "is not a controller: int lacks"),
        (make_controller, "gone", "has nothing named 'gone'; it has: .*STIFF"),
        (make_robot, "number", "defines neither ROBOT"),
    ],
)
def test_what_is_something_else_is_refused(make, attribute, message, mine):
    """The error says what it lacks or how it fails."""
    with pytest.raises(ConfigurationError, match=message):
        make(f"{mine}:{attribute}")


def test_files_that_are_not_there_or_fail_are_named(tmp_path):
    """This holds for controllers, supervisors, scenarios and robots."""
    for make in (make_controller, make_supervisor, make_scenario, make_robot):
        with pytest.raises(ConfigurationError, match="gone.py"):
            make(f"{tmp_path}/gone.py:Mine")
        (tmp_path / "bad.py").write_text("import sys\nsys.exit(5)\n")
        with pytest.raises(ConfigurationError, match=r"bad.py fails: it calls sys.exit\(5\)"):
            make(f"{tmp_path}/bad.py:Mine")


# Laws ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("ctrl_out[2] = 0.0", "skate_drive fails as plain Python: IndexError: index 2"),
        ("state[3] = force[0]", "IndexError: index 3"),
        ("ctrl_out[0] = gains[4]", "IndexError: index 4"),
        ("ctrl_out[0] = qpos[2]", "IndexError: index 2"),
        ("ctrl_out[0] = beyond(qvel)", "IndexError: index 7"),
    ],
)
def test_a_law_that_leaves_its_arrays_fails_its_check(line, said, skate):
    """The law and its compiled helpers are first run as plain Python, and then not at all as compiled code."""
    text = SKATE_PY.replace("@laws.drive", "@laws.allocation_free\ndef beyond(x):\n    return x[7]\n\n\n@laws.drive", 1)
    skate.write_text(text.replace("    ctrl_out[1] = helper", f"    {line}\n    ctrl_out[1] = helper"))
    items = list(checklist(str(skate)))
    assert items[-1].name == "laws" and not items[-1].passed and said in items[-1].detail


def test_a_plain_law_is_plain_down_to_its_helpers():
    """It gives the same numbers as the compiled law."""
    robot = make_robot("crazyflie")
    gains, ctrl = laws.as_gains(robot.drive, robot.params), np.zeros((2, 4))
    pose, force = np.array([0.1, 0.2, 0.2, 1.0, 0.01, 0.02, 0.0]), np.array([0.02, -0.01])
    for law, out in zip((robot.drive, all_plain(robot.drive)), ctrl, strict=True):
        law(gains, laws.as_state(robot.drive, robot.state), pose, np.zeros(6), force, 0.0025, out)
    np.testing.assert_allclose(ctrl[0], ctrl[1], rtol=1e-12)
    assert not laws.is_compiled(all_plain(robot.drive).__globals__["allot"])


def test_a_law_with_another_number_of_arguments_is_refused():
    """The error is raised where it is declared, and lists the arguments that it is called with."""
    with pytest.raises(
        ConfigurationError, match=r"law 'short' takes \(gains, state, qpos, qvel, force, ctrl_out\), .* h, ctrl_out\)"
    ):

        @laws.drive
        def short(gains, state, qpos, qvel, force, ctrl_out):
            pass
