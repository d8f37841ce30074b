"""Set-based composition: avoidance holds for any desired velocity, orders keep their meaning, and all simulators agree."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marlbc_mj import tasks
from marlbc_mj.controllers import SORLC
from marlbc_mj.core.barriers import Barrier, bound_obstacles
from marlbc_mj.core.braking import brake, least_distance, path_time, restrain
from marlbc_mj.engine.composition import PLANE_ROWS, WORKSPACE, compose_team, keep, limit
from marlbc_mj.engine.inequalities import BARRIER_MARGIN, BARRIER_RATE, BARRIER_REACH, BARRIER_SPEED, make_barrier, workspace_rows
from marlbc_mj.engine.plan import make_behaviors
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.reader import log_info
from marlbc_mj.recording.writer import METADATA, LogWriter
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.outcomes import outcome
from marlbc_mj.scenarios import Scenario, load_scenario, make_scenario, paper
from marlbc_mj.scenarios.base import Obstacle, Window
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.supervisors.scripted import Scripted
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import plain_data

seeds = st.integers(0, 2**32 - 1)
SET_BASED = {"composition": "set-based"}
LIMITS = {"speed_limit": 1.5, "acceleration_limit": 1.5}


def crowd(rng: np.random.Generator, **changes) -> Scenario:
    """Five agents at rest among discs, all clear of each other, with random slots among them."""
    distance, agents = 1.0, 5
    placed: list[np.ndarray] = []
    while len(placed) < agents:
        p = rng.uniform(-6, 6, 2)
        if all(np.linalg.norm(p - q) > 2.0 for q in placed):
            placed.append(p)
    discs: list[Obstacle] = []
    for _ in range(100):
        disc = Obstacle(*rng.uniform(-7, 7, 2), rng.uniform(0.0, 1.5))
        if len(discs) < 6 and all(np.hypot(p[0] - disc.x, p[1] - disc.y) > disc.radius + distance + 0.15 for p in placed):
            discs.append(disc)
    slots = tuple(tuple(row) for row in rng.uniform(-8, 8, (agents, 2)))
    columns = tuple(tuple(row) for row in rng.uniform(-8, 8, (agents, 2)))
    oa, fm, fr, aa = make_scenario("field").behaviors
    behaviors = (oa, replace(fm, offsets=slots), replace(fr, offsets=columns), aa)
    fields = {"starts": tuple(tuple(p) for p in placed), "behaviors": behaviors, "obstacles": tuple(discs)}
    return Scenario(name="crowd", safe_distance=distance, **{**fields, **SET_BASED, **changes})


def references(scenario: Scenario, orders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """p_r (T + 1, N, 2) [m] and v_r (T + 1, N, 2) [m/s] under orders (T, N), from rest, as the loop computes them."""
    behaviors = make_behaviors(scenario)
    workspace, grid, obstacles = np.zeros((workspace_rows(scenario), 2)), np.zeros(0), scenario.obstacle_array()
    places, velocities = [np.array(scenario.starts)], [np.zeros((scenario.agents, 2))]
    for t, row in enumerate(orders):
        v_r, before = velocities[-1].copy(), np.zeros((scenario.agents, 2))
        keep(behaviors, v_r, before)
        compose_team(t * scenario.mission_step, row, behaviors, places[-1], obstacles, grid, workspace, v_r)
        limit(behaviors, scenario.mission_step, before, v_r)
        velocities.append(v_r)
        places.append(places[-1] + scenario.mission_step * v_r)
    return np.array(places), np.array(velocities)


def room(scenario: Scenario, places: np.ndarray) -> tuple[float, float]:
    """Least d - d_OA of all agents and obstacles, and d - d_AA of all pairs [m], over ``places`` (T, N, 2)."""
    barrier, discs = make_barrier(scenario), scenario.obstacle_array()
    gaps = np.linalg.norm(places[:, :, None] - discs[:, :2], axis=-1) - discs[:, 2] - barrier.obstacle_distance
    i, j = np.triu_indices(scenario.agents, 1)
    pairs = np.linalg.norm(places[:, i] - places[:, j], axis=-1) - barrier.agent_distance
    return float(gaps.min(initial=np.inf)), float(pairs.min())


def random_orders(scenario: Scenario, rng: np.random.Generator, steps: int) -> np.ndarray:
    """(T, N) orders that change at random about once per second, for each agent separately."""
    orders = np.zeros((steps, scenario.agents), dtype=np.int64)
    for i in range(scenario.agents):
        for t in range(steps):
            again = t == 0 or rng.random() < 0.05
            orders[t, i] = rng.integers(len(scenario.orders)) if again else orders[t - 1, i]
    return orders


# Inequalities ----------------------------------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=40)
def test_references_never_use_up_the_margin(seed):
    """d >= d_OA + m and d_ij >= d_AA + m for random discs, slots and orders: every step leaves (1 - alpha T) of the room."""
    rng = np.random.default_rng(seed)
    scenario = crowd(rng)
    places, velocities = references(scenario, random_orders(scenario, rng, 200))
    obstacles, agents = room(scenario, places)
    assert min(obstacles, agents) >= BARRIER_MARGIN - 1e-9
    assert np.linalg.norm(velocities, axis=-1).max() <= BARRIER_SPEED * (1 + 1e-12)


@given(seeds)
@settings(max_examples=40)
def test_references_of_limited_acceleration_never_use_it_up_either(seed):
    """The same holds with |v_r| <= V and |dv_r| <= A T: braking remains possible under any orders."""
    rng = np.random.default_rng(seed)
    scenario = crowd(rng, **LIMITS)
    places, velocities = references(scenario, random_orders(scenario, rng, 200))
    obstacles, agents = room(scenario, places)
    assert min(obstacles, agents) >= BARRIER_MARGIN - 1e-9
    assert np.linalg.norm(velocities, axis=-1).max() <= LIMITS["speed_limit"] * (1 + 1e-12)
    change = np.linalg.norm(np.diff(velocities, axis=0), axis=-1).max()
    assert change <= LIMITS["acceleration_limit"] * scenario.mission_step * (1 + 1e-9)


BRAKING = Barrier(
    rate=4.0, margin=0.1, reach=50.0, speed=8.0, braking=2.0, duration=0.05, obstacle_distance=1.0, agent_distance=1.5
)


@given(seeds)
def test_any_wish_can_be_braked(seed):
    """Braking alone, without half-planes, keeps d for four agents among discs with hostile desired velocities up to 8 m/s."""
    rng = np.random.default_rng(seed)
    at = np.array([(-6.0, 0.0), (6.0, 0.0), (0.0, 6.0), (0.0, -6.0)]) + rng.uniform(-1, 1, (4, 2))
    discs = np.array([(0.0, 0.0, 2.0), *((*rng.uniform(9.3, 11) * u, 1.0) for u in np.eye(2))])
    v = np.zeros((4, 2))
    aim = rng.uniform(-12, 12, (4, 2))
    for _ in range(150):
        if rng.random() < 0.1:
            aim = rng.uniform(-12, 12, (4, 2))
        for i in range(4):
            before = v[i].copy()
            v[i] = 4.0 * (aim[i] - at[i])
            v[i] *= min(1.0, BRAKING.speed / np.linalg.norm(v[i]))
            restrain(i, before, BRAKING, at, discs, v)
            assert np.linalg.norm(v[i] - before) <= BRAKING.braking * BRAKING.duration * (1 + 1e-9)
        at = at + BRAKING.duration * v
        assert (np.linalg.norm(at[:, None] - discs[:, :2], axis=-1) - discs[:, 2]).min() >= 1.1 - 1e-9
        assert min(np.linalg.norm(at[i] - at[j]) for i in range(4) for j in range(i)) >= 1.6 - 1e-9


@given(st.floats(1e-6, 20.0), st.floats(0.5, 10.0), st.floats(0.02, 0.2))
def test_stopping_paths_are_nested(speed, braking, duration):
    """L(s) >= s T + L(s - A T): after a mission step of braking, the rest was foreseen; and L is the way that braking takes."""
    barrier = BRAKING._replace(braking=braking, duration=duration)
    left, made = speed, 0.0
    way = speed * path_time(speed, 0.0, barrier)
    while left > 0.0:
        made += left * duration
        assert way >= made + brake(left, 0.0, barrier)[0] * path_time(*brake(left, 0.0, barrier), barrier) - 1e-9 * (1 + way)
        left = brake(left, 0.0, barrier)[0]
    assert made <= way + 1e-9
    assert way <= made + braking * duration**2 / 8 + 1e-9


@given(seeds)
def test_the_braking_form_is_enough(seed):
    """|v| max(0, -n . v) <= 2 A (d - D) keeps the whole braking path at least D from a disc, for mission steps near zero."""
    rng = np.random.default_rng(seed)
    barrier = BRAKING._replace(duration=1e-9)
    p, radius, distance = rng.uniform(-10, 10, 2), rng.uniform(0, 3), 1.0
    v = rng.normal(size=2) * rng.uniform(0, 6)
    gap = np.linalg.norm(p) - radius - distance
    approach = max(0.0, -(p / np.linalg.norm(p)) @ v)
    if gap < 0 or np.linalg.norm(v) * approach > 2.0 * barrier.braking * gap:
        return
    way = v * path_time(*v, barrier)
    assert least_distance(*p, *way, 0.0, 0.0) >= radius + distance - 1e-6


@given(seeds)
def test_least_distance_of_two_ways_is_the_least_over_a_grid(seed):
    """It is never above the distance of any sampled pair of points, and close to the smallest of these."""
    rng = np.random.default_rng(seed)
    r, a, b = rng.normal(size=(3, 2)) * rng.choice([0.0, 1.0, 3.0], size=(3, 1))
    s = np.linspace(0, 1, 201)
    grid = np.linalg.norm(r + s[:, None, None] * a - s[None, :, None] * b, axis=-1).min()
    exact = least_distance(*r, *a, *b)
    assert exact <= grid + 1e-12
    assert exact >= grid - 0.01 * (np.linalg.norm(a) + np.linalg.norm(b))


def test_half_planes_of_one_disc():
    """2 m from a disc's center (radius 0.5, d_OA 1) the room is 0.4 m, so n . v >= -1.6, or -0.6 if it moves at (1, 2) m/s."""
    barrier = Barrier(BARRIER_RATE, BARRIER_MARGIN, BARRIER_REACH, BARRIER_SPEED, np.inf, 0.05, 1.0, 0.0)
    planes, p = np.zeros((2, 4)), np.array([2.0, 0.0])
    far = [10.0, 0.0, 0.5]
    assert bound_obstacles(p, np.array([[0.0, 0.0, 0.5], far]), 1.0, 3, barrier, planes, 0) == 1
    np.testing.assert_allclose(planes[0], (1.0, 0.0, -1.6, 3.0))
    assert bound_obstacles(p, np.array([[0.0, 0.0, 0.5, 1.0, 2.0]]), 1.0, 3, barrier, planes, 1) == 2
    np.testing.assert_allclose(planes[1], (1.0, 0.0, -0.6, 3.0))


# Orders ----------------------------------------------------------------------------------------------------------------------


def test_far_from_everything_the_reference_is_the_complete_behavior():
    """With nothing within reach, v_r is FM's or FR's, limited to 6 m/s, whichever behavior is above it."""
    scenario, null_space = paper(**SET_BASED), make_behaviors(paper())
    behaviors, at = make_behaviors(scenario), scenario.formations[0] + (-60.0, 0.1)
    for name, alone in (("FM", "FM"), ("OA>FM", "FM"), ("FR", "FR"), ("OA>FR", "FR")):
        v, expected = np.zeros((2, 4, 2))
        order, other = (np.full(4, scenario.orders.index(each)) for each in (name, alone))
        compose_team(60.0, order, behaviors, at, scenario.obstacle_array(), np.zeros(0), np.zeros((99, 2)), v)
        compose_team(60.0, other, null_space, at, scenario.obstacle_array(), np.zeros(0), np.zeros((9, 2)), expected)
        size = np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(v, expected * np.minimum(1.0, BARRIER_SPEED / size), rtol=1e-15)


def test_of_two_that_contradict_the_first_wins():
    """For an agent too close to a disc and to another agent, OA first moves it off the disc, AA first off the agent."""
    scenario = replace(
        crowd(np.random.default_rng(0)),
        starts=((0.0, 0.0), (1.0, 0.0), (20.0, 0.0), (30.0, 0.0), (40.0, 0.0)),
        obstacles=(Obstacle(-0.9, 0.0, 0.1),),
    )
    behaviors, obstacles = make_behaviors(scenario), scenario.obstacle_array()

    def towards(order: str) -> float:
        v, workspace = np.zeros((5, 2)), np.zeros((workspace_rows(scenario), 2))
        orders = np.full(5, scenario.orders.index(order))
        compose_team(0.0, orders, behaviors, np.array(scenario.starts), obstacles, np.zeros(0), workspace, v)
        return float(v[0, 0])

    assert towards("OA>AA>FM") == pytest.approx(BARRIER_RATE * (1.1 - 0.8), abs=1e-8)
    assert towards("AA>OA>FM") == pytest.approx(-0.5 * BARRIER_RATE * (1.6 - 1.0), abs=1e-8)
    assert towards("AA>FM") == towards("AA>OA>FM")
    assert towards("FM") == towards("OA>FM") == towards("OA>AA>FM")


def test_orders_of_one_command_give_one_motion():
    """A change that does not count as a switch changes no motion, even where all behaviors contradict each other."""
    rng = np.random.default_rng(3)
    scenario = crowd(rng)
    behaviors, orders = make_behaviors(scenario), scenario.orders
    at = rng.uniform(-2, 2, (5, 2))
    by_command: dict[int, set[bytes]] = {}
    for k in range(len(orders)):
        v = np.zeros((5, 2))
        workspace = np.zeros((workspace_rows(scenario), 2))
        compose_team(0.0, np.full(5, k), behaviors, at, scenario.obstacle_array(), np.zeros(0), workspace, v)
        by_command.setdefault(int(orders.command_of[k]), set()).add(v.tobytes())
    assert all(len(motions) == 1 for motions in by_command.values())


# Episodes --------------------------------------------------------------------------------------------------------------------


FM_ALONE = Scripted((Window(0.0, 0.0, -1, "FM"),))


@pytest.mark.parametrize("family", ["field", "forest", "traffic"])
def test_formation_maintenance_alone_flies_the_mission_without_a_violation(family):
    """On three held-out layouts per family, by measured positions, every agent ends in its slot without a violation."""
    scenario = make_scenario(family, split="test", **SET_BASED)
    world = World(scenario, record=True)
    for seed in range(3):
        assert outcome(measure(run_episode(world, FM_ALONE, seed=seed)), scenario).success


def test_all_views_of_a_world_compose_alike():
    """Compiled loop, Python path and dm_control are identical over an episode with switches among moving obstacles."""
    scenario = make_scenario("traffic", duration=20.0, layout=None, **SET_BASED)
    compiled, python = (World(scenario, native=native) for native in (True, False))
    environment = tasks.load("formation", "traffic", random_state=0, duration=20.0, layout=None, **SET_BASED)
    orders = random_orders(scenario, np.random.default_rng(1), scenario.mission_steps)
    compiled.reset(0), python.reset(0), environment.reset()
    for row in orders:
        one, other, timestep = compiled.step(row[None]), python.step(row[None]), environment.step(row)
        assert one.observation.reference.tobytes() == other.observation.reference.tobytes()
        qpos = environment.physics.data.qpos[compiled.plan.plant.qpos_index]
        np.testing.assert_array_equal(qpos, one.observation.position[0])
        np.testing.assert_array_equal(other.observation.position, one.observation.position)
        assert timestep.reward == one.reward[0] == other.reward[0]


def test_worlds_of_a_batch_are_those_alone():
    """Three draws together and each alone are identical; an acceleration limit gives references a memory."""
    scenario = make_scenario("field", duration=10.0, speed_limit=3.0, acceleration_limit=3.0, **SET_BASED)
    together = World(scenario, worlds=3)
    together.reset(5)
    alone = [World(scenario) for _ in range(3)]
    for b, world in enumerate(alone):
        world.copy_world(together, b, 0)
    orders = random_orders(scenario, np.random.default_rng(2), scenario.mission_steps)
    for row in orders:
        all_of_them = together.step(np.tile(row, (3, 1))).observation.position
        for b, world in enumerate(alone):
            np.testing.assert_array_equal(world.step(row[None]).observation.position[0], all_of_them[b])


def test_predictions_compose_as_the_mission_does():
    """MPCMS flies a set-based scenario without a violation."""
    scenario = make_scenario("field", split="test", duration=15.0, **SET_BASED)
    trajectory = run_episode(World(scenario, record=True), make_supervisor("mpcms"), seed=1)
    assert not outcome(measure(trajectory), scenario).violated


# Configuration ---------------------------------------------------------------------------------------------------------------


def test_the_composition_is_a_setting_of_every_kind_of_scenario(tmp_path):
    """It can be set in Python and in a file, for families and single missions; values that do not fit are refused."""
    assert all(make_scenario(name).composition == "null-space" for name in ("paper", "cruise", "field", "robot_gate"))
    assert all(make_scenario(name, **SET_BASED).composition == "set-based" for name in ("paper", "forest", "robot_gate"))
    file = tmp_path / "mine.toml"
    file.write_text('family = "traffic"\ncomposition = "set-based"\n')
    assert load_scenario(file).composition == "set-based"
    with pytest.raises(ConfigurationError, match="composition 'sets'.*null-space, set-based"):
        paper(composition="sets")
    with pytest.raises(ConfigurationError, match="two-sided OA is an equality task"):
        paper(two_sided=True, **SET_BASED)


def test_barriers_have_the_robots_scale():
    """A robot's unit scales lengths, its limits bound speed and rate; the workspace fits half-planes of obstacles and team."""
    barrier = make_barrier(make_scenario("field"))
    assert barrier[:5] == (BARRIER_RATE, BARRIER_MARGIN, BARRIER_REACH, BARRIER_SPEED, np.inf)
    assert (barrier.obstacle_distance, barrier.agent_distance) == (1.0, 1.5)
    slow = make_barrier(make_scenario("field", **LIMITS))
    assert (slow.speed, slow.rate, slow.braking) == (1.5, 1.0, 1.5)
    small = make_barrier(make_scenario("robot_gate", robot="crazyflie", **SET_BASED))
    assert small.margin < BARRIER_MARGIN
    assert workspace_rows(make_scenario("field")) == WORKSPACE
    assert workspace_rows(make_scenario("field", **SET_BASED)) == WORKSPACE + PLANE_ROWS * (12 + 4)


def test_logs_and_provenance_name_the_composition(tmp_path):
    """A log's metadata and the provenance of a configuration name it."""
    scenario = make_scenario("field", duration=0.1, **SET_BASED)
    path = tmp_path / "run.mcap"
    config = {"scenario": scenario}
    with LogWriter(path, scenario, SORLC(), names=("scripted", "sorlc"), seed=0, config=config) as log:
        run_episode(World(scenario, record=True), FM_ALONE, on_frame=log.write)
    assert log_info(path)["metadata"][METADATA]["composition"] == "set-based"
    assert plain_data(config)["scenario"]["composition"] == "set-based"
