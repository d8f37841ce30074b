"""The double-integrator setting with goals: rectangles and discs that cover them, random draws, and shares of success."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.core.behaviors import clearances
from marlbc_mj.studies import goal_reaching
from marlbc_mj.studies.goal_reaching import AGENT_RADIUS, LEAST_GAP, Box, draw_goals, fly_to_goals, goal_scenario, goal_shares


def test_the_distance_from_a_rectangle_is_that_of_its_nearest_point() -> None:
    """Checked on a square of 2 m at (1, 0), rotated by 45 degrees, so that its corners are on the axes."""
    box = Box(np.array([1.0, 0.0]), np.array([1.0, 1.0]), np.pi / 4)
    corner = np.sqrt(2.0)
    places = np.array([[1.0, 0.0], [1.0 + corner + 0.5, 0.0], [1.0, corner + 0.25], [1.0 + corner, corner]])
    np.testing.assert_allclose(box.distance(places), [0.0, 0.5, 0.25, 1.0], atol=1e-12)


@given(st.floats(0.5, 2.5), st.floats(0.5, 2.5), st.floats(0.0, 6.3), st.integers(0, 1000))
def test_discs_cover_the_edge_and_jut_out_little(width: float, height: float, angle: float, seed: int) -> None:
    """Every point of the edge is in a disc, and no disc extends more than 0.11 m beyond the rectangle."""
    box = Box(np.array([3.0, -2.0]), np.array([width, height]), angle)
    discs = np.array(box.discs())
    rng = np.random.default_rng(seed)
    side, along = rng.integers(0, 2, 40), rng.uniform(-1.0, 1.0, 40)
    local = np.where(side[:, None] == 0, np.stack([along, np.sign(along)], 1), np.stack([np.sign(along), along], 1)) * box.half
    cosine, sine = np.cos(angle), np.sin(angle)
    edge = local @ np.array([[cosine, sine], [-sine, cosine]]) + box.middle
    assert clearances(edge, discs).max() <= 1e-9
    rim = discs[:, None, :2] + discs[:, None, 2:] * np.stack([np.cos(np.arange(0, 7, 0.2)), np.sin(np.arange(0, 7, 0.2))], -1)
    assert box.distance(rim).max() <= 0.11


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_starts_and_goals_have_room(seed: int) -> None:
    """They keep LEAST_GAP from each other and from rectangles; the scenario can be built, and its FM slots are the goals."""
    drawn = draw_goals(np.random.default_rng(seed))
    for places in (drawn.starts, drawn.goals):
        between = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.diag(np.full(len(places), np.inf))
        assert between.min() > LEAST_GAP and min(float(box.distance(places).min()) for box in drawn.boxes) > LEAST_GAP
    scenario = goal_scenario(drawn)
    np.testing.assert_allclose(scenario.formations[0] + scenario.path_origin, drawn.goals, atol=1e-12)


def test_shares_count_agents_and_whole_teams() -> None:
    """Two teams of two agents: one agent arrives, and another collides, only after the short horizon."""
    never = np.inf
    ends = [(np.array([10.0, 300.0]), np.array([never, never])), (np.array([5.0, 6.0]), np.array([never, 400.0]))]
    early, late = goal_shares(ends, 256), goal_shares(ends, 1024)
    assert (early.reached.value, early.safe.value, early.success.value, early.teams.value) == (0.75, 1.0, 0.75, 0.5)
    assert (late.reached.value, late.safe.value, late.success.value, late.teams.value) == (1.0, 0.75, 0.75, 0.5)


def test_a_short_flight_touches_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """In 40 steps under the shield no agent touches anything."""
    monkeypatch.setattr(goal_reaching, "HORIZONS", (40,))
    reached, touched = fly_to_goals(3)
    assert reached.shape == touched.shape == (8,) and np.isinf(touched).all() and AGENT_RADIUS == 0.5
