"""ORCA and the second-order barrier function: planes checked by hand and by another implementation, and their shared program."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from marlbc_mj.core.halfplanes import closest
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.outcomes import outcome
from marlbc_mj.scenarios import held_out, make_scenario
from marlbc_mj.supervisors import CBFQP, ORCA, Blend, make_supervisor
from marlbc_mj.supervisors.cbf_qp import barrier_plane
from marlbc_mj.supervisors.orca import orca_plane
from marlbc_mj.util.errors import ConfigurationError

OPEN = make_scenario("open")
SLOTS = OPEN.formations[0]
FM = OPEN.orders.index("FM")
seeds = st.integers(0, 2**32 - 1)


def solve(planes: np.ndarray, wish, speed: float) -> tuple[np.ndarray, bool]:
    """The velocity (2,) nearest to ``wish``, and whether all half-planes (K, 3) hold."""
    rows, out = np.zeros((2 * len(planes) + 1, 4)), np.empty(2)
    rows[: len(planes), :3] = planes
    held = closest(np.asarray(wish, dtype=float), speed, rows, len(planes), out)
    return out, held


def random_planes(rng: np.random.Generator, count: int, through: float) -> np.ndarray:
    """(count, 3) half-planes; all hold at a common point if ``through`` is 0, most contradict each other if it is large."""
    angle = rng.uniform(0, 2 * np.pi, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    common = rng.uniform(-1, 1, 2)
    return np.column_stack([normals, normals @ common - rng.uniform(0, 1, count) + through * rng.uniform(0, 2, count)])


def corners(planes: np.ndarray, wish: np.ndarray, speed: float) -> np.ndarray:
    """All points that can be the optimum: the desired velocity, its projections on lines and circle, and intersections."""
    points = [wish, wish * speed / np.linalg.norm(wish)]
    for n, c in zip(planes[:, :2], planes[:, 2], strict=True):
        points.append(wish + (c - n @ wish) * n)
        if abs(c) <= speed:
            along = np.sqrt(speed**2 - c**2) * np.array([-n[1], n[0]])
            points += [c * n + along, c * n - along]
    for i in range(len(planes)):
        for j in range(i):
            if abs(np.linalg.det(planes[[i, j], :2])) > 1e-9:
                points.append(np.linalg.solve(planes[[i, j], :2], planes[[i, j], 2]))
    return np.array(points)


@given(seeds, st.integers(0, 7))
def test_the_program_finds_the_nearest_of_all_corners(seed, count):
    """For feasible problems in the disc of radius 2, the result is as near as the best of the finitely many candidates."""
    rng = np.random.default_rng(seed)
    planes, wish = random_planes(rng, count, 0.0), rng.uniform(-4, 4, 2)
    v, held = solve(planes, wish, 2.0)
    points = corners(planes, wish, 2.0)
    feasible = (points @ planes[:, :2].T >= planes[:, 2] - 1e-9).all(axis=1) & (np.linalg.norm(points, axis=1) <= 2.0 + 1e-9)
    assert held and np.linalg.norm(v) <= 2.0 + 1e-9
    assert (planes[:, :2] @ v >= planes[:, 2] - 1e-8).all()
    assert np.linalg.norm(v - wish) <= np.linalg.norm(points[feasible] - wish, axis=1).min() + 1e-7


@given(seeds, st.integers(3, 8))
def test_where_half_planes_contradict_the_greatest_violation_is_least(seed, count):
    """Compared with a linear program over v and the violation z, in which the disc is a circumscribed polygon of 360 sides."""
    rng = np.random.default_rng(seed)
    planes = random_planes(rng, count, 1.0)
    v, held = solve(planes, rng.uniform(-1, 1, 2), 2.0)
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    disc = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(360)])
    rows = np.vstack([np.column_stack([-planes[:, :2], -np.ones(count)]), disc])
    limits = np.concatenate([-planes[:, 2], np.full(360, 2.0)])
    best = linprog([0, 0, 1], A_ub=rows, b_ub=limits, bounds=[(None, None), (None, None), (0, None)]).fun
    violation = max(0.0, float((planes[:, 2] - planes[:, :2] @ v).max()))
    assert np.linalg.norm(v) <= 2.0 + 1e-9 and violation <= best + 1e-3
    assert held == (violation <= 1e-8)


# ORCA ---------------------------------------------------------------------------------------------------------------------------


def plane_for(x, relative, radius: float, v=(0.0, 0.0), share: float = 1.0, times=(2.0, 0.05)) -> np.ndarray:
    """The half-plane of an agent of velocity ``v`` for a body at relative position ``x`` and velocity ``relative``."""
    plane = np.empty(3)
    orca_plane(np.array([x, relative], dtype=float), radius, np.asarray(v, dtype=float), share, times, plane)
    return plane


def least_distance(x: np.ndarray, relative: np.ndarray, within: float) -> float:
    """Least distance of two bodies at relative position x and relative velocity ``relative``, over [0, within]."""
    when = np.clip(-(x @ relative) / max(relative @ relative, 1e-300), 0.0, within)
    return float(np.linalg.norm(x + when * relative))


@given(seeds)
def test_on_the_line_of_a_body_the_agent_just_touches_it(seed):
    """After a change of velocity by u, the shortest to the line, the least distance within the horizon is exactly the radius."""
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.5, 2.0)
    turn = rng.uniform(0, 2 * np.pi)
    x = (radius + rng.uniform(0.1, 5.0)) * np.array([np.cos(turn), np.sin(turn)])
    v, body = rng.uniform(-3, 3, (2, 2))
    plane = plane_for(x, body - v, radius, v)
    change = plane[2] - plane[:2] @ v
    after = v + change * plane[:2]
    assert least_distance(x, body - after, 2.0) == pytest.approx(radius, abs=1e-9)
    assert (change > 0) == (least_distance(x, body - v, 2.0) < radius - 1e-12) or abs(change) < 1e-9


def test_two_agents_share_what_one_would_do_alone():
    """Each takes half of u; towards a body at rest, an agent may cross a gap of 3 m in no less than the horizon of 2 s."""
    whole = plane_for((4.0, 0.0), (-4.0, 0.0), 1.0, v=(2.0, 0.0))
    half = plane_for((4.0, 0.0), (-4.0, 0.0), 1.0, v=(2.0, 0.0), share=0.5)
    assert half[2] - half[:2] @ (2.0, 0.0) == pytest.approx(0.5 * (whole[2] - whole[:2] @ (2.0, 0.0)))
    away = plane_for((4.0, 0.0), (0.0, 0.0), 1.0)
    np.testing.assert_allclose(away, [-1.0, 0.0, -1.5], atol=1e-12)


def test_bodies_that_overlap_part_within_one_mission_step():
    """Bodies 0.1 m too near must part at 2 m/s or faster, of which an agent takes half."""
    plane = plane_for((0.9, 0.0), (0.0, 0.0), 1.0, share=0.5)
    np.testing.assert_allclose(plane, [-1.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_orca_agrees_with_the_reference_implementation(seed):
    """The reference is RVO2 through pyrvo (single precision): velocities of five moving agents after one step."""
    pyrvo = pytest.importorskip("pyrvo")
    rng = np.random.default_rng(seed)
    radius, most, tau, dt = 0.75, 6.0, 2.0, 0.05
    p = np.array([(3.0 * i, rng.uniform(-1, 1)) for i in range(5)])
    v, wish = rng.uniform(-1.5, 1.5, (2, 5, 2))
    simulator = pyrvo.RVOSimulator(dt, 100.0, 10, tau, tau, radius, most)
    for i in range(5):
        simulator.add_agent(tuple(p[i]))
        simulator.set_agent_velocity(i, tuple(v[i]))
        simulator.set_agent_pref_velocity(i, tuple(wish[i]))
    simulator.do_step()
    for i in range(5):
        others = [j for j in range(5) if j != i]
        planes = np.array([plane_for(p[j] - p[i], v[j] - v[i], 2.0 * radius, v[i], 0.5, (tau, dt)) for j in others])
        own, held = solve(planes, wish[i], most)
        theirs = simulator.get_agent_velocity(i)
        assert held
        np.testing.assert_allclose(own, [theirs.x, theirs.y], rtol=0, atol=2e-5)


# Barrier functions --------------------------------------------------------------------------------------------------------------


def barrier(x, relative, least: float, pole: float = 3.0, share: float = 1.0) -> np.ndarray:
    plane = np.empty(3)
    between = np.array([x, relative], dtype=float)
    barrier_plane(between, float(np.linalg.norm(x)), least, pole, share, plane)
    return plane


def test_a_barrier_by_hand():
    """At 2 m from a body, at least 1 m allowed, approach at 1 m/s, pole 3: n.a >= -(6 * -1 + 9 * 1) = -3; sideways adds v^2/D."""
    np.testing.assert_allclose(barrier((2.0, 0.0), (-1.0, 0.0), 1.0), [-1.0, 0.0, -3.0], atol=1e-12)
    np.testing.assert_allclose(barrier((2.0, 0.0), (-1.0, 2.0), 1.0), [-1.0, 0.0, -5.0], atol=1e-12)
    np.testing.assert_allclose(barrier((2.0, 0.0), (-1.0, 0.0), 1.0, share=0.5), [-1.0, 0.0, -1.5], atol=1e-12)
    assert np.isfinite(barrier((0.0, 0.0), (0.0, 0.0), 1.0)).all()


@given(seeds)
def test_the_derivatives_in_a_barrier_are_those_of_the_distance(seed):
    """h'' + 2 rho h' + rho^2 h = 0 on the line, with finite differences of h along the motion with that acceleration."""
    rng = np.random.default_rng(seed)
    x, relative = rng.uniform(1.0, 3.0, 2), rng.uniform(-2, 2, 2)
    plane = barrier(x, relative, 1.0)
    acceleration = plane[2] * plane[:2]
    h = [float(np.linalg.norm(x + t * relative - 0.5 * t * t * acceleration)) - 1.0 for t in (-1e-4, 0.0, 1e-4)]
    first, second = (h[2] - h[0]) / 2e-4, (h[2] - 2 * h[1] + h[0]) / 1e-8
    assert second + 6.0 * first + 9.0 * h[1] == pytest.approx(0.0, abs=1e-4)


# Both ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["orca", "cbf-qp"])
def test_in_free_space_the_desired_velocity_is_kept(name):
    """In formation with nothing near, the velocity is the path's and the orders are FM."""
    supervisor, observation = make_supervisor(name), World(OPEN).observe()
    memory = supervisor.start(OPEN, 1)
    for _ in range(100):
        blend, memory = supervisor.decide(observation, memory)
    assert isinstance(blend, Blend) and (blend.orders == FM).all()
    np.testing.assert_allclose(blend.velocity, np.tile((1.0, 0.0), (1, 4, 1)), rtol=0, atol=1e-3)


@pytest.mark.parametrize("name", ["orca", "cbf-qp"])
def test_no_agent_comes_too_near_anything(name):
    """On held-out layouts with obstacles at rest or moving, nothing is violated or hit, whether the team arrives or not."""
    for family in ("field", "traffic", "gates"):
        scenario = held_out(make_scenario(family))
        found = outcome(measure(run_episode(World(scenario, record=True), make_supervisor(name), seed=7200)), scenario)
        assert not (found.violated or found.struck or found.collided), family


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ORCA(horizon=0.0), "horizon"),
        (lambda: CBFQP(pole=-1.0), "pole"),
        (lambda: CBFQP(acceleration=np.inf), "acceleration"),
        (lambda: ORCA(margin=-1.0).start(OPEN, 1), "margin"),
        (lambda: CBFQP(speed=0.0).start(OPEN, 1), "speed"),
        (lambda: ORCA(sight=np.nan).start(OPEN, 1), "sight"),
        (lambda: ORCA(motion="XX").start(OPEN, 1), "XX"),
    ],
)
def test_settings_that_cannot_be_are_refused(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()
