"""Solves with symmetric matrices of joint-space size, many at once, by Cholesky: in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU runs the factorisation written out, column by column, each
operation along the batch. On a GPU starting these operations would take longer than all else in the solve: there it is one
kernel, Triton's by `jax.experimental.pallas`, with the matrices of some neighbouring states in the registers of a few warps.
It is written with whole matrices and no entries, so that it is short: with one thread for each state and its entries by name a
Newton step took up to a quarter less time on 32768 states, and a minute to compile. (The line search and the gradient of the
solve as such kernels, too: 5 % slower on two bodies, 6 % faster on the hopper, ten seconds more to compile. The whole solve as
one was not compiled after four minutes.)
"""

import functools
import importlib
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

from mjxgrad.dynamics.linear import batch_last

_Vector = Float[Array, "n *batch"]
_Matrix = Float[Array, "n n *batch"]
# Larger factorisations are left to LAPACK or cuSOLVER: written out they would take longer to compile than they save.
LARGEST = 16
# Entries in the registers of one thread of the kernel, and threads of a warp.
_EACH, _WARP = 32, 32


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
        return jax.lax.platform_dependent(
            matrix, vector, cuda=lambda *system: in_one_kernel(*system)[0], default=written_out
        )
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
    solution: list[Array] = []
    for column, value in zip(columns[::-1], forward[::-1], strict=True):
        for above, known in zip(column[1:], reversed(solution), strict=True):
            value = value - above * known
        solution.append(value / column[0])
    return jnp.stack(solution[::-1])


def padded(size: int) -> int:
    """Return the size of the kernel's matrices, a power of two."""
    return max(8, 1 << (size - 1).bit_length())


def in_one_kernel(
    matrix: Float[Array, "n n batch"],
    vector: Float[Array, "n batch"],
    arrays: Sequence[Array] = (),
    add: Callable[..., Array] | None = None,
    *,
    interpret: bool = False,
) -> tuple[Float[Array, "n batch"], Float[Array, "n batch"]]:
    """Return matrix⁻¹ vector, non-finite where the matrix is not positive definite, and its diagonal.

    To the matrix of its states the kernel adds what `add` makes of it, of references to `arrays`, and of the indices of a row, a
    column and the states. It eliminates above and below the diagonal. `interpret` runs on any device, slowly.
    """
    # Imported here: no other device needs it, and it takes half a second.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    size, num = vector.shape
    last, width = size - 1, padded(size)
    states = max(8, 256 // width)  # neighbours in memory, so that whole sectors of it are read

    def kernel(matrix, vector, *refs):
        *refs, solution, diagonal = refs
        # Places beyond the batch repeat its last member, those beyond the matrix are an identity.
        state = jnp.minimum(pallas.program_id(0) * states + jnp.arange(states, dtype=jnp.int32), num - 1)[None]
        index = jnp.arange(width, dtype=jnp.int32)
        i, j, k = index[:, None, None], index[None, :, None], index[:, None]
        entries = matrix[jnp.minimum(i, last), jnp.minimum(j, last), state[None]]
        entries = jnp.where((i < size) & (j < size), entries, jnp.where(i == j, 1.0, 0.0).astype(entries.dtype))
        if add is not None:
            entries = add(entries, refs, i, j, state[None])
        on_diagonal = jnp.where(i == j, entries, 0.0).sum(axis=1)
        rest = jnp.where(k < size, vector[jnp.minimum(k, last), state], 0.0)

        def eliminate(pivot, carry):
            entries, rest = carry
            row = jnp.where(i == pivot, entries, 0.0).sum(axis=0)
            column = jnp.where(j == pivot, entries, 0.0).sum(axis=1)
            # By the root, so that a pivot that is not positive spoils all.
            inverse = jax.lax.rsqrt(jnp.where(k == pivot, column, 0.0).sum(axis=0)) ** 2
            own = jnp.where(k == pivot, rest, 0.0).sum(axis=0)
            factor = jnp.where(k == pivot, 0.0, column * inverse[None])
            return entries - factor[:, None] * row[None], rest - factor * own[None]

        entries, rest = jax.lax.fori_loop(0, size, eliminate, (entries, rest))
        pivots = jnp.where(i == j, entries, 0.0).sum(axis=1)
        solution[k, state] = rest * jax.lax.rsqrt(pivots) ** 2
        diagonal[k, state] = on_diagonal

    shape = jax.ShapeDtypeStruct((width, num), vector.dtype)
    found = pallas.pallas_call(
        kernel,
        out_shape=(shape, shape),
        grid=(-(-num // states),),
        compiler_params=triton.CompilerParams(num_warps=max(1, width**2 * states // (_EACH * _WARP)), num_stages=1),
        interpret=interpret,
    )(matrix, vector, *arrays)
    return found[0][:size], found[1][:size]
