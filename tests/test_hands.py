"""What strangers do with environments: copies, other processes, wrong actions, names and objects, frames."""

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
from pathlib import Path

import cloudpickle
import gymnasium
import numpy as np
import pytest
import torch

import marlbc_mj.tasks
from marlbc_mj import PD, World, paper
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Perturbation, robot_gate
from marlbc_mj.tasks.given import scenario_from
from marlbc_mj.tasks.gymnasium_env import PaperFormation, PaperFormationVector
from marlbc_mj.tasks.parallel_env import PaperFormationParallel
from marlbc_mj.util.errors import ConfigurationError

ID = "marlbc_mj/PaperFormation-v0"
AROUND = Perturbation(1.0, 0.5, (0.0, 2.0))
JOINT = np.array([0, 1, 2, 3])
WAYS = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda it: pickle.loads(pickle.dumps(it)),
    "cloudpickle": lambda it: pickle.loads(cloudpickle.dumps(it)),
}


def future(world: World, steps: int = 20) -> np.ndarray:
    """Positions over some mission steps."""
    orders = np.tile(JOINT, (world.worlds, 1))
    return np.array([world.step(orders).observation.position for _ in range(steps)])


@pytest.mark.parametrize("way", WAYS)
def test_a_copied_world_has_the_same_future_and_leaves_the_original_alone(way):
    world = World(paper(perturbation=AROUND, duration=5.0), worlds=2, record=True)
    world.reset(3)
    future(world, 7)
    before = world.snapshot()
    twin = WAYS[way](world)
    seen = future(twin)
    assert all(np.array_equal(before[name], array) for name, array in world.snapshot().items())
    assert (future(world) == seen).all()
    assert twin.step(np.tile(JOINT, (2, 1))).record is not None and (twin.worlds, twin.native) == (2, world.native)


def test_a_copy_of_robots_with_contact_outlives_its_original():
    """A robot with a drive, solid obstacles and a look-ahead point: the copy has its own MuJoCo data."""
    scenario = robot_gate("diff_drive", duration=2.0)
    world = World(scenario, PD(*make_robot("diff_drive").gains))
    future(world, 5)
    twin, lasting = copy.deepcopy(world), pickle.dumps(world)
    expected = future(world)
    del world
    assert (future(twin) == expected).all() and (future(pickle.loads(lasting)) == expected).all()


@pytest.mark.parametrize("way", [way for way in WAYS if way != "copy"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_copied_environment_plays_the_same_episode(way, wrapped):
    env = gymnasium.make(ID, duration=2.0, perturbation=AROUND) if wrapped else PaperFormation(duration=2.0, perturbation=AROUND)
    env.reset(seed=4)
    env.step(JOINT)
    twin = WAYS[way](env)
    states = [twin.step(JOINT)[0] for _ in range(30)]
    assert (np.array([env.step(JOINT)[0] for _ in range(30)]) == states).all()
    assert (env.reset()[0] == twin.reset()[0]).all()  # and draws the same next one


@pytest.mark.parametrize("way", [way for way in WAYS if way != "copy"])
def test_copies_of_the_other_views(way):
    vector, parallel = PaperFormationVector(3, duration=1.0, perturbation=AROUND), PaperFormationParallel(duration=1.0)
    vector.reset(seed=1), parallel.reset(seed=1)
    others = WAYS[way](vector), WAYS[way](parallel)
    orders = dict(zip(parallel.possible_agents, JOINT, strict=True))
    for _ in range(25):  # over the end of an episode
        assert (vector.step(np.tile(JOINT, (3, 1)))[0] == others[0].step(np.tile(JOINT, (3, 1)))[0]).all()
    assert parallel.step(orders)[1] == others[1].step(orders)[1] and (parallel.state() == others[1].state()).all()


CHILD = """
import pickle, sys
import numpy as np
env = pickle.load(open(sys.argv[1], "rb"))
np.save(sys.argv[2], np.array([env.step(np.array([0, 1, 2, 3]))[0] for _ in range(10)]))
"""


def test_an_environment_goes_on_in_another_process(tmp_path):
    """As joblib, ray, dask and submitit send it: cloudpickle there, pickle here."""
    env = gymnasium.make(ID, duration=2.0)
    env.reset(seed=0)
    env.step(JOINT)
    (tmp_path / "env.pkl").write_bytes(cloudpickle.dumps(env))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path / "env.pkl"), str(tmp_path / "seen.npy")], env=environment, check=True
    )
    assert (np.load(tmp_path / "seen.npy") == [env.step(JOINT)[0] for _ in range(10)]).all()


@pytest.mark.parametrize("way", WAYS)
def test_the_dm_control_view_refuses_to_be_copied(way):
    env = marlbc_mj.tasks.load("formation", "paper", duration=0.5)
    env.reset()
    for each in (env, env.task):
        with pytest.raises(ConfigurationError, match="random_state"):
            WAYS[way](each)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a fork beside threads
def test_a_fork_after_threads_works_in_series():
    """AsyncVectorEnv, SubprocVecEnv and pools fork: the child has no threads, and the same results."""
    teams = PaperFormationVector(4, threads=2, duration=0.5)
    teams.reset(seed=0)
    actions = np.tile(JOINT, (4, 1))
    teams.step(actions)
    context = multiprocessing.get_context("fork")
    told = context.SimpleQueue()
    child = context.Process(target=lambda: told.put(teams.step(actions)[0]))
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert (told.get() == teams.step(actions)[0]).all()


WRONG = {
    "one past the last": np.full(4, 24),
    "negative": np.full(4, -1),
    "a scalar": 2,
    "NaN": np.full(4, np.nan),
    "fractions": np.full(4, 0.5),
    "too few": np.ones(3, dtype=int),
    "too many": np.ones(5, dtype=int),
    "another axis": np.ones((1, 4), dtype=int),
    "bool": np.ones(4, dtype=bool),
    "nothing": None,
    "ragged": [[0], [0, 1], 0, 0],
    "objects": [object()] * 4,
    "a dictionary": {"agent_1": 0},
    "no order's name": ["FM", "FR", "OA", "XX"],
    "huge": np.full(4, 2**64 - 1, dtype=np.uint64),
    "a tensor of fractions": torch.zeros(4),
    "a tensor with gradients": torch.zeros(4, requires_grad=True),
}


@pytest.fixture(scope="module")
def views():
    """A step of every view, as a function of one team's action."""
    world, env, vector = World(paper(duration=1.0)), PaperFormation(duration=1.0), PaperFormationVector(1, duration=1.0)
    parallel, dm = PaperFormationParallel(duration=1.0), marlbc_mj.tasks.load("formation", "paper", duration=1.0)
    env.reset(seed=0), vector.reset(seed=0), parallel.reset(seed=0), dm.reset()

    def joint(action):
        agents = parallel.possible_agents
        return dict(zip(agents, action, strict=False)) if hasattr(action, "__len__") else action

    return {
        "world": lambda action: world.step([action]),
        "gymnasium": env.step,
        "vector": lambda action: vector.step([action]),
        "pettingzoo": lambda action: parallel.step(joint(action)),
        "dm_control": dm.step,
    }


@pytest.mark.parametrize("view", ["world", "gymnasium", "vector", "pettingzoo", "dm_control"])
@pytest.mark.parametrize("name", WRONG)
def test_no_view_takes_a_wrong_action(view, name, views):
    if view == "pettingzoo" and name in ("too many", "a dictionary"):
        pytest.skip("a dictionary is what it takes, and each agent has one action in it")
    with pytest.raises(ConfigurationError) as error:
        views[view](WRONG[name])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("action", [JOINT, JOINT.tolist(), torch.tensor(JOINT), JOINT.astype(np.uint8)])
@pytest.mark.parametrize("view", ["world", "gymnasium", "vector", "pettingzoo", "dm_control"])
def test_every_view_takes_whole_numbers_of_any_library(view, action, views):
    views[view](action)


def test_orders_by_name():
    one, other = World(paper(duration=1.0)), World(paper(duration=1.0))
    names = [["FM", "FR", "OA>FM", "OA>FR>FM"]]
    orders = [[one.scenario.orders.index(name) for name in names[0]]]
    assert (one.step(names).observation.position == other.step(orders).observation.position).all()
    with pytest.raises(ConfigurationError, match="unknown priority order 'FN'.*FM, FR"):
        one.step([["FN"] * 4])


@pytest.mark.parametrize(
    ("wrong", "fragment"),
    [
        (lambda: World(paper(), threads=1.5), "threads"),
        (lambda: World(paper(), worlds=1.5), "worlds"),
        (lambda: World(paper(duration=1.0)).reset(0.5), "seed"),
        (lambda: World(paper(duration=1.0)).reset(None), "seed"),
        (lambda: World(paper(duration=1.0)).reset(0, np.array([1])), "mask must be bool"),
        (lambda: World(paper(duration=1.0)).rollout([[0, 0, 0, 0]]), "steps, worlds, agents"),
        (lambda: World(paper(duration=1.0)).step([[0] * 4], [[["a", "b"]] * 4]), "velocity"),
        (lambda: PaperFormation(interval=2.0), "decision"),
        (lambda: PaperFormation(scenario=3), "a name, a .toml file or a Scenario, got int"),
        (lambda: PaperFormation(controller=3), "a Controller, got int"),
        (lambda: PaperFormation(controller="pid"), "controller 'pid'"),
        (lambda: PaperFormation(durtion=3.0), "field of a scenario 'durtion'"),
        (lambda: PaperFormation(paper(), durtion=3.0), "field of a scenario 'durtion'"),
        (lambda: PaperFormation(render_mode="ansi"), "render_mode 'ansi'"),
        (lambda: PaperFormationParallel(render_mode="human"), "render_mode 'human'"),
        (lambda: PaperFormationParallel(duration=1.0).reset(seed=-1), "non-negative whole number, got -1"),
        (lambda: PaperFormationParallel(duration=1.0).reset(seed=0.5), "non-negative whole number, got 0.5"),
        (lambda: PaperFormationParallel(duration=1.0).step({f"agent_{i}": 0 for i in range(1, 6)}), "unknown agent 'agent_5'"),
        (lambda: PaperFormationVector(2, duration=1.0).reset(options=[1]), "options"),
        (lambda: PaperFormationVector(2, duration=1.0).reset(seed=[0, 1.5]), "seed"),
        (lambda: marlbc_mj.tasks.load("formation", "paper", render_mode=None), "field of a scenario 'render_mode'"),
    ],
)
def test_wrong_settings_are_one_line(wrong, fragment):
    with pytest.raises(ConfigurationError) as error:
        wrong()
    assert fragment in str(error.value) and "\n" not in str(error.value)


def test_a_scenario_made_in_python_and_a_controller_by_name():
    own = paper(duration=1.0, force_limit=150.0)
    assert scenario_from(own, {}) == own and scenario_from(own, {"duration": 2.0}).duration == 2.0
    env = gymnasium.make(ID, scenario=own, controller="pd").unwrapped
    assert env.batch.scenario == own and env.batch.world.plan.controller == PD()
    assert PaperFormationVector(2, own, "pd").batch.scenario == own
    assert PaperFormationParallel(own, "pd").batch.scenario == own
    assert marlbc_mj.tasks.load("formation", own, controller="pd").task.scenario == own


def test_render_mode():
    """None is accepted and draws nothing; frames are as large as declared, and change as the team moves."""
    quiet = gymnasium.make(ID, render_mode=None, duration=1.0)
    assert quiet.unwrapped.render() is None and PaperFormationParallel(render_mode=None).render() is None
    env = gymnasium.make(ID, render_mode="rgb_array", scenario="cruise", duration=5.0)
    env.reset(seed=0)
    first = env.render()
    for _ in range(80):
        env.step(JOINT)
    later = env.render()
    assert first.shape == later.shape == (480, 640, 3) and first.dtype == np.uint8
    assert first.std() > 10 and (first != later).any()
    twin = copy.deepcopy(env)
    assert np.abs(twin.render().astype(int) - later).max() <= 2  # a new OpenGL context may round another way
    env.close(), twin.close()


def test_frames_of_the_other_views_and_of_robots():
    vector = gymnasium.make_vec(
        ID, num_envs=2, vectorization_mode="vector_entry_point", render_mode="rgb_array", perturbation=AROUND
    )
    vector.reset(seed=0)
    frames = vector.render()
    assert len(frames) == 2 and (frames[0] != frames[1]).any()
    vector.close()
    parallel = PaperFormationParallel(robot_gate("crazyflie", duration=1.0), "pd", render_mode="rgb_array")
    parallel.reset(seed=0)
    assert parallel.render().shape == (480, 640, 3)
    parallel.close()


def test_switched_off_rendering_says_so(tmp_path):
    code = (
        "import marlbc_mj.tasks, gymnasium\n"
        f"env = gymnasium.make({ID!r}, render_mode='rgb_array', disable_env_checker=True)\n"
        "env.reset()\n"
        "try: env.render()\n"
        "except ValueError as error: print(error)\n"
    )
    environment = {**os.environ, "MUJOCO_GL": "off", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert "switches rendering off" in done.stdout
    assert list(Path(tmp_path).iterdir()) == []


@pytest.fixture
def played():
    """``played(env, steps)``: states of an environment. It goes to workers by value, who so need not import this module."""

    def play(env: PaperFormation, steps: int) -> np.ndarray:
        return np.array([env.step(JOINT)[0] for _ in range(steps)])

    return play


def test_joblib_plays_copies_in_its_workers(played):
    joblib = pytest.importorskip("joblib")
    env = PaperFormation(duration=2.0)
    env.reset(seed=0)
    one, two = joblib.Parallel(n_jobs=2)(joblib.delayed(played)(env, 5) for _ in range(2))
    assert (one == two).all() and (one == played(env, 5)).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ray_plays_copies_in_its_workers(monkeypatch, played):
    """An environment goes to a task and to an actor, which keeps it; both play on where the original stands."""
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    env = PaperFormation(duration=2.0)
    env.reset(seed=0)

    class Player:
        def __init__(self, env):
            self.env = env

        def play(self, steps):
            return played(self.env, steps)

    path = [str(Path(__file__).parent), *sys.path]
    ray.init(
        num_cpus=2, include_dashboard=False, log_to_driver=False, runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join(path)}}
    )
    try:
        of_task = ray.get(ray.remote(played).remote(env, 5))
        actor = ray.remote(Player).remote(env)
        of_actor = np.concatenate([ray.get(actor.play.remote(steps)) for steps in (2, 3)])
    finally:
        ray.shutdown()
    assert (of_task == of_actor).all() and (of_task == played(env, 5)).all()


@pytest.mark.filterwarnings("ignore")  # of these libraries
def test_stable_baselines_learns_on_the_pettingzoo_view():
    """SuperSuit copies the environment with cloudpickle; PPO then steps the copies."""
    supersuit, sb3 = pytest.importorskip("supersuit"), pytest.importorskip("stable_baselines3")
    vector = supersuit.pettingzoo_env_to_vec_env_v1(PaperFormationParallel(duration=0.5))
    vector = supersuit.concat_vec_envs_v1(vector, 2, num_cpus=1, base_class="stable_baselines3")
    model = sb3.PPO("MlpPolicy", vector, n_steps=16, batch_size=32, n_epochs=1, device="cpu")
    assert model.learn(64).num_timesteps >= 64


@pytest.mark.filterwarnings("ignore")
def test_stable_baselines_takes_the_gymnasium_view():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(PaperFormation(duration=0.5), skip_render_check=True)
