"""A shield among moving obstacles: it stops relative to them, keeps clear of a single one, and counts failures among several."""

import numpy as np
import pytest
from test_shield import STRONG, corridor, harass

from marlbc_mj.controllers import PD
from marlbc_mj.core.shield import ASSUMPTIONS, MOTION_BROKEN, STATE_BROKEN, Shield
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Motion, Obstacle, make_scenario, paper
from marlbc_mj.studies.shield_missions import mission_of, run_missions
from marlbc_mj.studies.shield_states import leave_rate
from marlbc_mj.util.errors import ConfigurationError

PURSUED = STRONG._replace(obstacle_speed=2.0, obstacle_acceleration=20.0)
AT_REST = Motion(0.0, 0.0, 0.0, 0.0, 10.0, 0.0)


def test_one_obstacle_that_moves_within_its_bounds_leads_out_of_no_safe_state():
    """States are random on the edge of S in the obstacle's frame, with f and the obstacle's acceleration at their bounds."""
    assert leave_rate(PURSUED, 100_000, seed=3) == 0.0


def test_an_acceleration_that_is_not_believed_is_found():
    """The same states detect that the shield believes in obstacles without acceleration."""
    assert leave_rate(PURSUED._replace(believed_acceleration=0.0), 100_000, seed=3) > 1e-4


def test_an_agent_at_rest_gives_way_to_an_obstacle_that_comes():
    """It is pushed along at the obstacle's speed, outside the safe distance; the shield changes no other agent."""
    starts = ((0.0, 8.0), (0.0, 60.0), (0.0, 90.0), (0.0, 120.0))
    coming = Motion(-1.5, 0.0, 0.0, 0.0, 10.0, 0.0)
    scenario = paper(obstacles=(Obstacle(10.0, 8.0, 1.0),), motions=(coming,), starts=starts, schedule=(), duration=10.0)
    world = World(scenario, PD(), record=True, shield=True)
    still, least = np.zeros((1, 4, 2)), np.inf
    for _ in range(200):
        world.state.reference[:] = world.state.position
        world.step(np.zeros((1, 4), dtype=np.int64), still)
        least = min(least, float(world.state.clearance[0, 0]))
    assert least > scenario.safe_distance
    assert world.state.position[0, 0, 0] < -7.0
    assert world.state.breaches.sum() == 0
    assert world.state.interventions[0].tolist()[1:] == [0.0, 0.0, 0.0]


def test_obstacles_that_could_move_but_do_not_change_nothing():
    """Obstacles at rest equal obstacles with velocity 0, up to where projections stop (2 mm in 3 s of attack)."""
    scenario = corridor()
    moving = corridor(motions=(AT_REST,) * len(scenario.obstacles))
    shield = Shield(obstacle_speed=0.0, obstacle_acceleration=0.0)
    worlds = [World(each, PD(), record=True, shield=shield) for each in (scenario, moving)]
    np.testing.assert_allclose(harass(worlds[0], steps=60), harass(worlds[1], steps=60), rtol=1e-6)
    np.testing.assert_allclose(worlds[0].state.position, worlds[1].state.position, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(worlds[0].state.breaches, worlds[1].state.breaches)
    assert worlds[0].state.interventions.sum() > 0


def test_in_traffic_whoever_comes_too_near_was_counted_before():
    """Violations only occur with counted breaches; without a shield the same missions have more violations."""
    scenario = mission_of("traffic", 4, seconds=12.0)
    shielded, free = (run_missions(scenario, 8, seed=5, shield=shield) for shield in (True, None))
    assert free.violations > shielded.violations
    assert shielded.violations == 0 or shielded.breaches[[STATE_BROKEN, MOTION_BROKEN]].sum() > 0
    assert shielded.interventions > 0
    assert ASSUMPTIONS[MOTION_BROKEN] == "motion"


@pytest.mark.parametrize(
    ("shield", "said"),
    [
        (Shield(obstacle_speed=0.1), r"obstacle \d reaches .* m/s, more than obstacle_speed = 0.1 m/s"),
        (Shield(obstacle_acceleration=1e-4), r"m/s\^2, more than obstacle_acceleration = 0.0001 m/s\^2"),
        (Shield(obstacle_acceleration=150.0), r"leave .* N of the force limit of 200 N"),
        (Shield(level="reference", tube=0.1), "a shield of references supports only obstacles at rest"),
    ],
)
def test_motions_that_are_not_assumed_are_refused(shield, said):
    """The error names the number that breaks the assumption."""
    with pytest.raises(ConfigurationError, match=said):
        World(make_scenario("traffic"), PD(), shield=shield)
