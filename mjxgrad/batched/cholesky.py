"""Batched Cholesky solves with symmetric matrices of joint-space size.

Arrays may carry the batch as trailing axis, see `linear`. A CPU runs the factorisation column by column, each operation along
the batch: written out, or, where that would take long to compile, block by block. LAPACK would take one matrix after the other.
"""

from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from mjxgrad.batched import device, on_gpu
from mjxgrad.batched.linear import add, batch_last, dot, matvec, rmatvec

_Vector = Float[Array, "n *batch"]
_Matrix = Float[Array, "n n *batch"]
_LARGEST = 16  # larger factorisations are not written out: compiling them would take longer than they save
# Least columns of a block and largest number of blocks, each of which takes a tenth of a second to compile.
_LEAST_BLOCK = 4
_MOST_BLOCKS = 8
SOLUTION = "solution"
"""Name of solutions for `jax.checkpoint`: a rollout that recomputes its steps keeps them and skips the solves."""


def cholesky_solve(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector by Cholesky; non-finite where the matrix is not positive definite."""
    if matrix.ndim == 2:
        return jsl.cho_solve(jsl.cho_factor(matrix, lower=True), vector)
    if on_gpu.solves(0, len(vector)):
        return device.by_platform(matrix, vector, gpu=lambda *system: on_gpu.solve(*system)[0], default=_step_by_step)
    return _step_by_step(matrix, vector)


def _step_by_step(matrix: Float[Array, "n n batch"], vector: Float[Array, "n batch"]) -> Float[Array, "n batch"]:
    if len(vector) <= _LARGEST:
        return written_out(matrix, vector)
    if device.is_cpu():
        return in_blocks(matrix, vector)
    leading = jnp.moveaxis(matrix, (0, 1), (-2, -1)), jnp.moveaxis(vector, 0, -1)[..., None]
    factor = jnp.linalg.cholesky(leading[0])
    return jnp.moveaxis(jsl.cho_solve((factor, True), leading[1])[..., 0], -1, 0)


@jax.custom_jvp
def solve_positive_definite(operator: Any, vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return matrix⁻¹ vector, differentiable: derivatives are solves too and do not go through the factorisation."""
    # The operator is a symmetric matrix: `operator.matrix` has its entries, and `operator.apply(x)` is the product,
    # through which derivatives go. Under `jax.vmap` the batch is moved to the trailing axis for the factorisation. The
    # solution has the name `SOLUTION`, by which reverse mode can keep it.
    return batch_last(cholesky_solve)(operator.matrix, vector)


@solve_positive_definite.defjvp
def _solve_jvp(primals, tangents):
    operator, vector = primals
    solution = checkpoint_name(solve_positive_definite(operator, vector), SOLUTION)
    _, change = jax.jvp(lambda operator, vector: vector - operator.apply(solution), primals, tangents)
    return solution, jax.lax.custom_linear_solve(
        operator.apply, change, lambda _, b: batch_last(cholesky_solve)(operator.matrix, b), symmetric=True
    )


def written_out(matrix: Float[Array, "n n *fewer"], vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector by columns; the vector is factored along as one more row."""
    # Vectors may share a matrix, whose axis then has length one.
    columns: list[Array] = []  # columns of the factor, from the diagonal down
    forward: list[Array] = []
    for k in range(len(vector)):
        column, value = matrix[k:, k], vector[k]
        for j, (earlier, known) in enumerate(zip(columns, forward, strict=True)):
            column = column - earlier[k - j :] * earlier[k - j]
            value = value - known * earlier[k - j]
        root = jnp.sqrt(column[0])
        # A division, not a product with the inverse root: XLA stores quotients, but repeats products wherever they are used.
        columns.append(column / root)
        forward.append(value / root)
    solution: list[Array] = []
    for column, value in zip(columns[::-1], forward[::-1], strict=True):
        for above, known in zip(column[1:], reversed(solution), strict=True):
            value = value - above * known
        solution.append(value / column[0])
    return jnp.stack(solution[::-1])


def in_blocks(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector by blocks of columns; the vector is factored along as one more row."""
    size = len(vector)
    width = max(_LEAST_BLOCK, -(-size // _MOST_BLOCKS))
    columns = jnp.concatenate([matrix, vector[:, None]], axis=1)  # first the column, then the entry
    blocks: list[Array] = []  # columns of the factor, from the first row of a block down
    for start in range(0, size, width):
        own = columns[start : start + width, start:]
        for number, block in enumerate(blocks):
            below = block[:, start - number * width :]
            own = own - add(column[None] * column[: len(own), None] for column in below)
        blocks.append(_factor_of(own))
    solution = vector[:0]
    for block in reversed(blocks):
        value = block[:, -1]
        if len(solution):
            value = value - matvec(block[:, len(block) : -1], solution)
        solution = jnp.concatenate([_solution_above(block, value), solution])
    return solution


def _factor_of(columns: Float[Array, "width rows *batch"]) -> Float[Array, "width rows *batch"]:
    """Return a block of the factor from the same columns of the matrix; entries above its diagonal are rounding."""

    def turn(k: Array, factor: Array) -> Array:
        column = columns[k] - rmatvec(factor, factor[:, k])  # zero from the k-th on
        return factor.at[k].set(column / jnp.sqrt(column[k]))

    return jax.lax.fori_loop(0, len(columns), turn, jnp.zeros_like(columns))


def _solution_above(factor: Float[Array, "width rows *batch"], value: _Vector) -> _Vector:
    """Return L⁻ᵀ value, L the square block of the factor's first rows."""
    last = len(value) - 1

    def turn(done: Array, solution: Array) -> Array:
        k = last - done
        rest = value[k] - dot(factor[k, : len(value)], solution)  # zero up to the k-th
        return solution.at[k].set(rest / factor[k, k])

    return jax.lax.fori_loop(0, len(value), turn, jnp.zeros_like(value))
