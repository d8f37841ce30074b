"""Shields of real robots: of forces if these act at once, else of references within a measured or computed tube."""

from dataclasses import replace

import pytest
from hostile import attack
from test_shield import corridor

from marlbc_mj.controllers import LQR, PD, SORLC
from marlbc_mj.core.disturbances import PaperDrag
from marlbc_mj.core.shield import FORCE_BROKEN, STATE_BROKEN, TUBE_BROKEN, Shield
from marlbc_mj.engine.shielding import resolve, tracking_tube
from marlbc_mj.engine.world import World
from marlbc_mj.robots import ROBOTS, make_robot
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.util.errors import ConfigurationError


def limited(**changes):
    """Point masses among obstacles, with references of limited speed and acceleration."""
    return corridor(speed_limit=3.0, acceleration_limit=4.0, disturbance=PaperDrag(1.0), **changes)


def crowded(robot):
    """A robot's gate with all agents starting close to its obstacles, which saves the minute of the way there."""
    scenario = make_scenario("robot_gate", robot=robot)
    unit = make_robot(robot).length
    first = scenario.obstacles[0]
    starts = tuple((first.x + unit * x, first.y + unit * y) for x, y in ((-6.0, 0.0), (-6.0, 5.0), (6.0, 0.0), (6.0, 5.0)))
    return replace(scenario, starts=starts)


@pytest.mark.parametrize("robot", ["disc", "omni", "diff_drive", "crazyflie"])
def test_robots_keep_clear_under_a_supervisor_that_means_harm(robot):
    """It holds in MuJoCo at every substep, with the robots' own numbers, and no assumption is broken."""
    scenario = crowded(robot)
    world = World(scenario, PD(*make_robot(robot).gains), record=True, shield=True)
    clearance, distance, off = attack(world, 240, speed=world.scenario.speed_limit, change=30)
    assert clearance > scenario.safe_distance
    assert distance > 2.0 * world.plan.robot.radius
    assert world.state.breaches.sum() == 0
    assert world.state.interventions.sum() > 0
    forces = make_robot(robot).force_error is not None
    assert (world.plan.plant.shield[0].tube == 0.0) == forces
    assert forces or off <= world.plan.plant.shield[0].tube


def test_references_of_point_masses_have_a_computed_tube():
    """No agent leaves it, and it is less than three times as wide as needed."""
    world = World(limited(), PD(), record=True, shield=Shield(level="reference"))
    clearance, distance, off = attack(world, 240, speed=world.scenario.speed_limit, change=30)
    tube = world.plan.plant.shield[0].tube
    assert tube == tracking_tube(world.scenario, PD(), PaperDrag(1.0).force_bound())
    assert tube / 3.0 < off <= tube
    assert clearance > world.scenario.safe_distance
    assert distance > 2.0 * world.plan.robot.radius
    assert world.state.breaches.sum() == 0
    assert world.state.interventions.sum() > 0


def test_a_tube_that_is_too_narrow_is_counted():
    """Agents farther from their references than the tube are counted."""
    world = World(limited(), PD(), record=True, shield=Shield(tube=1e-3))
    attack(world, 20, speed=world.scenario.speed_limit, change=30)
    assert world.state.breaches[..., TUBE_BROKEN].sum() > 0
    assert world.state.breaches[..., (FORCE_BROKEN, STATE_BROKEN)].sum() == 0


def test_networks_that_are_off_have_the_tube_of_their_gains():
    """SORLC without networks is PD."""
    numbers = [resolve(Shield(level="reference"), limited(), 200.0, law) for law in (PD(), SORLC(basis="off"))]
    assert numbers[0] == numbers[1]


@pytest.mark.parametrize(
    ("scenario", "controller", "shield", "said"),
    [
        (limited(), SORLC(), Shield(level="reference"), "no tube is known for SORLC"),
        (limited(), PD(100.0, 10.0), Shield(level="reference"), "100 and 10 overshoot"),
        (limited(force_limit=6.0), PD(), Shield(level="reference"), "more than the force limit of 6 N"),
        (corridor(), PD(), Shield(level="reference"), "limited acceleration, got 'virtual' and inf"),
        (limited(reference="actual"), PD(), Shield(tube=0.1), "got 'actual' and 4"),
        (limited(), PD(), Shield(tube=0.1, latency=0.05), "messages may be late only in a shield of forces"),
        (limited(), PD(), Shield(tube=3.0), "starts at a clearance of 2.831 m"),
        (make_scenario("robot_gate", robot="diff_drive"), LQR(), True, "gains .* but LQR has"),
    ],
)
def test_what_a_shield_of_references_cannot_assume_is_refused(scenario, controller, shield, said):
    """The error names what breaks the assumption."""
    with pytest.raises(ConfigurationError, match=said):
        World(scenario, controller, shield=shield)


def test_a_robot_that_nobody_measured_is_told_what_is_missing(monkeypatch):
    """The error names both missing numbers and how to get them."""
    unknown = replace(make_robot("diff_drive"), name="unmeasured", tube=None)
    monkeypatch.setitem(ROBOTS, unknown.name, (lambda: unknown, ""))
    with pytest.raises(ConfigurationError, match="lacks force_error.*and tube.*shield_robots ROBOT"):
        World(make_scenario("robot_gate", robot=unknown.name), PD(), shield=True)
