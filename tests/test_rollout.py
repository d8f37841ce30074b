"""Rollout: its plans, the predicted lag of agents behind their references, and when the column is formed and left."""

import numpy as np
import pytest
from test_local_rivals import FM, FR, OPEN, SLOTS, orders_of, seen, wall

from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.supervisors import Rollout, rollout
from marlbc_mj.supervisors.rollout import Lag, One, Present, follow_plan, follow_reference
from marlbc_mj.util.errors import ConfigurationError, SimulationError


def test_there_are_33_plans():
    """Hold, or change at 8 instants from 0 to 8 s, for good or back after 3, 6 or 10 s; switches in the horizon are counted."""
    plans = Rollout().plans(0.05)
    assert plans.changed.shape == (33, 280) and not plans.changed[0].any() and plans.switches[0] == 0.0
    starts = sorted({int(row.argmax()) for row in plans.changed[1:]})
    assert starts == [0, 20, 40, 60, 80, 100, 120, 160]
    assert sorted({int(row.sum()) for row in plans.changed[1:] if row[-1] == 0}) == [60, 120, 200]
    edges = np.abs(np.diff(plans.changed, axis=1, prepend=0)).sum(axis=1)
    np.testing.assert_array_equal(edges, plans.switches)


@pytest.mark.parametrize("family", ["gates", "traffic"])
def test_plans_that_are_given_up_could_not_have_been_the_cheapest(family: str) -> None:
    """In random states of held-out layouts, each plan kept has exactly the cost of following it to its end."""
    scenario = make_scenario(family, composition="set-based", split="test")
    supervisor, world = Rollout(), World(scenario, worlds=6)
    for step in (0, 500, 1100):
        observation = world.reset(51_000 + step)._replace(step=np.full(6, step), time=np.full(6, 0.05 * step))
        memory = supervisor.start(scenario, 6)
        now = 0.05 * step * np.array(scenario.path_velocity) + np.random.default_rng(step).normal(size=(6, 4, 2))
        place = observation.reference + now, observation.position + now
        present = Present(observation.step, *place, observation.velocity, observation.obstacles)
        motion, room, found = np.array([0, 0, 0, 1, 1, 1]), memory.room, np.empty((6, 33))
        rollout._search(np.arange(6), motion, memory.search, present, room, found)
        costs = np.empty_like(found)
        for b, plan in np.ndindex(costs.shape):
            costs[b, plan] = follow_plan(One(np.array([b])), plan, np.inf, motion[b], memory.search, present, room)
        kept, best = np.isfinite(found), np.minimum.accumulate(costs, axis=1)
        assert np.isfinite(costs).all() and not kept.all() and kept[:, 1:].any()
        np.testing.assert_array_equal(found[kept], costs[kept])
        assert (costs[:, 1:] > best[:, :-1])[~kept[:, 1:]].all()


NOW_OR_NEVER = Rollout(change_after=(0.0,), back_after=())


def test_rollout_forms_the_column_for_a_wall_and_not_without():
    """With an empty path, or a disc beside it, the formation is kept; a wall in its way makes the whole team form the column."""
    x = SLOTS[0, 0]
    for supervisor in (Rollout(), NOW_OR_NEVER):
        assert orders_of(supervisor, seen(OPEN, ())) == [FM] * 4
        assert orders_of(supervisor, seen(OPEN, [(x + 6.0, 20.0, 1.0)])) == [FM] * 4
    assert orders_of(NOW_OR_NEVER, seen(OPEN, wall(x + 4.0))) == [FR] * 4


def test_rollout_changes_no_earlier_than_it_must():
    """Before a wall farther ahead, with plans that may wait: while waiting is safe, it is cheaper."""
    assert orders_of(Rollout(), seen(OPEN, wall(SLOTS[0, 0] + 7.0))) == [FM] * 4


def test_rollout_keeps_its_motion_between_decisions():
    """It decides at once and then every 0.5 s: 10 mission steps have the same motion, whatever is observed in between."""
    orders, memory = NOW_OR_NEVER.decide(seen(OPEN, wall(SLOTS[0, 0] + 4.0)), NOW_OR_NEVER.start(OPEN, 1))
    assert (orders == FR).all() and memory.due.tolist() == [10]
    column = OPEN.formations[1]
    for step in range(1, 12):
        now = seen(OPEN, (), at=column + (0.05 * step, 0.0), time=0.05 * step)
        orders, memory = NOW_OR_NEVER.decide(now, memory)
        assert (orders == (FR if step < 10 else FM)).all(), step


def test_a_lag_that_never_saturates_is_that_of_the_linear_loop():
    """A reference at constant speed is followed without error; the error of a jump decays like a damped oscillator's."""
    p_r, p, v, v_r = np.zeros((1, 2)), np.zeros((1, 2)), np.full((1, 2), 3.0), np.full((1, 2), 3.0)
    for _ in range(40):
        follow_reference(0.05, Lag(10, 0.005, 200.0), p_r, p, v, v_r)
    np.testing.assert_allclose(p, p_r, rtol=0, atol=1e-12)
    np.testing.assert_allclose(p_r, 3.0 * 40 * 0.05, rtol=0, atol=1e-12)
    p, v, v_r = p_r + 1e-3, np.zeros((1, 2)), np.zeros((1, 2))
    for _ in range(40):
        follow_reference(0.05, Lag(10, 0.005, 200.0), p_r, p, v, v_r)
    slow = 50.0 - np.sqrt(50.0**2 - 100.0)  # the slow pole of s^2 + 100 s + 100
    np.testing.assert_allclose((p - p_r) / 1e-3, np.exp(-2.0 * slow), rtol=0.03)


def test_a_saturated_agent_is_no_faster_than_its_force_allows():
    """A jump of 10 m takes at least 2 sqrt(10 / a) from rest to rest; half a second at 20 m/s^2 covers at most 2.5 m."""
    p_r, p, v, v_r = np.full((1, 2), 10.0), np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2))
    for _ in range(10):
        follow_reference(0.05, Lag(10, 0.005, 20.0), p_r, p, v, v_r)
    assert 2.0 < p[0, 0] <= 2.53
    exact = np.zeros((1, 2))
    follow_reference(0.05, Lag(0, 0.005, 20.0), p_r, exact, v, v_r)
    np.testing.assert_array_equal(exact, p_r)


@pytest.mark.parametrize(
    "setting", [{"horizon": 0.0}, {"interval": np.nan}, {"change_after": (14.0,)}, {"back_after": (-1.0,)}, {"w_switch": -1.0}]
)
def test_settings_of_rollout_are_checked(setting):
    with pytest.raises(ConfigurationError, match=next(iter(setting))):
        Rollout(**setting)


def test_a_team_without_a_plan_of_finite_cost_is_named():
    with pytest.raises(SimulationError, match=r"no plan has a finite cost at t = 0.000 s for team 0"):
        orders_of(Rollout(), seen(OPEN, [(5.0, 5.0, np.inf)]))
