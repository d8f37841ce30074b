"""The general policy: one network for all teams, its decisions, refusals, checkpoints and missions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj import World, make_scenario, paper
from marlbc_mj.core.behaviors import LineFormation
from marlbc_mj.policies import general
from marlbc_mj.policies import general_inputs as inputs
from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.policies.general import (
    GeneralPolicy,
    Sensed,
    lead_of_column,
    make_general,
    mean_policy,
    must_return,
    orders_for,
    read_general,
    write_general,
)
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.scenarios.teams import team_mission
from marlbc_mj.studies import validation
from marlbc_mj.supervisors import General, make_supervisor
from marlbc_mj.training.general.judging import Judge
from marlbc_mj.util.errors import ConfigurationError


def random_policy(seed: int = 0, margin: float = 0.0, actions: int = 2, **flown) -> GeneralPolicy:
    rng = np.random.default_rng(seed)
    sizes = [(inputs.INPUTS, 16), (16, 1 + actions)]
    weights = tuple(rng.normal(size=(1, *size)).astype(np.float32) for size in sizes)
    return make_general(weights, tuple(np.zeros((1, 1, b), dtype=np.float32) for _, b in sizes), margin)._replace(**flown)


def with_middle_layer(policy: GeneralPolicy, seed: int) -> GeneralPolicy:
    """The policy with a third layer between its two."""
    weight = np.random.default_rng(seed).normal(size=(1, 16, 16)).astype(np.float32)
    weights, biases = policy.network.weights, policy.network.biases
    return make_general((weights[0], weight, weights[1]), (biases[0], biases[0], biases[1]), 0.0)


def decide(policy: GeneralPolicy, now: Sensed, heard: np.ndarray, age: np.ndarray) -> np.ndarray:
    """Actions of agents that hear features and leads of the same agents."""
    values = policy.evaluate(now.features, heard, age)
    leads = np.repeat(lead_of_column(values)[:, None], age.shape[1], axis=1)
    return policy.decide(now, general.agree(values, leads, age) if policy.consensus else values)


def field(**changes):
    return make_scenario("field", composition="set-based", **changes)


def test_isolated_agent_ignores_messages() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(1, 3, inputs.FEATURES)).astype(np.float32)
    age = np.where(np.eye(3, dtype=bool), 0.0, np.inf)[None]
    policy, now = random_policy(consensus=True), Sensed(features, np.zeros((1, 3), np.int64), np.array([True]))
    heard = np.repeat(features[:, None, :, : inputs.SENT], 3, axis=1)
    alone = decide(policy, now, heard, age)
    heard[:, 0, 1:], heard[:, 1, ::2], heard[:, 2, :2] = 7.0, -7.0, 3.0
    np.testing.assert_array_equal(decide(policy, now, heard, age), alone)


@pytest.mark.parametrize("dwell", [1, 2, 4])
def test_a_new_order_is_kept_for_the_dwell(dwell: int) -> None:
    """It is kept for at least ``dwell`` decisions; the first change of an episode can come after one decision."""
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


def returns(distance: float, left: float, deadline: float) -> bool:
    """Whether an agent at ``distance`` from its slot in the formation [d_OA] with the time ``left`` [T] must return."""
    entries = np.float32([np.tanh(distance / inputs.COARSE), np.exp(-left / inputs.COARSEST)])
    return bool(must_return(*entries, deadline))


@given(st.floats(0.0, 30.0), st.floats(0.05, 60.0), st.floats(0.2, 3.0))
def test_an_agent_returns_when_its_way_takes_the_time_left(distance: float, left: float, deadline: float) -> None:
    """Distance and time are in the units of the features, which saturate: distances above 36 d_OA count as 36."""
    if abs(left / (deadline * distance + 1e-9) - 1.0) > 1e-2:
        assert returns(distance, left, deadline) == (left < deadline * distance)
    assert not returns(1e3, 40.0, 1.0)
    assert returns(1e3, 30.0, 1.0)


@pytest.mark.parametrize("actions", [2, 4])
def test_the_deadline_brings_everybody_into_formation(actions: int) -> None:
    """If no time is left, all agents return, whatever the networks prefer, and keep avoidance; without a deadline none must."""
    rng = np.random.default_rng(0)
    features = rng.uniform(0.1, 0.9, size=(20, 4, inputs.FEATURES)).astype(np.float32)
    features[10:, :, inputs.ENDING + 1], features[:10, :, inputs.ENDING + 1] = 1.0, 1e-3
    now = Sensed(features, np.zeros((20, 4), np.int64), np.ones(20, dtype=bool))
    heard, age = features[:, None, :, : inputs.SENT], np.zeros((20, 1, 4))
    free, bound = (decide(random_policy(1, actions=actions, deadline=d), now, heard, age) for d in (0.0, 1.0))
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
    """The values of a team are the same alone and together with other teams, to the last bit."""
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


def test_a_policy_with_four_actions_decides_about_avoidance() -> None:
    """It needs the null-space composition; its orders are those of the best actions, with AA on top near neighbors."""
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
    policy, path = random_policy(margin=0.25, dwell=4, deadline=0.5, consensus=True), tmp_path / "general.safetensors"
    write_general(path, policy, {"note": "x"})
    read, description = read_general(path)
    for one, other in zip(policy.network.weights, read.network.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (read.network.margin, read.dwell, read.deadline, read.consensus, description["note"]) == (0.25, 4, 0.5, True, "x")
    assert isinstance(make_supervisor(str(path)), General)
    assert path.stat().st_size < 1_000_000


@pytest.mark.parametrize(
    ("changes", "arrays", "said"),
    [
        ({"layout": {"version": 0}}, {}, "trained on other inputs: layout"),
        ({"interval": 3.0}, {}, "trained on other inputs: interval"),
        ({"kind": "team"}, {}, "not a general policy"),
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
    """This also holds for three layers; a mean of no policies, or of networks of different sizes, is refused."""
    deep = [with_middle_layer(random_policy(seed), seed) for seed in range(3)]
    seen = np.random.default_rng(0).normal(size=(7, inputs.INPUTS)).astype(np.float32)
    for policies in ([random_policy(1), random_policy(2)], deep):
        mean = np.mean([policy.values(seen) for policy in policies], axis=0)
        np.testing.assert_allclose(mean_policy(policies, 0.05).values(seen), mean, rtol=1e-4, atol=1e-4)
    with pytest.raises(ConfigurationError, match="at least one policy"):
        mean_policy([], 0.0)
    with pytest.raises(ConfigurationError, match="all decide by consensus"):
        mean_policy([random_policy(), random_policy(consensus=True)], 0.0)
    with pytest.raises(ConfigurationError, match="of the same size"):
        mean_policy([random_policy(), deep[0]], 0.0)


def test_the_shipped_policy_flies_what_it_never_saw() -> None:
    """It succeeds on held-out layouts of gates, through which only the column fits."""
    scenario = make_scenario("gates", composition="set-based", split="test")
    verdict = Judge(scenario, "sorlc", 2)(make_supervisor("marlms-general"), seed=59_000)
    assert verdict.success.all()
    assert shipped("marlms-general").stat().st_size < 1_000_000


def test_validation_missions_are_what_their_names_say() -> None:
    """Each has the family, team and variation of its name, the set-based composition, and held-out layouts."""
    made = {name: validation.validation_mission(name) for name in validation.VALIDATION_MISSIONS}
    assert len(made) == 27
    for name, scenario in made.items():
        family, formation, agents, *different = name.replace("-", " ").split()
        wanted = team_mission(family, formation, int(agents), composition="set-based", split="test")
        assert (scenario.name, scenario.split, scenario.composition) == (family, "test", "set-based")
        np.testing.assert_array_equal(scenario.formations[0], wanted.formations[0])
        assert (scenario.communication.silent == (0,)) == ("silent" in different)
        assert any(isinstance(b, LineFormation) for b in scenario.behaviors) == ("lines" in different)
    with pytest.raises(ConfigurationError, match="gates wedge-4"):
        validation.validation_mission("gate wedge-4")


def test_validation_flies_the_mean_of_the_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It uses the margin, dwell time and deadline of the command, not those of the files."""
    files = [str(tmp_path / f"{seed}.safetensors") for seed in range(2)]
    policies = [random_policy(seed) for seed in range(2)]
    for path, policy in zip(files, policies, strict=True):
        write_general(Path(path), policy, {})
    asked = [
        "--missions",
        "field wedge-4",
        "--layouts",
        "2",
        "--seed",
        "7",
        "--margins",
        "0.05,1e9",
        "--dwell",
        "2",
        "--deadline",
        "0",
    ]
    validation.validate([*files, *asked])
    judge = Judge(validation.validation_mission("field wedge-4"), "sorlc", 2)
    for margin, line in zip((0.05, 1e9), capsys.readouterr().out.splitlines()[::2], strict=True):
        verdict = judge(General(mean_policy(policies, margin)._replace(dwell=2)), 7)
        assert f"margin {margin:g}, field wedge-4: {verdict.success.sum()} of 2" in line
        assert f"median return {np.median(verdict.total):.0f}, {np.median(verdict.switches) / 4:.2f} switches" in line
