"""The terms of null-space composition (12): the part that one behavior adds, and the directions that it closes (erratum 5).

A^+ A is the orthogonal projector onto the row space of A, the Jacobians of all behaviors of higher priority. So N = I - A^+ A is
applied through an orthonormal basis of that space: no inverse is formed, a rank-deficient stack needs no special case, and any
number of behaviors with any Jacobians composes by the same lines. :func:`marlbc_mj.engine.composition.compose` is the whole sum.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free

RANK_TOLERANCE = 1e-9
"""A row whose part outside the span of the rows above it is shorter than this times its length adds no direction."""


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
