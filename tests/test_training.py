"""Parts of MARLMS compared with hand arithmetic and closed forms."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.policies.greedy import RISK_SLACK, Policy, admissible, greedy
from marlbc_mj.tasks.batch import DecisionOutcome
from marlbc_mj.training import trainer as trainer_module
from marlbc_mj.training.codes import StateHash
from marlbc_mj.training.config import PRESETS, TrainConfig, from_json, make_config
from marlbc_mj.training.exploration import Exploration, shares
from marlbc_mj.training.learner import HYSTERESIS, LARGEST_GRADIENT, Learner, clip_each, td_weight
from marlbc_mj.training.leniency import DECAY, KAPPA, RHO, Temperatures, leniency
from marlbc_mj.training.methods import METHODS
from marlbc_mj.training.networks import NetworkSize, TargetRing, TeamNetwork
from marlbc_mj.training.replay import Batch, Replay
from marlbc_mj.training.rivals import RLMS, VDN
from marlbc_mj.training.shaping import Shaping, lost, shaped_reward
from marlbc_mj.training.trainer import Trainer
from marlbc_mj.util.errors import ConfigurationError

N, S, A = 3, 5, 4


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def network(dueling=True, seed=0, risk=False):
    return TeamNetwork(
        NetworkSize(N, S, A, (6, 7)), torch.arange(1.0, S + 1), dueling=dueling, risk=risk, generator=generator(seed)
    )


def one_agent(net, agent, state):
    """The values of one agent's network, computed layer by layer."""
    x = state / np.arange(1.0, S + 1)
    weights = [w.detach().numpy()[agent] for w in net.weights]
    biases = [b.detach().numpy()[agent, 0] for b in net.biases]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = np.maximum(x @ weight + bias, 0.0)
    y = x @ weights[-1] + biases[-1]
    return y[0] + y[1:] - y[1:].mean() if net.dueling else y


@pytest.mark.parametrize("dueling", [True, False])
def test_the_stack_is_one_network_an_agent(dueling):
    net, states = network(dueling), np.random.default_rng(0).normal(size=(8, S)).astype(np.float32)
    values = net(torch.from_numpy(states)).detach().numpy()
    expected = [[one_agent(net, i, state) for state in states] for i in range(N)]
    assert np.allclose(values, expected, atol=1e-6)


def test_the_mean_of_a_dueling_network_is_its_value():
    net = network()
    x = torch.randn(4, S, generator=generator(1))
    hidden = x / net.scale
    values = net(x)
    for i in range(N):
        y = hidden
        for weight, bias in zip(net.weights[:-1], net.biases[:-1], strict=True):
            y = torch.relu(y @ weight[i] + bias[i])
        value = (y @ net.weights[-1][i] + net.biases[-1][i])[:, 0]
        assert torch.allclose(values[i].mean(dim=-1), value, atol=1e-6)


def test_averaged_targets_are_the_mean_over_the_last_copies():
    net, x = network(), torch.randn(6, S, generator=generator(2))
    ring = TargetRing(net, 3)
    assert torch.allclose(ring.heads(x)[0], net(x), atol=1e-6)
    past = [net(x).detach()] * 3
    for k in range(5):
        with torch.no_grad():
            for p in net.parameters():
                p.add_(0.1 * torch.randn(p.shape, generator=generator(10 + k)))
        ring.push()
        past = [*past[1:], net(x).detach()]
        assert torch.allclose(ring.heads(x)[0], torch.stack(past).mean(dim=0), atol=1e-5)


def test_a_policy_equals_the_network():
    for dueling in (True, False):
        net = network(dueling)
        states = np.random.default_rng(1).normal(size=(9, S)).astype(np.float32)
        arrays = [tuple(p.detach().numpy() for p in ps) for ps in (net.weights, net.biases)]
        policy = Policy(*arrays, scale=np.arange(1.0, S + 1, dtype=np.float32), dueling=dueling, margin=0.0)
        expected = net(torch.from_numpy(states)).detach().numpy().transpose(1, 0, 2)
        assert np.allclose(policy.values(states), expected, atol=1e-6)
        mixed = policy._replace(weights=(np.asfortranarray(policy.weights[0]), *policy.weights[1:]))
        mixed.weights[1].flags.writeable = False
        assert (mixed.values(states[:, ::-1][:, ::-1]) == policy.values(states)).all()
        risky = network(dueling, risk=True)
        risky.biases[-1].data += torch.randn(risky.biases[-1].shape, generator=generator(4))  # risks apart from 1/2
        arrays = [tuple(p.detach().numpy() for p in ps) for ps in (risky.weights, risky.biases)]
        policy = Policy(*arrays, scale=policy.scale, dueling=dueling, margin=0.0, risk=0.45)
        q, logits = (x.detach().numpy().transpose(1, 0, 2) for x in risky.heads(torch.from_numpy(states)))
        risks = 1 / (1 + np.exp(-logits))
        allowed = (risks <= 0.45) | (risks <= risks.min(axis=-1, keepdims=True) + 0.05)
        values = policy.values(states)
        assert 0 < allowed.mean() < 1
        assert np.allclose(values[allowed], q[allowed], atol=1e-6) and np.isneginf(values[~allowed]).all()


@given(st.integers(0, 2**32 - 1), st.floats(0, 2))
def test_greedy_leaves_an_order_only_for_a_lead_above_the_margin(seed, margin):
    rng = np.random.default_rng(seed)
    values, last, fresh = rng.normal(size=(6, N, A)), rng.integers(A, size=(6, N)), rng.random(6) < 0.5
    chosen = greedy(values, last, fresh, margin)
    for b in range(6):
        for i in range(N):
            best = int(values[b, i].argmax())
            leads = values[b, i, best] - values[b, i, last[b, i]] > margin
            assert chosen[b, i] == (best if leads or fresh[b] else last[b, i])


def test_a_last_action_that_is_none_is_refused():
    """Every entry is checked, since compiled code would read beyond the values."""
    values, fresh = np.zeros((2, N, A)), np.zeros(2, dtype=bool)
    for wrong in (-1, A):
        last = np.zeros((2, N), dtype=np.int64)
        last[1, N - 1] = wrong
        with pytest.raises(IndexError, match="last action"):
            greedy(values, last, fresh, 0.1)


def test_networks_have_a_hidden_layer():
    with pytest.raises(ConfigurationError, match="hidden"):
        TeamNetwork(NetworkSize(N, S, A, ()), torch.ones(S))


def test_leniency_is_the_published_formula():
    t = np.array([0.0, 0.05, 0.5, 1.0])
    assert np.allclose(leniency(t), 1.0 - np.exp(-KAPPA * t))


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, A - 1), st.integers(0, A - 1)), min_size=1, max_size=12))
def test_temperatures_cool_backwards_from_the_end(path):
    """Every visit multiplies by exp(rho d^m), m counted from the last decision; nothing exceeds nu."""
    codes = np.array([[c] for c, _, _ in path])
    actions = np.array([[[a, b]] for _, a, b in path])
    tables = Temperatures(2, 4, A)
    tables.nu = 0.8
    tables.cool(codes, actions, 0, 0, len(path) - 1)
    expected = {}
    for m, (code, *orders) in enumerate(reversed(path)):
        for agent, order in enumerate(orders):
            key = agent, code, order
            expected[key] = min(np.exp(RHO * DECAY**m) * expected.get(key, 0.8), 0.8)
    for (agent, code, order), value in expected.items():
        assert tables.read(np.array([code]))[0, agent, order] == pytest.approx(value, rel=1e-5)
    tables.nu = 0.1
    unseen = np.isinf(tables.table).transpose(1, 0, 2)
    assert (tables.read(np.arange(4))[unseen] == np.float32(0.1)).all()


@given(st.integers(0, 2**31 - 1), st.integers(1, 6), st.integers(0, 20))
def test_cooling_reads_the_ring_where_it_wraps(seed, length, first):
    """An episode in a ring of 6 rows, wherever it begins, gives the same temperatures as one that does not wrap."""
    rng = np.random.default_rng(seed)
    codes, actions = rng.integers(3, size=(length, 2)), rng.integers(A, size=(length, 2, N))
    ring_codes, ring_actions = rng.integers(3, size=(6, 2)), rng.integers(A, size=(6, 2, N))
    for k in range(length):
        ring_codes[(first + k) % 6], ring_actions[(first + k) % 6] = codes[k], actions[k]
    plain, ring = Temperatures(N, 3, A), Temperatures(N, 3, A)
    plain.nu = ring.nu = 0.7
    plain.cool(codes, actions, 1, 0, length - 1)
    ring.cool(ring_codes, ring_actions, 1, first, first + length - 1)
    assert (plain.table == ring.table).all() and np.isfinite(plain.table).any()


def test_the_leniency_that_is_stored_is_that_of_the_action_before_it_cooled(monkeypatch):
    """This includes decisions that end their episode, so that the temperature falls at once."""
    config = make_config(
        "fast", worlds=100, interval=2, hidden=(4,), batch=8, updates=1, capacity=10_000, threads=1, exploring_starts=1.0,
        start_length=0.5, hash="plain", bits=4,
    )  # fmt: skip
    monkeypatch.setattr(trainer_module, "WARM_UP", 2_000)  # transitions: 20 decisions of 100 teams
    trainer, cooled = Trainer(config), 0
    for _ in range(32):
        table, row = trainer.temperatures.table.copy(), trainer.replay.count % trainer.replay.rows
        outcome = trainer.advance()
        code, action, found = (trainer.replay.arrays[name][row] for name in ("code", "action", "leniency"))
        for i in range(4):
            t = table[i, code, action[:, i]]
            t = np.where(np.isinf(t), np.float32(trainer.temperatures.nu), t)
            assert np.allclose(found[:, i], 1.0 - np.exp(-KAPPA * t), rtol=1e-5)
            later = trainer.temperatures.table[i, code, action[:, i]]
            cooled += int((outcome.ended & (later < t)).sum())
    assert cooled > 100 and len(np.unique(found)) > 3


def test_a_positive_error_always_counts_and_a_negative_one_with_probability_1_minus_l():
    draws = 20_000
    error = torch.cat([torch.full((draws,), -1.0), torch.full((draws,), 1.0)])[None]
    for lenience in (0.0, 0.3, 1.0):
        weight = td_weight(error, torch.full_like(error, lenience), "lenient", generator())
        assert (weight[0, draws:] == 1).all()
        assert weight[0, :draws].mean().item() == pytest.approx(1.0 - lenience, abs=0.02)
    assert set(td_weight(error, error, "hysteretic", generator()).unique().tolist()) == {HYSTERESIS, 1.0}
    assert (td_weight(error, error, "plain", generator()) == 1).all()


@given(st.integers(1, 4), st.lists(st.sampled_from(["go", "cut", "over"]), min_size=8, max_size=14), st.integers(5, 9))
def test_n_step_returns_stop_where_an_episode_ends(steps, ends, rows):
    """They equal those of a plain loop over one world, with rewards that identify their row."""
    replay, gamma = Replay(rows, 1, 1, 1), 0.5
    for k, end in enumerate(ends):
        replay.store(
            state=np.array([[k]]), final=np.array([[k + 1]]), action=np.array([[k]]), reward=np.array([[2.0**k]]),
            leniency=np.array([[0.1 * k]]), code=np.array([0]), ended=np.array([end != "go"]),
            terminal=np.array([[end == "over"]]), lost=np.array([[False]]),
        )  # fmt: skip
    batch = replay.sample(200, steps, gamma, np.random.default_rng(0))
    first = batch.state[:, 0].astype(int)
    assert first.min() >= max(0, len(ends) - rows) and first.max() == len(ends) - steps
    for m, start in enumerate(first):
        total, discount, k = 0.0, 1.0, start
        for k in range(start, start + steps):  # the row the loop stops at is needed
            total += discount * 2.0**k
            discount *= gamma
            if ends[k] != "go":
                break
        assert batch.reward[m, 0] == pytest.approx(total, rel=1e-5)
        assert batch.discount[m, 0] == pytest.approx(0.0 if ends[k] == "over" else discount)
        assert batch.next_state[m, 0] == k + 1
        assert batch.action[m, 0] == start and batch.leniency[m, 0] == np.float32(0.1 * start)


@pytest.mark.parametrize("huber", [1.0, 0.25, np.inf])
def test_one_update_by_hand(huber):
    """Target r + gamma^n max of the averaged network, Huber slope, weight 0 for a negative error at L = 1."""
    config = replace(TrainConfig(), hidden=(6,), copies=2, capacity=4000, risk_gamma=0.0, huber=huber)
    learner = Learner(config, 2, A, np.ones(S), generator())
    rng = np.random.default_rng(0)
    state, after = (rng.normal(size=(2, S)).astype(np.float32) for _ in range(2))
    action = np.array([[0, 1], [2, 3]])
    reward = np.array([[0.5, -90.0], [0.25, 0.75]], dtype=np.float32)  # the second agent's first error is negative
    discount = np.array([[0.9, 0.9], [0.0, 0.9]], dtype=np.float32)  # over for the first agent of the second transition
    batch = Batch(state, action, reward, discount, after, np.ones((2, 2), np.float32))
    q = learner.network(torch.from_numpy(state))
    ahead = learner.targets.heads(torch.from_numpy(after))[0].amax(dim=-1)
    target = torch.from_numpy(reward.T) + torch.from_numpy(discount.T) * ahead
    chosen = torch.stack([torch.stack([q[i, m, action[m, i]] for m in range(2)]) for i in range(2)])
    error = (target - chosen).detach()
    slope = -torch.where(error > 0, error.clamp(-huber, huber), torch.zeros(())) / 2  # mean over the batch
    expected = torch.autograd.grad(chosen, list(learner.network.parameters()), slope)
    reported = learner.update(batch, 0.0)
    assert reported == pytest.approx(error.abs().mean().item(), rel=1e-5)
    for p, gradient in zip(learner.network.parameters(), expected, strict=True):
        assert torch.allclose(p.grad, gradient, atol=1e-6)


def gradients(net):
    """(N, P) gradients, one network per row."""
    return torch.cat([p.grad.flatten(start_dim=1) for p in net.parameters()], dim=1)


@pytest.mark.parametrize("kind", [Learner, RLMS, VDN])
def test_a_large_error_shortens_the_steps_of_its_own_network_only(kind):
    """Gradients are clipped for each agent separately if agents learn apart, together if one loss trains them."""

    def step(reward):
        config = replace(TrainConfig(), hidden=(6,), copies=2, learner="plain", risk_gamma=0.0)
        learner = kind(config, 2, A, np.ones(S), generator())
        rng = np.random.default_rng(0)
        shape = (2, 8, S) if kind is RLMS else (8, S)
        state = (100.0 * rng.normal(size=shape)).astype(np.float32)  # so that gradients are large
        state[..., 0, :] *= 10.0
        reward, none = np.tile(np.float32(reward), (8, 1)), np.zeros((8, 2), np.float32)
        learner.update(Batch(state, rng.integers(A, size=(8, 2)), reward, none, state, none), 1e-3)
        return gradients(learner.network)

    calm, wild = step([0.0, 0.0]), step([0.0, 1e6])
    assert wild[1].norm() > 9.9 or kind is VDN
    if kind is VDN:
        assert wild.norm() == pytest.approx(LARGEST_GRADIENT, rel=1e-4)
    else:
        assert torch.equal(calm[0], wild[0]) and (wild.norm(dim=1) <= LARGEST_GRADIENT * (1 + 1e-4)).all()


@given(st.integers(0, 2**31 - 1), st.floats(0.01, 100.0))
def test_clipping_keeps_each_direction_and_bounds_each_norm(seed, size):
    net = network()
    for p in net.parameters():
        p.grad = size * torch.randn(p.shape, generator=generator(seed)) * torch.tensor([1e-3, 1.0, 10.0])[:, None, None]
    before = gradients(net)
    clip_each(net.parameters(), 5.0)
    norms = before.norm(dim=1)
    assert torch.allclose(gradients(net), before * (5.0 / norms).clamp(max=1.0)[:, None], rtol=1e-5)


@pytest.mark.slow
def test_risks_are_the_discounted_chance_that_loss_is_unavoidable():
    """In a corridor of three states with two orders, the first order leads from the last state to loss, which is final."""
    config = replace(TrainConfig(), hidden=(32,), copies=2, push_every=10, capacity=4000, learner="plain", risk_gamma=0.5)
    learner = Learner(config, 2, 2, np.ones(4), generator())
    rng, eye = np.random.default_rng(0), np.eye(4, dtype=np.float32)
    for _ in range(1500):
        state, action = rng.integers(4, size=64), rng.integers(2, size=(64, 1))
        action = np.repeat(action, 2, axis=1)
        after = np.where((state == 3) | ((state == 2) & (action[:, 0] == 0)), 3, np.minimum(state + (action[:, 0] == 0), 2))
        gone = np.repeat((after == 3)[:, None], 2, axis=1)
        none = np.zeros((64, 2), np.float32)
        learner.update(Batch(eye[state], action, none, none + 0.9, eye[after], none, lost=gone), 1e-2)
    _, logits = learner.network.heads(torch.from_numpy(eye))
    expected = [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
    assert np.allclose(torch.sigmoid(logits).detach().numpy(), [expected] * 2, atol=0.05)
    values = learner.values(eye)
    assert np.isneginf(values[2, :, 0]).all() and np.isfinite(values[[0, 1, 3]]).all() and np.isfinite(values[2, :, 1]).all()


@given(st.lists(st.floats(0, 1), min_size=2, max_size=6), st.floats(0, 1))
def test_some_order_is_always_admissible(risks, limit):
    allowed = admissible(np.array(risks), np.array([min(risks)]), limit)
    assert allowed[np.argmin(risks)]
    assert allowed.tolist() == [r <= limit or r <= min(risks) + RISK_SLACK for r in risks]
    both = (torch.tensor(x, dtype=torch.float64) for x in (risks, [min(risks)]))
    assert (admissible(*both, limit).numpy() == allowed).all()


def test_the_policy_is_the_running_mean_of_the_weights():
    config = replace(TrainConfig(), hidden=(6,), copies=2, capacity=4000, risk_gamma=0.0, smoothing=0.9)
    learner = Learner(config, 2, A, np.ones(S), generator())
    rng, mean = np.random.default_rng(0), None
    for k in range(1, 30):
        state = rng.normal(size=(8, S)).astype(np.float32)
        action, reward = rng.integers(A, size=(8, 2)), rng.normal(size=(8, 2)).astype(np.float32)
        learner.update(Batch(state, action, reward, 0 * reward, state, 0 * reward), 1e-2)
        weight = learner.network.weights[0].detach().numpy().astype(float)
        mean = weight if mean is None else mean + max(0.1, 1 / k) * (weight - mean)
    assert np.allclose(learner.smooth.weights[0].detach().numpy(), mean, atol=1e-5)


def test_updates_learn_a_bandit():
    """Two agents get reward 1 for one order each, and the values converge to it."""
    config = replace(TrainConfig(), hidden=(16,), copies=2, capacity=4000, learner="plain", risk_gamma=0.0)
    learner = Learner(config, 2, A, np.ones(S), generator())
    rng = np.random.default_rng(0)
    for _ in range(300):
        state, action = np.zeros((64, S), np.float32), rng.integers(A, size=(64, 2))
        reward = (action == np.array([1, 3])).astype(np.float32)
        learner.update(Batch(state, action, reward, np.zeros((64, 2), np.float32), state, np.zeros((64, 2), np.float32)), 1e-2)
    assert np.allclose(learner.values(np.zeros((1, S)))[0], np.eye(A)[[1, 3]], atol=0.05)


def test_exploration_follows_the_temperature():
    config = replace(TrainConfig(), worlds=4000, hold=1, together=0.0, least_exploration=0.0, capacity=40_000)
    rng, best = np.random.default_rng(0), np.full((4000, N), 9)
    for temperature in (0.0, 0.3, 1.0):
        explore = Exploration(config, N, A)
        chosen = explore(best, np.full(best.shape, temperature), rng)
        assert (chosen != 9).mean() == pytest.approx(temperature**0.999, abs=0.02)
        assert set(np.unique(chosen)) <= {0, 1, 2, 3, 9}


@pytest.mark.parametrize("temperature", [[0.03] * N, [0.5] * N, [1.0] * N, [0.1, 0.6, 0.9]])
@pytest.mark.parametrize(("hold", "together"), [(1, 0.0), (1, 0.5), (6, 0.0), (6, 0.5), (3, 1.0)])
def test_the_share_of_random_orders_is_the_temperature(hold, together, temperature):
    """This holds for every decision of an episode, from the first, and for each agent, whatever is held and shared."""
    worlds, decisions = 3000, 14
    config = replace(TrainConfig(), worlds=worlds, hold=hold, together=together, least_exploration=0.0, capacity=30_000)
    explore, rng, best = Exploration(config, N, A), np.random.default_rng(3), np.full((worlds, N), 9)
    explore(best, np.ones(best.shape), rng)
    explore.forget(np.ones(worlds, dtype=bool))
    found = np.array([explore(best, np.tile(temperature, (worlds, 1)), rng) for _ in range(decisions)]) != 9
    share = np.array(temperature) ** 0.999
    error = np.sqrt(share * (1 - share) / worlds)
    assert (abs(found.mean(axis=1) - share) <= 4.5 * error + 1e-9).all()
    assert (abs(found.mean(axis=(0, 1)) - share) <= 4.5 * error * np.sqrt(min(hold, decisions) / decisions) + 1e-9).all()


@given(st.lists(st.floats(0, 1), min_size=N, max_size=N), st.floats(0, 1))
def test_joint_and_own_shares_make_up_the_whole(share, together):
    joint, alone = shares(np.array([share]), together)
    taking = joint[0]
    assert 0 <= joint[0] <= 1 and (alone >= 0).all() and (alone <= 1).all()
    assert np.allclose(taking + (1 - taking) * alone, share, atol=1e-9)
    if max(share) == min(share) and joint[0] < 1:
        assert taking == pytest.approx(together * share[0])


def test_of_equal_agents_explorations_the_share_together_is_joint():
    """A share ``together`` of an agent's random orders is common to the team."""
    best, rng = np.full((3000, N), 9), np.random.default_rng(0)
    for together in (0.5, 0.3):
        config = replace(TrainConfig(), worlds=3000, hold=4, together=together, capacity=30_000)
        explore = Exploration(config, N, 10_000)
        explored = joint = 0
        for _ in range(20):
            chosen = explore(best, np.full(best.shape, 0.4), rng)
            mine = chosen[:, 0] != 9
            explored += mine.sum()
            joint += (mine & (chosen[:, :1] == chosen[:, 1:]).any(axis=1)).sum()
        assert joint / explored == pytest.approx(together, abs=0.02)


def test_held_orders_last_and_are_shared():
    config = replace(TrainConfig(), worlds=500, hold=6, together=1.0, least_exploration=0.0, capacity=40_000)
    explore, rng, best = Exploration(config, N, A), np.random.default_rng(0), np.full((500, N), 9)
    rows = [explore(best, np.ones(best.shape), rng)]
    assert (rows[0] == rows[0][:, :1]).all() and (rows[0] != 9).all()
    cold = np.zeros(best.shape)
    rows += [explore(best, cold, rng) for _ in range(7)]
    lengths = (np.array(rows)[:, :, 0] != 9).sum(axis=0)
    assert set(np.unique(lengths)) == {1, 2, 3, 4, 5, 6}
    for b, length in enumerate(lengths):
        held = np.array(rows)[:length, b, 0]
        assert (held == held[0]).all()
    explore(best, np.ones(best.shape), rng)
    explore.forget(np.ones(500, dtype=bool))
    assert (explore(best, cold, rng) == 9).all()


def quiet(**changes):
    """A configuration without exploration except for ``changes``."""
    return replace(TrainConfig(), worlds=400, together=0.0, agreement=0.0, least_exploration=0.0, capacity=40_000, **changes)


def test_a_team_begins_as_it_is_told_and_endangers_nobody():
    explore, rng, best = Exploration(quiet(hold=3), N, A), np.random.default_rng(0), np.full((400, N), 9)
    told = np.where(np.arange(400) % 2, -1, 2)
    cold, allowed = np.zeros(best.shape), np.ones((400, N, A), dtype=bool)
    allowed[::4, 1, 2] = False
    explore.begin(told, rng)
    rows = np.array([explore(best, cold, rng, allowed=allowed) for _ in range(5)])
    assert (rows[:, 1::2] == 9).all() and (rows[:, ::4, 1] == 9).all()
    others = rows[:, ::2][:, :, [0, 2]]
    assert (others[0] == 2).all() and (others[4] == 9).all()
    lengths = (others == 2).sum(axis=0)
    assert set(np.unique(lengths)) == {1, 2, 3} and (lengths == lengths[:, :1]).all()


def test_a_torn_team_agrees_on_a_members_order():
    config = replace(quiet(), agreement=0.3)
    explore, rng, cold = Exploration(config, N, A), np.random.default_rng(0), np.zeros((400, N))
    last = np.tile([1, 1, 1], (400, 1))
    best = np.tile([1, 3, 1], (400, 1))
    chosen = np.concatenate([explore(best, cold, rng, last=last) for _ in range(30)])
    agreed = (chosen == chosen[:, :1]).all(axis=1)
    assert agreed.mean() == pytest.approx(0.3, abs=0.02) and (chosen[~agreed] == best[0]).all()
    assert (chosen[agreed, 0] == 3).mean() == pytest.approx(1 / 3, abs=0.03)
    allowed = np.ones((400, N, A), dtype=bool)
    allowed[:, 0, 3] = False
    chosen = np.concatenate([explore(best, cold, rng, last=last, allowed=allowed) for _ in range(30)])
    assert (chosen[:, 0] == 1).all() and (chosen[:, 1:] == 3).all(axis=1).any()
    for unmoved in (best, np.full_like(best, 3)):  # no agent wants to change; all agents want the same
        assert (explore(unmoved, cold, rng, last=best if unmoved is best else last) == unmoved).all()


@pytest.mark.parametrize("kind", ["autoencoder", "plain"])
def test_hash_codes(kind):
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(4000, 3)) @ rng.normal(size=(3, 20))
    states = (0.5 * factors).astype(np.float32)
    code = StateHash(20, 16, kind, rng)
    assert (code(states) == 0).all()
    error = code.fit(states, generator())
    if kind == "autoencoder":
        assert error < 0.25 * states.var()
    codes = code(states)
    assert codes.min() >= 0 and codes.max() < 1 << 16 and len(np.unique(codes)) > 100
    assert (code(states) == codes).all()
    near, far = code(states + 1e-4), code(states[rng.permutation(4000)])

    def bits(other):
        return np.mean([bin(int(x)).count("1") for x in codes ^ other])

    assert bits(near) < 0.2 < 2.0 < bits(far)


def outcome(**changes):
    b = 2
    fields = {
        "state": None, "final_state": None, "formation": np.array([40.0, 0.0]), "violation": np.array([0.0, -20.0]),
        "switching": np.array([-3.0, 0.0]), "switches": np.array([[True, False, True], [False] * 3]),
        "clearance": np.array([[3.0, 2.05, 9.0], [1.0, 5.0, 5.0]]),
        "age": np.array([[9.0, 9.0, 1.0], [1.0] * 3]), "steps": np.full(b, 4), "terminal": None, "truncated": None,
    }  # fmt: skip
    return DecisionOutcome(**{**fields, **changes})


def test_the_published_reward_is_unshaped():
    assert shaped_reward(outcome(), Shaping()).tolist() == [[37.0] * 3, [-20.0] * 3]
    assert lost(outcome(), Shaping(), 2.0).tolist() == [[False] * 3, [True, False, False]]


def test_shaped_reward_by_hand():
    shaping = Shaping(
        centre=10.0,
        scale=2.0,
        violation=0.5,
        margin=0.06,
        own_violation_cost=100.0,
        own_switch_cost=5.0,
        haste_cost=7.0,
        dwell=2.0,
    )
    expected = [[(37 - 40 - 5) / 2, (37 - 40) / 2, (37 - 40 - 5 - 7) / 2], [(-10 - 40) / 2] * 3]
    assert np.allclose(shaped_reward(outcome(), shaping), expected)
    assert lost(outcome(), shaping, 2.0).tolist() == [[False, True, False], [True, False, False]]


def test_what_an_agent_does_when_lost_is_its_own_business():
    """The others' returns continue past the decision in which one agent is lost; its own ends there, without a bootstrap."""
    replay = Replay(4, 1, 2, 1)
    for k in range(4):
        replay.store(
            state=np.array([[k]]), final=np.array([[k + 1]]), action=np.zeros((1, 2)), reward=np.array([[1.0, 1.0]]),
            leniency=np.zeros((1, 2)), code=np.zeros(1), ended=np.array([False]), terminal=np.array([[k == 1, False]]),
            lost=np.array([[k == 1, False]]),
        )  # fmt: skip
    batch = replay.sample(50, 3, 0.5, np.random.default_rng(0))
    for start, reward, discount in zip(batch.state[:, 0], batch.reward, batch.discount, strict=True):
        assert reward.tolist() == [[1.5, 1.75], [1.0, 1.75]][int(start)]
        assert discount.tolist() == [0.0, 0.125]


def test_presets_and_json():
    paper = make_config("paper")
    assert (paper.learning_rate, paper.capacity, paper.budget, paper.interval) == (1e-4, 50_000, 200_000_000, 1)
    assert (paper.state, paper.actions, paper.shaping) == ("published", "orders", Shaping())
    from marlbc_mj.util.provenance import plain_data

    config = make_config("fast", seed=4, hidden=(8, 9))
    assert from_json(plain_data(config)) == config
    assert paper.huber == np.inf and from_json(json.loads(json.dumps(plain_data(paper), allow_nan=False))) == paper


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_no_own_cost_is_worth_paying(method, preset):
    """The discounted cost of being out of formation forever, sum of gamma^k centre interval, is below that of being lost."""
    config = make_config(preset, **METHODS[method][0])
    if config.shaping.own_violation_cost:
        worst = sum(config.gamma**k * config.shaping.centre * config.interval for k in range(10_000))
        assert worst == pytest.approx(config.shaping.centre * config.interval / (1 - config.gamma))
        assert worst < config.shaping.own_violation_cost


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"budget": 0}, ["budget", "0"]),
        ({"gamma": 1.0}, ["gamma", "1.0"]),
        ({"state": "pixels"}, ["state", "pixels", "extended"]),
        ({"learner": "bold"}, ["learner", "bold", "lenient"]),
        ({"learning_rate": 0.0}, ["learning_rate", "0.0"]),
        ({"huber": 0.0}, ["huber", "0.0"]),
        ({"hidden": ()}, ["hidden"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"capacity": 128}, ["capacity", "128"]),
        ({"together": 2.0}, ["together", "2.0"]),
        ({"n_step": 3}, ["n_step", "3", "risk_gamma"]),
        ({"risk_limit": 0.0}, ["risk_limit", "0.0", "risk_gamma"]),
        ({"evaluate_every": 0}, ["evaluate_every", "0"]),
        ({"save_every": -1.0}, ["save_every", "-1.0"]),
        ({"updates": 0}, ["updates", "0"]),
        ({"updates": -1}, ["updates", "-1"]),
        ({"bits": 25}, ["bits", "24", "25"]),
        ({"method": "central", "learner": "plain"}, ["central", "risk_gamma", "0.8"]),
        ({"method": "rlms", "learner": "plain"}, ["rlms", "risk_gamma", "0.8"]),
        ({"method": "mappo", "learner": "plain"}, ["mappo", "risk_gamma", "0.8"]),
    ],
)
def test_wrong_settings_are_named(changes, fragments):
    with pytest.raises(ConfigurationError) as error:
        make_config("fast", **changes)
    assert all(fragment in str(error.value) for fragment in fragments)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_rewards_are_divided_by_something_positive(scale):
    with pytest.raises(ConfigurationError, match=f"shaping.scale must be positive, got {scale}"):
        Shaping(scale=scale)


@pytest.mark.parametrize("interval", [2000, 4000])
def test_a_decision_is_shorter_than_the_mission(interval):
    with pytest.raises(ConfigurationError, match=str(interval)) as error:
        Trainer(make_config("fast", interval=interval, worlds=2, threads=1))
    assert "\n" not in str(error.value)


def test_unknown_preset():
    with pytest.raises(ConfigurationError, match="fast, paper"):
        make_config("slow")


@pytest.mark.parametrize(("exploring_starts", "capacity", "rows"), [(0.0, 600, 100), (0.0, 360, 90), (0.5, 600, 84)])
def test_states_are_hashed_once_the_buffer_has_seen_the_mission(exploring_starts, capacity, rows, monkeypatch):
    """Hashing begins after a whole mission's decisions if all episodes begin at the start, else after the warm-up.

    Only decisions that have a code of their own cool a temperature.
    """
    config = make_config(
        "fast", worlds=4, interval=20, hidden=(4,), batch=8, updates=1, capacity=capacity, threads=1,
        exploring_starts=exploring_starts, start_length=20.0, hash="plain",
    )  # fmt: skip
    monkeypatch.setattr(trainer_module, "WARM_UP", 336)  # transitions: 84 decisions of 4 teams
    trainer = Trainer(config)
    for _ in range(rows):
        trainer.advance()
        assert not trainer.hash.fitted and np.isinf(trainer.temperatures.table).all()
    trainer.advance()
    assert trainer.hash.fitted
    for _ in range(125 - rows):
        trainer.advance()
    coded = set(zip(*(a.ravel().tolist() for a in np.nonzero(np.isfinite(trainer.temperatures.table))), strict=True))
    ring = np.arange(rows, trainer.replay.count) % trainer.replay.rows
    codes, actions = (trainer.replay.arrays[name][ring] for name in ("code", "action"))
    seen = {(i, int(c), int(a)) for i in range(4) for c, a in zip(codes.ravel(), actions[..., i].ravel(), strict=True)}
    assert coded <= seen and (coded or not exploring_starts)
