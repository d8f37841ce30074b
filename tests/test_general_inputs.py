"""What an agent of the general policy senses, sends and pools: no scale, lanes, ways, messages, the end of the mission."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_general import field, random_policy

from marlbc_mj import World
from marlbc_mj.controllers import make_controller
from marlbc_mj.policies import general_inputs as inputs
from marlbc_mj.scenarios import make_scenario


def sight_of(length: float, time: float, speed=(1.0, 0.3)) -> inputs.Sight:
    """Slots, path and bins in units of ``length`` and ``time``."""
    slots = length * np.random.default_rng(1).normal(scale=4.0, size=(2, 3, 2))
    path = np.array([(0.0, 1.0), np.array(speed) / time]) * length
    edges, delays = time * np.array(inputs.EDGES), time * np.array(inputs.WAY_DELAYS)
    return inputs.Sight(slots, path, edges, delays, 4.0 * length / time, length, time, 20.0 * time, np.array([False, True]))


def sensed(sight: inputs.Sight, length: float, time: float, moving: bool) -> np.ndarray:
    rng = np.random.default_rng(2)
    obstacles = length * rng.uniform(-12.0, 12.0, size=(2, 6, 5))
    obstacles[..., 2] = length * rng.uniform(0.0, 1.5, size=(2, 6))
    obstacles[..., 3:] /= 8.0 * time
    features = np.empty((2, 3, inputs.FEATURES), dtype=np.float32)
    position, clearance = length * rng.normal(scale=5.0, size=(2, 3, 2)), length * rng.uniform(0.0, 5.0, size=(2, 3))
    age = time * rng.uniform(0.0, 30.0, size=(2, 3))
    shown = np.ascontiguousarray(obstacles if moving else obstacles[..., :3])
    now = time * np.array([3.0, 7.0])
    inputs._fill_features(sight, rng.random((2, 3)) < 0.5, now, position, clearance, age, shown, features)
    return features


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("length", "time"), [(2.0, 1.0), (1.0, 3.0), (0.2, 0.5)])
def test_features_have_no_scale(length: float, time: float, moving: bool) -> None:
    """A mission of other lengths and times, all in proportion, looks the same."""
    unit = sensed(sight_of(1.0, 1.0), 1.0, 1.0, moving)
    np.testing.assert_allclose(sensed(sight_of(length, time), length, time, moving), unit, atol=2e-6)
    assert np.ptp(unit[..., : inputs.WAYS]) > 1.0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_a_lane_is_the_least_clearance_in_every_bin(seed: int) -> None:
    """Against a thousand samples per bin, obstacles near and far."""
    rng, sight = np.random.default_rng(seed), sight_of(1.5, 0.7)
    reach = rng.choice((15.0, 50.0))
    obstacles = np.concatenate(
        [rng.uniform(-reach, reach, (9, 2)), rng.uniform(0.0, 2.0, (9, 1)), rng.normal(size=(9, 2))], axis=1
    )
    slot, lane = rng.normal(scale=3.0, size=2), np.empty(inputs.LANE_BINS)
    inputs.fill_lane(slot, sight, obstacles, lane)
    for k in range(inputs.LANE_BINS):
        t = np.linspace(sight.edges[k], sight.edges[k + 1], 1001)[:, None, None]
        gap = np.linalg.norm(slot + t * sight.path[1] - obstacles[:, :2] - t * obstacles[:, 3:], axis=-1) - obstacles[:, 2]
        wanted = np.clip(gap.min() / sight.length - 1.0, inputs.LEAST_BEYOND, inputs.MOST_BEYOND)
        assert wanted - 1e-3 <= lane[k] + 1e-12 <= wanted + 2e-12


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_a_way_is_the_least_clearance_of_an_agent_that_sets_out_later(seed: int) -> None:
    """Against a thousand samples per delay, obstacles near and far, at rest and moving."""
    rng, sight = np.random.default_rng(seed), sight_of(1.5, 0.7)
    at, slot, reach = rng.normal(scale=5.0, size=2), rng.normal(scale=5.0, size=2), rng.choice((10.0, 30.0))
    obstacles = np.concatenate(
        [rng.uniform(-reach, reach, (6, 2)), rng.uniform(0.0, 2.0, (6, 1)), rng.normal(size=(6, 2))], axis=1
    )
    for shown, velocity in ((obstacles, obstacles[:, 3:]), (np.ascontiguousarray(obstacles[:, :3]), np.zeros((6, 2)))):
        ways = way_clearances(at, slot, sight, shown)
        away = np.linalg.norm(slot - at) / sight.speed  # how long it takes [s]
        for delay, found in zip(sight.delays, ways, strict=True):
            share = np.linspace(0.0, 1.0, 1001)[:, None, None]
            time = delay + share * away
            on_it = at + share * (slot - at) + time * sight.path[1]
            gap = np.linalg.norm(on_it - obstacles[:, :2] - time * velocity, axis=-1) - obstacles[:, 2]
            wanted = np.clip(gap.min() / sight.length - 1.0, inputs.LEAST_BEYOND, inputs.MOST_BEYOND)
            assert wanted - 1e-3 <= found + 1e-12 <= wanted + 2e-12


def way_clearances(at: np.ndarray, slot: np.ndarray, sight: inputs.Sight, obstacles: np.ndarray) -> np.ndarray:
    ways = np.empty(len(inputs.WAY_DELAYS))
    inputs.fill_ways(at, slot, sight, obstacles, ways)
    return ways


def test_the_way_to_a_slot_sees_what_is_between() -> None:
    """A path along x: an obstacle on the way now is behind the way of an agent that sets out later."""
    sight, obstacles = sight_of(1.0, 1.0, speed=(1.0, 0.0)), np.array([[1.25, 5.0, 0.25]])
    at, slot = np.zeros(2), np.array([0.0, 10.0])  # 2.5 s at 4 m/s, so half-way at (1.25, 5)
    ways = way_clearances(at, slot, sight, obstacles)
    assert ways[0] == inputs.LEAST_BEYOND
    assert (np.diff(ways) > 0.0).all()
    assert way_clearances(at, at, sight, obstacles).tolist() == [inputs.MOST_BEYOND] * len(ways)
    assert way_clearances(at, slot, sight, obstacles[:0]).tolist() == [inputs.MOST_BEYOND] * len(ways)


def test_references_take_the_way() -> None:
    """Without obstacles, a wedge that changes to the column or back stays close to the ways and arrives when they say so."""
    scenario = make_scenario("open", agents=4, formation="wedge", composition="set-based")
    sight, world = inputs.make_sight(scenario), World(scenario, make_controller("pd"))
    order = [scenario.orders.index(name) for name in scenario.formation_names]
    for which in (0, 1, 0):
        now, start = world.state.steps[0] * scenario.mission_step, world.state.reference[0].copy()
        slots = sight.path[0] + now * sight.path[1] + sight.slots[which]
        arrival = np.linalg.norm(slots - start, axis=1) / sight.speed
        way = slots + arrival[:, None] * sight.path[1] - start
        for k in range(60):
            world.step(np.full((1, 4), order[which]))
            flown, time = world.state.reference[0] - start, (k + 1) * scenario.mission_step
            share = np.clip(time / np.maximum(arrival, 1e-9), 0.0, 1.0)
            aside = np.abs(way[:, 0] * flown[:, 1] - way[:, 1] * flown[:, 0]) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
            assert (aside[share < 1.0] < 0.3 * sight.length).all()
            away = np.linalg.norm(start + flown - slots - (k + 1) * scenario.mission_step * sight.path[1], axis=1)
            assert (away[time > arrival + sight.time] <= scenario.formation_tolerance).all()


def test_all_hearing_all_is_the_limit_of_hearing_each() -> None:
    features = np.random.default_rng(0).normal(size=(3, 5, inputs.FEATURES)).astype(np.float32)
    one = inputs.join_inputs(features, features[:, None, :, : inputs.SENT], np.zeros((3, 1, 5)))
    each = inputs.join_inputs(features, np.repeat(features[:, None, :, : inputs.SENT], 5, axis=1), np.zeros((3, 5, 5)))
    np.testing.assert_array_equal(one, each)


def test_pooling_does_not_ask_who_spoke() -> None:
    rng = np.random.default_rng(0)
    heard, age = rng.normal(size=(2, 1, 6, inputs.SENT)).astype(np.float32), rng.uniform(0.0, 9.0, (2, 1, 6))
    order = rng.permutation(6)
    other = (np.ascontiguousarray(each[:, :, order]) for each in (heard, age))
    np.testing.assert_allclose(inputs.pool_heard(*other), inputs.pool_heard(heard, age), rtol=1e-6, atol=1e-6)


def test_what_was_never_heard_counts_for_nothing() -> None:
    """And says so: the share of agents heard is an input."""
    rng = np.random.default_rng(0)
    heard, age = rng.normal(size=(1, 1, 4, inputs.SENT)).astype(np.float32), np.array([[[0.0, 2.0, np.inf, np.inf]]])
    other = heard.copy()
    other[..., 2:, :] = 1e6
    pooled = inputs.pool_heard(heard, age)
    np.testing.assert_array_equal(pooled, inputs.pool_heard(other, age))
    assert pooled[0, 0, -2] == 0.5
    assert pooled[0, 0, 0] == np.minimum(*heard[0, 0, :2, 0])


def test_the_column_and_its_age_are_inputs() -> None:
    scenario = field(duration=2.0)
    world, column = World(scenario), np.full((1, 4), scenario.orders.index("FR"))
    for _ in range(20):
        observation = world.step(column).observation
    features = inputs.sense_features(observation, inputs.make_sight(scenario))[0]
    assert (features[:, inputs.COLUMN_ENTRY] == 1.0).all()
    after = world.step(np.full((1, 4), scenario.orders.index("FM"))).observation
    features = inputs.sense_features(after, inputs.make_sight(scenario))[0]
    assert (features[:, inputs.COLUMN_ENTRY] == 0.0).all()
    assert (features[:, inputs.AGE_ENTRIES] < 0.1).all()


def test_the_end_of_the_mission_is_known_and_not_sent() -> None:
    """1 at the end, 1/e the coarser scale before it, nothing long before."""
    scenario = field()
    sight, world = inputs.make_sight(scenario), World(scenario)
    observation = world.observe()
    for left, wanted in ((0.0, (1.0, 1.0)), (inputs.COARSEST, (np.exp(-inputs.COARSEST / inputs.COARSE), np.exp(-1.0)))):
        now = observation._replace(time=np.array([scenario.duration - left * sight.time]))
        features = inputs.sense_features(now, sight)
        np.testing.assert_allclose(features[0, :, inputs.ENDING :], np.tile(wanted, (4, 1)), rtol=1e-5)
    assert inputs.sense_features(observation, sight)[..., inputs.ENDING :].max() < 2e-3
    assert random_policy().messages(features).shape == (1, 4, inputs.SENT)
