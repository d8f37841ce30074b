"""The grid gives the same result as trying all points, to the last bit, for any points and in whole missions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.core.cells import FARTHEST, fill, nearest, room, spacing
from marlbc_mj.engine import plan as plans
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Scenario, make_scenario
from marlbc_mj.scenarios.families import Field

COORDINATE = st.one_of(st.floats(-50, 50), st.integers(-3, 3).map(float), st.floats(-1e9, 1e9))
POINTS = st.integers(1, 40).flatmap(lambda n: arrays(np.float64, (n, 2), elements=COORDINATE))


def filled(points: np.ndarray) -> np.ndarray:
    grid = np.full(room(len(points)), np.nan)
    fill(points, grid)
    return grid


def by_definition(p: np.ndarray, points: np.ndarray, own: int) -> int:
    """Index of the least gap, the lowest on ties, without the point ``own``; -1 if there is no other point."""
    gaps = np.sqrt((p[0] - points[:, 0]) ** 2 + (p[1] - points[:, 1]) ** 2)
    if points.shape[1] > 2:
        gaps = gaps - points[:, 2]
    if own >= 0:
        gaps[own] = np.inf
    return int(gaps.argmin()) if len(points) > (own >= 0) else -1


@settings(deadline=None, max_examples=60)
@given(POINTS, arrays(np.float64, 2, elements=COORDINATE))
def test_the_nearest_point_is_that_of_the_definition(points, p):
    """Query points are anywhere; points may coincide, lie on a line or be far apart; on ties the lowest index counts."""
    grid = filled(points)
    assert nearest(p, points, grid, -1) == by_definition(p, points, -1)
    for own in range(len(points)):
        assert nearest(points[own], points, grid, own) == by_definition(points[own], points, own)


@settings(deadline=None, max_examples=60)
@given(POINTS, st.integers(0, 2**31))
def test_the_nearest_disc_gives_the_clearance_of_all(points, seed):
    """Radii range from 0 to more than the spread of the centers."""
    rng = np.random.default_rng(seed)
    discs = np.ascontiguousarray(np.column_stack([points, rng.exponential(rng.choice([0.1, 10.0, 1e4]), len(points))]))
    grid = filled(discs)
    for p in rng.uniform(-80, 80, (8, 2)):
        k = nearest(p, discs, grid, -1)
        normal, all_normal = np.empty(2), np.empty(2)
        assert k == by_definition(p, discs, -1)
        assert nearest_obstacle(p, discs[k : k + 1], normal) == nearest_obstacle(p, discs, all_normal)
        np.testing.assert_array_equal(normal, all_normal)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.floats(0.01, 1e6))
def test_spacing_is_the_distance_to_the_nearest_other(seed, scale):
    """Checked for a team that is large enough for a grid."""
    positions = np.random.default_rng(seed).normal(0, scale, (3, 70, 2)).round(2)
    apart = np.sqrt(((positions[:, :, None] - positions[:, None]) ** 2).sum(-1))
    apart[:, range(70), range(70)] = np.inf
    np.testing.assert_allclose(spacing(positions), apart.min(-1), rtol=1e-15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_numbers_that_are_not_finite_do_not_go_into_a_grid(bad):
    """All points are then tried, and a bad point is nearest to nothing; a query from a bad position finds no point."""
    points = np.random.default_rng(0).uniform(0, 1, (40, 2))
    points[7, 1] = bad
    grid = filled(points)
    assert nearest(points[3], points, grid, 3) not in (3, 7, -1)
    fine = np.random.default_rng(0).uniform(0, 1, (40, 2))
    assert nearest(np.array([bad, 0.0]), fine, filled(fine), -1) == -1


def test_a_query_from_far_away_is_answered():
    """The query is so far away that the grid's cells no longer help."""
    points = np.random.default_rng(0).uniform(0, 1, (100, 2))
    for far in (10.0, 2.0 * FARTHEST):
        p = np.array([far, -far])
        assert nearest(p, points, filled(points), -1) == by_definition(p, points, -1)


def crowd(agents: int) -> Scenario:
    length = 20.0 + 12.0 * np.sqrt(agents)
    return Field(agents=agents, formation="grid", obstacles=agents, radius=(0.3, 0.6), length=length, gap=2.5).build(duration=3.0)


@pytest.mark.parametrize("name", ["field", "traffic"])
def test_a_mission_with_grids_is_the_same_mission(name, monkeypatch):
    """With and without grids a mission is identical to the last bit, for random orders and obstacles at rest or moving."""
    scenario = crowd(16) if name == "field" else make_scenario(name, duration=20.0)
    without = World(scenario)
    assert without.plan.grid_room == 0
    monkeypatch.setattr(plans, "WORTH", 0)
    grids = World(scenario)
    assert grids.plan.grid_room > 0
    orders = np.random.default_rng(1).integers(0, len(scenario.orders), (scenario.mission_steps, 1, scenario.agents))
    np.testing.assert_array_equal(without.rollout(orders), grids.rollout(orders))
    for field in ("position", "velocity", "reference", "clearance", "controller"):
        np.testing.assert_array_equal(getattr(without.state, field), getattr(grids.state, field))


def test_large_teams_use_grids_and_the_case_study_does_not():
    """The threshold lies between the case study and 64 agents among 64 obstacles."""
    assert World(make_scenario("paper")).plan.grid_room == 0
    assert World(crowd(64)).plan.grid_room > 0
