"""Scenarios: the case study's numbers and geometry, and settings that cannot be run, each refused with its value."""

import re

import numpy as np
import pytest

from marlbc_mj.controllers import PD, SORLC
from marlbc_mj.core.behaviors import Formation, clearances
from marlbc_mj.core.disturbances import make_disturbance
from marlbc_mj.engine.world import World
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Obstacle, Perturbation, make_scenario, paper, standard_behaviors
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError, MarlbcError

SLOTS = paper().behaviors[1].offsets
COLUMN = paper().behaviors[2].offsets
PRINTED_COLUMN = ((4.5, 0.0), (1.5, 0.0), (1.5, 0.0), (4.5, 0.0))  # Gamma_3 and Gamma_4 negative (erratum 4)


def test_the_case_study_is_the_published_one():
    """Its numbers are those of section 4.1 and Tables 1 and 2, with Gamma positive (erratum 4)."""
    scenario = paper()
    gamma = np.array([9, 3, 3, 9]) / 5.0
    slots = np.array([(2.5, 6), (2.5, -6), (-2.5, 12), (-2.5, -12)])
    assert scenario.starts == ((-2, 8), (-2, -8), (-7, 14), (-7, -14))
    np.testing.assert_array_equal(scenario.formations[0], slots)
    np.testing.assert_allclose(scenario.formations[1], np.stack([gamma * slots[:, 0], np.zeros(4)], axis=1), rtol=1e-15)
    assert scenario.obstacles == ((20, 5, 0), (40, -11, 0), (60, 9, 5), (70, 9, 5), (60, -9, 5), (70, -9, 5))
    assert (scenario.path_origin, scenario.path_velocity) == ((-2.5, 0), (1, 0))
    assert (scenario.mission_steps, scenario.mission_step, scenario.substeps, scenario.substep) == (2000, 0.05, 10, 0.005)
    assert (scenario.safe_distance, scenario.force_limit, scenario.mass) == (2, 200, 1)
    assert [b.gain for b in scenario.behaviors] == [20, 8, 8] and scenario.behaviors[0].safe_distance == 2
    sorlc = SORLC()
    assert (sorlc.position_error_gain, sorlc.velocity_error_gain, sorlc.compensator_gain) == (100, 100, 50)
    assert (sorlc.identifier_rate, sorlc.identifier_leak, sorlc.actor_rate, sorlc.critic_rate) == (0.4, 0.6, 6, 4)
    assert (sorlc.control_weight, sorlc.centre_range, sorlc.width, sorlc.tau_sign) == (1, 6, 2, -1)


def test_the_path_ends_where_the_paper_says():
    """Targets are the slots around the centroid at 100 s, relative to a path that ends at (97.5, 0)."""
    end = np.array(paper().path_origin) + 100.0 * np.array(paper().path_velocity)
    np.testing.assert_allclose(paper().formations[0] + end, [(100, 6), (100, -6), (95, 12), (95, -12)])


def test_what_the_geometry_asks_for():
    """Agents 1 and 4 pass a point at 1 m, 2 and 3 at 2 m or more; every slot meets a disc; the column clears the gate by 4 m."""
    scenario = paper()
    t = np.linspace(0.0, 100.0, 20001)
    centroid = np.array(scenario.path_origin) + t[:, None] * np.array(scenario.path_velocity)
    slots, column = (centroid[:, None] + offsets for offsets in scenario.formations)
    points, discs = scenario.obstacle_array()[:2], scenario.obstacle_array()[2:]
    nearest = clearances(slots, points).min(axis=0)
    np.testing.assert_allclose(nearest[[0, 3]], 1.0, atol=1e-6)
    assert (nearest[[1, 2]] >= 2.0).all()
    assert (clearances(slots, discs).min(axis=0) < 0.0).all()
    np.testing.assert_allclose(clearances(column, discs).min(axis=0), 4.0, atol=1e-6)


def refusal(*fragments: str):
    """Expect a ConfigurationError with a message that contains all ``fragments`` in this order."""
    return pytest.raises(ConfigurationError, match=".*".join(map(re.escape, fragments)))


@pytest.mark.parametrize(
    ("make", "fragments"),
    [
        (lambda: make_scenario("nowhere"), ("scenario 'nowhere'", "paper")),
        (lambda: make_supervisor("nobody"), ("supervisor 'nobody'", "scripted", "fsams")),
        (lambda: make_disturbance("rain"), ("disturbance 'rain'", "paper, linear")),
        (lambda: make_robot("unicycle"), ("robot 'unicycle'", "point_mass")),
        (lambda: World(paper(robot="unicycle")), ("robot 'unicycle'", "point_mass")),
        (lambda: paper(reference="real"), ("reference mode 'real'", "virtual, actual")),
        (lambda: paper(formation_names=("FM", "COLUMN")), ("formation behavior 'COLUMN'", "FM, FR")),
        (lambda: paper().orders.index("FM>XX"), ("priority order 'FM>XX'", "OA>FM")),
    ],
)
def test_unknown_names_are_refused_with_the_valid_ones(make, fragments):
    """This holds for scenario, supervisor, disturbance, robot, reference mode, formation and order."""
    with refusal(*fragments):
        make()


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, np.inf])
@pytest.mark.parametrize(
    "name", ["safe_distance", "formation_tolerance", "duration", "mission_step", "substep", "mass", "force_limit"]
)
def test_numbers_must_be_positive_and_finite(name, value):
    """The message names the field and the value."""
    with refusal(name, str(value)):
        paper(**{name: value})


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"substep": 0.007}, ("mission_step 0.05", "substep 0.007")),
        ({"substep": 0.1}, ("mission_step 0.05", "substep 0.1")),
        ({"substep": 0.004}, ("mission_step 0.05", "substep 0.004")),
        ({"duration": 0.12}, ("duration 0.12", "mission_step 0.05")),
        ({"starts": ((np.nan, 0.0), *paper().starts[1:])}, ("starts", "nan")),
        ({"path_velocity": (np.inf, 0.0)}, ("path", "inf")),
        ({"obstacles": (Obstacle(1.0, np.nan),)}, ("obstacles", "nan")),
        ({"obstacles": (Obstacle(1.0, 2.0, -3.0),)}, ("obstacle 0", "negative radius", "-3.0")),
        ({"obstacles": (Obstacle(50, 0), Obstacle(-2, 6, 2.5))}, ("obstacle 1", "(-2, 6, 2.5)", "agent 1", "(-2.0, 8.0)")),
        ({"obstacles": (Obstacle(-7, -14),)}, ("obstacle 0", "agent 4", "(-7.0, -14.0)")),
        ({"starts": ((0.0, 0.0),)}, ("1 agent(s)", "at least 2")),
        ({"starts": ()}, ("0 agent(s)", "at least 2")),
        ({"starts": paper().starts[:3]}, ("FM has 4 slots for 3 agents",)),
        ({"behaviors": standard_behaviors(SLOTS, PRINTED_COLUMN)}, ("FR slots of agents 2 and 3", "(1.5, 0.0)")),
    ],
    ids=str,
)
def test_what_cannot_be_run_is_refused_when_the_scenario_is_built(changes, fragments):
    """Wrong clocks, numbers and teams, obstacles on starts, and overlapping slots, as with the published Gamma (erratum 4)."""
    with refusal(*fragments):
        paper(**changes)


@pytest.mark.parametrize(
    ("make", "value"),
    [
        (lambda: standard_behaviors(SLOTS, COLUMN, avoidance_gain=-20.0), "-20.0"),
        (lambda: standard_behaviors(SLOTS, COLUMN, formation_gain=np.nan), "nan"),
        (lambda: standard_behaviors(SLOTS, COLUMN, safe_distance=-2.0), "-2.0"),
        (lambda: Formation("FM", SLOTS, np.inf), "inf"),
        (lambda: PD(position_gain=-3.0), "-3.0"),
        (lambda: SORLC(compensator_gain=-50.0), "-50.0"),
    ],
)
def test_gains_must_be_positive_and_finite(make, value):
    """This holds for behaviors and controllers; the message shows the value."""
    with refusal(value):
        make()


@pytest.mark.parametrize(
    ("numbers", "value"),
    [
        ({"drag_scale": (1.5, 0.5)}, "(1.5, 0.5)"),
        ({"drag_scale": (-0.5, 0.5)}, "-0.5"),
        ({"start_spread": -1.0}, "-1.0"),
        ({"obstacle_spread": np.nan}, "nan"),
        ({"drag_scale": (0.0, np.inf)}, "inf"),
    ],
)
def test_perturbations_must_be_ordered_ranges(numbers, value):
    """Negative, unordered or infinite ranges are refused, and the message shows them."""
    with refusal("perturbation", value):
        Perturbation(**numbers)


def test_substeps_beyond_the_stability_limit_are_refused():
    """0.025 s divides 0.05 s, but gains 100 and 100 need less than 19.8 ms, and a lighter agent less still."""
    with refusal("25 ms", "19.8 ms", "100"):
        World(paper(substep=0.025))
    with refusal("50 ms", "19.8 ms"):
        World(paper(substep=0.05), PD())
    with refusal("5 ms", "2.0 ms"):
        World(paper(mass=0.1))
    World(paper(substep=0.025), PD(position_gain=10.0, velocity_gain=10.0))
    World(paper(substep=0.0125))


@pytest.mark.parametrize("number", [0, -1])
def test_a_world_needs_copies(number):
    """The message shows the number."""
    with refusal("worlds", str(number)):
        World(paper(), worlds=number)


@pytest.mark.parametrize("number", [0, -1, 99])
def test_threads_are_those_of_the_machine(number):
    """The message shows the number and the range."""
    with refusal("threads must be between 1 and", f"got {number}"):
        World(paper(), threads=number)


@pytest.mark.parametrize(
    ("orders", "value"),
    [
        (np.zeros((1, 4)), "(2, 4)"),
        (np.zeros(4), "(4,)"),
        (np.zeros((2, 3)), "(2, 3)"),
        (np.full((2, 4), 6), "0 to 5"),
        (np.full((2, 4), -1), "-1"),
    ],
    ids=str,
)
def test_orders_must_be_indices_in_the_right_shape(orders, value):
    """Orders are (worlds, agents), each from 0 to 5; with others, no world is stepped."""
    world = World(paper(), worlds=2)
    with refusal("orders must", value):
        world.step(orders.astype(np.int64))
    assert (world.state.steps == 0).all() and all(data.time == 0.0 for data in world.data)


def test_errors_have_one_root_and_an_exit_status():
    """A ConfigurationError is a ValueError too, and makes the command line exit with 2."""
    assert issubclass(ConfigurationError, MarlbcError) and issubclass(ConfigurationError, ValueError)
    assert ConfigurationError.exit_status == 2
