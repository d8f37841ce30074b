"""Gymnasium, vector and PettingZoo environments: they pass the checkers of their libraries and fly the mission of World."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import parallel_api_test

from marlbc_mj import World, paper
from marlbc_mj.core.behaviors import clearances
from marlbc_mj.policies.states import CLOSE, OLD, RANGE, SPEED, make_state, nearest_surface
from marlbc_mj.scenarios import Perturbation, held_out, make_scenario
from marlbc_mj.scenarios.family import Family
from marlbc_mj.tasks.batch import FormationBatch
from marlbc_mj.tasks.gymnasium_env import PaperFormation, PaperFormationVector
from marlbc_mj.tasks.parallel_env import PaperFormationParallel
from marlbc_mj.tasks.starts import Starts
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.seeding import stream

ID = "marlbc_mj/PaperFormation-v0"
AROUND = Perturbation(1.0, 0.5, (0.0, 2.0))


def test_gymnasium_checker():
    check_env(gymnasium.make(ID, duration=1.0).unwrapped, skip_render_check=True)


def test_parallel_api():
    parallel_api_test(PaperFormationParallel(duration=1.0), num_cycles=60)


@pytest.mark.parametrize(("actions", "count"), [("commands", 4), ("orders", 6)])
def test_action_sets(actions, count):
    env = PaperFormation(actions=actions)
    assert env.action_space.nvec.tolist() == [count] * 4


def test_a_whole_episode_is_the_mission_of_world():
    """The same orders give the same rewards and states, with a decision in every mission step or in every fourth."""
    world, rng = World(paper(duration=20.0)), np.random.default_rng(3)
    actions = rng.integers(4, size=(100, 4))
    for interval in (1, 4):
        env = PaperFormation(state="published", interval=interval, duration=20.0)
        state, _ = env.reset(seed=0)
        world.reset(0)
        assert (state == world.observe().state()[0].astype(np.float32)).all()
        for k in range(400 // interval):
            action = actions[k % 100]
            state, reward, terminal, truncated, info = env.step(action)
            orders = world.scenario.orders.representative[action][None]
            expected = sum(world.step(orders).reward[0] for _ in range(interval))
            assert reward == expected
            assert reward == info["formation_reward"] + info["violation_reward"] + info["switching_reward"]
            assert (state == world.observe().state()[0].astype(np.float32)).all()
            assert not truncated and terminal == (k == 400 // interval - 1)


@pytest.mark.parametrize("make", [PaperFormation, PaperFormationParallel])
def test_a_seed_fixes_a_whole_episode(make):
    def episode(seed):
        env = make(duration=5.0, interval=4, perturbation=AROUND)
        rng, seen = np.random.default_rng(1), []
        env.reset(seed=seed)
        for _ in range(25):
            joint = rng.integers(4, size=4)
            step = env.step(joint if make is PaperFormation else dict(zip(env.possible_agents, joint, strict=True)))
            seen.append(step[0] if make is PaperFormation else step[0]["agent_1"])
        return np.array(seen)

    first = episode(7)
    assert (first == episode(7)).all()
    assert (first != episode(8)).any()


def test_vector_env_restarts_by_itself_and_keeps_the_final_state():
    vector = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="vector_entry_point", duration=1.0)
    single = PaperFormation(duration=1.0)
    start, _ = vector.reset(seed=2)
    single.reset(seed=2)
    action = np.array([2, 3, 2, 3])
    for _ in range(20):
        states, _, terminal, truncated, infos = vector.step(np.tile(action, (3, 1)))
        last, *_ = single.step(action)
    assert terminal.all() and not truncated.any()
    assert infos["_final_obs"].all()
    for b in range(3):
        assert (infos["final_obs"][b] == last).all()
    assert (states == start).all()  # nothing is perturbed, so all episodes start alike


def test_worlds_of_a_vector_env_do_not_depend_on_their_number():
    small, large = (PaperFormationVector(n, duration=2.0, perturbation=AROUND) for n in (2, 5))
    assert (small.reset(seed=4)[0] == large.reset(seed=4)[0][:2]).all()
    action = np.array([0, 1, 2, 3])
    for _ in range(30):
        a, b = small.step(np.tile(action, (2, 1))), large.step(np.tile(action, (5, 1)))
        assert (a[1] == b[1][:2]).all()


@pytest.mark.parametrize("starts", [Starts(), Starts(0.7, 1.0), Starts(0.7, 0.5, focus=0.5, turning=0.5)])
def test_worlds_do_not_depend_on_the_others_over_many_episodes(starts):
    """World b is the same for any B and any orders of other worlds, over many episodes of different lengths."""
    small, large = (FormationBatch(paper(duration=4.0, perturbation=AROUND), worlds=n, starts=starts) for n in (2, 5))
    assert (small.reset(4) == large.reset(4)[:2]).all()
    rng, ends = np.random.default_rng(0), np.zeros(2, dtype=int)
    for _ in range(120):
        actions = rng.integers(4, size=(5, 4))
        a, b = small.step(actions[:2]), large.step(actions)
        ends += a.ended
        for one, other in zip(a, b, strict=True):
            assert np.array_equal(one, other[:2])
    assert ends.min() >= 6


def test_a_feature_that_never_happens_draws_no_number():
    """Kinds of starts with a share of 0 do not advance the random stream."""

    def drawn(**shares):
        batch = FormationBatch(paper(perturbation=AROUND), starts=Starts(**shares))
        batch.reset(1)
        return batch.rngs[0].bit_generator.state

    plain = np.random.default_rng(np.random.SeedSequence([1, 0]))
    plain.integers(2**31)
    assert drawn() == plain.bit_generator.state != drawn(exploring=0.5)
    assert drawn(exploring=1.0) != drawn(exploring=1.0, focus=0.5)
    assert drawn(exploring=1.0) != drawn(exploring=1.0, turning=0.5)


@given(st.integers(0, 3), st.integers(0, 3), st.sampled_from([-1, 4, 2**40, -(2**40)]))
@settings(max_examples=20)
def test_invalid_actions_are_refused(world, agent, value):
    """Any index outside the action set is refused, in any world and agent, before a world has moved."""
    batch = FormationBatch(paper(duration=1.0), worlds=4)
    actions = np.zeros((4, 4), dtype=np.int64)
    actions[world, agent] = value
    with pytest.raises(ConfigurationError, match=rf"from 0 to 3, got {value} for world {world}, agent {agent + 1}"):
        batch.step(actions)
    assert (batch.world.state.steps == 0).all() and (batch.last == batch.action_of[batch.world.state.command]).all()


@pytest.mark.parametrize(
    ("actions", "fragment"),
    [
        (np.zeros((2, 3), dtype=int), r"\(2, 4\).*got \(2, 3\)"),
        (np.zeros(4, dtype=int), r"\(2, 4\).*got \(4,\)"),
        (np.zeros((2, 4)), "whole numbers from 0 to 3, got float64"),
        (np.zeros((2, 4), dtype=bool), "whole numbers from 0 to 3, got bool"),
        ([[0, 1], [0]], r"\(2, 4\)"),
        (np.full((2, 4), "a"), "whole numbers"),
        (np.full((2, 4), 2**64 - 1, dtype=np.uint64), "got 18446744073709551615"),
    ],
)
def test_actions_of_another_shape_or_kind_are_named(actions, fragment):
    vector = PaperFormationVector(2, duration=1.0)
    vector.reset(seed=0)
    for step in (vector.step, vector.batch.step):
        with pytest.raises(ConfigurationError, match=fragment):
            step(actions)


def test_every_view_refuses_wrong_actions():
    env, parallel = PaperFormation(duration=1.0), PaperFormationParallel(duration=1.0)
    env.reset(seed=0), parallel.reset(seed=0)
    for action in ([0, 1, 2], [0, 1, 2, 7], [0.5, 1, 2, 3], 1):
        with pytest.raises(ConfigurationError, match="actions must"):
            env.step(action)
    some = dict.fromkeys(parallel.possible_agents, 1)
    for wrong, fragment in (({"agent_2": -1}, "-1 for world 0, agent 2"), ({"agent_3": 1.5}, "1.5")):
        with pytest.raises(ConfigurationError, match=fragment):
            parallel.step({**some, **wrong})
    with pytest.raises(ConfigurationError, match="agent_4"):
        parallel.step(dict.fromkeys(parallel.possible_agents[:3], 0))
    assert not any(parallel.step(some)[2].values())


def test_a_mask_chooses_the_worlds_that_begin_anew():
    vector = PaperFormationVector(4, duration=1.0, perturbation=AROUND)
    begun, _ = vector.reset(seed=3)
    actions = np.tile([0, 1, 2, 3], (4, 1))
    moved = vector.step(actions)[0]
    mask = np.array([True, False, False, True])
    state, infos = vector.reset(seed=3, options={"reset_mask": mask})
    assert (state[mask] == begun[mask]).all() and (state[~mask] == moved[~mask]).all() and infos == {}
    other, _ = vector.reset(options={"reset_mask": ~mask})
    assert (other[mask] == begun[mask]).all() and (other[~mask] != begun[~mask]).any(axis=1).all()
    ends = [vector.step(actions)[2] for _ in range(20)]
    assert np.array_equal(ends[19], [True] * vector.num_envs) and not np.any(ends[:19])  # all worlds had the same time left


def test_a_list_has_a_seed_for_every_world():
    vector = PaperFormationVector(3, duration=1.0, perturbation=AROUND)
    one, again = vector.reset(seed=[5, 6, 7])[0], vector.reset(seed=[5, 8, 7])[0]
    assert (one[[0, 2]] == again[[0, 2]]).all() and (one[1] != again[1]).any()
    later = vector.reset(seed=[None, 8, 7])[0]
    assert (later[1:] == again[1:]).all() and (later[0] != again[0]).any()


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        ({"seed": [1, 2]}, r"a list with 3 of them, got \[1, 2\]"),
        ({"seed": [1, 2, -3]}, "negative"),
        ({"options": {"reset_mask": np.array([True, False])}}, r"shape \(3,\), got bool with shape \(2,\)"),
        ({"options": {"reset_mask": np.array([0, 1, 2])}}, "bool with shape"),
        ({"options": {"reset_mask": np.zeros(3, dtype=bool)}}, "at least one world"),
    ],
)
def test_wrong_resets_are_named(arguments, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        PaperFormationVector(3, duration=1.0).reset(**arguments)


def test_infos_are_those_of_gymnasiums_own_vector_env():
    """Keys, masks and masked values equal those of a SyncVectorEnv at every step, also when episodes end."""
    same = gymnasium.vector.AutoresetMode.SAME_STEP
    reference = gymnasium.vector.SyncVectorEnv([lambda: PaperFormation(duration=0.5)] * 2, autoreset_mode=same)
    vector = PaperFormationVector(2, duration=0.5)
    reference.reset(seed=0), vector.reset(seed=0)

    def equal(one, other):
        assert {*one} == {*other}
        for name in one:
            if name.startswith("_"):
                assert (one[name] == other[name]).all()
            elif isinstance(one[name], dict):
                equal(one[name], other[name])
            else:
                for a, b, valid in zip(one[name], other[name], other[f"_{name}"], strict=True):
                    assert not valid or np.array_equal(a, b)

    rng = np.random.default_rng(0)
    for k in range(22):
        actions = rng.integers(4, size=(2, 4))
        expected, found = reference.step(actions), vector.step(actions)
        for a, b in zip(expected[:4], found[:4], strict=True):
            assert np.array_equal(a, b)
        equal(expected[4], found[4])
        assert ("final_info" in found[4]) == (k % 10 == 9)


def test_equal_seeds_of_worlds_are_equal_episodes_and_those_of_one_environment():
    """As in Gymnasium's SyncVectorEnv, world b of a list of seeds begins like one environment with the b-th seed."""
    vector, single = PaperFormationVector(3, "field", duration=2.0), PaperFormation("field", duration=2.0)
    vector.reset(seed=[5, 7, 5])
    single.reset(seed=7)
    drawn = vector.batch.world.observe().obstacles
    assert (drawn[0] == drawn[2]).all() and (drawn[0] != drawn[1]).any()
    assert (single.batch.world.observe().obstacles[0] == drawn[1]).all()


def test_a_layout_is_the_one_that_evaluate_flies():
    """In every view; seeds do not matter then."""
    scenario = held_out(make_scenario("field", duration=2.0))
    world = World(scenario)
    world.begin(0, stream(20_000))
    expected = world.observe().obstacles[0]
    options = {"layout": 20_000}
    views = PaperFormation(scenario), PaperFormationVector(2, scenario), PaperFormationParallel(scenario)
    for view in views:
        view.reset(seed=3, options=options)
        for obstacles in view.batch.world.observe().obstacles:
            np.testing.assert_array_equal(obstacles, expected)
    views[1].reset(options={"layout": [20_000, 1]})
    assert (views[1].batch.world.observe().obstacles[1] != expected).any()
    with pytest.raises(ConfigurationError, match="a layout must be a non-negative whole number.* got -1"):
        views[0].reset(options={"layout": -1})


@pytest.mark.parametrize("make", [PaperFormation, PaperFormationParallel])
def test_after_its_end_a_mission_stays_as_it_was(make):
    """What is drawn or read from the world is the end, not the next start; a step must wait for a reset."""
    env = make(duration=0.2)
    action = np.zeros(4, dtype=int) if make is PaperFormation else dict.fromkeys(env.possible_agents, 0)
    with pytest.raises(ConfigurationError, match="no episode is going on: call reset"):
        env.step(action)
    env.reset(seed=0)
    for _ in range(4):
        env.step(action)
    assert env.batch.world.state.steps.tolist() == [4]
    with pytest.raises(ConfigurationError, match="no episode is going on: call reset"):
        env.step(action)
    env.reset(seed=0)
    env.step(action)
    assert env.batch.world.state.steps.tolist() == [1]


def test_exploring_starts_lie_on_the_route_and_are_cut():
    batch = FormationBatch(paper(), worlds=40, starts=Starts(exploring=1.0, length=2.0))
    batch.reset(0)
    state = batch.world.state
    time = state.steps * batch.scenario.mission_step
    assert len(np.unique(time)) > 20
    centroid = state.position.mean(axis=1)
    assert np.allclose(centroid[:, 0], -2.5 + time) and np.allclose(centroid[:, 1], 0.0)
    assert set(np.unique(state.formation)) == {1, 2}
    assert clearances(state.position[0], state.obstacles[0]).min() > 0
    for _ in range(10):
        outcome = batch.step(np.zeros((40, 4), dtype=np.int64))
    assert (outcome.truncated | outcome.terminal).any()
    assert not (outcome.truncated & outcome.terminal).any()
    assert (outcome.state[outcome.ended] != outcome.final_state[outcome.ended]).any()


def test_the_final_state_is_the_true_successor_where_only_some_worlds_end():
    """Checked against copies that do not end: in worlds that end it is the old episode's next state, in others the new state."""
    batch = FormationBatch(paper(perturbation=AROUND), worlds=12, interval=2, starts=Starts(exploring=0.8, length=1.0))
    batch.reset(5)
    twin, rng, partial = World(paper(perturbation=AROUND), worlds=12), np.random.default_rng(0), 0
    batch.cut[batch.cut < 2000] += rng.integers(10, size=(batch.cut < 2000).sum())  # so that they end at different times
    for _ in range(25):
        twin.restore(batch.world.snapshot())
        actions, before = rng.integers(4, size=(12, 4)), twin.observe().age
        outcome = batch.step(actions)
        commands = twin.state.command.copy()
        begun = twin.state.steps > 0
        for _ in range(2):
            twin.step(batch.order_of[actions])
        age = np.where((twin.state.command != commands) & begun[:, None], 0.0, before) + 0.1
        np.testing.assert_allclose(twin.observe().age, age, rtol=0, atol=1e-12)
        assert (outcome.age == before).all() and (outcome.final_state == batch.read(twin.observe())).all()
        ended = outcome.ended
        assert (outcome.final_state[~ended] == outcome.state[~ended]).all()
        assert (outcome.final_state[ended] != outcome.state[ended]).any(axis=1).all()
        partial += bool(ended.any() and not ended.all() and (outcome.truncated == ended).all())
    assert partial >= 3


def test_focused_starts_lie_shortly_before_the_moments_that_the_geometry_gives():
    """A slot is within d_OA up to sqrt(3) m from a point passed at 1 m, and up to sqrt(40) m from a 5 m disc passed at 3 m."""
    points = [20.0 - np.sqrt(3.0), 20.0 + np.sqrt(3.0), 45.0 - np.sqrt(3.0), 45.0 + np.sqrt(3.0)]
    gate = [60.0 - np.sqrt(40.0), 65.0 - np.sqrt(40.0), 70.0 + np.sqrt(40.0), 75.0 + np.sqrt(40.0)]
    batch = FormationBatch(paper(), worlds=200, interval=1, starts=Starts(exploring=1.0, focus=1.0, lead=3.0))
    found = batch.route.critical * batch.scenario.mission_step
    assert np.allclose(found, points + gate, atol=0.051)
    batch.reset(0)
    time = batch.world.state.steps * batch.scenario.mission_step
    ahead = found - time[:, None]
    assert (((ahead > -0.03) & (ahead < 3.03)).any(axis=1)).all()
    assert (((ahead > -0.03) & (ahead < 3.03)).any(axis=0)).all()


def test_a_turning_start_is_to_begin_with_one_formation_or_the_other():
    batch = FormationBatch(paper(), worlds=60, interval=10, starts=Starts(exploring=1.0, length=1.0, turning=0.5))
    batch.reset(0)
    for _ in range(2):
        turning = batch.turn >= 0
        assert 15 < turning.sum() < 45
        commands = np.array(batch.scenario.orders.commands)[batch.scenario.orders.command_of[batch.order_of[batch.turn[turning]]]]
        assert set(commands) == {"FM", "FR"} and 0.2 < (commands == "FM").mean() < 0.8
        for _ in range(2):
            outcome = batch.step(batch.last)
        assert outcome.truncated.sum() > 50


def test_exploring_starts_are_clear_of_obstacles_that_move():
    batch = FormationBatch(make_scenario("traffic"), worlds=40, interval=10, starts=Starts(exploring=1.0, focus=0.5))
    batch.reset(0)
    state = batch.world.state
    assert (state.steps > 0).sum() > 30
    gaps = [clearances(state.position[b], state.obstacles[b]).min() for b in range(40)]
    assert min(gaps) > batch.scenario.safe_distance


@given(
    st.lists(st.tuples(*[st.floats(-50, 50)] * 2), min_size=1, max_size=4),
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(0, 5)), max_size=5),
)
def test_nearest_points_at_the_nearest_surface(points, discs):
    obstacles = np.array(discs, dtype=float).reshape(-1, 3)
    seen = np.empty((len(points), 3))
    for point, out in zip(np.array(points), seen, strict=True):
        nearest_surface(point, obstacles, out)
    expected = np.minimum(clearances(np.array(points), obstacles), RANGE)
    assert np.allclose(seen[:, 2], expected)
    if len(discs):
        assert np.allclose(np.hypot(seen[:, 0], seen[:, 1]), np.abs(expected), atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3, 4, 5, 9]))
def test_the_extended_state_is_what_it_says(seed, agents):
    """Every entry equals its definition for any team, clipped if out of range; NaN stays NaN."""
    scenario, rng = paper() if agents == 4 else Family(agents=agents).build(), np.random.default_rng(seed)
    commands = len(scenario.orders.commands)
    read, world = make_state("extended", scenario), World(scenario, worlds=3)
    shape = 3, scenario.agents
    position, velocity = rng.normal(size=(*shape, 2)) * 8.0, rng.normal(size=(*shape, 2)) * 4.0
    command, formation, age = rng.integers(commands, size=shape), rng.integers(3, size=3), rng.uniform(0.0, 8.0, size=shape)
    obstacles = np.concatenate([rng.normal(size=(3, 6, 2)) * 10.0, rng.uniform(0.0, 3.0, size=(3, 6, 1))], axis=-1)
    seen = world.observe()._replace(position=position, velocity=velocity, command=command, formation=formation)
    seen = seen._replace(obstacles=obstacles, age=age)
    state = read(seen)
    surfaces = np.empty((2, *shape, 3))
    slots = position.mean(axis=1)[:, None, None] + scenario.formations  # (B, 2, N, 2)
    for b, i in np.ndindex(shape):
        nearest_surface(position[b, i], obstacles[b], surfaces[0, b, i])
        nearest_surface(slots[b, 0, i], obstacles[b], surfaces[1, b, i])
    surfaces[..., 2] -= scenario.safe_distance
    lengths = np.concatenate([position - slots[:, 0], position - slots[:, 1], *surfaces], axis=-1)
    speeds = (velocity - np.array(scenario.path_velocity)) / SPEED
    parts = [lengths / RANGE, lengths / CLOSE, speeds, np.eye(commands)[command], age[..., None] / OLD]
    expected = np.concatenate([np.concatenate(parts, axis=-1).reshape(3, -1), np.eye(3)[formation]], axis=-1)
    np.testing.assert_allclose(state, np.clip(expected, -1.0, 1.0), atol=1e-7)
    position[1, 1, 0] = np.nan
    assert np.isnan(read(seen)).any(axis=1).tolist() == [False, True, False]
    command[2, 0] = commands
    with pytest.raises(IndexError):
        read(seen)


def test_a_command_that_an_episode_began_with_is_as_old_as_can_be():
    """Its age is infinite, which saturates the state as any age from ``OLD`` on does."""
    read, seen = make_state("extended", paper()), World(paper(), worlds=2).observe()
    assert np.isinf(seen.age).all()
    for age in (OLD, 2.0 * OLD):
        assert (read(seen) == read(seen._replace(age=np.full((2, 4), age)))).all()
    assert (read(seen) != read(seen._replace(age=np.full((2, 4), 0.9 * OLD)))).sum() == 8


def test_the_extended_state_does_not_know_where_on_the_path_it_is():
    """Moving team and obstacles together along the path does not change the state."""
    scenario = paper()
    read = make_state("extended", scenario)
    world = World(scenario)
    observation = world.observe()
    moved = observation._replace(
        position=observation.position + np.array([13.0, 0.0]), obstacles=observation.obstacles + np.array([13.0, 0.0, 0.0])
    )
    there = read(moved)
    assert np.allclose(read(observation), there, atol=1e-6)
    assert there.shape == (1, read.size)


def test_ages_count_from_the_last_change_of_command():
    batch = FormationBatch(paper(), worlds=2, interval=10)
    batch.reset(0)
    plan = [[2, 2, 2, 2], [2, 2, 2, 2], [3, 2, 2, 2], [3, 2, 2, 0], [2, 2, 2, 0]]
    ages = [batch.step(np.array([row, [2] * 4])).age[0] for row in plan]
    assert np.isinf(ages[:3]).all()  # the first decision is no switch
    assert ages[3][0] == pytest.approx(0.5) and ages[4][0] == pytest.approx(1.0) and ages[4][3] == pytest.approx(0.5)
    assert batch.world.observe().age[0].tolist() == pytest.approx([0.5, np.inf, np.inf, 1.0])


@pytest.mark.parametrize(
    ("build", "fragments"),
    [
        (lambda: PaperFormation(state="pixels"), ["state", "pixels", "extended", "published"]),
        (lambda: PaperFormation(actions="all"), ["action set", "all", "commands", "orders"]),
        (lambda: PaperFormation(interval=3), ["2000", "3"]),
        (lambda: PaperFormation("maze"), ["maze", "paper"]),
        (lambda: Starts(exploring=1.5), ["1.5"]),
        (lambda: Starts(length=0.0), ["0.0"]),
        (lambda: Starts(focus=1.2), ["focus", "1.2"]),
        (lambda: Starts(lead=-1.0), ["-1.0"]),
    ],
)
def test_wrong_settings_are_named(build, fragments):
    with pytest.raises(ConfigurationError) as error:
        build()
    assert all(fragment in str(error.value) for fragment in fragments)
