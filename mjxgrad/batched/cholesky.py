"""Solves with symmetric matrices of joint-space size, many at once, by Cholesky: in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU runs the factorisation column by column, each operation along
the batch: written out, or, where that would take long to compile, block by block with a loop for the columns of a block. On a
GPU starting these operations would take longer than all else in the solve: there it is one kernel.

LAPACK does not get batches on a CPU. It takes one matrix after the other, and jaxlib before 0.11 waits within the threads that
the batch is shared out to: once as many programs do so as there are threads, all wait for ever.
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from mjxgrad.batched import device, on_gpu
from mjxgrad.batched.linear import add, batch_last, dot, matvec, rmatvec

_Vector = Float[Array, "n *batch"]
_Matrix = Float[Array, "n n *batch"]
# Larger factorisations are not written out: they would take longer to compile than they save.
_LARGEST = 16
# Of a larger one the columns of a block, and at most how many blocks. 23 columns in six blocks take a third of LAPACK's time and
# in two blocks nine tenths; each block is a tenth of a second to compile.
_LEAST_BLOCK = 4
_MOST_BLOCKS = 8
SOLUTION = "solution"
"""Name for `jax.checkpoint` of solutions: a rollout that recomputes its steps keeps them and spares itself the solves."""


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


@runtime_checkable
class Operator(Protocol):
    """A symmetric matrix, by its entries and as a map."""

    @property
    def matrix(self) -> Float[Array, "n n"]: ...

    def apply(self, x: Float[Array, " n"]) -> Float[Array, " n"]: ...


@jax.custom_jvp
def solve_positive_definite(operator: Operator, vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return matrix⁻¹ vector, differentiable: its derivatives are solves too, and none goes through the factorisation.

    Under `jax.vmap` the batch is moved to the trailing axis for the factorisation. Derivatives go through the map, in place of
    the entries. The solution has a name, `SOLUTION`, by which reverse mode can keep it.
    """
    return batch_last(cholesky_solve)(operator.matrix, vector)


@solve_positive_definite.defjvp
def _solve_jvp(primals, tangents):
    operator, vector = primals
    solution = checkpoint_name(solve_positive_definite(operator, vector), SOLUTION)
    _, change = jax.jvp(lambda operator, vector: vector - operator.apply(solution), primals, tangents)
    return solution, jax.lax.custom_linear_solve(
        operator.apply, change, lambda _, b: batch_last(cholesky_solve)(operator.matrix, b), symmetric=True
    )


def written_out(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector, column by column; the vector goes through the factorisation as one more row."""
    columns: list[Array] = []  # of the factor, from the diagonal down
    forward: list[Array] = []
    for k in range(len(vector)):
        column, value = matrix[k:, k], vector[k]
        for j, (earlier, known) in enumerate(zip(columns, forward, strict=True)):
            column = column - earlier[k - j :] * earlier[k - j]
            value = value - known * earlier[k - j]
        root = jnp.sqrt(column[0])
        # XLA keeps what was divided; products it forms anew, and all that they are made of, wherever they are used.
        columns.append(column / root)
        forward.append(value / root)
    solution: list[Array] = []
    for column, value in zip(columns[::-1], forward[::-1], strict=True):
        for above, known in zip(column[1:], reversed(solution), strict=True):
            value = value - above * known
        solution.append(value / column[0])
    return jnp.stack(solution[::-1])


def in_blocks(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector, block by block of columns; the vector goes through the factorisation as one more row."""
    size = len(vector)
    width = max(_LEAST_BLOCK, -(-size // _MOST_BLOCKS))
    columns = jnp.concatenate([matrix, vector[:, None]], axis=1)  # first the column, then the entry
    blocks: list[Array] = []  # of the factor, from the first entry of a block's diagonal down
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
    """Return the columns of the factor, from those of a matrix whose first rows are square; above its diagonal is rounding."""

    def turn(k: Array, factor: Array) -> Array:
        column = columns[k] - rmatvec(factor, factor[:, k])  # zero from the k-th on
        return factor.at[k].set(column / jnp.sqrt(column[k]))

    return jax.lax.fori_loop(0, len(columns), turn, jnp.zeros_like(columns))


def _solution_above(factor: Float[Array, "width rows *batch"], value: _Vector) -> _Vector:
    """Return what the transpose of the factor's first rows, which are square, makes of the value."""
    last = len(value) - 1

    def turn(done: Array, solution: Array) -> Array:
        k = last - done
        rest = value[k] - dot(factor[k, : len(value)], solution)  # zero up to the k-th
        return solution.at[k].set(rest / factor[k, k])

    return jax.lax.fori_loop(0, len(value), turn, jnp.zeros_like(value))
