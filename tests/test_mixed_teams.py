"""Mixed teams: identical on all paths, true to MuJoCo for every agent, and refused with one line if they cannot be."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hostile import attack

from marlbc_mj.cli import main
from marlbc_mj.controllers import PD
from marlbc_mj.core.shield import Shield
from marlbc_mj.engine.assembly import agent_prefix
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.log import from_trajectory
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.results.metrics import measure
from marlbc_mj.robots import ROBOTS, make_fleet, make_robot
from marlbc_mj.scenarios import Perturbation, Scenario, load_scenario, make_scenario
from marlbc_mj.scenarios.robot_gate import robot_gate
from marlbc_mj.scenarios.titles import mission_title, robots_title
from marlbc_mj.studies.robot_truth import compare
from marlbc_mj.supervisors import Scripted
from marlbc_mj.tasks.formation import make_environment
from marlbc_mj.tasks.gymnasium_env import PaperFormation
from marlbc_mj.tasks.parallel_env import PaperFormationParallel
from marlbc_mj.util.errors import ConfigurationError

MIXED = ("crazyflie", "disc", "omni", "disc")
"""Equal robots that are not adjacent: agents keep their numbers, and the discs form two groups."""
SLIDING = ("disc", "point_mass", "disc", "disc")
"""A point mass on slides, which touches nothing, among discs with a pose."""


def gate(robots: tuple[str, ...] = MIXED, **changes) -> Scenario:
    """The gate mission for one second."""
    return robot_gate(robots=robots, **{"duration": 1.0, **changes})


@pytest.mark.parametrize("robots", [MIXED, SLIDING, ("diff_drive", "omni", "crazyflie", "diff_drive")])
def test_compiled_loop_python_path_and_dm_control_agree(robots):
    """p, v, force and pose are identical to the last bit on both paths of World; p, v and force agree in dm_control too."""
    scenario = gate(robots, duration=0.25, perturbation=Perturbation(start_spread=0.05, obstacle_spread=0.05))
    compiled, python = (
        run_episode(World(scenario, PD(), record=True, native=native), Scripted(), seed=3) for native in (None, False)
    )
    for field in ("position", "velocity", "force", "pose"):
        assert getattr(compiled, field).tobytes() == getattr(python, field).tobytes()
    environment = make_environment(scenario, PD(), random_state=0)
    environment.reset()
    state, world = environment.task.state, World(scenario, PD())
    world.reset(int(np.random.RandomState(0).randint(2**31)))
    orders = np.full(4, scenario.orders.index("FR"))
    for _ in range(scenario.mission_steps):
        environment.step(orders)
        world.step(orders[None])
    for field in ("position", "velocity", "force"):
        np.testing.assert_allclose(getattr(state, field), getattr(world.state, field), rtol=0, atol=1e-9)


def test_every_agent_is_where_mujoco_has_its_body_and_is_pushed_as_its_own_robot():
    """p is a fixed point of each agent's own body, v its velocity, force the force that its actuators apply to the base."""
    world = World(gate(), PD())
    orders = np.full((1, 4), world.scenario.orders.index("FR"))
    truths = []
    for _ in range(10):
        world.step(orders)
        truths.append(compare(world))
    for truth in truths:
        np.testing.assert_allclose(truth.offset, truths[0].offset, atol=1e-6)
        np.testing.assert_allclose(truth.velocity_error, 0.0, atol=1e-6)
    pushing = [0, 1, 3]  # all but the omni, which drives on wheels
    gained = world.data[0].qfrc_actuator[world.plan.plant.qvel_index[pushing]]
    np.testing.assert_allclose(world.state.force[0, pushing], gained, atol=2e-3)


def test_a_mixed_team_starts_where_it_is_put():
    """Agents start at the drawn starts, also those led by a point ahead of their axle."""
    scenario = gate(("diff_drive", "omni", "crazyflie", "diff_drive"), perturbation=Perturbation(start_spread=0.1))
    world = World(scenario, PD(), worlds=2)
    observation = world.reset(7)
    drawn = scenario.draw(np.random.default_rng([7, 0]))
    assert drawn.starts.shape == observation.position[0].shape
    truth = compare(world)
    np.testing.assert_allclose(truth.offset[[0, 3]], [[0.15, 0.0]] * 2, atol=1e-12)
    np.testing.assert_allclose(truth.offset[[1, 2]], 0.0, atol=1e-12)


def test_mass_force_limit_and_force_unit_are_each_robots_own():
    """Equal errors accelerate all agents alike, up to their own limits; masses in MuJoCo are those of the robots."""
    world = World(gate(), PD())
    plant, fleet = world.plan.plant, make_fleet(MIXED)
    np.testing.assert_array_equal(plant.masses, [make_robot(name).mass for name in MIXED])
    np.testing.assert_array_equal(plant.unit_forces, plant.masses)
    np.testing.assert_array_equal(world.scenario.force_limits, [make_robot(name).force_limit for name in MIXED])
    gains = np.array([row[0] for row in plant.controller_params])
    np.testing.assert_array_equal(gains, gains[0])
    limits = [row[-1] for row in plant.controller_params.tolist()]
    np.testing.assert_allclose(limits, world.scenario.force_limits / plant.masses)
    heaviest = [world.plan.model.body(agent_prefix(i) + "body").subtreemass[0] for i in range(4)]
    assert heaviest[1] == heaviest[3] == 4.0 and heaviest[0] < 0.1
    assert fleet.scale()["force_limit"] == 24.0
    assert world.scenario.least_acceleration == (world.scenario.force_limits / plant.masses).min()


def test_the_largest_robot_sets_lengths_and_the_weakest_speed_and_acceleration():
    """Safe distance and formations are those of the disc's gate, speed and acceleration limits those of the Crazyflie."""
    scenario, largest, slowest = gate(), robot_gate("disc"), make_robot("crazyflie")
    assert scenario.safe_distance == largest.safe_distance
    np.testing.assert_array_equal(scenario.formations, largest.formations)
    assert (scenario.speed_limit, scenario.acceleration_limit) == (slowest.speed_limit, slowest.acceleration_limit)


@pytest.mark.parametrize("robots", [("disc",) * 4, ["disc"] * 4])
def test_four_times_the_same_robot_is_one_robot_for_all(robots):
    """Naming the same robot for every agent gives the same scenario as naming it once."""
    assert robot_gate(robots=tuple(robots), duration=1.0) == robot_gate("disc", duration=1.0)
    assert replace(robot_gate("disc", duration=1.0), robots=robots) == robot_gate("disc", duration=1.0)


def test_a_copy_of_a_mixed_world_goes_on_like_its_source():
    """A pickled copy continues identically to the last bit."""
    world = World(gate(), PD(), worlds=2)
    orders = np.full((2, 4), world.scenario.orders.index("FM"))
    world.reset(1)
    world.step(orders)
    copy = pickle.loads(pickle.dumps(world))
    for each in (world, copy):
        for _ in range(5):
            each.step(orders)
    assert world.state.position.tobytes() == copy.state.position.tobytes()
    assert world.state.robot.tobytes() == copy.state.robot.tobytes()


@pytest.mark.parametrize("robots", [MIXED, SLIDING])
def test_a_log_knows_each_agents_robot_and_is_drawn_with_it(robots, tmp_path):
    """A log read back has the names, poses and metrics of its trajectory, and every robot is drawn with its own radius."""
    scenario, path = gate(robots), tmp_path / "log.mcap"
    with LogWriter(path, scenario, PD(), names=("scripted", "pd"), seed=0, config={}) as log:
        trajectory = run_episode(World(scenario, PD(), record=True), Scripted(), on_frame=log.write)
    read = read_log(path)
    assert read.robots == from_trajectory(trajectory, PD()).robots == robots
    np.testing.assert_array_equal(read.pose, trajectory.pose)
    assert measure(read)["agents"] == measure(trajectory)["agents"]
    stage = make_stage(read)
    stage.pose(float(read.time[7]))
    np.testing.assert_allclose(stage.radii, [make_robot(name).radius for name in robots])
    np.testing.assert_allclose(stage.data.qpos[stage.joints], read.position[7], atol=1e-9)
    assert stage.middles().shape == (4, 3)


def test_saturation_is_measured_by_each_robots_own_limit():
    """A force of 12 N saturates an omni, but not a disc, which has a limit of 24 N."""
    scenario = gate(("disc", "omni", "disc", "omni"), duration=0.2)
    trajectory = run_episode(World(scenario, PD(), record=True), Scripted())
    force = np.full_like(trajectory.force, 12.0)
    duty = [agent["saturation_duty"] for agent in measure(replace(trajectory, force=force))["agents"]]
    assert duty == [0.0, 1.0, 0.0, 1.0]


def test_a_shield_of_references_keeps_a_mixed_team_clear():
    """If robots have different tubes, the wider one applies to the whole team, and no agent leaves it."""
    scenario = robot_gate(robots=("diff_drive", "crazyflie", "diff_drive", "crazyflie"))
    unit, first = scenario.fleet.length, scenario.obstacles[0]
    places = ((-6.0, 0.0), (-6.0, 5.0), (6.0, 0.0), (6.0, 5.0))
    crowded = replace(scenario, starts=tuple((first.x + unit * x, first.y + unit * y) for x, y in places))
    world = World(crowded, PD(), record=True, shield=True)
    assert world.plan.plant.shield[0].tube == make_robot("diff_drive").tube
    clearance, distance, off = attack(world, 60, speed=crowded.speed_limit, change=30)
    assert clearance > crowded.safe_distance and distance > 2.0 * scenario.fleet.radius
    assert off <= world.plan.plant.shield[0].tube


def test_files_and_settings_name_each_agents_robot(tmp_path, capsys):
    """A TOML file, a change from Python and ``--set`` make the same team; the scenario's scale is derived from it."""
    path = tmp_path / "team.toml"
    path.write_text('family = "open"\nagents = 4\nrobots = ["crazyflie", "disc", "omni", "disc"]\n')
    scenario = load_scenario(path)
    assert scenario.robots == MIXED and scenario.substep == 0.0025 and scenario.force_limit == 24.0
    changed = make_scenario("open", **make_fleet(MIXED).scale())
    assert (changed.robots, changed.speed_limit) == (scenario.robots, scenario.speed_limit)
    arguments = ["--set", f"robots={','.join(MIXED)}", "--controller", "pd", "--duration", "0.2", "--quiet"]
    main(["run", "open", *arguments, "--out", str(tmp_path / "run")])
    assert read_log(next((tmp_path / "run").rglob("*.mcap"))).robots == MIXED
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"robots": ("disc", "disk", "omni", "omni")}, ("unknown robot 'disk'", "perhaps 'disc'")),
        ({"robots": ("disc", "omni")}, ("robots lists 2 robots for 4 agents: disc, omni",)),
        ({"robots": "disc"}, ("robots must be names, one per agent, got 'disc'",)),
        ({"robots": (1, 2, 3, 4)}, ("robots must be names, one per agent",)),
        ({"robot": "disc", "robots": ("omni", "disc", "omni", "disc")}, ("robot 'disc' and robots omni, disc",)),
        ({"robots": MIXED, "substep": 0.005}, ("substep must be at most 0.0025 for robot 'crazyflie'",)),
    ],
)
def test_robots_that_cannot_be_are_one_line(changes, words):
    with pytest.raises(ConfigurationError) as found:
        World(make_scenario("open", **changes), PD())
    assert all(word in str(found.value) for word in words) and "\n" not in str(found.value)


def test_a_shield_that_a_mixed_team_cannot_have_says_why():
    """A shield of forces needs robots that brake alike; a shield of references needs a tube."""
    scenario = gate(("disc", "omni", "disc", "omni"))
    with pytest.raises(ConfigurationError, match="robots 'disc' and 'omni' brake differently"):
        World(scenario, PD(), shield=Shield(level="force"))
    with pytest.raises(ConfigurationError, match="robot 'disc' has no tube"):
        World(scenario, PD(), shield=True)
    assert World(scenario, PD(), shield=Shield(tube=0.1)).plan.plant.shield[0].tube == 0.1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda spec: setattr(spec.option, "gravity", [0.0, 0.0, 0.0]), "their files say gravity"),
        (lambda spec: setattr(spec.option, "impratio", 3.0), "their files say impratio 10.0 and 3.0"),
    ],
)
def test_robots_that_live_in_different_worlds_are_refused(change, words, monkeypatch):
    """Gravity must agree; a solver or contact option that only one file sets applies to all."""
    strange = replace(make_robot("omni"), name="strange", prepare=change)
    monkeypatch.setitem(ROBOTS, "strange", (lambda: strange, ""))
    with pytest.raises(ConfigurationError, match=words):
        World(gate(("disc", "strange", "disc", "disc")), PD())
    assert World(gate(), PD()).plan.model.opt.impratio == 10.0


def test_robots_that_stand_on_different_ground_are_refused(monkeypatch):
    """The arena's ground collides with all geoms, a robot's own floor only with that robot's."""
    standing = replace(make_robot("omni"), name="standing", ground=True)
    monkeypatch.setitem(ROBOTS, "standing", (lambda: standing, ""))
    with pytest.raises(ConfigurationError, match="'standing' and 'disc' cannot be in one world"):
        World(gate(("disc", "standing", "disc", "disc")), PD())
    make_fleet(("standing", "crazyflie"))  # a Crazyflie never touches the ground


def test_titles_name_the_robots():
    assert mission_title(gate().name) == "Point and gate, mixed team"
    assert robots_title(MIXED) == "Crazyflies (1), discs (2, 4), omnidirectional bases (3)"
    assert robots_title(("disc", "disc")) == "discs"


def test_gymnasium_and_pettingzoo_take_a_mixed_team():
    """The same decisions give the same rewards and positions as in World."""
    scenario, world = gate(duration=0.2), World(gate(duration=0.2), PD())
    single, parallel = PaperFormation(scenario, PD()), PaperFormationParallel(scenario, PD())
    single.reset(seed=0)
    parallel.reset(seed=0)
    orders = world.scenario.orders.representative[[0, 1, 0, 1]][None]
    for _ in range(scenario.mission_steps - 1):  # the last step would begin a new episode
        step = world.step(orders)
        _, reward, *_ = single.step(np.array([0, 1, 0, 1]))
        _, rewards, *_ = parallel.step({agent: k % 2 for k, agent in enumerate(parallel.agents)})
        assert {reward, *rewards.values()} == {step.reward[0]}
    for env in (single, parallel):
        np.testing.assert_array_equal(env.batch.world.state.position, world.state.position)
