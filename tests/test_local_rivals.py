"""Baselines for unseen layouts: fixed priority, set-based rule and look-ahead on hand-made geometry and in missions."""

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
from marlbc_mj.supervisors import LOCAL_BASELINES, FixedPriority, LookAhead, Rollout, SetBasedRule, carry_out, make_supervisor
from marlbc_mj.supervisors.lookahead import blocked_lanes
from marlbc_mj.supervisors.set_based_rule import IN_COLUMN, IN_FORMATION
from marlbc_mj.util.errors import ConfigurationError

OPEN = make_scenario("open")  # d_OA = 1 m, gain 4, 1 m/s along x, four agents in a wedge
SLOTS = OPEN.formations[0]
FM, FR, OA_FM, OA_FR = (OPEN.orders.index(name) for name in ("FM", "FR", "OA>FM", "OA>FR"))


def seen(scenario: Scenario, obstacles, *, at=None, time: float = 0.0) -> Observation:
    """Observation of one team at ``at`` (4, 2), by default in its formation, among obstacles (K, 3 or 5)."""
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


# Fixed priority -----------------------------------------------------------------------------------------------------------------


def test_a_fixed_priority_never_changes():
    """Its orders are the same for any observation, and returned as a new array."""
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
    """A disc of radius 0.5 m with its surface ``gap`` ahead of an agent's slot, or to its side if ``side`` is not 0."""
    x, y = SLOTS[agent]
    return (x + gap + 0.5, y, 0.5) if side == 0.0 else (x, y + side * (gap + 0.5), 0.5)


@pytest.mark.parametrize(
    ("gap", "avoids"), [(0.5, True), (1.3, True), (1.55, True), (1.6, True), (1.64, True), (1.66, False), (3.0, False)]
)
def test_the_rule_acts_from_one_mission_step_before_the_margin(gap, avoids):
    """An agent in its slot moves 0.05 m per mission step, so the rule acts below d_OA + margin + 0.05 m = 1.65 m."""
    orders = orders_of(SetBasedRule(), seen(OPEN, [ahead_of(0, gap)]))
    assert orders == [OA_FM if avoids else FM, FM, FM, FM]


def test_the_rule_lets_go_of_what_lies_behind():
    """The rule ignores an obstacle with n.(v - o') >= 0: one behind the agent, or beside it and not approached."""
    assert orders_of(SetBasedRule(), seen(OPEN, [ahead_of(0, -1.8)])) == [FM] * 4  # 0.8 m behind
    x, y = SLOTS[1]
    beside = (x - 0.01, y + 1.7, 0.5)
    assert orders_of(SetBasedRule(), seen(OPEN, [beside])) == [FM] * 4


def test_the_velocity_of_an_obstacle_counts():
    """An obstacle ahead that is faster than the team is ignored; one that approaches from the side is avoided."""
    x, y = SLOTS[0]
    flees = [(x + 1.8, y, 0.5, 1.5, 0.0)]
    comes = [(x - 0.01, y + 1.8, 0.5, 0.0, -0.5)]
    moving = make_scenario("traffic")
    for obstacles, expected in ((flees, "FM"), (comes, "OA>FM")):
        orders = orders_of(SetBasedRule(), seen(moving, obstacles, at=moving.formations[0]), moving)
        assert orders[0] == moving.orders.index(expected)


def test_the_column_obeys_the_same_rule():
    """With FR instead of FM, agents that are about to come too near get OA>FR; a distant slot means a long step."""
    rule = SetBasedRule(column=True)
    column = OPEN.formations[1]
    x, y = column[0]
    assert orders_of(rule, seen(OPEN, [(x + 1.9, y, 0.5)], at=column)) == [OA_FR, FR, FR, FR]
    leap = column.copy()
    leap[0] += 0.0, 20.0  # 80 m/s back to the slot, 4 m per mission step
    assert orders_of(rule, seen(OPEN, [(x, y + 15.5, 0.5)], at=leap))[0] == OA_FR
    assert orders_of(rule, seen(OPEN, [(x, y + 13.0, 0.5)], at=leap))[0] == FR


@given(st.integers(0, 10_000))
def test_every_agent_decides_by_itself(seed):
    """The order of an agent depends on its own position and the obstacles, not on other agents that are far enough away."""
    rng = np.random.default_rng(seed)
    obstacles = np.column_stack([rng.uniform(-12, 12, (6, 2)), rng.uniform(0.1, 2.0, 6)])
    now = seen(OPEN, obstacles)
    moved = now.reference.copy()
    moved[0, 1:] += (0.0, 40.0)
    other = now._replace(reference=moved, position=moved)
    assert orders_of(SetBasedRule(), now)[0] == orders_of(SetBasedRule(), other)[0]


def test_agents_give_way_under_the_rule():
    """AA is added on top of the rule's order while a neighbor is too close."""
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
    """Discs across the whole route at ``x``, with an opening 5 m wide around the path."""
    return [(x, sign * (3.5 + 2.0 * k), 1.0) for sign in (-1.0, 1.0) for k in range(8)]


@pytest.mark.parametrize(
    ("ahead", "blocked"), [(-5.0, False), (-3.9, True), (0.0, True), (9.9, True), (10.1, False), (30.0, False)]
)
def test_a_lane_is_blocked_from_8_s_before_to_2_s_after(ahead, blocked):
    """Agent 1's lane with a disc of radius 1 m is blocked if the slot's gap is at most d_OA = 1 m within this window."""
    x, y = SLOTS[0]
    supervisor = LookAhead()
    lanes = supervisor.start(OPEN, 1)
    found = blocked_lanes(seen(OPEN, [(x + ahead, y, 1.0)]), lanes, (-supervisor.behind, supervisor.ahead))
    assert found[0].tolist() == [blocked, False, False, False]


@given(st.integers(0, 10_000))
def test_the_nearest_approach_in_a_lane_is_that_of_a_fine_sampling(seed):
    """For obstacles in straight motion, the closed form and 1001 sampled instants agree, except where obstacles graze."""
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
    """One disc blocks one lane, whose agent goes around it; a wall blocks all lanes."""
    x, y = SLOTS[0]
    assert orders_of(LookAhead(), seen(OPEN, [(x + 5.0, y, 1.0)])) == [FM] * 4
    assert orders_of(LookAhead(blocked=1), seen(OPEN, [(x + 5.0, y, 1.0)])) == [FR] * 4
    assert orders_of(LookAhead(), seen(OPEN, wall(8.0))) == [FR] * 4
    assert orders_of(LookAhead(ahead=2.0), seen(OPEN, wall(8.0))) == [FM] * 4


def test_no_column_where_its_own_lane_is_blocked():
    """A column does not help against a wall without an opening."""
    closed = [*wall(8.0), (8.0, 0.0, 1.0)]
    assert orders_of(LookAhead(), seen(OPEN, wall(8.0))) == [FR] * 4
    assert orders_of(LookAhead(), seen(OPEN, closed)) == [FM] * 4


@pytest.mark.parametrize(("end", "opens"), [(3.0, False), (-2.0, False), (-5.0, False), (-9.0, True)])
def test_nobody_opens_up_between_walls(end, opens):
    """Two rows of discs from behind the team to ``end``, outside all lanes but on the ways to the outer slots.

    They block no lane of the formation, but a team in a column stays in it until its last agent is out.
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


# Whole missions -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LOCAL_BASELINES)
def test_decisions_among_moving_obstacles_do_not_depend_on_the_batch(name):
    """Three layouts in one World end as each does in its own World, to the last bit; so does a repetition."""
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
    """Whether whole missions on held-out layouts succeed, per seed."""
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
    """No number in the package was tuned on these layouts."""
    layouts = 1 if isinstance(supervisor, Rollout) else 3  # a search takes ten times as long
    assert all(successes(supervisor, family, range(7110, 7110 + layouts)))


def test_a_scenario_without_an_order_is_refused():
    """The rule needs orders with avoidance on top of both formations."""
    bare = replace(OPEN, behaviors=tuple(b for b in OPEN.behaviors if b.name in ("FM", "FR")))
    for supervisor in (SetBasedRule(), LookAhead(), Rollout()):
        with pytest.raises(ConfigurationError, match="OA>FM"):
            supervisor.start(bare, 1)
