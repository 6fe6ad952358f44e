"""GPU kernels: a program solves one state and stops when that state is done.

As operations on batched arrays, Newton's method runs until the last state is done, and each iteration starts some thirty kernels.
Here every state has a program that keeps J and H in registers. The kernels are Triton's, by `jax.experimental.pallas`. Arrays
have the batch as trailing axis outside the kernels, see `linear`. `interpret` runs a kernel on any device, slowly.
"""

import functools
import importlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.batched import device, linear

_Part = Float[Array, " 16"]
_Vector = Float[Array, " width"]
_Blocks = list[list[Any]]  # 16 by 16, None below the diagonal

# Matrices are eliminated in blocks of so many columns: a program selects a row by a sum over the whole block.
_BLOCK, _MOST_COLUMNS = 16, 64
# Number of warps by the largest number of entries of J. Several warps exchange sums through shared memory.
_WARPS = {2048: 1, 4096: 2, 8192: 8}
_MOST_ROWS = 1024


@functools.cache
def has_kernels() -> bool:
    """Return whether there is a GPU and JAX compiles Triton's kernels for it, as releases after 0.11 may not."""
    if not device.is_gpu():
        return False
    try:
        importlib.import_module("jax.experimental.pallas.triton")
    except ImportError:
        return False
    return True


def solves(num_rows: int, num_columns: int) -> bool:
    """Return whether there are kernels, and `solve` takes a system of this size."""
    return num_columns <= _MOST_COLUMNS and num_rows <= _MOST_ROWS and has_kernels()


def holds(num_rows: int, num_columns: int) -> bool:
    """Return whether there are kernels, and a program can keep J of this size."""
    return solves(num_rows, num_columns) and padded(num_rows) * padded(num_columns) <= max(_WARPS)


def padded(size: int) -> int:
    """Return the length of a vector in a kernel, a power of two."""
    return max(_BLOCK, 1 << (size - 1).bit_length())


def solve(
    mass: Float[Array, "n n batch"],
    vector: Float[Array, "n batch"],
    left: Float[Array, "rows n batch"] | None = None,
    scale: Float[Array, "rows batch"] | None = None,
    right: Float[Array, "rows n batch"] | None = None,
    *,
    max_shift: float = 0.0,
    interpret: bool = False,
) -> tuple[Float[Array, "n batch"], Float[Array, "n batch"]]:
    """Return (mass + Σ scale left rightᵀ)⁻¹ vector, with the sum over rows, and the diagonal of that matrix."""
    # The matrix must be symmetric. The solution is not finite where the matrix is not positive definite even with a share of its
    # diagonal below `max_shift` added. The right rows default to the left ones. A row whose scale is zero costs little.

    def kernel(mass, vector, *refs):
        *refs, solution, on_diagonal = refs
        matrix = blocks(mass)
        if left is not None:
            matrix = add_rows(matrix, refs[0], refs[1][...], refs[2 if right is not None else 0])
        on_diagonal[...] = diagonal(matrix)
        solution[...] = solve_regularised(matrix, vector[...], size, max_shift)

    size, inputs = len(vector), [x for x in (filled(mass), vector, left, scale, right) if x is not None]
    found = run(kernel, inputs, [(vector.dtype, padded(size))] * 2, interpret=interpret)
    return found[0][:size], found[1][:size]


def run(
    kernel: Callable,
    inputs: Sequence[Array],
    outputs: Sequence[tuple[Any, int]],
    num_entries: int = 1,
    *,
    interpret: bool,
) -> list[Array]:
    """Run a program for every state on its part of the inputs, and return the outputs of these types and lengths."""
    # The inputs are padded with zeros to powers of two, so that one thread reads and keeps neighbours in memory. The
    # program has registers for `num_entries` entries.
    # Imported here: only a GPU needs it, and it takes half a second.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    inputs = [jnp.moveaxis(_padded_to(x, [padded(size) for size in x.shape[:-1]]), -1, 0) for x in inputs]
    shapes = [jax.ShapeDtypeStruct((len(inputs[0]), length), dtype) for dtype, length in outputs]
    num_warps = next(warps for most, warps in _WARPS.items() if num_entries <= most)

    def of_one(x) -> pallas.BlockSpec:
        return pallas.BlockSpec((None, *x.shape[1:]), lambda state: (state, *(0,) * (len(x.shape) - 1)))

    how: Any = {"in_specs": [of_one(x) for x in inputs], "out_specs": [of_one(x) for x in shapes]}
    how |= {"compiler_params": triton.CompilerParams(num_warps=num_warps, num_stages=1), "interpret": interpret}
    call = pallas.pallas_call(kernel, out_shape=shapes, grid=(len(inputs[0]),), **how)
    return [jnp.moveaxis(x, 0, -1) for x in call(*inputs)]


def _padded_to(x: Float[Array, "*shape batch"], shape: Sequence[int]) -> Array:
    return jnp.pad(x, [*((0, wanted - size) for wanted, size in zip(shape, x.shape[:-1], strict=True)), (0, 0)])


def filled(matrix: Float[Array, "n n batch"]) -> Float[Array, "width width batch"]:
    """Return a matrix padded with a unit matrix."""
    size, width = len(matrix), padded(len(matrix))
    beyond = jnp.diag(jnp.arange(width) >= size).astype(matrix.dtype)
    return _padded_to(matrix, (width, width)) + beyond[:, :, None]


def blocks(ref: Any) -> _Blocks:
    """Return the blocks of a symmetric matrix, on and above its diagonal."""
    return _above(
        ref.shape[0] // _BLOCK, lambda b, c: ref[b * _BLOCK : (b + 1) * _BLOCK, c * _BLOCK : (c + 1) * _BLOCK]
    )


def add_rows(matrix: _Blocks, left: Any, scale: Float[Array, " rows"], right: Any) -> _Blocks:
    """Return a matrix plus Σ scale left rightᵀ, summed over the rows whose scale is not zero."""
    number = jnp.arange(len(scale), dtype=jnp.int32)

    def after(row: Array) -> Array:
        return jnp.where((scale != 0) & (number > row), number, len(scale)).min()

    def parts(ref: Any, row: Array) -> list[_Part]:
        return [ref[row, b * _BLOCK : (b + 1) * _BLOCK] for b in range(len(matrix))]

    def add_row(carry):
        row, matrix = carry
        own = jnp.where(number == row, scale, 0.0).sum()
        one, other = parts(left, row), parts(right, row)
        return after(row), _above(len(matrix), lambda b, c: matrix[b][c] + (own * one[b])[:, None] * other[c][None])

    return jax.lax.while_loop(lambda carry: carry[0] < len(scale), add_row, (after(jnp.int32(-1)), matrix))[1]


def add_to_diagonal(matrix: _Blocks, vector: _Vector) -> _Blocks:
    """Return a matrix with a vector added to its diagonal."""
    index = jnp.arange(_BLOCK, dtype=jnp.int32)

    def block(b: int, c: int) -> Array:
        if b != c:
            return matrix[b][c]
        return matrix[b][b] + jnp.where(index[:, None] == index[None], _part(vector, b)[None], 0.0)

    return _above(len(matrix), block)


def diagonal(matrix: _Blocks) -> _Vector:
    """Return the diagonal."""
    return join([_diagonal(matrix[b][b]) for b in range(len(matrix))])


def solve_blocks(matrix: _Blocks, vector: _Vector, size: int) -> _Vector:
    """Return matrix⁻¹ vector, not finite where the matrix is not positive definite."""
    return join(_solve(matrix, [_part(vector, b) for b in range(len(matrix))], size))


def solve_regularised(matrix: _Blocks, vector: _Vector, size: int, max_shift: float) -> _Vector:
    """Return matrix⁻¹ vector, with the smallest share of the diagonal added that makes the matrix positive definite."""
    found, own = solve_blocks(matrix, vector, size), diagonal(matrix)
    if not max_shift:
        return found
    can_be = is_finite(own) & is_finite(vector)

    def attempt(carry):
        share = next_share(carry[0])
        return share, solve_blocks(add_to_diagonal(matrix, share * own), vector, size)

    def goes_on(carry):
        share, found = carry
        return can_be & ~is_finite(found) & (next_share(share) < max_shift)

    return jax.lax.while_loop(goes_on, attempt, (jnp.zeros((), vector.dtype), found))[1]


def next_share(share: Float[Array, ""]) -> Float[Array, ""]:
    """Return the next share of the diagonal to add: first rounding, then four times the last share."""
    return jnp.maximum(4 * share, float(jnp.finfo(share.dtype).eps))


def is_finite(vector: _Vector) -> Bool[Array, ""]:
    """Return whether all entries are finite."""
    return (~(jnp.abs(vector) < jnp.inf)).astype(jnp.int32).sum() == 0


def join(parts: list[_Part]) -> _Vector:
    """Return a vector from its parts."""
    if len(parts) == 1:
        return parts[0]
    index = jnp.arange(padded(len(parts) * _BLOCK), dtype=jnp.int32)[:, None]
    return linear.add(jnp.where(_is_part(index, b), part[None], 0.0).sum(axis=1) for b, part in enumerate(parts))


def _part(vector: _Vector, number: int) -> _Part:
    if len(vector) == _BLOCK:
        return vector
    index = jnp.arange(len(vector), dtype=jnp.int32)[:, None]
    return jnp.where(_is_part(index, number), vector[:, None], 0.0).sum(axis=0)


def _is_part(index: Int[Array, "width 1"], number: int) -> Array:
    return index == number * _BLOCK + jnp.arange(_BLOCK, dtype=jnp.int32)[None]


def _above(num: int, block: Callable[[int, int], Array]) -> Any:
    return [[block(b, c) if b <= c else None for c in range(num)] for b in range(num)]


def _solve(matrix: _Blocks, vector: list[_Part], size: int) -> list[_Part]:
    if len(vector) == 1:
        return [_eliminate(matrix[0][0], vector[0], size)]
    product, others = functools.partial(jnp.dot, precision="highest"), range(1, len(vector))
    inverse = _inverse(matrix[0][0])
    first = (inverse * vector[0][:, None]).sum(axis=0)
    above = [product(inverse, matrix[0][c]) for c in others]
    rest = _above(len(others), lambda b, c: matrix[b + 1][c + 1] - product(matrix[0][b + 1].T, above[c]))
    left = [vector[b] - (matrix[0][b] * first[:, None]).sum(axis=0) for b in others]
    found = _solve(rest, left, size - _BLOCK)
    back = linear.add((one * other[None]).sum(axis=1) for one, other in zip(above, found, strict=True))
    return [first - back, *found]


def _eliminate(matrix: Float[Array, "16 16"], vector: _Part, size: int) -> _Part:
    index = jnp.arange(_BLOCK, dtype=jnp.int32)

    def eliminate(pivot, carry):
        entries, rest = carry
        row, column, inverse = _cross(entries, pivot)
        own = jnp.where(index == pivot, rest, 0.0).sum()
        factor = jnp.where(index == pivot, 0.0, column * inverse)
        return entries - factor[:, None] * row[None], rest - factor * own

    entries, rest = jax.lax.fori_loop(0, size, eliminate, (matrix, vector))
    return rest * jax.lax.rsqrt(_diagonal(entries)) ** 2


def _inverse(matrix: Float[Array, "16 16"]) -> Float[Array, "16 16"]:
    index = jnp.arange(_BLOCK, dtype=jnp.int32)

    def eliminate(pivot, entries):
        row, column, inverse = _cross(entries, pivot)
        # Row and column of the pivot become those of the inverse.
        rest = jnp.where((index == pivot)[:, None] | (index == pivot)[None], 0.0, entries)
        row, column = jnp.where(index == pivot, 1.0, row), jnp.where(index == pivot, -1.0, column)
        return rest - (column * inverse)[:, None] * row[None]

    return jax.lax.fori_loop(0, _BLOCK, eliminate, matrix)


def _cross(matrix: Float[Array, "16 16"], pivot: Array) -> tuple[_Part, _Part, Array]:
    """Return the row and the column of a pivot, and the pivot's inverse."""
    index = jnp.arange(_BLOCK, dtype=jnp.int32)
    row = jnp.where((index == pivot)[:, None], matrix, 0.0).sum(axis=0)
    column = jnp.where((index == pivot)[None], matrix, 0.0).sum(axis=1)
    # Through the root, so that a pivot that is not positive makes the result non-finite.
    return row, column, jax.lax.rsqrt(jnp.where(index == pivot, column, 0.0).sum()) ** 2


def _diagonal(matrix: Float[Array, "16 16"]) -> _Part:
    index = jnp.arange(_BLOCK, dtype=jnp.int32)
    return jnp.where(index[:, None] == index[None], matrix, 0.0).sum(axis=1)
