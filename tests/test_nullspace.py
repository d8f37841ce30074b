"""Composition (12) against the literal formula with Moore-Penrose inverses, and the projector's defining properties."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.core.nullspace import RANK_TOLERANCE, add_behavior

OA, FM, FR = 0, 1, 2
seeds = st.integers(0, 2**32 - 1)


def composed(order, velocities, jacobians, rows) -> np.ndarray:
    """The sum (12), term by term, as :func:`marlbc_mj.engine.composition.compose` computes it."""
    n = velocities.shape[1]
    out, basis, rank = np.zeros(n), np.empty((n, n)), 0
    for j in order:
        rank = add_behavior(velocities[j], jacobians[j], rows[j], basis, rank, out)
    return out


def projector(stack: np.ndarray) -> np.ndarray:
    """N = I - A^+ A for a stack of Jacobians, (m, n) -> (n, n): the textbook form.

    It drops directions relative to the largest singular value, ``add_behavior`` relative to each row's own length.
    """
    return np.eye(stack.shape[1]) - np.linalg.pinv(stack, rcond=RANK_TOLERANCE) @ stack


def literal(order, velocities, jacobians, rows) -> np.ndarray:
    """v_r = v^1 + sum_j N^{1..j-1} v^j with N = I - A^+ A (12), the Jacobians above j stacked (erratum 5)."""
    n = velocities.shape[1]
    v_r = np.zeros(n)
    stack = np.zeros((0, n))
    for j in order:
        v_r = v_r + projector(stack) @ velocities[j]
        stack = np.vstack([stack, jacobians[j, : rows[j]]])
    return v_r


def random_behaviors(seed: int):
    """Behaviors with orthonormal rows from one frame, some repeated, some zero, some scaled: exact and well-conditioned ranks."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 6)), int(rng.integers(1, 6))
    frame = np.linalg.qr(rng.normal(size=(n, n)))[0]
    rows = rng.integers(1, n + 1, size=m)
    jacobians = np.full((m, n, n), np.nan)  # unused rows must not be read
    for j in range(m):
        choice = frame[rng.integers(0, n, size=rows[j])] * rng.uniform(0.2, 5.0, size=(rows[j], 1))
        choice[rng.random(rows[j]) < 0.2] = 0.0
        jacobians[j, : rows[j]] = choice
    return rng.permutation(m), rng.normal(scale=10.0, size=(m, n)), jacobians, rows


@given(seeds)
def test_compose_is_the_literal_formula_for_rank_deficient_stacks(seed):
    """(12) for any number of behaviors and dimensions, with repeated and zero rows in the stack (erratum 5)."""
    case = random_behaviors(seed)
    np.testing.assert_allclose(composed(*case), literal(*case), rtol=0, atol=1e-12 * max(1.0, np.abs(case[1]).sum()))


@given(seeds)
def test_compose_is_the_literal_formula_for_general_jacobians(seed):
    """The same holds for Gaussian rows, with stacks of full rank but not orthogonal, and a combination of two of them."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    jacobians = rng.normal(size=(4, 1, n))
    jacobians[2] = jacobians[0] - 2.0 * jacobians[1]  # adds no rank
    stack = jacobians[:, 0]
    if np.linalg.svd(stack[[0, 1, 3]][: min(n, 3)], compute_uv=False)[-1] < 0.1:
        return  # nearly dependent rows: neither formula has 12 digits
    case = (np.arange(4), rng.normal(size=(4, n)), jacobians, np.ones(4, dtype=int))
    np.testing.assert_allclose(composed(*case), literal(*case), rtol=0, atol=1e-12)


@given(seeds)
def test_lower_priorities_never_disturb_the_first_task(seed):
    """J_1 v_r = J_1 v^1 whatever velocities the other behaviors request."""
    order, velocities, jacobians, rows = random_behaviors(seed)
    first = jacobians[order[0], : rows[order[0]]]
    difference = first @ (composed(order, velocities, jacobians, rows) - velocities[order[0]])
    assert np.abs(difference).max() < 1e-12 * max(1.0, np.abs(velocities).sum()) * 5.0


@given(seeds)
def test_projector_is_an_orthogonal_projector_onto_the_null_space(seed):
    """|J N| < 1e-12, N N = N, N = N^T, trace N = n - rank J."""
    order, _, jacobians, rows = random_behaviors(seed)
    stack = jacobians[order[0], : rows[order[0]]]
    null = projector(stack)
    assert np.linalg.norm(stack @ null) < 1e-12
    assert np.linalg.norm(null @ null - null) < 1e-12
    assert np.linalg.norm(null - null.T) < 1e-12
    assert np.trace(null) == pytest.approx(stack.shape[1] - np.linalg.matrix_rank(stack, tol=1e-9), abs=1e-9)


@given(seeds)
def test_six_orders_of_the_paper_give_the_four_closed_forms(seed):
    """FM, FR, OA>FM, OA>FR: with J_FM = J_FR = I, v_r is v_FM, v_FR, v_OA + (I - n n^T) v_FM or the same with v_FR."""
    rng = np.random.default_rng(seed)
    velocities = rng.normal(scale=10.0, size=(3, 2))
    angle = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(angle), np.sin(angle)])
    velocities[OA] = normal * rng.uniform(0, 40)
    jacobians = np.zeros((3, 2, 2))
    jacobians[OA, 0], jacobians[FM], jacobians[FR] = normal, np.eye(2), np.eye(2)
    tangent = np.eye(2) - np.outer(normal, normal)
    closed_forms = {
        (OA, FM, FR): velocities[OA] + tangent @ velocities[FM],
        (OA, FR, FM): velocities[OA] + tangent @ velocities[FR],
        (FM, OA, FR): velocities[FM],
        (FM, FR, OA): velocities[FM],
        (FR, OA, FM): velocities[FR],
        (FR, FM, OA): velocities[FR],
    }
    results = {order: composed(order, velocities, jacobians, [1, 2, 2]) for order in permutations(range(3))}
    for order, expected in closed_forms.items():
        np.testing.assert_allclose(results[order], expected, rtol=0, atol=1e-12)
    assert len({result.tobytes() for result in results.values()}) == 4


def test_a_nearly_parallel_row_adds_no_direction():
    """Rows that differ by rounding count once, so the behavior below still has its free direction."""
    jacobians = np.array([[[1.0, 0.0]], [[1.0, 1e-12]], [[0.0, 1.0]]])
    velocities = np.array([[1.0, 0.0], [5.0, 0.0], [0.0, 3.0]])
    np.testing.assert_allclose(composed([0, 1, 2], velocities, jacobians, [1, 1, 1]), [1.0, 3.0], atol=1e-12)
