"""Solves with symmetric matrices of joint-space size, many at once, by Cholesky: in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU runs the factorisation written out, column by column, each
operation along the batch. On a GPU starting these operations would take longer than all else in the solve: there it is one
kernel, a thread for each matrix, with the numbers in its registers. (The line search and the gradient of the solve,
wide rather than long, as such kernels too: 5 % slower on two bodies, 6 % faster on the hopper, ten seconds more to compile. The
whole solve as one was not compiled after four minutes.) The kernel is Triton's, by way of `jax.experimental.pallas`.
"""

import functools
import importlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

from mjxgrad.dynamics.linear import batch_last

_Vector = Float[Array, "n *batch"]
_Matrix = Float[Array, "n n *batch"]
# Larger factorisations are left to LAPACK or cuSOLVER: written out they would take longer to compile than they save.
LARGEST = 16
# Threads of one block of the kernel: a warp.
_BLOCK = 32


def cholesky_solve(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector by Cholesky; non-finite where the matrix is not positive definite."""
    if matrix.ndim == 2:
        return jsl.cho_solve(jsl.cho_factor(matrix, lower=True), vector)
    if len(vector) > LARGEST:
        leading = jnp.moveaxis(matrix, (0, 1), (-2, -1)), jnp.moveaxis(vector, 0, -1)[..., None]
        factor = jnp.linalg.cholesky(leading[0])
        return jnp.moveaxis(jsl.cho_solve((factor, True), leading[1])[..., 0], -1, 0)
    if has_kernels():
        # The program may yet be compiled for the CPU beside the GPU.
        return jax.lax.platform_dependent(matrix, vector, cuda=in_one_kernel, default=written_out)
    return written_out(matrix, vector)


@functools.cache
def has_kernels() -> bool:
    """Return whether there is a GPU, and a JAX that compiles Triton's kernels for it; those after 0.11 may not."""
    if jax.default_backend() != "gpu":
        return False
    try:
        importlib.import_module("jax.experimental.pallas.triton")
    except ImportError:
        return False
    return True


def solve_positive_definite(
    matrix: Float[Array, "n n"],
    vector: Float[Array, " n"],
    apply: Callable[[Float[Array, " n"]], Float[Array, " n"]] | None = None,
) -> Float[Array, " n"]:
    """Return matrix⁻¹ vector, differentiable: its derivatives are solves too, and none goes through the factorisation.

    Under `jax.vmap` the batch is moved to the trailing axis for the factorisation. Derivatives go through `apply`, the matrix
    as a map, in place of its entries.
    """

    def solve(_, b):
        return batch_last(cholesky_solve)(matrix, b)

    return jax.lax.custom_linear_solve(apply or (lambda x: matrix @ x), vector, solve, symmetric=True)


def written_out(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Return matrix⁻¹ vector, column by column."""
    columns: list[Array] = []  # of the factor, from the diagonal down
    for k in range(len(vector)):
        column = matrix[k:, k]
        for j, earlier in enumerate(columns):
            column = column - earlier[k - j :] * earlier[k - j]
        columns.append(column * jax.lax.rsqrt(column[0]))
    forward, rest = [], vector
    for column in columns:
        forward.append(rest[0] / column[0])
        rest = rest[1:] - column[1:] * forward[-1]
    return jnp.stack(_backward(columns, forward))


def in_one_kernel(
    matrix: Float[Array, "n n batch"], vector: Float[Array, "n batch"], *, interpret: bool = False
) -> Float[Array, "n batch"]:
    """Return matrix⁻¹ vector, entry by entry in the registers of one thread each; `interpret` runs on any device, slowly."""
    # Imported here: no other device needs it, and it takes half a second.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    size, num = vector.shape

    def kernel(matrix, vector, solution):
        # Threads beyond the batch repeat its last member.
        lane = jnp.minimum(pallas.program_id(0) * _BLOCK + jnp.arange(_BLOCK, dtype=jnp.int32), num - 1)
        columns, forward, rest = [], [], [vector[k, lane] for k in range(size)]
        for k in range(size):
            column = [matrix[i, k, lane] for i in range(k, size)]
            for j, earlier in enumerate(columns):
                column = [x - y * earlier[k - j] for x, y in zip(column, earlier[k - j :], strict=True)]
            inverse = jax.lax.rsqrt(column[0])
            columns.append([x * inverse for x in column])
            forward.append(rest[0] / columns[k][0])
            rest = [x - y * forward[k] for x, y in zip(rest[1:], columns[k][1:], strict=True)]
        for k, value in enumerate(_backward(columns, forward)):
            solution[k, lane] = value

    return pallas.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct(vector.shape, vector.dtype),
        grid=(-(-num // _BLOCK),),
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
    )(matrix, vector)


def _backward(columns, forward: list[Array]) -> list[Array]:
    """Return the solution of the transposed half of the solve, from the last entry up."""
    solution: list[Array] = []
    for k in reversed(range(len(forward))):
        value = forward[k]
        for above, known in zip(columns[k][1:], reversed(solution), strict=True):
            value = value - above * known
        solution.append(value / columns[k][0])
    return solution[::-1]
