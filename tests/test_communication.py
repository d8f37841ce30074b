"""Properties of the communication layer over random graphs, losses, delays and silent agents."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.core.communication import IDEAL, Communication, components, within_range
from marlbc_mj.core.imperfections import uniform
from marlbc_mj.scenarios import load_scenario, make_scenario
from marlbc_mj.supervisors.communication import Consensus, Flooding, Layer, Radio, hearing, make_layer
from marlbc_mj.util.errors import ConfigurationError

STEP = 0.05
ROOM = 10.0  # side of the square that the agents are in [m]

teams = st.integers(2, 7).flatmap(
    lambda agents: st.lists(st.tuples(st.floats(0, ROOM), st.floats(0, ROOM)), min_size=agents, max_size=agents)
)
reaches = st.floats(1.0, 8.0)


def layer_of(agents: int, **settings) -> Layer:
    radio = Radio(Communication(**settings), agents, STEP)
    return Consensus(radio) if settings.get("protocol") == "consensus" else Flooding(radio)


def distances(link: np.ndarray) -> np.ndarray:
    """(N, N) number of hops between agents of a graph (N, N); infinite between components."""
    agents = len(link)
    hops = np.where(np.eye(agents, dtype=bool), 0.0, np.where(link, 1.0, np.inf))
    for k in range(agents):
        hops = np.minimum(hops, hops[:, k, None] + hops[None, k])
    return hops


def talk(layer, position, messages, seed=None, first: int = 0):
    """Exchange ``messages`` (T, B, N, M) at ``position`` (T, B, N, 2) for T mission steps; return all knowledge, and memory."""
    memory = layer.start(position.shape[1], messages.shape[3])
    known = []
    for k, (where, said) in enumerate(zip(position, messages, strict=True)):
        knowledge, memory = layer.exchange(np.full(len(where), (first + k) * STEP), where, said, memory, seed)
        known.append(knowledge)
    return known, memory


def wandering(rng, steps: int, worlds: int, agents: int, size: int = 2):
    """Random positions of moving agents, and random messages."""
    position = np.cumsum(rng.normal(0, 0.3, (steps, worlds, agents, 2)), axis=0) + rng.uniform(0, ROOM, (worlds, agents, 2))
    return position, rng.normal(size=(steps, worlds, agents, size))


# Flooding -----------------------------------------------------------------------------------------------------------------------


@given(teams, reaches, st.integers(1, 3), st.integers(0, 3))
def test_flooding_reaches_one_hop_further_with_every_period(points, reach, period, delay):
    """An entry from h hops away is as old as h hops take; in the end every agent knows all of its component."""
    place = np.array(points)
    agents = len(place)
    hops = distances(within_range(place[None], reach)[0])
    period = 1 if delay else period
    diameter = int(hops[np.isfinite(hops)].max())
    steps = max(1, diameter * max(period, delay)) + period
    layer = layer_of(agents, range=reach, period=period * STEP, delay=delay * STEP)
    position = np.broadcast_to(place, (steps, 1, agents, 2))
    said = np.arange(steps)[:, None, None, None] + 100.0 * np.arange(agents)[None, None, :, None]  # encodes time and sender
    for k, (heard, stamp) in enumerate(talk(layer, position, said)[0]):
        last = k - k % period  # the last broadcast
        sent = np.where(hops == 0, k, k - hops * delay if delay else last - (hops - 1) * period)
        expected = np.where(sent >= 0, sent * STEP, -np.inf)
        np.testing.assert_allclose(stamp[0], expected, atol=1e-9)
        known = np.isfinite(expected)
        np.testing.assert_array_equal(heard[0, ..., 0][known], (sent + 100.0 * np.arange(agents))[known])
        assert (heard[0, ~known] == 0.0).all()
    assert (np.isfinite(stamp[0]) == np.isfinite(hops)).all()


@given(st.integers(0, 2**31), st.integers(2, 6), reaches, st.integers(0, 3), st.floats(0, 0.9))
def test_stamps_never_go_backwards_and_are_those_of_what_is_heard(seed, agents, reach, delay, loss):
    """Checked while agents move, messages are lost and one agent falls silent."""
    layer = layer_of(agents, range=reach, delay=delay * STEP, loss=loss, silent=(0,), silent_from=0.4)
    position, said = wandering(np.random.default_rng(seed), 20, 1, agents)
    before = np.full((1, agents, agents), -np.inf)
    for k, (heard, stamp) in enumerate(talk(layer, position, said, np.array([seed]))[0]):
        assert (stamp >= before).all() and (stamp <= k * STEP + 1e-9).all()
        for i, j in np.argwhere(np.isfinite(stamp[0])):
            np.testing.assert_array_equal(heard[0, i, j], said[round(stamp[0, i, j] / STEP), 0, j])
        before = stamp


@given(st.integers(0, 2**31), st.integers(2, 6))
def test_ideal_is_the_limit_of_infinite_range_without_delay_and_loss(seed, agents):
    """Both are equal to the last bit while agents move: every agent knows the current message of every other."""
    position, said = wandering(np.random.default_rng(seed), 5, 2, agents)
    ideal, far = (talk(layer_of(agents, range=reach), position, said)[0] for reach in (np.inf, 1e9))
    for k, (one, other) in enumerate(zip(ideal, far, strict=True)):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(one.heard, np.repeat(said[k][:, None], agents, axis=1))
        assert (one.stamp == k * STEP).all()


@given(teams, reaches, st.sampled_from(["flooding", "consensus"]), st.floats(0, 0.5))
def test_components_never_hear_each_other(points, reach, protocol, loss):
    """An agent's knowledge does not depend on messages from other components."""
    place = np.array(points)
    agents = len(place)
    part = components(within_range(place[None], reach))[0]
    assert (part[:, None] == part)[within_range(place[None], reach)[0]].all() and (part <= np.arange(agents)).all()
    position, said = np.broadcast_to(place, (12, 1, agents, 2)), np.random.default_rng(0).normal(size=(12, 1, agents, 1))
    other = np.where(part[:, None] == 0, said, -7.0)
    layer = layer_of(agents, range=reach, protocol=protocol, loss=loss)
    for one, two in zip(talk(layer, position, said)[0], talk(layer, position, other)[0], strict=True):
        np.testing.assert_array_equal(one.heard[0, part == 0], two.heard[0, part == 0])
        if protocol == "flooding":
            assert not np.isfinite(one.stamp[0][part[:, None] != part]).any()


def test_a_silent_agent_hears_and_is_not_heard():
    """From ``silent_from`` on, the others keep its last message, whose age grows."""
    layer = layer_of(3, range=100.0, silent=(1,), silent_from=0.2)
    position = np.zeros((10, 1, 3, 2))
    known, memory = talk(layer, position, np.arange(30.0).reshape(10, 1, 3, 1))
    for k, (heard, stamp) in enumerate(known):
        assert stamp[0, 0, 1] == stamp[0, 2, 1] == pytest.approx(min(k, 3) * STEP)
        assert heard[0, 0, 1, 0] == 3 * min(k, 3) + 1
        assert (stamp[0, 1] == k * STEP).all()
    np.testing.assert_array_equal(memory.link[0], [[False, False, True], [True, False, True], [True, False, False]])


# Consensus ----------------------------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**31), st.integers(2, 6), reaches, st.integers(0, 3), st.floats(0, 0.9))
def test_consensus_conserves_the_sum_whatever_is_lost(seed, agents, reach, delay, loss):
    """Checked while agents move, messages change or are lost, and one agent falls silent."""
    layer = layer_of(agents, protocol="consensus", range=reach, delay=delay * STEP, loss=loss, silent=(0,), silent_from=0.4)
    position, said = wandering(np.random.default_rng(seed), 20, 1, agents)
    for (heard, _), now in zip(talk(layer, position, said, np.array([seed]))[0], said, strict=True):
        assert (heard == heard[:, :, :1]).all()
        np.testing.assert_allclose(heard[:, :, 0].sum(axis=1), now.sum(axis=1), atol=1e-9)


@given(teams, reaches, st.integers(0, 2), st.sampled_from([0.0, 0.3]))
def test_consensus_converges_to_the_mean_of_each_component(points, reach, delay, loss):
    place = np.array(points)
    agents = len(place)
    part = components(within_range(place[None], reach))[0]
    steps = 1200 * max(1, 2 * delay)
    layer, said = layer_of(agents, protocol="consensus", range=reach, delay=delay * STEP, loss=loss), place[None]
    memory = layer.start(1, 2)
    for k in range(steps):
        (heard, _), memory = layer.exchange(np.array([k * STEP]), place[None], said, memory)
        expected = np.array([place[part == own].mean(axis=0) for own in part])
        if np.abs(heard[0, :, 0] - expected).max() < 1e-3:
            return
    raise AssertionError(f"not within {steps} steps")


def test_a_round_of_consensus_is_metropolis_weights_by_hand():
    """Three agents in a row: degrees 1, 2, 1, so both weights are 1/3."""
    layer = layer_of(3, protocol="consensus", range=1.5)
    place, said = np.array([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]]), np.array([[[0.0], [3.0], [9.0]]])
    (heard, stamp), memory = layer.exchange(np.zeros(1), place, said, layer.start(1, 1))
    np.testing.assert_allclose(heard[0, :, 0, 0], [1.0, 4.0, 7.0])
    assert (stamp == 0.0).all()
    (heard, _), _ = layer.exchange(np.full(1, STEP), place, said + 1.0, memory)
    np.testing.assert_allclose(heard[0, :, 0, 0], [2.0 + 1.0, 5.0, 8.0 - 1.0])


# Both protocols -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["flooding", "consensus"])
def test_a_team_is_the_same_in_any_batch_and_when_it_begins_anew(protocol):
    """Losses depend only on the seed and the time, and a new episode forgets all knowledge; checked to the last bit."""
    layer = layer_of(4, protocol=protocol, range=6.0, delay=0.1, loss=0.4)
    position, said = wandering(np.random.default_rng(1), 15, 3, 4)
    seeds = np.array([5, 6, 5])
    together, memory = talk(layer, position, said, seeds)
    for b in range(3):
        alone, _ = talk(layer, position[:, b, None], said[:, b, None], seeds[b, None])
        for one, other in zip(alone, together, strict=True):
            for a, whole in zip(one, other, strict=True):
                np.testing.assert_array_equal(a[0], whole[b])
    again = layer.exchange(np.array([0.0, 0.75, 0.0]), position[0], said[0], memory, seeds)[0]
    for a, whole in zip(again, together[0], strict=True):
        np.testing.assert_array_equal(a[[0, 2]], whole[[0, 2]])
        assert (a[1] != whole[1]).any()


def test_losses_have_their_share_and_are_independent():
    """Losses are independent between seeds, mission steps and directions."""
    numbers = uniform(np.arange(20), np.full(20, 3), np.arange(1000))
    assert numbers.shape == (20, 1000) and numbers.min() >= 0.0 and numbers.max() < 1.0
    assert abs(numbers.mean() - 0.5) < 0.01 and abs((numbers < 0.2).mean() - 0.2) < 0.01
    assert np.abs(np.corrcoef(numbers) - np.eye(20)).max() < 0.15
    radio = Radio(Communication(loss=0.2), 6, STEP)
    arrived = radio.arrives(np.arange(2000), np.full(2000, 9))
    assert abs(arrived.mean() - 0.8) < 0.01
    assert abs(np.corrcoef(arrived[:, 0, 1], arrived[:, 1, 0])[0, 1]) < 0.08
    assert (radio.arrives(np.arange(2000), np.full(2000, 10)) != arrived).any()


def test_what_is_heard_of_a_supervisor_without_a_layer():
    assert hearing((1, 2), np.zeros(1)) is None


# The scenario's field -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "fragment"),
    [
        ({"range": -1.0}, "communication.range must be positive, got -1.0"),
        ({"range": float("nan")}, "communication.range must be positive"),
        ({"loss": 1.0}, "communication.loss must be at least 0 and below 1, got 1.0"),
        ({"loss": -0.1}, "communication.loss must be at least 0 and below 1, got -0.1"),
        ({"delay": -0.1}, "communication.delay must be non-negative and finite, got -0.1"),
        ({"delay": 0.07}, "communication.delay 0.07 s must be a whole multiple of the mission step 0.05 s"),
        ({"period": 0.01}, "communication.period 0.01 s must be a whole multiple of the mission step 0.05 s"),
        ({"silent": (4,)}, "communication.silent must name agents from 0 to 3, got 4"),
        ({"silent_from": float("inf")}, "communication.silent_from must be non-negative and finite"),
        ({"protocol": "gossip"}, "unknown communication.protocol 'gossip'; choose from: flooding, consensus"),
        ({"range": 5.0}, "communication.range 5 m splits the team into 4 parts at the start: agents 1 | 2 | 3 | 4"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(settings, fragment):
    with pytest.raises(ConfigurationError) as refused:
        make_scenario("gates", communication=Communication(**settings))
    assert fragment in str(refused.value) and "\n" not in str(refused.value)


def test_a_range_that_leaves_two_parts_names_them():
    scenario = make_scenario("open", formation="line", agents=5)
    starts = [*scenario.starts[:3], (0.0, 90.0), (0.0, 96.0)]
    with pytest.raises(ConfigurationError, match=r"into 2 parts at the start: agents 1, 2, 3 \| 4, 5"):
        replace(scenario, starts=tuple(starts), communication=Communication(range=7.0))


def test_a_file_and_a_family_set_it(tmp_path):
    """A scenario file has it as a table; without one, communication is ideal."""
    (tmp_path / "a.toml").write_text(
        'family = "gates"\n[communication]\nrange = 8\ndelay = 0.1\nloss = 0.2\nsilent = [2]\nsilent_from = 10.0\n'
    )
    scenario = load_scenario(tmp_path / "a.toml")
    assert scenario.communication == Communication(range=8.0, delay=0.1, loss=0.2, silent=(2,), silent_from=10.0)
    assert make_scenario("gates").communication == IDEAL
    assert isinstance(make_layer(scenario), Flooding)
    (tmp_path / "b.toml").write_text('family = "gates"\n[communication]\nrange = 8\nlost = 0.1\n')
    with pytest.raises(ConfigurationError, match=r"communication\.lost"):
        load_scenario(tmp_path / "b.toml")
