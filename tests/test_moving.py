"""Moving obstacles: one law of motion, evaluated at the right time by behaviors, supervisors, metrics, logs and pictures."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.controllers import SORLC
from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import ObstacleAvoidance, clearances
from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.core.motion import MOVING, drift, move, moved, obstacles_at
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.log import from_trajectory
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import Motion, Obstacle, make_scenario
from marlbc_mj.scenarios.layout import motion_array, motions_of
from marlbc_mj.supervisors import MPCMS, make_supervisor
from marlbc_mj.tasks.formation import make_environment
from marlbc_mj.util.errors import ConfigurationError

NUMBER = st.floats(-5, 5)
MOTION = st.builds(Motion, NUMBER, NUMBER, NUMBER, NUMBER, st.floats(0.5, 50), st.floats(-7, 7))


def traffic(**changes):
    return make_scenario("traffic", **{"duration": 10.0, **changes})


@given(MOTION, st.floats(0, 100), NUMBER, NUMBER)
def test_motion_matches_its_closed_form(motion, t, x, y):
    """o(t) = anchor + v t + a sin(2 pi t / period + phase)."""
    anchors, rows = np.array([[x, y, 1.5]]), motion_array((motion,))
    place = np.empty((1, MOVING))
    move(t, anchors, rows, place)
    angle = 2 * np.pi * t / motion.period + motion.phase
    expected = [x + motion.vx * t + motion.ax * np.sin(angle), y + motion.vy * t + motion.ay * np.sin(angle)]
    np.testing.assert_allclose(place[0, :3], [*expected, 1.5], atol=1e-9)
    h = 1e-5
    before, after = moved(np.array([t - h, t + h]), anchors, rows)
    np.testing.assert_allclose(place[0, 3:], (after - before)[0, :2] / (2 * h), atol=1e-3)
    np.testing.assert_allclose(motion_array(motions_of(rows)), rows, rtol=1e-12)


@given(MOTION, st.floats(0, 2))
def test_a_prediction_is_exact_for_straight_motion(motion, t):
    straight = motion._replace(ax=0.0, ay=0.0)
    anchors, rows, predicted = np.array([[1.0, 2.0, 0.5]]), motion_array((straight,)), np.empty((1, MOVING))
    now, then = moved(np.array([3.0, 3.0 + t]), anchors, rows)
    drift(t, now, predicted)
    np.testing.assert_allclose(predicted, then, atol=1e-9)


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 1.9))
def test_avoidance_keeps_its_rate_relative_to_an_obstacle_that_moves(vx, vy, x, y, error):
    """d' = n^T (v - o') = Lambda (d_OA - d) whatever the obstacle's velocity."""
    normal = np.array([x, y]) / max(np.hypot(x, y), 1e-9) if np.hypot(x, y) > 1e-3 else np.array([1.0, 0.0])
    p, velocity, jacobian = (2.0 - error + 1.0) * normal, np.empty(2), np.empty((2, 2))
    disc = np.array([[0.0, 0.0, 1.0, vx, vy]])
    behavior = ObstacleAvoidance()
    law, gains = behavior.law, laws.as_gains(behavior.law, behavior.params(0))
    assert law(gains, p, np.zeros((2, 2)), disc, np.zeros((2, 2)), 0, velocity, jacobian) == 1
    assert jacobian[0] @ (velocity - [vx, vy]) == pytest.approx(20.0 * error, abs=1e-6)


def test_the_compiled_loop_the_python_path_and_dm_control_are_one():
    """All three agree over 24 s with crossing and swinging obstacles and random orders."""
    scenario = make_scenario("traffic", duration=24.0)
    orders = np.random.default_rng(5).integers(0, len(scenario.orders), (scenario.mission_steps, scenario.agents))
    compiled, python = World(scenario), World(scenario, native=False)
    environment = make_environment(scenario, SORLC(), random_state=0)
    seed = int(np.random.RandomState(0).randint(2**31))
    compiled.reset(seed), python.reset(seed)
    environment.reset()
    for row in orders:
        step = environment.step(row)
        ours, theirs = compiled.step(row[None]), python.step(row[None])
        np.testing.assert_array_equal(ours.observation.position, theirs.observation.position)
        np.testing.assert_array_equal(compiled.state.obstacles, python.state.obstacles)
        np.testing.assert_allclose(step.observation["position"], ours.observation.position[0], atol=1e-9)
        np.testing.assert_allclose(step.observation["clearance"], ours.observation.clearance[0], atol=1e-9)
        assert step.reward == ours.reward[0] == theirs.reward[0]


def test_a_world_shows_obstacles_where_they_are():
    """Obstacles are right after reset, after every mission step, after ``place`` into the middle of a mission, and in a copy."""
    scenario = traffic()
    world, other = World(scenario, worlds=2), World(scenario)
    world.reset(3)
    order = np.zeros((2, scenario.agents), dtype=np.int64)
    for k in range(4):
        for b in range(2):
            place = obstacles_at(k * scenario.mission_step, world.state.anchors[b], world.state.motions[b])
            np.testing.assert_allclose(world.state.obstacles[b, :, :3], place, atol=1e-12)
            np.testing.assert_allclose(world.state.clearance[b], clearances(world.state.position[b], place), atol=1e-12)
        world.step(order)
    assert not np.array_equal(world.state.anchors[0], world.state.anchors[1])
    world.place(1, 100, np.zeros((4, 2)) + np.arange(4)[:, None], np.zeros((4, 2)), order[0])
    place = obstacles_at(100 * scenario.mission_step, world.state.anchors[1], world.state.motions[1])
    np.testing.assert_allclose(world.state.obstacles[1, :, :3], place, atol=1e-12)
    other.copy_world(world, 1, 0)
    world.step(order), other.step(order[:1])
    np.testing.assert_array_equal(world.state.obstacles[1], other.state.obstacles[0])
    np.testing.assert_array_equal(world.state.position[1], other.state.position[0])


def test_motions_that_stand_still_change_nothing():
    """With motions of zero, the mission is identical to the one with obstacles at rest."""
    still = replace(make_scenario("field", duration=5.0), layout=None)
    zero = replace(still, motions=(Motion(),) * len(still.obstacles))
    rest, moving = World(still), World(zero)
    orders = np.random.default_rng(0).integers(0, len(still.orders), (still.mission_steps, 1, still.agents))
    np.testing.assert_array_equal(rest.rollout(orders), moving.rollout(orders))
    np.testing.assert_array_equal(rest.state.position, moving.state.position)


@pytest.fixture(scope="module")
def episode():
    scenario = traffic(duration=12.0)
    return run_episode(World(scenario, record=True), make_supervisor("fsams"), seed=2, names=("fsams", "sorlc"))


def test_metrics_measure_from_where_obstacles_are_at_every_substep(episode):
    """Clearances are measured after each substep, to where the obstacles are at that time."""
    scenario = episode.scenario
    for k in (0, 7, 1203, len(episode.time) - 1):
        place = obstacles_at((k + 1) * scenario.substep, episode.obstacles, episode.motions)
        np.testing.assert_allclose(episode.clearances()[k], clearances(episode.position[k + 1], place), atol=1e-12)
    least = min(agent["clearance_min"] for agent in measure(episode)["agents"])
    assert least == pytest.approx(episode.clearances().min())
    assert not np.allclose(episode.clearances(), clearances(episode.position[1:], episode.obstacles))


def test_logs_and_pictures_show_obstacles_at_the_right_time(episode, tmp_path):
    """A log read back has the same motions, and the drawn discs are where the obstacles are at each time."""
    scenario, law = replace(episode.scenario, duration=8.0), SORLC()
    path = tmp_path / "traffic.mcap"
    with LogWriter(path, scenario, law, names=("fsams", "sorlc"), seed=2, config={}) as log:
        flown = run_episode(World(scenario, law, record=True), make_supervisor("fsams"), seed=2, on_frame=log.write)
    written, derived = read_log(path), from_trajectory(flown, law)
    for name in ("obstacles", "motions", "position", "clearance", "formation"):
        np.testing.assert_allclose(getattr(written, name), getattr(derived, name), atol=1e-12)
    stage = make_stage(written)
    for time in (0.0, 5.05):
        stage.pose(time)
        place = written.obstacles_at(time)
        np.testing.assert_allclose(stage.data.geom_xpos[stage.discs, :2], place[:, :2], atol=1e-9)
        assert stage.model.geom_size[stage.discs[0], 0] == pytest.approx(place[0, 2])


@pytest.mark.parametrize("prediction", ["kinematic", "mujoco"])
def test_predictions_see_obstacles_come(prediction):
    """A disc that is far away now but will hit the team makes holding the formation expensive; one at rest does not."""
    comes, stays = (
        make_scenario("open", obstacles=((9.0, -6.36, 0.5),), motions=(Motion(vx=speed),), duration=2.0) for speed in (-4.0, 0.0)
    )
    for scenario, avoids in ((comes, True), (stays, False)):
        supervisor, world = MPCMS(prediction=prediction), World(scenario)
        seen, memory = world.observe(), supervisor.start(scenario, 1)
        costs, _ = supervisor._predict(seen, memory, supervisor._pairs(memory)[1])
        assert (costs[0] > 1e3) == avoids
        assert seen.clearance.min() > 3.0


@pytest.mark.parametrize(
    ("motions", "fragment"),
    [
        ((Motion(1.0),), "1 motions for 2 obstacles"),
        ((Motion(1.0), Motion(np.nan)), "motion 1 must be finite"),
        ((Motion(), Motion(period=0.0)), "positive period"),
    ],
)
def test_motions_that_cannot_be_are_refused(motions, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        make_scenario("paper", obstacles=(Obstacle(20, 5), Obstacle(40, 5)), motions=motions)


def test_an_obstacle_that_begins_on_a_start_is_refused():
    """The obstacle's position at t = 0 counts, not the anchor of its motion."""
    swing = Motion(ax=30.0, phase=np.pi / 2)
    with pytest.raises(ConfigurationError, match="covers the start of agent 1"):
        make_scenario("paper", obstacles=(Obstacle(-32, 8, 1),), motions=(swing,))
    make_scenario("paper", obstacles=(Obstacle(-2, 8, 1),), motions=(swing,), disturbance=LinearDrag())


def test_oracle_refuses_moving_obstacles():
    """The oracle's search refuses moving obstacles."""
    from marlbc_mj.supervisors.oracle import search

    with pytest.raises(ConfigurationError, match="known obstacles at rest; scenario 'traffic'"):
        search(traffic())
