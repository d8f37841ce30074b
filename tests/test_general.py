"""The general policy: inputs without scale, pooling that takes what it gets, and one network for all teams."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marlbc_mj import World, make_scenario, paper
from marlbc_mj.core.communication import Communication
from marlbc_mj.policies import general_inputs as inputs
from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.policies.general import (
    GeneralPolicy,
    Sensed,
    make_general,
    mean_policy,
    must_return,
    orders_for,
    read_general,
    write_general,
)
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.supervisors import General, make_supervisor
from marlbc_mj.training.general.judging import Judge
from marlbc_mj.util.errors import ConfigurationError


def random_policy(seed: int = 0, margin: float = 0.0, actions: int = 2, **flown) -> GeneralPolicy:
    rng = np.random.default_rng(seed)
    sizes = [(inputs.INPUTS, 16), (16, 1 + actions)]
    weights = tuple(rng.normal(size=(1, *size)).astype(np.float32) for size in sizes)
    return make_general(weights, tuple(np.zeros((1, 1, b), dtype=np.float32) for _, b in sizes), margin)._replace(**flown)


def with_middle_layer(policy: GeneralPolicy, seed: int) -> GeneralPolicy:
    """The policy with another layer between its two."""
    weight = np.random.default_rng(seed).normal(size=(1, 16, 16)).astype(np.float32)
    weights, biases = policy.network.weights, policy.network.biases
    return make_general((weights[0], weight, weights[1]), (biases[0], biases[0], biases[1]), 0.0)


def field(**changes):
    return make_scenario("field", composition="set-based", **changes)


def sight_of(length: float, time: float, speed=(1.0, 0.3)) -> inputs.Sight:
    """Slots, path and bins in units of ``length`` and ``time``."""
    slots = length * np.random.default_rng(1).normal(scale=4.0, size=(2, 3, 2))
    path = np.array([(0.0, 1.0), np.array(speed) / time]) * length
    return inputs.Sight(slots, path, time * np.array(inputs.EDGES), length, time, 20.0 * time, np.array([False, True]))


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
    """Against a thousand samples per bin."""
    rng, sight = np.random.default_rng(seed), sight_of(1.5, 0.7)
    obstacles = np.concatenate([rng.uniform(-15.0, 15.0, (5, 2)), rng.uniform(0.0, 2.0, (5, 1)), rng.normal(size=(5, 2))], axis=1)
    slot, lane = rng.normal(scale=3.0, size=2), np.empty(inputs.LANE_BINS)
    inputs.fill_lane(slot, sight, obstacles, lane)
    for k in range(inputs.LANE_BINS):
        t = np.linspace(sight.edges[k], sight.edges[k + 1], 1001)[:, None, None]
        gap = np.linalg.norm(slot + t * sight.path[1] - obstacles[:, :2] - t * obstacles[:, 3:], axis=-1) - obstacles[:, 2]
        wanted = np.clip(gap.min() / sight.length - 1.0, inputs.LEAST_BEYOND, inputs.MOST_BEYOND)
        assert wanted - 1e-3 <= lane[k] + 1e-12 <= wanted + 2e-12


def test_the_way_to_a_slot_sees_what_is_between() -> None:
    obstacles = np.array([[5.0, 0.5, 0.25]])
    at, slot = np.zeros(2), np.array([10.0, 0.0])
    assert inputs.way_clearance(at, slot, 1.0, obstacles) == pytest.approx(-0.75)
    assert inputs.way_clearance(at, at, 1.0, obstacles) == inputs.MOST_BEYOND
    assert inputs.way_clearance(at, slot, 1.0, obstacles[:0]) == inputs.MOST_BEYOND


def test_all_hearing_all_is_the_limit_of_hearing_each() -> None:
    features = np.random.default_rng(0).normal(size=(3, 5, inputs.FEATURES)).astype(np.float32)
    one = inputs.join_inputs(features, features[:, None, :, : inputs.SENT], np.zeros((3, 1, 5)))
    each = inputs.join_inputs(features, np.repeat(features[:, None, :, : inputs.SENT], 5, axis=1), np.zeros((3, 5, 5)))
    np.testing.assert_array_equal(one, each)


def test_pooling_does_not_ask_who_spoke() -> None:
    rng = np.random.default_rng(0)
    heard, age = rng.normal(size=(2, 1, 6, inputs.SENT)).astype(np.float32), rng.uniform(0.0, 9.0, (2, 1, 6))
    order = rng.permutation(6)
    np.testing.assert_allclose(
        inputs.pool_heard(heard[:, :, order], age[:, :, order]), inputs.pool_heard(heard, age), rtol=1e-6, atol=1e-6
    )


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


def test_who_hears_nothing_decides_by_itself() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(1, 3, inputs.FEATURES)).astype(np.float32)
    age = np.where(np.eye(3, dtype=bool), 0.0, np.inf)[None]
    policy, now = random_policy(), Sensed(features, np.zeros((1, 3), np.int64), np.array([True]))
    heard = np.repeat(features[:, None, :, : inputs.SENT], 3, axis=1)
    alone = policy.decide(now, heard, age)
    heard[:, 0, 1:], heard[:, 1, ::2], heard[:, 2, :2] = 7.0, -7.0, 3.0
    np.testing.assert_array_equal(policy.decide(now, heard, age), alone)


@pytest.mark.parametrize("dwell", [1, 2, 4])
def test_a_new_order_is_kept_for_the_dwell(dwell: int) -> None:
    """At least so many decisions; the first change of an episode may come at once, and without a dwell orders last a decision."""
    scenario = field(split="test", duration=20.0)
    lasted, first = [], []
    for seed in range(4):
        supervisor, world = General(random_policy(seed, dwell=dwell)), World(scenario, worlds=8)
        observation, memory = world.reset(5), supervisor.start(scenario, 8)
        taken = []
        for _ in range(scenario.mission_steps):
            orders, memory = supervisor.decide(observation, memory)
            observation = world.step(orders).observation
            taken.append(orders.reshape(-1))
        for line in np.array(taken).T:
            changes = np.flatnonzero(np.diff(line)) + 1
            lasted += np.diff(changes).tolist()
            first += changes[:1].tolist()
    assert min(lasted) == dwell * memory.interval
    assert min(first) == memory.interval


@given(st.floats(0.0, 30.0), st.floats(0.05, 60.0), st.floats(0.2, 3.0))
def test_an_agent_returns_when_its_way_takes_the_time_left(distance: float, left: float, deadline: float) -> None:
    """In the units of the features, whose entries saturate; farther than 36 d_OA counts as 36."""
    if abs(left / (deadline * distance + 1e-9) - 1.0) > 1e-2:
        e, t = np.float32(np.tanh(distance / inputs.COARSE)), np.float32(np.exp(-left / inputs.COARSEST))
        assert must_return(e, t, deadline) == (left < deadline * distance)
    assert not must_return(np.float32(1.0), np.float32(np.exp(-40.0 / inputs.COARSEST)), 1.0)
    assert must_return(np.float32(1.0), np.float32(np.exp(-30.0 / inputs.COARSEST)), 1.0)


@pytest.mark.parametrize("actions", [2, 4])
def test_the_deadline_brings_everybody_into_formation(actions: int) -> None:
    """In the last decision, whatever the networks say; avoidance stays as it is, and without a deadline nothing is forced."""
    rng = np.random.default_rng(0)
    features = rng.uniform(0.1, 0.9, size=(20, 4, inputs.FEATURES)).astype(np.float32)
    features[10:, :, inputs.ENDING + 1], features[:10, :, inputs.ENDING + 1] = 1.0, 1e-3
    now = Sensed(features, np.zeros((20, 4), np.int64), np.ones(20, dtype=bool))
    heard, age = features[:, None, :, : inputs.SENT], np.zeros((20, 1, 4))
    free, bound = (random_policy(1, actions=actions, deadline=d).decide(now, heard, age) for d in (0.0, 1.0))
    np.testing.assert_array_equal(bound[:10], free[:10])
    np.testing.assert_array_equal(bound[10:], free[10:] - free[10:] % 2)
    assert (free[10:] % 2 == 1).any()


@pytest.mark.parametrize(("formation", "agents"), [("line", 2), ("grid", 9), ("circle", 32)])
def test_one_policy_flies_teams_of_any_size(formation: str, agents: int) -> None:
    scenario = make_scenario("open", composition="set-based", formation=formation, agents=agents, duration=1.0)
    supervisor, world = General(random_policy()), World(scenario)
    memory = supervisor.start(scenario, 1)
    observation = world.reset()
    for _ in range(scenario.mission_steps):
        orders, memory = supervisor.decide(observation, memory)
        assert orders.shape == (1, agents)
        assert np.isin(orders, memory.orders).all()
        observation = world.step(orders).observation


def test_teams_do_not_depend_on_each_other() -> None:
    """Values and decisions of a team are the same, bit for bit, whatever other teams are asked about."""
    scenario = field(split="test")
    world = World(scenario, worlds=5)
    seen = world.reset(3)
    sight, policy = inputs.make_sight(scenario), random_policy()
    features = inputs.sense_features(seen, sight)
    whole = inputs.join_inputs(features, policy.messages(features)[:, None], np.zeros((5, 1, 4)))
    for b in range(5):
        part = features[b : b + 1]
        alone = inputs.join_inputs(part, policy.messages(part)[:, None], np.zeros((1, 1, 4)))
        np.testing.assert_array_equal(policy.values(alone[0]), policy.values(whole.reshape(-1, inputs.INPUTS))[4 * b : 4 * b + 4])


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


def test_a_policy_with_four_actions_decides_about_avoidance() -> None:
    """Under the null-space composition alone; its orders are those of its best actions, and close neighbors give way."""
    scenario, policy = make_scenario("field"), random_policy(actions=4)
    names = [scenario.orders.names[k] for k in orders_for(policy, scenario)]
    assert names == ["FM>OA>FR>AA", "FR>OA>FM>AA", "OA>FM>FR>AA", "OA>FR>FM>AA"]
    with pytest.raises(ConfigurationError, match="--composition null-space"):
        orders_for(policy, field())
    seen, chosen = World(scenario).reset(0), set()
    features = inputs.sense_features(seen, inputs.make_sight(scenario))
    known = inputs.join_inputs(features, features[:, None, :, : inputs.SENT], np.zeros((1, 1, 4)))[0]
    for seed in range(20):
        supervisor = General(random_policy(seed, actions=4))
        orders, memory = supervisor.decide(seen, supervisor.start(scenario, 1))
        np.testing.assert_array_equal(orders[0], memory.orders[supervisor.policy.values(known).argmax(axis=1)])
        chosen |= set(orders.ravel().tolist())
    assert len(chosen) == 4
    together = seen._replace(position=np.zeros_like(seen.position))
    orders, _ = supervisor.decide(together, supervisor.start(scenario, 1))
    assert all(scenario.orders.names[k].startswith("AA>") for k in orders.ravel())


@pytest.mark.parametrize(
    ("scenario", "said"),
    [
        (make_scenario("field"), "--composition set-based"),
        (replace(paper(composition="set-based"), path_velocity=(0.0, 0.0)), "path at rest"),
    ],
)
def test_missions_it_cannot_fly_are_refused(scenario, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        General(random_policy()).start(scenario, 1)


def test_a_formation_that_is_its_own_column_is_refused() -> None:
    scenario = field()
    formation = next(b for b in scenario.behaviors if b.name == "FM")
    same = tuple(replace(b, offsets=formation.offsets) if b.name == "FR" else b for b in scenario.behaviors)
    with pytest.raises(ConfigurationError, match="has no column"):
        General(random_policy()).start(replace(scenario, behaviors=same), 1)


def test_a_checkpoint_comes_back_as_it_was(tmp_path: Path) -> None:
    policy, path = random_policy(margin=0.25, dwell=4, deadline=0.5), tmp_path / "general.safetensors"
    write_general(path, policy, {"note": "x"})
    read, description = read_general(path)
    for one, other in zip(policy.network.weights, read.network.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (read.network.margin, read.dwell, read.deadline, description["note"]) == (0.25, 4, 0.5, "x")
    assert isinstance(make_supervisor(str(path)), General)
    assert path.stat().st_size < 1_000_000


@pytest.mark.parametrize(
    ("changes", "arrays", "said"),
    [
        ({"layout": {"version": 0}}, {}, "trained on other inputs: its layout"),
        ({"interval": 3.0}, {}, "trained on other inputs: its interval"),
        ({"kind": "team"}, {}, "not hold a general policy"),
        ({"margin": None}, {}, "does not hold the network"),
        ({"dwell": 0}, {}, "its dwell is 0 decisions"),
        ({"deadline": -1.0}, {}, "its deadline -1.0"),
        ({}, {"weight0": np.zeros((1, 7, 16), np.float32)}, "7, 16"),
        ({}, {"weight1": np.full((1, 16, 3), np.nan, np.float32)}, "not finite"),
        ({}, {"weight1": np.zeros((1, 16, 4), np.float32), "bias1": np.zeros((1, 1, 4), np.float32)}, "2 or 4 advantages"),
        ({}, {"weight0": np.zeros((1, inputs.INPUTS, 16))}, "float32"),
        ({}, {"weight0": np.zeros((2, inputs.INPUTS, 16), np.float32)}, "layer 0 has weights"),
        ({}, {"weight0": np.float32(1.0)}, "float32"),
    ],
)
def test_checkpoints_of_another_kind_are_refused(tmp_path: Path, changes, arrays, said: str) -> None:
    path = tmp_path / "general.safetensors"
    write_general(path, random_policy(), {})
    old, description = read_arrays(path)
    del description["sha256"]
    write_arrays(path, old | arrays, description | changes)
    with pytest.raises(ConfigurationError, match=said):
        read_general(path)


def test_a_checkpoint_of_one_team_is_no_general_policy() -> None:
    with pytest.raises(ConfigurationError, match="of a single team"):
        read_general(shipped("marlms"))


def test_the_mean_of_policies_has_the_mean_of_their_values() -> None:
    """Also of three layers; a mean of none, or of networks of two sizes, is refused."""
    deep = [with_middle_layer(random_policy(seed), seed) for seed in range(3)]
    seen = np.random.default_rng(0).normal(size=(7, inputs.INPUTS)).astype(np.float32)
    for policies in ([random_policy(1), random_policy(2)], deep):
        mean = np.mean([policy.values(seen) for policy in policies], axis=0)
        np.testing.assert_allclose(mean_policy(policies, 0.05).values(seen), mean, rtol=1e-4, atol=1e-4)
    with pytest.raises(ConfigurationError, match="at least one policy"):
        mean_policy([], 0.0)
    with pytest.raises(ConfigurationError, match="of the same size"):
        mean_policy([random_policy(), deep[0]], 0.0)


def test_the_shipped_policy_flies_what_it_never_saw() -> None:
    """A held-out layout of a family with walls, in whose middle only the column fits."""
    scenario = make_scenario("gates", composition="set-based", split="test")
    verdict = Judge(scenario, "sorlc", 2)(make_supervisor("marlms-general"), seed=59_000)
    assert verdict.success.all()
    assert shipped("marlms-general").stat().st_size < 1_000_000


def decisions(scenario, steps: int = 30, worlds: int = 2) -> np.ndarray:
    """(steps, B, N) orders of the first mission steps of held-out layouts."""
    supervisor, world = General(random_policy()), World(scenario, worlds=worlds)
    observation, memory = world.reset(3), supervisor.start(scenario, worlds)
    taken = []
    for _ in range(steps):
        orders, memory = supervisor.decide(observation, memory)
        taken.append(orders.copy())
        observation = world.step(orders).observation
    return np.stack(taken)


def test_ideal_communication_is_the_limit_of_a_long_range() -> None:
    """One decision is the same whether nothing is exchanged because all hear all, or a layer carries it without limits."""
    ideal, carried = (field(communication=c) for c in (Communication(), Communication(range=1e6)))
    np.testing.assert_array_equal(decisions(carried), decisions(ideal))


@pytest.mark.parametrize("changes", [{"delay": 0.1, "loss": 0.5}, {"silent": (0,)}, {"protocol": "consensus", "range": 9.0}])
def test_it_flies_over_any_network(changes) -> None:
    """Every team decides on its own network: alone it takes the same orders as beside another."""
    scenario = field(communication=Communication(**changes))
    taken = decisions(scenario)
    assert np.isin(taken, [scenario.orders.index("FM"), scenario.orders.index("FR")]).all()
    np.testing.assert_array_equal(decisions(scenario, worlds=1)[:, 0], taken[:, 0])
