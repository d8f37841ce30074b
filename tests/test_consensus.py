"""Consensus and communication of the general policy: leads, who agrees with whom, and decisions over any network."""

import numpy as np
import pytest
from test_general import decide, field, random_policy

from marlbc_mj import World
from marlbc_mj.core.communication import Communication
from marlbc_mj.policies import general
from marlbc_mj.policies import general_inputs as inputs
from marlbc_mj.policies.general import Sensed, lead_of_column
from marlbc_mj.supervisors import General


def test_only_fresh_leads_count() -> None:
    leads, interval = np.float32([[[1.0, 2.0, 6.0], [1.0, 2.0, 6.0]]]), general.INTERVAL
    age = np.array([[[0.0, interval, np.inf], [interval + 1e-6, 0.1, 0.0]]])
    np.testing.assert_array_equal(general.mean_lead(leads, age), np.float32([[1.5, 4.0]]))
    np.testing.assert_array_equal(general.mean_lead(leads[:, :1], np.zeros((1, 1, 3))), [[3.0]])


@pytest.mark.parametrize("actions", [2, 4])
def test_a_lead_moves_the_column_against_the_formation(actions: int) -> None:
    """The values get the wanted lead; actions with the same motion keep their distances."""
    rng = np.random.default_rng(0)
    values, lead = rng.normal(size=(3, 5, actions)).astype(np.float32), rng.normal(size=(3, 5)).astype(np.float32)
    moved = general.with_lead(values, lead)
    np.testing.assert_array_equal(lead_of_column(moved), lead)
    for motion in (0, 1):
        own, other = values[..., motion::2], moved[..., motion::2]
        np.testing.assert_allclose(other - other[..., :1], own - own[..., :1], atol=1e-6)
    np.testing.assert_array_equal(lead_of_column(values), values[..., 1::2].max(axis=-1) - values[..., 0::2].max(axis=-1))
    values[0, 0, -1] = np.nan  # not hidden by the other actions
    assert np.isnan(lead_of_column(values)).sum() == np.isnan(lead_of_column(values)[0, 0]) == 1


@pytest.mark.parametrize("actions", [2, 4])
def test_agents_that_hear_each_other_take_the_motion_with_the_greatest_sum(actions: int) -> None:
    """It is the one with the greatest sum of the agents' values; two groups that do not hear each other decide apart."""
    rng, policy = np.random.default_rng(3), random_policy(2, actions=actions, consensus=True)
    features = rng.normal(size=(40, 5, inputs.FEATURES)).astype(np.float32)
    features[..., inputs.WAYS :] = rng.uniform(size=features[..., inputs.WAYS :].shape)
    now = Sensed(features, np.zeros((40, 5), np.int64), np.ones(40, dtype=bool))
    group = np.array([0, 0, 0, 1, 1])
    apart = np.where(group[:, None] == group, 0.0, np.inf)[None].repeat(40, 0)
    heard, motions = features[:, None, :, : inputs.SENT].repeat(5, 1), set()
    for age in (np.zeros((40, 5, 5)), apart):
        best = policy.evaluate(features, heard, age).astype(float)
        totals = np.stack([best[..., motion::2].max(axis=-1) for motion in (0, 1)], axis=-1)
        chosen = decide(policy, now, heard, age) % 2
        for members in [group == 0, group == 1] if age is apart else [group >= 0]:
            wanted = totals[:, members].sum(axis=1).argmax(axis=-1)
            np.testing.assert_array_equal(chosen[:, members], wanted[:, None].repeat(members.sum(), 1))
        motions |= set(chosen.ravel().tolist())
    assert motions == {0, 1}


def decisions(scenario, steps: int = 60, worlds: int = 2, consensus: bool = True) -> np.ndarray:
    """Orders (steps, B, N) of a random policy in the first mission steps."""
    supervisor, world = General(random_policy(2, consensus=consensus)), World(scenario, worlds=worlds)
    observation, memory = world.reset(3), supervisor.start(scenario, worlds)
    taken = []
    for _ in range(steps):
        orders, memory = supervisor.decide(observation, memory)
        taken.append(orders.copy())
        observation = world.step(orders).observation
    return np.stack(taken)


@pytest.mark.parametrize("consensus", [False, True])
def test_ideal_communication_is_the_limit_of_a_long_range(consensus: bool) -> None:
    """Decisions are the same with ideal communication, which has no layer, and with a layer of very long range."""
    ideal, carried = (decisions(field(communication=c), consensus=consensus) for c in (Communication(), Communication(range=1e6)))
    np.testing.assert_array_equal(carried, ideal)
    assert (ideal == ideal[..., :1]).all() == consensus


def test_a_team_that_cannot_hear_does_not_agree() -> None:
    """With a silent agent the others agree among themselves; if all are silent, everybody decides alone."""
    silent, alone, own = (
        decisions(field(communication=Communication(silent=agents)), consensus=consensus)
        for agents, consensus in (((0,), True), ((0, 1, 2, 3), True), ((0, 1, 2, 3), False))
    )
    assert (silent[..., 1:] == silent[..., 1:2]).all()
    assert not (alone == alone[..., :1]).all()
    np.testing.assert_array_equal(alone, own)


@pytest.mark.parametrize("changes", [{"delay": 0.1, "loss": 0.5}, {"silent": (0,)}, {"protocol": "consensus", "range": 9.0}])
def test_it_flies_over_any_network(changes) -> None:
    """Every team has its own network, so it takes the same orders alone and next to another team."""
    scenario = field(communication=Communication(**changes))
    taken = decisions(scenario)
    assert np.isin(taken, [scenario.orders.index("FM"), scenario.orders.index("FR")]).all()
    np.testing.assert_array_equal(decisions(scenario, worlds=1)[:, 0], taken[:, 0])
