"""Sensor noise, delay, actuator loss and limits of references: their effects, and agreement of all paths."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.controllers import PD
from marlbc_mj.core.imperfections import Imperfections, normal
from marlbc_mj.engine.composition import keep, limit
from marlbc_mj.engine.plan import make_behaviors
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import Perturbation, paper
from marlbc_mj.studies.batches import evaluate_batch
from marlbc_mj.supervisors import Scripted, make_supervisor
from marlbc_mj.tasks.formation import make_environment
from marlbc_mj.util.errors import ConfigurationError

NOISY = Imperfections(position_noise=0.02, velocity_noise=0.05, delay=0.02, loss=0.3, loss_agent=1, loss_start=0.5)


def orders_of(scenario, worlds=1):
    return np.full((worlds, 4), scenario.orders.index("FM"))


def test_noise_is_standard_normal_and_independent():
    """Checked by mean, spread and kurtosis of 40 000 numbers, and by correlations between neighbours and streams."""
    draws = np.array([[normal(7 + s, k, s) for k in range(20_000)] for s in range(2)])
    assert abs(draws.mean()) < 0.02 and draws.std() == pytest.approx(1.0, abs=0.02)
    assert (draws**4).mean() == pytest.approx(3.0, abs=0.15)
    assert abs(np.corrcoef(draws)[0, 1]) < 0.03
    assert abs(np.corrcoef(draws[0, :-1], draws[0, 1:])[0, 1]) < 0.03
    assert normal(3, 5, 1) == normal(3, 5, 1) != normal(3, 5, 2)


def test_a_delay_shows_what_was_and_nothing_else():
    """The measured p, v at the end of a mission step are the true ones 4 substeps earlier, to the last bit."""
    scenario = paper(imperfections=Imperfections(delay=0.02))
    world = World(scenario, PD(), record=True)
    start = world.observe()
    assert (start.position[0] == np.array(scenario.starts)).all()
    for _ in range(5):
        step = world.step(orders_of(scenario))
        np.testing.assert_array_equal(step.observation.position[0], step.record.position[0, 10 - 4])
        np.testing.assert_array_equal(step.observation.velocity[0], step.record.velocity[0, 10 - 4])
        assert (world.state.position != step.observation.position).any()


def test_noise_has_the_stated_size_and_another_seed_is_other_noise():
    """Differences of measured and true values over 200 mission steps have the stated standard deviation."""
    scenario = paper(imperfections=Imperfections(position_noise=0.02, velocity_noise=0.05))
    world = World(scenario, PD())
    errors = []
    for _ in range(200):
        step = world.step(orders_of(scenario))
        errors.append([step.observation.position - world.state.position, step.observation.velocity - world.state.velocity])
    spread = np.std(errors, axis=(0, 2, 3, 4))
    np.testing.assert_allclose(spread, [0.02, 0.05], rtol=0.08)
    first = world.reset(1).position
    assert (first != world.reset(2).position).all()


def test_where_robots_end_is_not_what_they_measure(tmp_path):
    """Trajectories, logs, metrics and batches end at the true position, whatever the sensors measure."""
    scenario = paper(duration=1.0, imperfections=Imperfections(position_noise=0.5, velocity_noise=0.1))
    world = World(scenario, PD(), record=True)
    with LogWriter(tmp_path / "log.mcap", scenario, PD(), names=("fixed", "pd"), seed=1, config={}) as log:
        flown = run_episode(world, make_supervisor("fixed"), seed=1, on_frame=log.write)
    np.testing.assert_array_equal(flown.position[-1], world.state.position[0])
    np.testing.assert_array_equal(flown.velocity[-1], world.state.velocity[0])
    assert np.abs(world.observe().position[0] - flown.position[-1]).max() > 0.1
    metrics = measure(flown)
    assert measure(read_log(tmp_path / "log.mcap"))["team"] == metrics["team"]
    batch = evaluate_batch(scenario, (0, 1), "fixed", "pd")[1].metrics
    assert batch is not None and batch["team"]["end_error"] == metrics["team"]["end_error"]


def test_a_lost_actuator_gives_its_share_from_its_time_on():
    """At 0.5 s the recorded force of agent 2 drops to 0.7 of the law's; the forces of the other agents do not change."""
    scenario = paper(duration=1.0, imperfections=Imperfections(loss=0.3, loss_agent=1, loss_start=0.5))
    trajectory = run_episode(World(scenario, PD(), record=True), Scripted())
    early, late = trajectory.time < 0.5 - 1e-9, trajectory.time >= 0.5 - 1e-9
    assert np.abs(trajectory.force[early, 1]).max() == 200.0
    plain = run_episode(World(paper(duration=1.0), PD(), record=True), Scripted())
    np.testing.assert_array_equal(trajectory.force[early], plain.force[early])
    first = int(np.flatnonzero(late)[0])
    np.testing.assert_allclose(trajectory.force[first, 1], 0.7 * plain.force[first, 1], rtol=1e-12)
    np.testing.assert_array_equal(trajectory.force[:, [0, 2, 3]], plain.force[:, [0, 2, 3]])


def test_imperfections_are_the_same_on_every_path_and_in_any_batch():
    """Compiled loop and Python path, threads and batches agree to the last bit; dm_control agrees within 1e-9."""
    scenario = paper(duration=2.0, imperfections=NOISY, perturbation=Perturbation(start_spread=0.2))
    compiled, python = (run_episode(World(scenario, record=True, native=n), Scripted(), seed=2) for n in (None, False))
    assert compiled.position.tobytes() == python.position.tobytes()
    runs = []
    for worlds, threads in ((3, 1), (3, 2), (4, 1)):
        world = World(scenario, worlds=worlds, threads=threads)
        for _ in range(20):
            world.step(orders_of(scenario, worlds))
        runs.append(world.observe().position[2].tobytes() + world.state.position[2].tobytes())
    assert len(set(runs)) == 1
    environment = make_environment(scenario, random_state=0)
    environment.reset()
    world = World(scenario)
    world.reset(int(np.random.RandomState(0).randint(2**31)))
    for _ in range(scenario.mission_steps):
        environment.step(orders_of(scenario)[0])
        world.step(orders_of(scenario))
    np.testing.assert_allclose(environment.task.state.position, world.state.position, rtol=0, atol=1e-9)


def test_a_snapshot_takes_noise_and_delay_along():
    """A restored world continues with the same random numbers."""
    scenario = paper(imperfections=NOISY)
    world = World(scenario)
    for _ in range(5):
        world.step(orders_of(scenario))
    kept = world.snapshot()
    first = [world.step(orders_of(scenario)).observation.position for _ in range(5)]
    world.restore(kept)
    again = [world.step(orders_of(scenario)).observation.position for _ in range(5)]
    assert np.array(first).tobytes() == np.array(again).tobytes()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"position_noise": -1.0}, "position_noise must be non-negative and finite, got -1.0"),
        ({"delay": np.inf}, "delay must be non-negative"),
        ({"loss": 1.5}, "loss must be from 0 to 1, got 1.5"),
    ],
)
def test_impossible_imperfections_are_named(fields, message):
    """The message names the field, the value and the valid range."""
    with pytest.raises(ConfigurationError, match=message):
        Imperfections(**fields)


def test_imperfections_must_fit_the_scenario():
    """Refused: a delay that is not a whole number of substeps, an agent that does not exist, a speed limit of 0."""
    with pytest.raises(ConfigurationError, match="delay 0.007 s must be a whole multiple of the substep 0.005 s"):
        paper(imperfections=Imperfections(delay=0.007))
    with pytest.raises(ConfigurationError, match=r"loss_agent must be -1 \(all\) or 0 to 3, got 4"):
        paper(imperfections=Imperfections(loss=0.1, loss_agent=4))
    with pytest.raises(ConfigurationError, match="speed_limit must be positive, got 0"):
        paper(speed_limit=0.0)


vectors = st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=3, max_size=3)


@given(vectors, vectors, st.floats(0.1, 100), st.floats(0.1, 100))
def test_limited_references_keep_speed_and_acceleration(before, wanted, speed, acceleration):
    """|v_r| and |dv_r| / dt are within the limits for any previous v_r; a v_r that is within them already is unchanged."""
    limits = make_behaviors(paper(speed_limit=speed, acceleration_limit=acceleration))
    old, new, kept = np.array(before), np.array(wanted), np.zeros((3, 2))
    old *= np.minimum(1.0, speed / np.maximum(np.linalg.norm(old, axis=1), 1e-12))[:, None]
    keep(limits, old, kept)
    result = new.copy()
    limit(limits, 0.05, kept, result)
    assert (np.linalg.norm(result, axis=1) <= speed * (1 + 1e-9) + 1e-12).all()
    assert (np.linalg.norm(result - old, axis=1) <= 0.05 * acceleration * (1 + 1e-9) + 1e-12).all()
    inside = (np.linalg.norm(new, axis=1) <= speed) & (np.linalg.norm(new - old, axis=1) <= 0.05 * acceleration)
    np.testing.assert_array_equal(result[inside], new[inside])
    untouched = new.copy()
    limit(make_behaviors(paper()), 0.05, kept, untouched)
    np.testing.assert_array_equal(untouched, new)
