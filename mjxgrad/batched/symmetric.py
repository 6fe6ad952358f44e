"""Eigenvectors of small symmetric matrices, thousands at a time.

Libraries take one matrix after the other, on a GPU in several kernels that the host waits for. Jacobi's rotations, written out
entry by entry, are one kernel for all.
"""

import itertools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SWEEPS = 5  # of a matrix of four rows the fifth changes nothing in double precision


def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return eigenvalues, in no order, and eigenvectors as columns, by Jacobi's rotations; for up to six rows or so.

    Source: Golub and Van Loan, Matrix Computations, section 8.5.
    """
    size = len(matrix)
    if size == 1:
        return matrix[0], jnp.ones_like(matrix)

    def sweep(_: Array, state: tuple[list[list[Array]], list[list[Array]]]) -> tuple:
        entries, vectors = ([list(row) for row in x] for x in state)
        for p, q in itertools.combinations(range(size), 2):
            cosine, sine = _rotation(entries[p][p], entries[p][q], entries[q][q])
            for row in entries:
                row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
            columns = [
                (cosine * x - sine * y, sine * x + cosine * y) for x, y in zip(entries[p], entries[q], strict=True)
            ]
            entries[p], entries[q] = ([pair[side] for pair in columns] for side in (0, 1))
            for row in vectors:
                row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
        return entries, vectors

    zero = 0.0 * matrix[0, 0]
    state = (
        [[matrix[i, j] for j in range(size)] for i in range(size)],
        [[zero + float(i == j) for j in range(size)] for i in range(size)],
    )
    entries, vectors = jax.lax.fori_loop(0, _SWEEPS, sweep, state)
    return jnp.stack([entries[i][i] for i in range(size)]), jnp.stack([jnp.stack(row) for row in vectors])


def _rotation(first: Array, beside: Array, last: Array) -> tuple[Array, Array]:
    """Return cosine and sine of the smaller rotation after which the entry beside the diagonal is zero."""
    is_any = beside != 0
    slope = (last - first) / (2 * jnp.where(is_any, beside, 1.0))
    tangent = jnp.where(slope < 0, -1.0, 1.0) / (jnp.abs(slope) + jnp.sqrt(1 + slope**2))
    tangent = jnp.where(is_any, tangent, 0.0)
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    return cosine, tangent * cosine
