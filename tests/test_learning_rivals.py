"""The learning baselines against hand computation, closed forms and plain loops; all resume to the last bit."""

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from marlbc_mj import paper
from marlbc_mj.engine.observation import Observation
from marlbc_mj.policies.actions import ACTIONS, order_of
from marlbc_mj.policies.checkpoint import read_arrays
from marlbc_mj.policies.greedy import greedy
from marlbc_mj.policies.states import STATES, make_state
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.tasks.batch import FormationBatch
from marlbc_mj.tasks.starts import Starts
from marlbc_mj.training.config import TrainConfig, from_json, make_config
from marlbc_mj.training.learner import Learner
from marlbc_mj.training.mappo import MAPPO, ValueScale, advantages, clipped_loss, log_probability
from marlbc_mj.training.methods import METHODS, PPO
from marlbc_mj.training.prioritised import ALPHA, BETA, LEAST_ERROR, PrioritisedReplay
from marlbc_mj.training.replay import Batch
from marlbc_mj.training.resuming import RESUME
from marlbc_mj.training.rivals import LEARNERS, QMIX, RLMS, VDN, Central, Mixer, learner_class, own_entries
from marlbc_mj.training.run import Interrupted, make_trainer, resume, train
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import plain_data

N, S, A = 3, 5, 4


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def batch_of(size=6, seed=0):
    rng = np.random.default_rng(seed)
    state, after = (rng.normal(size=(size, S)).astype(np.float32) for _ in range(2))
    discount = np.where(rng.random((size, N)) < 0.2, 0.0, 0.9).astype(np.float32)
    reward = rng.normal(size=(size, N)).astype(np.float32)
    return Batch(state, rng.integers(A, size=(size, N)), reward, discount, after, np.zeros((size, N), np.float32))


def learner_of(kind, **changes):
    """A learner after a few updates, so that its past networks differ from the current one."""
    config = replace(TrainConfig(), hidden=(6,), copies=2, learner="plain", push_every=2, risk_gamma=0.0, **changes)
    learner = kind(config, N, A, np.arange(1.0, S + 1), generator())
    for seed in range(3):
        learner.update(batch_of(seed=seed), 1e-2)
    return learner


def both(learner, batch):
    """Values of the chosen actions and their targets."""
    return learner.estimates(
        batch, learner.network(torch.from_numpy(batch.state)), learner.targets.heads(torch.from_numpy(batch.next_state))[0]
    )


def test_vdn_by_hand():
    learner, batch = learner_of(VDN), batch_of(seed=9)
    chosen, target = both(learner, batch)
    now = learner.values(batch.state)
    ahead = learner.targets.heads(torch.from_numpy(batch.next_state))[0].numpy()
    for m in range(len(batch.state)):
        assert chosen[0, m].item() == pytest.approx(sum(now[m, i, batch.action[m, i]] for i in range(N)), rel=1e-4)
        expected = sum(batch.reward[m, i] + batch.discount[m, i] * ahead[i, m].max() for i in range(N))
        assert target[0, m].item() == pytest.approx(expected, rel=1e-4, abs=1e-5)
    assert chosen.shape == target.shape == (1, 6) and not target.requires_grad


def mixed(mixer, values, state):
    """Output of the mixer for one state, written out in NumPy."""
    x = state / np.arange(1.0, S + 1)

    def linear(layer, y):
        return y @ layer.weight.detach().numpy().T + layer.bias.detach().numpy()

    hidden = values @ np.abs(linear(mixer.weight1, x)).reshape(N, -1) + linear(mixer.bias1, x)
    hidden = np.where(hidden > 0, hidden, np.expm1(np.minimum(hidden, 0.0)))
    bias = linear(mixer.bias2[2], np.maximum(linear(mixer.bias2[0], x), 0.0))[0]
    return hidden @ np.abs(linear(mixer.weight2, x)) + bias


def test_qmix_by_hand():
    learner, batch = learner_of(QMIX), batch_of(seed=9)
    chosen, target = both(learner, batch)
    now = learner.values(batch.state)
    ahead = learner.targets.heads(torch.from_numpy(batch.next_state))[0].numpy()
    for m in range(len(batch.state)):
        own = np.array([now[m, i, batch.action[m, i]] for i in range(N)])
        assert chosen[0, m].item() == pytest.approx(mixed(learner.mixer, own, batch.state[m]), rel=1e-4)
        future = mixed(learner.target_mixer, ahead[:, m].max(axis=-1), batch.next_state[m])
        expected = batch.reward[m].sum() + batch.discount[m].min() * future
        assert target[0, m].item() == pytest.approx(expected, rel=1e-4, abs=1e-5)
    assert not target.requires_grad


def test_the_target_mixer_lags_and_is_copied_with_the_networks():
    learner = learner_of(QMIX)  # 3 updates, a push every 2

    def same():
        pairs = zip(learner.mixer.parameters(), learner.target_mixer.parameters(), strict=True)
        return all(torch.equal(p, q) for p, q in pairs)

    assert not same()
    learner.update(batch_of(), 1e-2)
    assert same()


@settings(max_examples=40)
@given(st.integers(0, 2**31 - 1), st.floats(0.01, 30.0))
def test_the_mixer_is_monotonic(seed, size):
    """dQ_tot / dQ_i >= 0 for any weights, state and values."""
    mixer = Mixer(N, torch.arange(1.0, S + 1), generator(seed))
    with torch.no_grad():
        for p in mixer.parameters():
            p.add_(size * torch.randn(p.shape, generator=generator(seed + 1)))
    values = (size * torch.randn(N, 20, generator=generator(seed + 2))).requires_grad_()
    total = mixer(values, size * torch.randn(20, S, generator=generator(seed + 3)))
    assert total.shape == (1, 20)
    (slope,) = torch.autograd.grad(total.sum(), values)
    assert (slope >= 0).all() and (slope > 0).any()


def test_central_by_hand():
    learner, batch = learner_of(Central), batch_of(seed=9)
    chosen, target = both(learner, batch)
    now, present = learner.values(batch.state)[:, 0], learner.values(batch.next_state)[:, 0]
    past = learner.targets.heads(torch.from_numpy(batch.next_state))[0].numpy()[0]
    assert now.shape == (6, A**N)
    for m, (a, b, c) in enumerate(batch.action):
        assert chosen[0, m].item() == pytest.approx(now[m, (a * A + b) * A + c], rel=1e-5)
        ahead = past[m, present[m].argmax()]
        expected = batch.reward[m].sum() + batch.discount[m].min() * ahead
        assert target[0, m].item() == pytest.approx(expected, rel=1e-4, abs=1e-5)


@given(st.lists(st.integers(0, A - 1), min_size=N, max_size=N))
def test_joint_actions_are_read_as_they_are_written(action):
    learner = Central(replace(TrainConfig(), hidden=(2,), risk_gamma=0.0), N, A, np.ones(S), generator())
    joint = np.ravel_multi_index(tuple(action), learner.each)
    values = np.eye(A**N)[[joint]][:, None]
    assert greedy(values, np.zeros((1, N), dtype=np.int64), np.array([True]), 0.1).tolist() == [action]


@pytest.mark.parametrize("kind", [VDN, QMIX, Central])
def test_a_team_that_must_agree_learns_to(kind):
    """One decision, with a reward for one joint action only, shared by all agents; the greedy team learns this action."""
    config = replace(TrainConfig(), hidden=(16,), copies=2, push_every=10, learner="plain", risk_gamma=0.0)
    learner = kind(config, N, A, np.ones(S), generator())
    rng, state, none = np.random.default_rng(0), np.zeros((64, S), np.float32), np.zeros((64, N), np.float32)
    for _ in range(400):
        action = rng.integers(A, size=(64, N))
        reward = np.repeat((action == [1, 3, 0]).all(axis=1)[:, None] / N, N, axis=1).astype(np.float32)
        learner.update(Batch(state, action, reward, none, state, none), 1e-2)
    best = greedy(learner.values(state[:1]), np.zeros((1, N), dtype=np.int64), np.array([True]), 0.0)
    assert best.tolist() == [[1, 3, 0]]
    if kind is Central:
        assert learner.values(state[:1]).max() == pytest.approx(1.0, abs=0.1)


def filled(rows=6, worlds=5, decisions=8, agents=2):
    replay = PrioritisedReplay(rows, worlds, agents, 1)
    for k in range(decisions):
        number = 10.0 * k + np.arange(worlds)
        replay.store(
            state=number[:, None], final=number[:, None] + 1, action=np.zeros((worlds, agents)),
            reward=number[:, None] + [0.0, 0.5], leniency=np.zeros((worlds, agents)), code=np.zeros(worlds),
            ended=np.zeros(worlds, dtype=bool), terminal=np.zeros((worlds, agents), dtype=bool),
            lost=np.zeros((worlds, agents), dtype=bool),
        )  # fmt: skip
    return replay


def test_new_transitions_have_the_largest_priority():
    replay = filled(decisions=2)
    assert (replay.arrays["priority"][:2] == 1).all() and (replay.arrays["priority"][2:] == 0).all()
    batch = replay.sample(1, 1, 0.9, np.random.default_rng(0))
    replay.learnt(batch, np.array([[7.0], [0.0]]))
    largest, least = (7.0 + LEAST_ERROR) ** ALPHA, LEAST_ERROR**ALPHA
    flat = replay.arrays["priority"].reshape(-1, 2)
    assert flat[batch.place[0, 0], 0] == pytest.approx(largest) and flat[batch.place[0, 1], 1] == pytest.approx(least)
    replay.store(**{name: array[0] for name, array in replay.arrays.items() if name != "priority"})
    assert np.allclose(replay.arrays["priority"][2], [[largest, 1.0]] * 5)


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_prioritised_sampling_is_the_closed_form(steps, share):
    """Per agent, P(j) = p_j / sum p over complete transitions; weights are (n P)^-beta divided by the largest of them."""
    replay, rng = filled(), np.random.default_rng(1)
    errors = rng.exponential(size=(2, 30))
    every = np.repeat(np.arange(30)[:, None], 2, axis=1)
    replay.learnt(Batch(*[np.zeros(1)] * 6, place=every), errors)
    p = (errors.T + LEAST_ERROR) ** ALPHA  # (30, 2)
    whole = np.ones((6, 5), dtype=bool)
    whole[[(8 - k) % 6 for k in range(1, steps)]] = False  # the newest rows have no successors yet
    p[~whole.ravel()] = 0.0
    chance = p / p.sum(axis=0)
    weights = (whole.sum() * np.where(p > 0, chance, 1.0)) ** -(BETA + (1 - BETA) * share)
    weights /= np.where(p > 0, weights, 0.0).max(axis=0)
    count = np.zeros((30, 2))
    for _ in range(100):
        batch = replay.sample(300, steps, 0.5, rng, share)
        for i in range(2):
            count[:, i] += np.bincount(batch.place[:, i], minlength=30)
            assert np.allclose(batch.weight[:, i], weights[batch.place[:, i], i], rtol=1e-5)
            number = batch.state[i, :, 0]
            k = np.where(batch.place[:, i] // 5 >= 2, batch.place[:, i] // 5, batch.place[:, i] // 5 + 6)
            assert (number == 10.0 * k + batch.place[:, i] % 5).all()
            expected = sum(0.5**j * (number + 10.0 * j + 0.5 * i) for j in range(steps))
            assert np.allclose(batch.reward[:, i], expected, rtol=1e-5)
            assert (batch.next_state[i, :, 0] == number + 10.0 * (steps - 1) + 1).all()
    assert np.allclose(count / 30_000, chance, atol=0.004)


def test_importance_weights_and_errors_go_through_an_update():
    mask = np.ones((2, S), dtype=np.float32)
    config = replace(TrainConfig(), method="rlms", hidden=(6,), copies=1, learner="plain", risk_gamma=0.0)
    learner = RLMS(config, 2, A, np.ones(S), generator(), mask)
    rng = np.random.default_rng(0)
    states = rng.normal(size=(2, 8, S)).astype(np.float32)
    reward, none = rng.normal(size=(8, 2)).astype(np.float32), np.zeros((8, 2), np.float32)
    weight = rng.random((8, 2)).astype(np.float32)
    batch = Batch(states, rng.integers(A, size=(8, 2)), reward, none, states, none, weight)
    q = [learner.network(torch.from_numpy(states[i]))[i] for i in range(2)]
    chosen = torch.stack([q[i][torch.arange(8), torch.from_numpy(batch.action[:, i])] for i in range(2)])
    error = torch.from_numpy(reward.T) - chosen.detach()
    expected = torch.autograd.grad(
        chosen, list(learner.network.parameters()), -torch.from_numpy(weight.T) * error.clamp(-1, 1) / 8
    )
    learner.update(batch, 0.0)
    assert np.allclose(learner.errors, error.abs(), atol=1e-6)
    for p, gradient in zip(learner.network.parameters(), expected, strict=True):
        assert torch.allclose(p.grad, gradient, atol=1e-6)


@pytest.mark.parametrize("name", STATES)
def test_the_own_entries_of_a_state_are_the_agents_own(name):
    """An agent's velocity, command and age of command change only its own entries."""
    scenario = paper()
    state, rng = make_state(name, scenario), np.random.default_rng(0)
    mask = own_entries(state, 4).astype(bool)

    def read(velocity, command, age):
        position = np.arange(8.0).reshape(1, 4, 2)
        obstacles, none = np.zeros((1, 1, 3)), np.zeros(1, dtype=np.int64)
        clearance = np.ones((1, 4))
        observation = Observation(none, np.zeros(1), position, velocity, clearance, none, command, age, position, obstacles, none)
        return state(observation)[0]

    velocity, command, age = rng.normal(size=(1, 4, 2)), np.zeros((1, 4), dtype=np.int64), np.ones((1, 4))
    seen = 3 if name == "published" else 5  # the published state has no age
    assert (mask.sum(axis=0) <= 1).all() and mask.sum() == state.size - (1 if name == "published" else 3)
    for j in range(4):
        faster, other, older = velocity.copy(), command.copy(), age.copy()
        faster[0, j] += 0.1
        other[0, j] = 1
        older[0, j] += 1.0
        changed = read(velocity, command, age) != read(faster, other, older)
        assert changed.sum() >= seen and (changed <= mask[j]).all()


def test_an_agent_on_its_own_does_not_see_the_others():
    mask = np.array([[1, 1, 0, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 0, 1]], dtype=np.float32)
    config = replace(TrainConfig(), method="rlms", hidden=(6,), copies=1, learner="plain", risk_gamma=0.0, push_every=5)
    learner = RLMS(config, N, A, np.ones(S), generator(), mask)
    rng = np.random.default_rng(0)
    for _ in range(20):
        states = rng.normal(size=(N, 8, S)).astype(np.float32)
        reward, none = rng.normal(size=(8, N)).astype(np.float32), np.ones((8, N), np.float32)
        learner.update(Batch(states, rng.integers(A, size=(8, N)), reward, 0.9 * none, states, none, none), 5e-3)
    states = rng.normal(size=(4, S)).astype(np.float32)
    exported = learner.network.weights[0].detach().numpy()
    assert (exported[mask == 0] == 0).all() and (exported[mask == 1] != 0).all()
    before, past = learner.values(states), learner.targets.heads(torch.from_numpy(states))[0]
    for i in range(N):
        other = np.where(mask[i] == 1, states, 5.0).astype(np.float32)
        assert (learner.values(other)[:, i] == before[:, i]).all()
        assert torch.equal(learner.targets.heads(torch.from_numpy(other))[0][i], past[i])
        assert (learner.values(np.where(mask[i] == 0, states, 5.0))[:, i] != before[:, i]).all()


def test_action_sets():
    scenario = paper()
    names = {kind: [scenario.orders.names[k] for k in order_of(scenario, kind)] for kind in ACTIONS}
    assert names["orders"] == list(scenario.orders.names) and len(names["commands"]) == 4
    assert names["avoidance"] == ["FM>OA>FR", "OA>FM>FR"]
    with pytest.raises(ConfigurationError, match="all, choose|avoidance"):
        order_of(scenario, "all")


def test_avoidance_keeps_to_its_commands_in_every_start():
    batch = FormationBatch(paper(), worlds=64, interval=10, actions="avoidance", starts=Starts(1.0, 5.0))
    batch.reset(3)
    allowed = {batch.scenario.orders.commands.index(name) for name in ("FM", "OA>FM")}
    state = batch.world.state
    assert set(np.unique(state.command)) == allowed
    commands = batch.scenario.orders.command_of[batch.order_of]
    assert (commands[batch.last] == state.command).all()
    outcome = batch.step(batch.last)
    assert not outcome.switches.any()


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.99), st.floats(0, 1))
@settings(max_examples=30)
def test_advantages_against_a_plain_loop(seed, gamma, trace):
    """An advantage is the sum of (gamma lambda)^k d_k until the agent is done or the episode ends."""
    rng = np.random.default_rng(seed)
    rows, worlds = 7, 2
    reward, value, ahead = (rng.normal(size=(rows, worlds, N)) for _ in range(3))
    over, ended = rng.random((rows, worlds, N)) < 0.2, rng.random((rows, worlds)) < 0.2
    found = advantages(reward, value, ahead, over, ended, gamma, trace)
    for t in range(rows):
        for b in range(worlds):
            for i in range(N):
                total, factor = 0.0, 1.0
                for k in range(t, rows):
                    future = 0.0 if over[k, b, i] else ahead[k, b, i]
                    total += factor * (reward[k, b, i] + gamma * future - value[k, b, i])
                    factor *= gamma * trace
                    if over[k, b, i] or ended[k, b]:
                        break
                assert found[t, b, i] == pytest.approx(total, abs=1e-9)


def test_the_clip_by_hand():
    """Ratios 2, 0.5 and 1.1 with advantages of both signs: outside the clip range, only a way back has a gradient."""
    ratio = torch.tensor([[2.0, 2.0, 0.5, 0.5, 1.1]], dtype=torch.float64, requires_grad=True)
    gain = torch.tensor([[1.0, -1.0, 1.0, -1.0, 3.0]], dtype=torch.float64)
    loss = clipped_loss(ratio.log(), torch.zeros(1, 5, dtype=torch.float64), gain, 0.2)
    assert torch.allclose(loss, torch.tensor([[-1.2, 2.0, -0.5, 0.8, -3.3]], dtype=torch.float64))
    loss.sum().backward()
    assert torch.allclose(ratio.grad, torch.tensor([[0.0, 1.0, -1.0, 0.0, -3.0]], dtype=torch.float64))


def test_log_probabilities_and_entropy():
    logits = torch.log(torch.tensor([[[0.5, 0.25, 0.25]], [[0.1, 0.1, 0.8]]]))
    chosen, entropy = log_probability(logits + 3.0, torch.tensor([[1], [2]]))
    assert np.allclose(chosen, np.log([[0.25], [0.8]]))
    assert np.allclose(entropy, [[1.5 * np.log(2)], [-0.2 * np.log(0.1) - 0.8 * np.log(0.8)]])


def test_returns_are_normalised_and_back():
    scale, rng = ValueScale(2), np.random.default_rng(0)
    values = rng.normal(size=(5, 2))
    assert (scale.undo(values) == values).all()  # nothing is known yet
    returns = rng.normal([3.0, -50.0], [2.0, 9.0], size=(4, 5000, 2))
    for part in returns:
        scale.take(part)
    found = scale(returns.reshape(-1, 2))
    assert np.allclose(found.mean(axis=0), 0.0, atol=1e-3) and np.allclose(found.std(axis=0), 1.0, atol=1e-3)
    assert np.allclose(scale.undo(scale(values)), values)


def test_mappo_learns_the_rewarded_action():
    """After rollouts in which only action 2 is rewarded, actors prefer it in over 95 % of the states."""
    trainer = MAPPO(small("mappo", ppo=PPO(rollout=8, epochs=3, minibatches=2)))
    rng = np.random.default_rng(0)
    for _ in range(12):
        trainer.rows["state"][:] = rng.normal(size=trainer.rows["state"].shape)
        trainer.rows["action"][:] = rng.integers(4, size=trainer.rows["action"].shape)
        trainer.rows["reward"][:] = trainer.rows["action"] == 2
        trainer.rows["over"][:] = True
        trainer._learn(5e-3)
    values = trainer.policy().values(rng.normal(size=(200, trainer.batch.read.size)))
    assert (values.argmax(axis=-1) == 2).mean() > 0.95
    assert trainer.policy().dueling is False and trainer.policy().margin == 0.0
    assert trainer.updates == 72 and 0.0 < trainer.temperature < 0.9


SMALL = {
    "worlds": 128, "interval": 2, "hidden": (16,), "batch": 32, "updates": 1, "capacity": 7_000, "threads": 1,
    "start_length": 2.0, "hash": "plain",
}  # fmt: skip


def small(method, **changes):
    own = METHODS[method][0]
    base = {**SMALL, "budget": 20_000, "evaluate_every": 20_000, **own, "method": method}
    return make_config("fast", **{**base, **changes})


def equal(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


@pytest.mark.usefixtures("quick_warm_up")
@pytest.mark.parametrize("method", ["vdn", "qmix", "central", "rlms", "mappo"])
def test_every_rival_goes_on_bit_for_bit(method):
    config = small(method, worlds=32, capacity=1_750, ppo=PPO(rollout=6, epochs=2))
    one = make_trainer(config)
    for _ in range(45):  # past the warm-up; inside a rollout
        one.advance()
    arrays, scalars = one.snapshot()
    arrays, scalars = {name: array.copy() for name, array in arrays.items()}, json.loads(json.dumps(scalars))
    other = make_trainer(replace(config, seed=5))
    other.restore(arrays, scalars)
    for _ in range(14):
        a, b = one.advance(), other.advance()
        assert (a.state == b.state).all() and (a.reward == b.reward).all()
    assert one.error == other.error != 0.0 and one.updates == other.updates > 0 and one.temperature == other.temperature
    assert equal(*(trainer.snapshot()[0] for trainer in (one, other)))


@pytest.mark.slow
@pytest.mark.parametrize(("method", "state"), [("rlms", "published"), ("central", "extended"), ("mappo", "extended")])
def test_a_checkpoint_of_a_rival_gives_the_evaluated_episode(method, state, tmp_path):
    """The checkpoint loads as a supervisor; an interrupted and resumed run ends with the same networks, to the last bit."""
    config = small(method, state=state, budget=12_800, ppo=PPO(rollout=4, epochs=1))

    def interrupt(trainer, row):
        if trainer.updates > 3:
            os.kill(os.getpid(), signal.SIGTERM)

    rows = train(config, tmp_path / "run")
    stopped = train(config, tmp_path / "stopped", progress=interrupt)
    assert stopped == Interrupted(signal.SIGTERM)
    saved = read_arrays(tmp_path / "stopped" / RESUME)[1]["scalars"]
    assert saved["updates"] > 3 and saved["steps"] < 12_800
    resumed = resume(tmp_path / "stopped")
    assert [{**row, "wall_s": 0.0} for row in rows] == [{**row, "wall_s": 0.0} for row in resumed]
    assert equal(*(read_arrays(tmp_path / name / RESUME)[0] for name in ("run", "stopped")))
    learned = Learned.load(tmp_path / "run" / "checkpoint" / "last.safetensors")
    scenario = paper()
    chosen = set(learned.start(scenario, 1).order_of.tolist())
    assert chosen == set(order_of(scenario, "avoidance" if method == "rlms" else "commands").tolist())
    assert learned.policy.weights[0].shape[0] == (1 if method == "central" else 4)
    outputs = learned.policy.weights[-1].shape[2] - learned.policy.dueling
    assert outputs == {"rlms": 2, "central": 256, "mappo": 4}[method]
    if method == "rlms":
        unseen = own_entries(make_state(state, scenario), 4) == 0
        assert (learned.policy.weights[0][unseen] == 0).all()


def test_every_method_has_a_learner_and_a_configuration():
    assert set(METHODS) == {*LEARNERS, "mappo"}
    for method, (changes, line) in METHODS.items():
        config = make_config("fast", **{**changes, "method": method})
        assert line and from_json(plain_data(config)) == config
        assert replace(config, preset="paper").rows > config.n_step
    old = plain_data(TrainConfig())
    del old["ppo"]
    assert from_json(old) == TrainConfig()
    assert all(issubclass(kind, Learner) for kind in LEARNERS.values())


@pytest.mark.parametrize(
    ("make", "fragments"),
    [
        (lambda: make_config("fast", method="vdn"), ["vdn", "lenient"]),
        (lambda: PPO(rollout=0), ["ppo.rollout", "0"]),
        (lambda: PPO(clip=1.5), ["ppo.clip", "1.5"]),
        (lambda: learner_class("dqn"), ["dqn", "marlms", "qmix"]),
        (lambda: make_trainer(replace(TrainConfig(), method="dqn", threads=1)), ["dqn", "marlms"]),
    ],
)
def test_wrong_settings_are_named(make, fragments):
    with pytest.raises(ConfigurationError) as error:
        make()
    assert all(fragment in str(error.value) for fragment in fragments)
