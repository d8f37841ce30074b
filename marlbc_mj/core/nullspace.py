"""One term of null-space composition (12): the velocity that a behavior adds, and the directions that it blocks (erratum 5).

A stacks the Jacobians of all behaviors of higher priority, and A^+ A is the orthogonal projector onto its row space. So
N = I - A^+ A is applied through an orthonormal basis of that space: no inverse is formed, a rank-deficient stack needs no special
case, and the same code composes any number of behaviors with any Jacobians. :func:`marlbc_mj.engine.composition.compose` computes
the whole sum.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free

RANK_TOLERANCE = 1e-9
"""A row whose part outside the span of the rows above it is shorter than this times its length adds no direction."""


@allocation_free
def add_behavior(velocity, jacobian, rows, basis, rank, out):
    """Add one term of (12): the part of ``velocity`` that higher priorities leave free; block the directions of ``jacobian``.

    The first ``rank`` rows of ``basis`` span the Jacobians of higher priority. Returns the new rank. Full rank adds nothing.
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
    """Put the part of ``vector`` (n,) outside the span of the first ``rank`` rows of ``basis`` into row ``rank``.

    Returns its length. Projecting twice makes the result accurate to machine precision.
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
