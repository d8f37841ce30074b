"""The half-plane program against a quadratic solver, a linear solver, and a search over candidates for the optimum."""

from itertools import combinations

import numpy as np
import pytest
import quadprog
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from marlbc_mj.core.halfplanes import RELAXATION, closest
from marlbc_mj.core.laws import plain

seeds = st.integers(0, 2**32 - 1)
FAR = 1e4  # [m/s], a speed limit that is never active here


def half_planes(normals, bounds, levels=0) -> np.ndarray:
    """Half-planes (n, 4) from unit normals (n, 2), bounds (n,) and levels."""
    planes = np.zeros((len(bounds), 4))
    planes[:, :2], planes[:, 2], planes[:, 3] = normals, bounds, levels
    return planes


def solve(wish, planes, speed=FAR) -> tuple[np.ndarray, bool]:
    """Solution of :func:`closest`, and whether it is feasible; ``planes`` are not changed."""
    v = np.full(2, np.nan)
    feasible = closest(np.asarray(wish, dtype=float), speed, planes.copy(), len(planes), v)
    return v, feasible


def unit(angles) -> np.ndarray:
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def draw(rng: np.random.Generator, most: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Random normals and bounds; some normals are repeated or opposed, and some half-planes are redundant."""
    n = int(rng.integers(1, most))
    normals, bounds = unit(rng.uniform(0, 2 * np.pi, n)), rng.normal(scale=3.0, size=n)
    for k in range(1, n):
        if rng.random() < 0.3:
            normals[k] = normals[rng.integers(k)] * rng.choice([-1.0, 1.0])
    return normals, bounds


def violation(v, planes) -> float:
    """Greatest violation of the half-planes by ``v`` [m/s], negative if all hold."""
    return float((planes[:, 2] - planes[:, :2] @ v).max())


def optimum_of_candidates(wish, planes, speed) -> np.ndarray | None:
    """The optimum: the feasible candidate nearest to ``wish``, which is ``wish``, its projection on a border or the circle, or
    a corner; None if no candidate is feasible.
    """
    n, b = planes[:, :2], planes[:, 2]
    tangents = np.stack([-n[:, 1], n[:, 0]], axis=-1)
    candidates = [wish, wish * speed / max(np.linalg.norm(wish), 1e-300)]
    candidates += [row * bound + t * (t @ wish) for row, bound, t in zip(n, b, tangents, strict=True)]
    for row, bound, t in zip(n, b, tangents, strict=True):
        if abs(bound) <= speed:
            half = np.sqrt(speed**2 - bound**2)
            candidates += [row * bound + half * t, row * bound - half * t]
    for i, j in combinations(range(len(b)), 2):
        if abs(np.linalg.det(n[[i, j]])) > 1e-9:
            candidates.append(np.linalg.solve(n[[i, j]], b[[i, j]]))
    good = [v for v in candidates if violation(v, planes) <= 1e-9 and np.linalg.norm(v) <= speed * (1 + 1e-9)]
    return min(good, key=lambda v: np.linalg.norm(v - wish)) if good else None


def least_violation(planes, hard=()) -> float:
    """Greatest violation of ``planes`` [m/s], minimized by a linear solver while the half-planes ``hard`` hold."""
    rows = [[-x, -y, -1.0] for x, y, *_ in planes] + [[-x, -y, 0.0] for x, y, *_ in hard]
    bounds = [-plane[2] for plane in planes] + [-plane[2] for plane in hard]
    found = linprog([0, 0, 1], rows, bounds, bounds=[(-FAR, FAR), (-FAR, FAR), (0, None)], method="highs")
    assert found.success
    return float(found.fun)


@given(seeds)
def test_feasible_programs_equal_a_quadratic_solver(seed):
    """min |v - wish|^2 to 1e-9, with parallel, opposed and redundant half-planes around a point that satisfies them all."""
    rng = np.random.default_rng(seed)
    normals, room = draw(rng)
    wish = rng.normal(scale=4.0, size=2)
    planes = half_planes(normals, normals @ rng.normal(scale=3.0, size=2) - np.abs(room))
    expected = quadprog.solve_qp(np.eye(2), wish, normals.T.copy(), planes[:, 2].copy())[0]
    v, feasible = solve(wish, planes)
    assert feasible
    np.testing.assert_allclose(v, expected, rtol=0, atol=1e-9 * (1 + np.abs(expected).max()))


@given(seeds)
def test_within_a_speed_the_optimum_is_the_best_candidate(seed):
    """With |v| <= speed as a constraint; to 1e-6, as the corner of a border that touches the circle is ill-conditioned."""
    rng = np.random.default_rng(seed)
    normals, bounds = draw(rng, 7)
    planes, speed, wish = half_planes(normals, 0.4 * bounds), 2.0, rng.normal(scale=2.0, size=2)
    expected = optimum_of_candidates(wish, planes, speed)
    v, feasible = solve(wish, planes, speed)
    assert np.linalg.norm(v) <= speed * (1 + 1e-12)
    if feasible:
        assert violation(v, planes) <= 1e-9
        assert expected is not None
        np.testing.assert_allclose(v, expected, rtol=0, atol=1e-6)
    else:
        assert optimum_of_candidates(wish, planes - [0, 0, 1e-7, 0], speed) is None or violation(v, planes) < 1e-6


@given(seeds)
def test_where_half_planes_contradict_the_greatest_violation_is_least(seed):
    """It equals that of a linear solver to 1e-6, its tolerance; v is the velocity nearest to ``wish`` that attains it."""
    rng = np.random.default_rng(seed)
    normals, bounds = draw(rng)
    planes, wish = half_planes(normals, bounds + 2.0), rng.normal(scale=4.0, size=2)
    v, feasible = solve(wish, planes)
    least = least_violation(planes)
    assert feasible == (least < 1e-9) or least < 1e-6
    if not np.linalg.norm(v) < 0.1 * FAR:
        return  # nearly opposed borders that meet far away
    assert max(0.0, violation(v, planes)) == pytest.approx(least, abs=1e-6)
    if feasible:
        return
    relaxed = planes - [0, 0, max(0.0, violation(v, planes)) + 1e-12, 0]
    nearest = optimum_of_candidates(wish, relaxed, FAR)
    assert nearest is None or np.linalg.norm(v - wish) <= np.linalg.norm(nearest - wish) + 1e-5


@given(seeds)
def test_of_two_levels_the_first_is_violated_least_and_then_the_second(seed):
    """Lexicographic: z_1 is the least without the second level, and z_2 is the least that keeps this z_1."""
    rng = np.random.default_rng(seed)
    normals, bounds = draw(rng)
    cut = int(rng.integers(0, len(bounds) + 1))
    planes = half_planes(normals, bounds + 2.0, np.arange(len(bounds)) >= cut)
    v, _ = solve(rng.normal(scale=4.0, size=2), planes)
    if not np.linalg.norm(v) < 0.01 * FAR:
        return
    first, second = planes[:cut], planes[cut:]
    least = least_violation(first) if cut else 0.0
    if cut:
        assert max(0.0, violation(v, first)) == pytest.approx(least, abs=1e-6)
    if cut < len(planes):
        low, high = (least_violation(second, first - [0, 0, least + slack, 0]) for slack in (1e-6, 1e-9))
        assert low - 1e-5 <= max(0.0, violation(v, second)) <= high + 1e-5


def test_two_walls_that_close_in():
    """n = (1, 0) requires 3 and n = (-1, 0) requires 1: both are violated by 2. On different levels the first one holds."""
    normals = [(1.0, 0.0), (-1.0, 0.0)]
    v, feasible = solve((0.0, 0.5), half_planes(normals, [3.0, 1.0]), 6.0)
    assert not feasible
    np.testing.assert_allclose(v, (1.0, 0.5), rtol=0, atol=2 * RELAXATION)
    for levels, x in (((0, 1), 3.0), ((1, 0), -1.0)):
        order = np.argsort(levels)
        planes = half_planes(normals, [3.0, 1.0], levels)[order]
        np.testing.assert_allclose(solve((0.0, 0.5), planes, 6.0)[0], (x, 0.5), rtol=0, atol=2 * RELAXATION)


def test_without_half_planes_the_wish_is_shortened():
    """(3, 4), shortened to a length of 2.5, is (1.5, 2)."""
    v, feasible = solve((3.0, 4.0), np.zeros((0, 4)), 2.5)
    assert feasible
    np.testing.assert_allclose(v, (1.5, 2.0), rtol=1e-15)


@given(seeds)
def test_compiled_equals_plain(seed):
    """The same bits with and without compilation of the outer function."""
    rng = np.random.default_rng(seed)
    normals, bounds = draw(rng)
    planes, wish, v = half_planes(normals, bounds), rng.normal(scale=4.0, size=2), np.zeros(2)
    plain(closest)(wish, 3.0, planes.copy(), len(planes), v)
    np.testing.assert_array_equal(v, solve(wish, planes, 3.0)[0])
