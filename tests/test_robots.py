"""Robots: physics compared with theory, one law on three paths, the gate mission, users' robots, and refused input."""

import ast
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import mujoco
import numpy as np
import pytest
from robot_worlds import Push, push

from marlbc_mj.cli import main
from marlbc_mj.controllers import PD
from marlbc_mj.core import laws
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.log import from_trajectory
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.robots import ROBOTS, Robot, make_robot, register
from marlbc_mj.scenarios import Perturbation, paper
from marlbc_mj.scenarios.robot_gate import robot_gate
from marlbc_mj.studies.robot_check import checklist, step_scenario
from marlbc_mj.studies.robot_gate import fly_gate
from marlbc_mj.supervisors import Scripted
from marlbc_mj.tasks.formation import make_environment
from marlbc_mj.util.errors import ConfigurationError, SimulationError

crazyflie = import_module("marlbc_mj.robots.crazyflie")
REAL = [name for name in ROBOTS if name != "point_mass"]
GRAVITY = 9.81
DIRECTIONS = [(1.0, 0.0), (0.8, 0.6)]

HOVER = """<mujoco model="hover">
  <compiler autolimits="true"/>
  <worldbody><body name="hull" pos="0 0 0.1">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
    <joint name="yaw" type="hinge" axis="0 0 1"/>
    <geom name="hull" type="box" size="0.3 0.2 0.1" mass="2" contype="0" conaffinity="0"/><site name="nozzle"/>
  </body></worldbody>
  <actuator>
    <motor name="ahead" site="nozzle" gear="1 0 0 0 0 0" ctrlrange="-8 8"/>
    <motor name="left" site="nozzle" gear="0 1 0 0 0 0" ctrlrange="-8 8"/>
    <motor name="turn" site="nozzle" gear="0 0 0 0 0 1" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
HOVER_PY = '''"""A hovercraft whose nozzles push along its own axes, while it keeps turning slowly."""

from pathlib import Path

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.robots import Robot


@laws.drive
def hover_drive(params, state, qpos, qvel, force, h, ctrl_out):
    state[0] = qpos[2]
    ctrl_out[0] = np.cos(qpos[2]) * force[0] + np.sin(qpos[2]) * force[1]
    ctrl_out[1] = np.cos(qpos[2]) * force[1] - np.sin(qpos[2]) * force[0]
    ctrl_out[2] = laws.clip(params[0] * (0.5 - qvel[2]), 1.0)


@laws.reading
def hover_reading(params, state, qpos, qvel, actuator_force, p_out, v_out, force_out):
    cosine, sine = np.cos(state[0]), np.sin(state[0])
    for axis in range(2):
        p_out[axis], v_out[axis] = qpos[axis], qvel[axis]
    force_out[0] = cosine * actuator_force[0] - sine * actuator_force[1]
    force_out[1] = sine * actuator_force[0] + cosine * actuator_force[1]


ROBOT = Robot(
    name="hover", mjcf=Path(__file__).with_name("hover.xml"), description="hovercraft that turns", joints=("x", "y"),
    body="hull", radius=0.36, drive=hover_drive, reading=hover_reading, params=(0.2,), state=(0.0,), mass=2.0,
    force_limit=5.0, speed_limit=1.5, acceleration_limit=1.5, gains=(36.0, 12.0), length=0.6, substep=0.005,
)
'''


@pytest.fixture
def hover(tmp_path: Path) -> Path:
    """A user's robot: one MJCF and one Python file."""
    (tmp_path / "hover.xml").write_text(HOVER)
    (tmp_path / "hover.py").write_text(HOVER_PY)
    return tmp_path / "hover.py"


# Theory ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_disc_slides_and_stops_as_coulomb_says(direction):
    """a = F/m - mu g with force and -mu g without, in every direction, and it stops after v^2 / (2 mu g); all within 3 %."""
    friction, wish = 0.15 * GRAVITY, 3.0
    _, p, v, force = push("disc", (wish * direction[0], wish * direction[1]), 0.6, 2.0)
    speed, along = np.linalg.norm(v, axis=1), np.array(direction)
    start, end = round(0.1 / 0.0025), round(0.6 / 0.0025)
    assert (speed[end] - speed[start]) / 0.5 == pytest.approx(wish - friction, rel=0.03)
    later = end + round(0.2 / 0.0025)
    assert (speed[end + 2] - speed[later]) / (0.195) == pytest.approx(friction, rel=0.03)
    assert speed[-1] < 1e-3
    assert np.dot(p[-1] - p[later], along) == pytest.approx(speed[later] ** 2 / (2.0 * friction), rel=0.03)
    assert np.abs(force[start:end] - 4.0 * wish * along).max() < 1e-12


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (0.8, 0.6)])
def test_omni_wheels_drive_without_slip_and_rollers_brake_as_stated(direction):
    """The force accelerates m + 3/2 I/r^2, to 1.5 %; rollers brake with 0.01 g times the mean |axle . v|, to 35 %; slip < 1 %."""
    robot, wish = make_robot("omni"), 1.5
    world, _, v, _ = push("omni", (wish * direction[0], wish * direction[1]), 0.6, 1.5)
    speed, end = np.linalg.norm(v, axis=1), round(0.6 / 0.0025)
    angles = np.pi * (2 * np.arange(3) + 1) / 3.0
    along = np.abs(np.cos(angles) * direction[0] + np.sin(angles) * direction[1])
    brake = 0.01 * GRAVITY * along.mean() * 5.45 / robot.mass
    assert (speed[end] - speed[80]) / (0.0025 * (end - 80)) == pytest.approx(wish - brake, rel=0.015)
    assert (speed[end + 40] - speed[-1]) / (0.0025 * (len(speed) - end - 41)) == pytest.approx(brake, rel=0.35)
    treads = 0.04 * world.data[0].qvel[6:9]
    expected = -np.sin(angles) * v[-1, 0] + np.cos(angles) * v[-1, 1]
    assert np.abs(treads - expected).max() < 0.01 * speed[-1]


def test_a_differential_drive_accelerates_and_rolls_on_as_its_equations_say():
    """m p'' = F for the point ahead, to 4 %, in a turn; its energy equals the work done; without torque its speed is constant."""
    robot, wish = make_robot("diff_drive"), np.array([0.96, 0.72])
    world, _, v, force = push("diff_drive", tuple(wish), 0.6, 2.0)
    end = round(0.6 / 0.0025)
    np.testing.assert_allclose(v[end], 0.6 * wish, rtol=0.04)
    np.testing.assert_allclose(force[:end] / robot.mass, np.tile(wish, (end, 1)), rtol=1e-9)
    base = world.data[0].qvel[:2]
    assert np.linalg.norm(base) == pytest.approx(np.linalg.norm(v[end + 80]), rel=0.15)  # the axle swings in behind the point
    _, _, straight, _ = push("diff_drive", (1.2, 0.0), 0.6, 2.0)
    work = robot.mass * 1.2 * 0.0025 * straight[:end, 0].sum()
    assert 0.5 * robot.mass * straight[end, 0] ** 2 == pytest.approx(work, rel=0.01)
    assert straight[-1, 0] == pytest.approx(straight[end + 4, 0], rel=1e-3)


def test_a_crazyflie_follows_newton_and_coasts_to_a_stop_in_its_own_drag():
    """Its momentum equals the impulse of rotors and drag to 1 %; then v decays as exp(-c t / m) to 3 %, at constant height."""
    robot, drag, h = make_robot("crazyflie"), 0.0147, 0.0025
    world, _, v, force = push("crazyflie", (1.6, 1.2), 0.6, 3.0, drag=drag)
    impulse = h * (force - drag * v)[:-1].sum(axis=0)
    np.testing.assert_allclose(robot.mass * v[-1], impulse, rtol=0.01)
    level = round(1.6 / h)
    speed = np.linalg.norm(v, axis=1)
    elapsed = h * (len(v) - 1 - level)
    assert speed[-1] / speed[level] == pytest.approx(np.exp(-drag * elapsed / robot.mass), rel=0.03)
    assert world.state.robot[0, 0, robot.diagnostics["height_error"]] < 0.005


def test_crazyflie_has_the_measured_numbers_and_keeps_its_thrust_limits():
    """Mass, inertia and thrust limits are those of the installed package; commands beyond the limits are clipped and counted."""
    drone = crazyflie._measured("data")
    world, *_ = push("crazyflie", (50.0, 0.0), 0.2, 0.2)
    model, data = world.plan.model, world.data[0]
    assert model.body("agent1_body").mass[0] == drone["mass"]
    np.testing.assert_allclose(model.body("agent1_body").inertia, np.diag(drone["J"]), rtol=1e-6)
    np.testing.assert_allclose(model.actuator_ctrlrange, np.tile([drone["thrust_min"], drone["thrust_max"]], (8, 1)), rtol=1e-5)
    least, most = data.actuator_force.min(), data.actuator_force.max()
    assert drone["thrust_min"] * (1 - 1e-5) <= least < most <= drone["thrust_max"] * (1 + 1e-5)
    robot = make_robot("crazyflie")
    gains, state, ctrl = laws.as_gains(robot.drive, robot.params), laws.as_state(robot.drive, robot.state), np.zeros(4)
    deep = np.array([0.0, 0.0, -5.0, 1.0, 0.0, 0.0, 0.0])
    for _ in range(200):
        robot.drive(gains, state, deep, np.zeros(6), np.zeros(2), 0.0025, ctrl)
    assert (ctrl == drone["thrust_max"]).all() and state.saturated > 100


# One law, three paths ----------------------------------------------------------------------------------------------------------


def short_gate(name: str, **changes):
    return robot_gate(name, duration=1.5, **changes)


@pytest.mark.parametrize("name", REAL)
def test_compiled_loop_python_path_and_dm_control_agree(name):
    """p, v, force and pose are identical to the last bit on both paths of World; dm_control's p agrees to 1e-9, v to 1e-8."""
    robot = make_robot(name)
    scenario = short_gate(name, perturbation=Perturbation(start_spread=0.05, obstacle_spread=0.05))
    compiled, python = (
        run_episode(World(scenario, PD(*robot.gains), record=True, native=native), Scripted(), seed=3) for native in (None, False)
    )
    for field in ("position", "velocity", "force", "pose"):
        assert getattr(compiled, field).tobytes() == getattr(python, field).tobytes()
    environment = make_environment(scenario, PD(*robot.gains), random_state=0)
    environment.reset()
    state = environment.task.state
    world = World(scenario, PD(*robot.gains))
    world.reset(int(np.random.RandomState(0).randint(2**31)))
    orders = np.full(4, scenario.orders.index("FR"))
    for _ in range(scenario.mission_steps):
        environment.step(orders)
        world.step(orders[None])
        np.testing.assert_allclose(state.position, world.state.position, rtol=0, atol=1e-9)
        np.testing.assert_allclose(state.velocity, world.state.velocity, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["omni", "crazyflie"])
def test_a_robot_depends_on_neither_batch_nor_threads_and_repeats_itself(name):
    """Two worlds on two threads equal the same worlds on one, and a reset world repeats its episode."""
    scenario, controller = short_gate(name, perturbation=Perturbation(start_spread=0.05)), PD(*make_robot(name).gains)
    orders = np.full((2, 4), scenario.orders.index("FM"))
    results = []
    for threads in (1, 2):
        world = World(scenario, controller, worlds=2, threads=threads)
        for _ in range(2):
            world.reset(5)
            for _ in range(10):
                world.step(orders)
            results.append(world.state.position.tobytes() + world.state.robot.tobytes())
    assert len(set(results)) == 1


def test_solid_obstacles_go_where_an_episode_has_them_and_stop_a_robot():
    """Solid obstacles are at their drawn positions; a disc pushed against one stays outside it."""
    scenario = short_gate("disc", perturbation=Perturbation(obstacle_spread=0.2))
    world = World(scenario, PD(64.0, 16.0), worlds=2)
    world.reset(4)
    for b, data in enumerate(world.data):
        np.testing.assert_array_equal(data.mocap_pos[:, :2], world.state.obstacles[b, :, :2])
    wall = step_scenario(make_robot("disc"), obstacles=((2.0, -10.5, 1.0),), duration=2.0)
    world = World(wall, Push((4.0, 0.0), 2.0), record=True)
    orders = np.full((1, 2), wall.orders.index("FM"))
    clearance = [world.step(orders).observation.clearance[0, 0] for _ in range(wall.mission_steps)]
    assert min(clearance) == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(
    ("name", "supervisor", "switches"),
    [*((name, "scripted", (4, 2, 2, 2)) for name in REAL), ("crazyflie", "marlms-general", (2, 2, 2, 2))],
)
def test_every_robot_flies_its_gate(name, supervisor, switches):
    """No violation, no contact, tracking within 0.25 length units; a Crazyflie stays within its bounds on height and tilt."""
    row, trajectory = fly_gate(name, supervisor)
    robot = make_robot(name)
    assert row.violation == 0.0 and row.collisions == 0 and row.clearance > row.safe_distance
    assert row.error < 0.25 * robot.length and row.switches == switches
    speed = np.linalg.norm(trajectory.reference_velocity, axis=-1)
    change = np.linalg.norm(np.diff(trajectory.reference_velocity[:: trajectory.scenario.substeps], axis=0), axis=-1)
    assert speed.max() <= robot.speed_limit * (1 + 1e-12)
    assert change.max() <= robot.acceleration_limit * 0.05 * (1 + 1e-9)
    if row.height_error is not None:
        assert row.height_error < 0.05 and row.tilt < 35.0


def test_poses_travel_through_a_log_into_the_picture(tmp_path):
    """Position and quaternion of every body are read back to the last bit, and the drawn model takes these poses."""
    scenario, controller = short_gate("crazyflie"), PD(9.0, 6.0)
    path = tmp_path / "log.mcap"
    names = {"names": ("scripted", "pd"), "seed": 0, "config": {}}
    with LogWriter(path, scenario, controller, **names) as log:
        trajectory = run_episode(World(scenario, controller, record=True), Scripted(), on_frame=log.write)
    read = read_log(path)
    np.testing.assert_array_equal(read.pose, trajectory.pose)
    np.testing.assert_array_equal(from_trajectory(trajectory, controller).pose, trajectory.pose)
    stage = make_stage(read)
    stage.pose(float(read.time[7]))
    np.testing.assert_allclose(stage.data.qpos.reshape(4, 7), trajectory.pose[7], rtol=0, atol=1e-12)


# A user's robot ----------------------------------------------------------------------------------------------------------------


def test_a_users_robot_takes_one_mjcf_and_fewer_than_60_lines(hover):
    """It passes the checklist, and the compiled and the Python path give the same mission."""
    assert len(HOVER_PY.splitlines()) < 60
    items = list(checklist(str(hover)))
    assert [item.detail for item in items if not item.passed] == []
    scenario = robot_gate(str(hover), duration=3.0)
    runs = [run_episode(World(scenario, PD(36.0, 12.0), record=True, native=native), Scripted()) for native in (None, False)]
    assert runs[0].position.tobytes() == runs[1].position.tobytes()
    assert np.linalg.norm(runs[0].position[-1] - runs[0].reference[-1], axis=-1).max() < 0.1


def test_a_robot_whose_laws_are_plain_python_takes_the_python_path(hover):
    """Laws that are not compiled give the same numbers."""
    robot = make_robot(str(hover))
    plain = replace(robot, name="plain_hover", drive=laws.plain(robot.drive), reading=laws.plain(robot.reading))
    try:
        register(plain)
        worlds = [World(robot_gate(name, duration=0.5), PD(36.0, 12.0)) for name in (robot.name, plain.name)]
        assert worlds[0].native and not worlds[1].native
        for world in worlds:
            world.step(np.full((1, 4), world.scenario.orders.index("FR")))
        assert worlds[0].state.position.tobytes() == worlds[1].state.position.tobytes()
    finally:
        ROBOTS.pop("plain_hover", None)


def test_a_users_mjcf_alone_is_driven_by_what_its_actuators_do(tmp_path):
    """Slides with motors, and rotors, are recognized, with the mass of the file."""
    robot = make_robot(str(make_robot("disc").mjcf))
    assert robot.direct and robot.motors == ("x", "y") and robot.mass == pytest.approx(4.0)
    rotors = tmp_path / "quad.xml"
    spec = mujoco.MjSpec.from_file(str(make_robot("crazyflie").mjcf))
    crazyflie._prepare(spec)
    rotors.write_text(spec.to_xml())
    found = make_robot(str(rotors))
    np.testing.assert_allclose(found.mass, make_robot("crazyflie").mass)
    assert not found.direct and found.height == pytest.approx(0.25)


def test_meshes_are_carried_in_the_text(tmp_path):
    """With a mesh from an OBJ file, the assembled text names no file and the model has the original's mass and inertia."""
    (tmp_path / "hull.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    xml = HOVER.replace("<worldbody>", '<asset><mesh name="hull" file="hull.obj" scale="0.5 0.5 0.5"/></asset><worldbody>', 1)
    xml = xml.replace('type="box" size="0.3 0.2 0.1"', 'type="mesh" mesh="hull"').replace(
        'site="nozzle" gear="1 0', 'joint="x" gear="1 0'
    )
    xml = (
        xml.replace('site="nozzle" gear="0 1', 'joint="y" gear="0 1')
        .replace('gear="1 0 0 0 0 0"', "")
        .replace('gear="0 1 0 0 0 0"', "")
    )
    (tmp_path / "hull.xml").write_text(xml)
    name = str(tmp_path / "hull.xml")
    original = mujoco.MjModel.from_xml_path(name)
    plan = World(robot_gate(name, duration=0.05), PD(64.0, 16.0)).plan
    assert "hull.obj" not in plan.xml
    np.testing.assert_allclose(plan.model.body("agent2_hull").inertia, original.body("hull").inertia, rtol=1e-6)
    np.testing.assert_allclose(plan.model.body("agent2_hull").mass, original.body("hull").mass)


# Bad input ---------------------------------------------------------------------------------------------------------------------

BROKEN = {
    "no actuators": (HOVER[: HOVER.index("  <actuator>")] + "</mujoco>", "has no actuators"),
    "no mass": (HOVER.replace('mass="2"', 'mass="0"'), "mass"),
    "unknown site": (HOVER.replace('name="turn" site="nozzle"', 'name="turn" site="nowhere"'), "nowhere"),
    "name clash": (HOVER.replace('name="left"', 'name="ahead"'), "repeated name 'ahead'"),
    "not xml": ("<mujoco", "is not a valid MJCF file"),
    "outside": (
        HOVER.replace("<worldbody>", '<asset><mesh name="m" file="../secret.obj"/></asset><worldbody>', 1),
        "uses a file outside its folder: ../secret.obj",
    ),
    "missing": (
        HOVER.replace("<worldbody>", '<asset><mesh name="m" file="gone.obj"/></asset><worldbody>', 1),
        "uses a file that does not exist: gone.obj",
    ),
    "undriven": (HOVER, "write a Python file"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_mjcf_is_refused_in_one_line(case, tmp_path, capsys):
    """The error names the file and its fault; the command's exit status is 1."""
    text, message = BROKEN[case]
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=f"(?s)broken.xml.*{message}") as caught:
        make_robot(str(path))
    assert "\n" not in str(caught.value)
    with pytest.raises(SystemExit) as stopped:
        main(["robot", "check", str(path)])
    assert stopped.value.code == 1 and "FAIL" in capsys.readouterr().out


def test_a_robot_that_diverges_fails_its_check_and_stops_a_world(hover):
    """A drive that outputs NaN is reported with world, agent and time, before MuJoCo receives it."""
    hover.write_text(HOVER_PY.replace("params[0] * (0.5 - qvel[2])", "np.sqrt(-1.0 - qvel[2] ** 2)"))
    failed = [item for item in checklist(str(hover)) if not item.passed]
    assert [item.name for item in failed] == ["step"] and "world 0, agent 1, t = 0.000 s" in failed[0].detail
    world = World(robot_gate(str(hover), duration=0.5), PD(36.0, 12.0))
    with pytest.raises(SimulationError, match="world 0, agent 1"):
        world.step(np.full((1, 4), world.scenario.orders.index("FM")))
    assert np.isfinite(world.data[0].qpos).all()


def test_names_files_and_scales_that_cannot_be_are_named(monkeypatch, tmp_path):
    """Unknown robots, a missing package or checkout, another robot's mass, and limits or substeps beyond the robot's."""
    with pytest.raises(ConfigurationError, match="unknown robot 'rover'; choose from: point_mass, disc"):
        make_robot("rover")
    with pytest.raises(ConfigurationError, match="no robot file"):
        make_robot(str(tmp_path / "gone.xml"))
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    with pytest.raises(ConfigurationError, match="MENAGERIE_ROOT"):
        make_robot("menagerie:skydio_x2/x2.xml")
    monkeypatch.setattr(crazyflie, "PACKAGE", "drone_models_that_nobody_has")
    with pytest.raises(ConfigurationError, match=r"pip install 'marlbc-mj\[robots\]'"):
        crazyflie.crazyflie()
    with pytest.raises(ConfigurationError, match="mass 1 kg, but robot 'disc' has 4 kg"):
        World(paper(robot="disc"))
    with pytest.raises(ConfigurationError, match="force_limit must be at most 24 for robot 'disc', got 99"):
        World(robot_gate("disc", force_limit=99.0), PD(64.0, 16.0))
    with pytest.raises(ConfigurationError, match="substep must be at most 0.0025"):
        World(robot_gate("disc", substep=0.005), PD(64.0, 16.0))
    with pytest.raises(ConfigurationError, match="names that are taken"):
        register(replace(make_robot("disc"), description="another"))
    with pytest.raises(ConfigurationError, match="one of drive and reading"):
        replace(make_robot("disc"), drive=make_robot("omni").drive)


def test_a_python_file_that_makes_no_robot_is_refused(tmp_path):
    """The error gives the file's exception, or what the file lacks."""
    path = tmp_path / "mine.py"
    for text, message in (("1 / 0", "fails: ZeroDivisionError"), ("ROBOT = 3", "defines neither ROBOT")):
        path = path.with_stem(path.stem + "x")
        path.write_text(text)
        with pytest.raises(ConfigurationError, match=message):
            make_robot(str(path))


@pytest.mark.parametrize("name", REAL)
def test_shipped_robots_pass_their_checklist(name):
    """Every item passes, and a robot's Python file has fewer than 100 lines."""
    assert [item for item in checklist(name) if not item.passed] == []
    robot = make_robot(name)
    assert isinstance(robot, Robot)
    source = Path(ast.__file__).parent if robot.drive is None else Path(laws.plain(robot.drive).__code__.co_filename)
    assert robot.drive is None or len(source.read_text().splitlines()) < 100
