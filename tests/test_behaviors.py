"""Elementary behaviors (8)-(11): Jacobians against finite differences, closed forms, and one-sided avoidance."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import Behavior, Formation, LineFormation, ObstacleAvoidance, nearest_obstacle
from marlbc_mj.util.errors import ConfigurationError

STEP = 1e-6  # step of the finite differences [m]

coordinates = st.floats(-20.0, 20.0)
points = arrays(np.float64, 2, elements=coordinates)
paths = arrays(np.float64, (2, 2), elements=coordinates)
obstacle_fields = arrays(
    np.float64, st.tuples(st.integers(1, 6), st.just(3)), elements=st.floats(0.0, 5.0)
)  # (K, 3): discs crowded into a corner of the plane, so that the nearest one changes often


def evaluate(behavior: Behavior, p, *, path=None, obstacles=None, agent=0):
    """A behavior's velocity (2,) and Jacobian (rows, 2) at ``p``."""
    path = np.zeros((2, 2)) if path is None else path
    obstacles = np.zeros((0, 3)) if obstacles is None else obstacles
    velocity, jacobian = np.full(2, np.nan), np.full((2, 2), np.nan)
    gains = laws.as_gains(behavior.law, behavior.params(agent))
    team = np.tile(p, (4, 1))
    rows = behavior.law(gains, np.array(p, dtype=np.float64), path, obstacles, team, agent, velocity, jacobian)
    return velocity, jacobian[:rows]


def clearance_of(p, obstacles) -> tuple[float, np.ndarray]:
    normal = np.full(2, np.nan)
    return nearest_obstacle(np.array(p, dtype=np.float64), np.array(obstacles, dtype=np.float64), normal), normal


def central_difference(function, p) -> np.ndarray:
    """d function / d p, (rows, 2)."""
    columns = [
        (np.atleast_1d(function(p + STEP * axis)) - np.atleast_1d(function(p - STEP * axis))) / (2 * STEP) for axis in np.eye(2)
    ]
    return np.stack(columns, axis=-1)


def gaps(p, obstacles) -> np.ndarray:
    return np.linalg.norm(p - obstacles[:, :2], axis=1) - obstacles[:, 2]


@given(points, obstacle_fields)
def test_avoidance_jacobian_is_the_gradient_of_the_clearance(p, obstacles):
    """J_OA = d rho_OA / d p with rho_OA the clearance (9), away from its center and from ties of nearest obstacles."""
    ordered = np.sort(gaps(p, obstacles))
    assume(len(ordered) == 1 or ordered[1] - ordered[0] > 1e-3)
    assume(np.linalg.norm(p - obstacles[:, :2], axis=1).min() > 0.05)
    _, jacobian = evaluate(ObstacleAvoidance(), p, obstacles=obstacles)
    assert jacobian.shape == (1, 2)
    np.testing.assert_allclose(jacobian, central_difference(lambda q: clearance_of(q, obstacles)[0], p), atol=1e-6)


@given(points, obstacle_fields)
def test_clearance_is_the_smallest_distance_to_a_surface_and_the_normal_points_outwards(p, obstacles):
    """d = min(|p - o| - r) (erratum 7), n is a unit vector, and 1 m along n leads 1 m away from the obstacle."""
    clearance, normal = clearance_of(p, obstacles)
    assert clearance == pytest.approx(gaps(p, obstacles).min(), abs=1e-12)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    nearest = obstacles[gaps(p, obstacles).argmin()]
    assert np.linalg.norm(p + normal - nearest[:2]) == pytest.approx(np.linalg.norm(p - nearest[:2]) + 1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("p", "clearance"), [((57.0, 0.0), np.hypot(3.0, 9.0) - 5.0), ((65.0, 0.0), np.hypot(5.0, 9.0) - 5.0), ((60.0, 9.5), -4.5)]
)
def test_clearance_to_discs_is_to_their_surface_and_negative_inside(p, clearance):
    """Erratum 7 on the case study's gate."""
    assert clearance_of(p, [(60, 9, 5), (70, 9, 5), (60, -9, 5), (70, -9, 5)])[0] == pytest.approx(clearance, abs=1e-12)


@given(points, obstacle_fields)
def test_one_sided_avoidance_pushes_inside_the_safe_distance_and_is_still_beyond(p, obstacles):
    """v = n Lambda max(0, d_OA - d): (9) with erratum 6."""
    clearance, normal = clearance_of(p, obstacles)
    velocity, _ = evaluate(ObstacleAvoidance(gain=20.0, safe_distance=2.0), p, obstacles=obstacles)
    np.testing.assert_allclose(velocity, normal * 20.0 * max(0.0, 2.0 - clearance), rtol=1e-12, atol=1e-12)
    if clearance >= 2.0:
        assert not velocity.any()


@given(st.floats(-1.0, 1.0), st.floats(0.0, 2 * np.pi), st.floats(0.0, 5.0))
def test_one_sided_avoidance_begins_exactly_at_the_safe_distance(excess, angle, radius):
    """Around one disc, at d = 2 + excess: speed 20 max(0, -excess) outwards, on both sides of the threshold."""
    outwards = np.array([np.cos(angle), np.sin(angle)])
    p = np.array([60.0, 9.0]) + (radius + 2.0 + excess) * outwards
    velocity, _ = evaluate(ObstacleAvoidance(gain=20.0, safe_distance=2.0), p, obstacles=np.array([[60.0, 9.0, radius]]))
    np.testing.assert_allclose(velocity, 20.0 * max(0.0, -excess) * outwards, rtol=0, atol=1e-12 * 60 * 20)


@given(points, obstacle_fields)
def test_two_sided_avoidance_attracts_from_beyond(p, obstacles):
    """The published equality task: along n the velocity is Lambda (d_OA - d), negative outside (erratum 6)."""
    clearance, normal = clearance_of(p, obstacles)
    velocity, _ = evaluate(ObstacleAvoidance(gain=20.0, safe_distance=2.0, two_sided=True), p, obstacles=obstacles)
    assert velocity @ normal == pytest.approx(20.0 * (2.0 - clearance), rel=1e-9, abs=1e-9)
    assert np.linalg.norm(velocity) == pytest.approx(abs(20.0 * (2.0 - clearance)), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("two_sided", [False, True])
def test_without_obstacles_avoidance_asks_for_nothing(two_sided):
    """Without obstacles the clearance is infinite; velocity and Jacobian are zero, so that nothing is projected away."""
    assert clearance_of((1.0, 2.0), np.zeros((0, 3)))[0] == np.inf
    velocity, jacobian = evaluate(ObstacleAvoidance(two_sided=two_sided), (1.0, 2.0))
    assert not velocity.any() and not jacobian.any()


def test_at_the_centre_of_an_obstacle_there_still_is_a_way_out():
    """The normal is not defined there; (1, 0) is used, and the velocity is finite and points along it."""
    clearance, normal = clearance_of((60.0, 9.0), [(60, 9, 5)])
    assert clearance == -5.0 and normal.tolist() == [1.0, 0.0]
    velocity, _ = evaluate(ObstacleAvoidance(), (60.0, 9.0), obstacles=np.array([[60.0, 9.0, 5.0]]))
    assert velocity.tolist() == [20.0 * 7.0, 0.0]


@given(points, paths, st.lists(st.tuples(coordinates, coordinates), min_size=4, max_size=4), st.integers(0, 3))
def test_formation_is_the_closed_loop_of_its_own_task_variable(p, path, offsets, agent):
    """rho = p - p_cd - offset: J = d rho / d p = I and v = p_cd' - Lambda rho, for FM (10) and FR (11) alike (erratum 3)."""
    behavior = Formation("FM", tuple(offsets), gain=8.0)

    def task(q):
        return q - path[0] - np.array(offsets[agent])

    velocity, jacobian = evaluate(behavior, p, path=path, agent=agent)
    np.testing.assert_allclose(jacobian, central_difference(task, p), atol=1e-6)
    np.testing.assert_array_equal(jacobian, np.eye(2))
    np.testing.assert_allclose(velocity, path[1] - 8.0 * task(p), rtol=1e-12, atol=1e-12)


def test_on_its_slot_an_agent_moves_with_the_path():
    """On its slot, v is the path's velocity, so that the agent does not lag (erratum 3)."""
    velocity, _ = evaluate(Formation("FM", ((2.5, 6.0),)), (12.5, 6.0), path=np.array([[10.0, 0.0], [1.0, 0.0]]))
    assert velocity.tolist() == [1.0, 0.0]


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, np.inf])
@pytest.mark.parametrize(
    "make",
    [lambda x: ObstacleAvoidance(gain=x), lambda x: ObstacleAvoidance(safe_distance=x), lambda x: Formation("FM", ((0, 0),), x)],
)
def test_numbers_that_are_not_positive_and_finite_are_refused(make, value):
    """This holds for gains and the safe distance; the message shows the value."""
    with pytest.raises(ConfigurationError, match=str(value)):
        make(value)


def test_offsets_that_are_not_finite_are_refused():
    """The message shows the offsets."""
    with pytest.raises(ConfigurationError, match="nan"):
        Formation("FM", ((0.0, np.nan),))


@given(points, paths, points)
def test_along_the_line_of_a_slot_only_near_that_line(p, path, slot):
    """Across the path it equals FR. Relative to the path's motion, it is FR on the line, less near it, 0 from ``width`` on."""
    assume(np.linalg.norm(path[1]) > 1e-3)
    along = path[1] / np.linalg.norm(path[1])
    across = np.array([-along[1], along[0]])
    straight, jacobian = evaluate(Formation("FR", (tuple(slot),), 2.0), p, path=path)
    line, same = evaluate(LineFormation("FR", (tuple(slot),), 2.0, width=3.0), p, path=path)
    np.testing.assert_array_equal(jacobian, same)
    assert across @ line == pytest.approx(across @ straight, abs=1e-9)
    share = max(0.0, 1.0 - (across @ (path[0] + slot - p) / 3.0) ** 2)
    assert along @ (line - path[1]) == pytest.approx(share * (along @ (straight - path[1])), abs=1e-9)


def test_a_path_at_rest_has_no_lines():
    p, slot = np.array([1.0, 2.0]), ((5.0, -3.0),)
    straight, line = (evaluate(kind("FR", slot, 2.0), p)[0] for kind in (Formation, LineFormation))
    np.testing.assert_array_equal(line, straight)


def test_a_line_has_a_width():
    with pytest.raises(ConfigurationError, match="FR width"):
        LineFormation("FR", ((0.0, 0.0),), width=0.0)
