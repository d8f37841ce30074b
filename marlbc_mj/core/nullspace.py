"""Null-space composition of behaviors: equation (12) with errata 5 (Moore-Penrose, Jacobians above j only)."""

import numpy as np

from marlbc_mj.core.laws import allocation_free

RANK_TOLERANCE = 1e-9
"""A row whose part outside the span of the rows above it is shorter than this times its length adds no direction."""


@allocation_free
def compose(order, velocities, jacobians, rows, basis, out):
    """Composite velocity v_r = v^1 + sum_j N^{1..j-1} v^j, N = I - A^+ A (12).

    A stacks the Jacobians of all behaviors of higher priority. A^+ A is the orthogonal projector onto the row space of A,
    so N is applied through an orthonormal basis of that space: no inverse is formed, a rank-deficient stack (erratum 5) needs no
    special case, and any number of behaviors with any Jacobians composes by the same lines.

    Args:
        order: (M,) int64, behavior indices, highest priority first.
        velocities: (M, n) [m/s], desired velocity of each behavior (8).
        jacobians: (M, r, n), the first ``rows[j]`` rows of each are used.
        rows: (M,) int64.
        basis: (n, n), scratch.
        out: (n,) [m/s], the composite velocity, written in place.
    """
    out[:] = 0.0
    rank = 0
    for j in order:
        rank = add_behavior(velocities[j], jacobians[j], rows[j], basis, rank, out)


@allocation_free
def add_behavior(velocity, jacobian, rows, basis, rank, out):
    """One term of (12): add the part of ``velocity`` that those above leave free, and shut the directions of ``jacobian``.

    The first ``rank`` rows of ``basis`` span the Jacobians above; returns the new rank. At full rank nothing is left to add.
    """
    n = out.shape[0]
    if rank == n:
        return rank
    _project(velocity, basis, rank)
    for axis in range(n):
        out[axis] += basis[rank, axis]
    for row in range(rows):
        length = _length(jacobian[row])
        remaining = _project(jacobian[row], basis, rank)
        if remaining > RANK_TOLERANCE * length:
            for axis in range(n):
                basis[rank, axis] /= remaining
            rank += 1
            if rank == n:
                break
    return rank


@allocation_free
def _project(vector, basis, rank):
    """Put the part of ``vector`` (n,) outside the span of the first ``rank`` rows of ``basis`` into row ``rank``; its length.

    The projection is done twice, which brings it to machine precision.
    """
    n = vector.shape[0]
    for axis in range(n):
        basis[rank, axis] = vector[axis]
    for _ in range(2):
        for k in range(rank):
            along = 0.0
            for axis in range(n):
                along += basis[k, axis] * basis[rank, axis]
            for axis in range(n):
                basis[rank, axis] -= along * basis[k, axis]
    return _length(basis[rank])


@allocation_free
def _length(vector):
    square = 0.0
    for axis in range(vector.shape[0]):
        square += vector[axis] * vector[axis]
    return np.sqrt(square)


def projector(stack: np.ndarray) -> np.ndarray:
    """N = I - A^+ A for a stack of Jacobians, (m, n) -> (n, n); the textbook form, for analysis and tests.

    It drops directions relative to the largest singular value, :func:`compose` relative to each row's own length.
    """
    return np.asarray(np.eye(stack.shape[1]) - np.linalg.pinv(stack, rcond=RANK_TOLERANCE) @ stack)
