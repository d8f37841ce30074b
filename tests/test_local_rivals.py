"""Rivals for unseen layouts: fixed priority, the set-based rule, look-ahead and rollout, against geometry made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.outcomes import outcome
from marlbc_mj.scenarios import Scenario, held_out, make_scenario
from marlbc_mj.supervisors import (
    LOCAL_RIVALS,
    FixedPriority,
    LookAhead,
    Rollout,
    SetBasedRule,
    carry_out,
    make_supervisor,
    rollout,
)
from marlbc_mj.supervisors.lookahead import blocked_lanes
from marlbc_mj.supervisors.rollout import Lag, One, Present, follow_plan, follow_reference
from marlbc_mj.supervisors.set_based_rule import IN_COLUMN, IN_FORMATION
from marlbc_mj.util.errors import ConfigurationError, SimulationError

OPEN = make_scenario("open")  # d_OA = 1 m, gain 4, 1 m/s along x, four agents in a wedge
SLOTS = OPEN.formations[0]
FM, FR, OA_FM, OA_FR = (OPEN.orders.index(name) for name in ("FM", "FR", "OA>FM", "OA>FR"))


def seen(scenario: Scenario, obstacles, *, at=None, time: float = 0.0) -> Observation:
    """One team with references and agents ``at`` (4, 2), in formation unless said otherwise, among obstacles (K, 3 or 5)."""
    empty = World(scenario).observe()
    where = (scenario.formations[0] + np.array([time * 1.0, 0.0])) if at is None else np.asarray(at, dtype=float)
    discs = np.asarray(obstacles, dtype=float)
    discs = discs.reshape(-1, discs.shape[-1] if discs.size else 3)
    step = round(time / scenario.mission_step)
    return empty._replace(
        step=np.array([step]), time=np.array([time]), position=where[None], reference=where[None], obstacles=discs[None]
    )


def orders_of(supervisor, now: Observation, scenario: Scenario = OPEN) -> list[int]:
    return supervisor.decide(now, supervisor.start(scenario, 1))[0][0].tolist()


# One order for ever -------------------------------------------------------------------------------------------------------------


def test_a_fixed_priority_never_changes():
    """Whatever is seen; each team has its own copy."""
    supervisor = FixedPriority("OA>FM")
    memory = supervisor.start(OPEN, 3)
    for obstacles in ((), [(0.0, 0.0, 5.0)]):
        orders, memory = supervisor.decide(seen(OPEN, obstacles), memory)
        assert (orders == OA_FM).all() and orders.shape == (3, 4) and orders is not memory
    assert orders_of(FixedPriority(), seen(OPEN, ())) == [FM] * 4
    with pytest.raises(ConfigurationError, match="XX"):
        FixedPriority("XX").start(OPEN, 1)


# The local rule -----------------------------------------------------------------------------------------------------------------


def ahead_of(agent: int, gap: float, side: float = 0.0) -> tuple[float, float, float]:
    """A disc of radius 0.5 m whose surface is ``gap`` ahead of an agent's slot, or beside it if ``side`` is not 0."""
    x, y = SLOTS[agent]
    return (x + gap + 0.5, y, 0.5) if side == 0.0 else (x, y + side * (gap + 0.5), 0.5)


@pytest.mark.parametrize(
    ("gap", "avoids"), [(0.5, True), (1.3, True), (1.55, True), (1.6, True), (1.64, True), (1.66, False), (3.0, False)]
)
def test_the_rule_acts_from_one_mission_step_before_the_margin(gap, avoids):
    """In its slot an agent moves 0.05 m in a mission step: d_OA + margin = 1.6 m is reached from 1.65 m on."""
    orders = orders_of(SetBasedRule(), seen(OPEN, [ahead_of(0, gap)]))
    assert orders == [OA_FM if avoids else FM, FM, FM, FM]


def test_the_rule_lets_go_of_what_lies_behind():
    """n.(v - o') >= 0: an obstacle behind, or one beside which the path leads straight on, is left alone."""
    assert orders_of(SetBasedRule(), seen(OPEN, [ahead_of(0, -1.8)])) == [FM] * 4  # 0.8 m behind
    x, y = SLOTS[1]
    beside = (x - 0.01, y + 1.7, 0.5)
    assert orders_of(SetBasedRule(), seen(OPEN, [beside])) == [FM] * 4


def test_the_velocity_of_an_obstacle_counts():
    """One that flees faster than the team follows is no danger; one that comes from the side is."""
    x, y = SLOTS[0]
    flees = [(x + 1.8, y, 0.5, 1.5, 0.0)]
    comes = [(x - 0.01, y + 1.8, 0.5, 0.0, -0.5)]
    moving = make_scenario("traffic")
    for obstacles, expected in ((flees, "FM"), (comes, "OA>FM")):
        orders = orders_of(SetBasedRule(), seen(moving, obstacles, at=moving.formations[0]), moving)
        assert orders[0] == moving.orders.index(expected)


def test_the_column_obeys_the_same_rule():
    """With FR in the place of FM: OA>FR for who is about to come too near, and a far slot makes a long step."""
    rule = SetBasedRule(column=True)
    column = OPEN.formations[1]
    x, y = column[0]
    assert orders_of(rule, seen(OPEN, [(x + 1.9, y, 0.5)], at=column)) == [OA_FR, FR, FR, FR]
    leap = column.copy()
    leap[0] += 0.0, 20.0  # 80 m/s back to the slot: 4 m in a mission step
    assert orders_of(rule, seen(OPEN, [(x, y + 15.5, 0.5)], at=leap))[0] == OA_FR
    assert orders_of(rule, seen(OPEN, [(x, y + 13.0, 0.5)], at=leap))[0] == FR


@given(st.integers(0, 10_000))
def test_every_agent_decides_by_itself(seed):
    """The orders of one agent follow from its own place and the obstacles: others may be anywhere that is not too close."""
    rng = np.random.default_rng(seed)
    obstacles = np.column_stack([rng.uniform(-12, 12, (6, 2)), rng.uniform(0.1, 2.0, 6)])
    now = seen(OPEN, obstacles)
    moved = now.reference.copy()
    moved[0, 1:] += (0.0, 40.0)
    other = now._replace(reference=moved, position=moved)
    assert orders_of(SetBasedRule(), now)[0] == orders_of(SetBasedRule(), other)[0]


def test_agents_give_way_under_the_rule():
    """AA goes on top of what the rule says while a neighbor is too close."""
    near = SLOTS.copy()
    near[1] = near[0] + (0.0, 1.0)
    names = [OPEN.orders.commands[OPEN.orders.command_of[order]] for order in orders_of(SetBasedRule(), seen(OPEN, (), at=near))]
    assert names == ["AA>FM", "AA>FM", "FM", "FM"]


@pytest.mark.parametrize("margin", [-0.1, np.nan, np.inf])
def test_a_margin_that_cannot_be_is_refused(margin):
    for supervisor in (SetBasedRule(margin), LookAhead(margin=margin), Rollout(margin=margin)):
        with pytest.raises(ConfigurationError, match="margin"):
            supervisor.start(OPEN, 1)


# Looking ahead ------------------------------------------------------------------------------------------------------------------


def wall(x: float) -> list[tuple[float, float, float]]:
    """Discs across the whole way at ``x``, with an opening 5 m wide around the path."""
    return [(x, sign * (3.5 + 2.0 * k), 1.0) for sign in (-1.0, 1.0) for k in range(8)]


@pytest.mark.parametrize(
    ("ahead", "blocked"), [(-5.0, False), (-3.9, True), (0.0, True), (9.9, True), (10.1, False), (30.0, False)]
)
def test_a_lane_is_blocked_from_8_s_before_to_2_s_after(ahead, blocked):
    """Agent 1's slot and a disc of radius 1 m in its lane: blocked while their gap would be at most d_OA = 1 m."""
    x, y = SLOTS[0]
    supervisor = LookAhead()
    lanes = supervisor.start(OPEN, 1)
    found = blocked_lanes(seen(OPEN, [(x + ahead, y, 1.0)]), lanes, (-supervisor.behind, supervisor.ahead))
    assert found[0].tolist() == [blocked, False, False, False]


@given(st.integers(0, 10_000))
def test_the_nearest_approach_in_a_lane_is_that_of_a_fine_sampling(seed):
    """Obstacles that move, in straight lines: what a thousand instants find is what the closed form says, but for grazing."""
    rng = np.random.default_rng(seed)
    obstacles = np.column_stack([rng.uniform(-8, 16, (3, 2)), rng.uniform(0.2, 2.0, 3), rng.uniform(-1, 1, (3, 2))])
    now = seen(OPEN, obstacles, time=2.0)
    lanes = LookAhead().start(OPEN, 1)
    found = blocked_lanes(now, lanes, (-2.0, 8.0))[0]
    tau = np.linspace(-2.0, 8.0, 1001)[:, None, None]
    slots = SLOTS + np.array([2.0, 0.0]) + tau * np.array([1.0, 0.0])
    places = obstacles[:, :2] + tau * obstacles[:, 3:]
    gap = (np.linalg.norm(slots[:, :, None] - places[:, None], axis=-1) - obstacles[:, 2]).min(axis=(0, 2))
    clear = np.abs(gap - OPEN.safe_distance) > 1e-3
    assert (found[clear] == (gap <= OPEN.safe_distance)[clear]).all()


def test_the_column_takes_two_blocked_lanes():
    """One disc blocks one lane: who is in it goes around. A wall blocks them all."""
    x, y = SLOTS[0]
    assert orders_of(LookAhead(), seen(OPEN, [(x + 5.0, y, 1.0)])) == [FM] * 4
    assert orders_of(LookAhead(blocked=1), seen(OPEN, [(x + 5.0, y, 1.0)])) == [FR] * 4
    assert orders_of(LookAhead(), seen(OPEN, wall(8.0))) == [FR] * 4
    assert orders_of(LookAhead(ahead=2.0), seen(OPEN, wall(8.0))) == [FM] * 4


def test_no_column_where_its_own_lane_is_blocked():
    """A wall without an opening: there is nothing to be gained."""
    closed = [*wall(8.0), (8.0, 0.0, 1.0)]
    assert orders_of(LookAhead(), seen(OPEN, wall(8.0))) == [FR] * 4
    assert orders_of(LookAhead(), seen(OPEN, closed)) == [FM] * 4


@pytest.mark.parametrize(("end", "opens"), [(3.0, False), (-2.0, False), (-5.0, False), (-9.0, True)])
def test_nobody_opens_up_between_walls(end, opens):
    """Two rows of discs from behind to ``end``, beside all lanes and across the way to the outer slots.

    From the formation nothing is blocked. The column stays until the last one is out.
    """
    rows = [(x, side * 4.25, 1.0) for x in np.arange(-20.0, end + 0.1, 1.0) for side in (-1.0, 1.0)]
    supervisor, now = LookAhead(), seen(OPEN, rows, at=OPEN.formations[1])
    memory = supervisor.start(OPEN, 1)
    assert (supervisor.decide(now, memory)[0] == FM).all()
    orders, after = supervisor.decide(now, memory._replace(motion=np.array([IN_COLUMN])))
    assert (orders == (FM if opens else FR)).all() and after.motion.tolist() == [IN_FORMATION if opens else IN_COLUMN]


@pytest.mark.parametrize("setting", [{"blocked": 0}, {"blocked": 1.5}, {"ahead": -1.0}, {"behind": np.inf}, {"change": np.nan}])
def test_settings_of_looking_ahead_are_checked(setting):
    with pytest.raises(ConfigurationError, match=next(iter(setting))):
        LookAhead(**setting)


# Rollout ------------------------------------------------------------------------------------------------------------------------


def test_there_are_33_plans():
    """Hold; change at 8 instants from 0 to 8 s, for good or back 3, 6 or 10 s later; the price counts changes in the horizon."""
    plans = Rollout().plans(0.05)
    assert plans.changed.shape == (33, 280) and not plans.changed[0].any() and plans.switches[0] == 0.0
    starts = sorted({int(row.argmax()) for row in plans.changed[1:]})
    assert starts == [0, 20, 40, 60, 80, 100, 120, 160]
    assert sorted({int(row.sum()) for row in plans.changed[1:] if row[-1] == 0}) == [60, 120, 200]
    edges = np.abs(np.diff(plans.changed, axis=1, prepend=0)).sum(axis=1)
    np.testing.assert_array_equal(edges, plans.switches)


@pytest.mark.parametrize("family", ["gates", "traffic"])
def test_plans_that_are_given_up_could_not_have_been_the_cheapest(family: str) -> None:
    """The rest costs what every plan costs that is followed to its end, to the bit; in drawn states of held-out layouts."""
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
    """Nothing in the way, or a disc beside the way: formation. A wall that stops the formation: column, for the whole team."""
    x = SLOTS[0, 0]
    for supervisor in (Rollout(), NOW_OR_NEVER):
        assert orders_of(supervisor, seen(OPEN, ())) == [FM] * 4
        assert orders_of(supervisor, seen(OPEN, [(x + 6.0, 20.0, 1.0)])) == [FM] * 4
    assert orders_of(NOW_OR_NEVER, seen(OPEN, wall(x + 4.0))) == [FR] * 4


def test_rollout_changes_no_earlier_than_it_must():
    """The same wall, with plans that may wait: as long as waiting is safe it is cheaper."""
    assert orders_of(Rollout(), seen(OPEN, wall(SLOTS[0, 0] + 7.0))) == [FM] * 4


def test_rollout_keeps_its_motion_between_decisions():
    """Decided at once and then every 0.5 s: 10 mission steps under the same motion, whatever is seen in between."""
    orders, memory = NOW_OR_NEVER.decide(seen(OPEN, wall(SLOTS[0, 0] + 4.0)), NOW_OR_NEVER.start(OPEN, 1))
    assert (orders == FR).all() and memory.due.tolist() == [10]
    column = OPEN.formations[1]
    for step in range(1, 12):
        now = seen(OPEN, (), at=column + (0.05 * step, 0.0), time=0.05 * step)
        orders, memory = NOW_OR_NEVER.decide(now, memory)
        assert (orders == (FR if step < 10 else FM)).all(), step


def test_a_lag_that_never_saturates_is_that_of_the_linear_loop():
    """A reference that moves at constant speed is followed without error; a jump decays as the damped oscillator does."""
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
    """A jump of 10 m takes at least 2 sqrt(10 / a) there and to rest; after half a second at 20 m/s^2 it is 2.5 m at most."""
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


# All of them --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LOCAL_RIVALS)
def test_teams_among_moving_obstacles_are_told_what_they_are_told_alone(name):
    """Three layouts in one world and each in a world of its own, to the bit; and twice the same."""
    scenario = make_scenario("traffic", duration=6.0)
    world = World(scenario, worlds=3)
    world.reset(5)
    alone = [World(scenario) for _ in range(3)]
    for b, own in enumerate(alone):
        own.copy_world(world, b, 0)
    again = World(scenario, worlds=3)
    again.reset(5)
    ends = [fly(name, one) for one in (world, again, *alone)]
    assert ends[0].tobytes() == ends[1].tobytes() == np.concatenate(ends[2:]).tobytes()


def fly(name: str, world: World) -> np.ndarray:
    """Positions (B, N, 2) at the end of the mission."""
    supervisor, observation = make_supervisor(name), world.observe()
    memory = supervisor.start(world.scenario, world.worlds)
    for _ in range(world.scenario.mission_steps):
        decision, memory = supervisor.decide(observation, memory)
        observation = carry_out(world, decision).observation
    return observation.position


def successes(supervisor, family: str, seeds) -> list[bool]:
    """Outcome of a whole mission on held-out layouts."""
    scenario = held_out(make_scenario(family))
    world = World(scenario, record=True)
    return [outcome(measure(run_episode(world, supervisor, seed=seed)), scenario).success for seed in seeds]


@pytest.mark.parametrize(
    ("supervisor", "family"),
    [
        (SetBasedRule(), "field"),
        (SetBasedRule(), "forest"),
        (Rollout(), "gates"),
        (Rollout(), "corridor"),
        (LookAhead(), "gates"),
        (LookAhead(), "corridor"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_missions_on_held_out_layouts_succeed(supervisor, family):
    """Layouts that no number in this package was chosen on."""
    layouts = 1 if isinstance(supervisor, Rollout) else 3  # a search takes ten times as long
    assert all(successes(supervisor, family, range(7110, 7110 + layouts)))


def test_a_scenario_without_an_order_is_refused():
    """The rule needs avoidance on top of both formations."""
    bare = replace(OPEN, behaviors=tuple(b for b in OPEN.behaviors if b.name in ("FM", "FR")))
    for supervisor in (SetBasedRule(), LookAhead(), Rollout()):
        with pytest.raises(ConfigurationError, match="OA>FM"):
            supervisor.start(bare, 1)
