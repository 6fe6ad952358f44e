"""Linear algebra of joint-space size, for many small problems at once.

Arrays may carry the batch as trailing axes, so that every operation runs along whole vectors of problems. Sums over short axes
are written out, since XLA does not vectorise a reduction along the remaining batch axis.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mjxgrad.batched import device

_Items = Float[Array, "n *rest"]
_Matrix = Float[Array, "n n *batch"]
LONGEST_SUM = 64  # longer sums are matrix products: written out they would take longer to compile than they save
_SWEEPS = 5  # of Jacobi's rotations; of a matrix of four rows the fifth changes nothing in double precision


def matvec(matrix: Float[Array, "m n *batch"], x: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
    """Return matrix x."""
    if matrix.ndim == 2:
        return matrix @ x
    if matrix.shape[1] > LONGEST_SUM:
        return jnp.einsum("mn...,n...->m...", matrix, x, precision="highest")
    return add(matrix[:, i] * x[i] for i in range(matrix.shape[1]))


def rmatvec(matrix: Float[Array, "m n *batch"], x: Float[Array, "m *batch"]) -> Float[Array, "n *batch"]:
    """Return matrixᵀ x."""
    if matrix.ndim == 2 or len(matrix) > LONGEST_SUM:
        return matvec(jnp.swapaxes(matrix, 0, 1), x)
    return add(row * factor for row, factor in zip(matrix, x, strict=True))


def dot(x: Float[Array, "n *batch"], y: Float[Array, "n *batch"]) -> Float[Array, "*batch"]:
    """Return the inner product."""
    if x.ndim == 1:
        return jnp.sum(x * y)
    rest = x * y
    while len(rest) > LONGEST_SUM:  # XLA's CPU backend hands a reduction to a library, as in `sum_of_few`
        half = len(rest) // 2
        rest = jnp.concatenate([rest[:half] + rest[half : 2 * half], rest[2 * half :]])
    return add(rest)


def diagonal(matrix: _Matrix) -> Float[Array, "n *batch"]:
    """Return the diagonal."""
    return jnp.stack([matrix[i, i] for i in range(len(matrix))])


def sum_of_few(terms: Float[Array, "contacts few *rest"]) -> Float[Array, "contacts 1 *rest"]:
    """Return the sum over the second axis, written out."""
    # XLA's CPU backend hands such a reduction to a library (YNNPACK) that neither vectorises it over the batch nor,
    # under two `jax.vmap` (jax 0.10.2), always survives it.
    return add(terms[:, i : i + 1] for i in range(terms.shape[1]))


def batch_last(function: Callable) -> Callable:
    """Return a function whose `jax.vmap` calls it on arrays with the batch as one more trailing axis."""
    # Nested batches are merged into one axis, which makes longer vectors and arrays of lower rank. The function takes
    # and returns pytrees of arrays.

    def call(*args: PyTree) -> PyTree:
        # The forward mode of `custom_vmap`, which `jax.hessian` uses, would take None for an array (jax 0.10.2).
        leaves, structure = jax.tree.flatten(args)
        return _of_leaves(lambda *given: function(*jax.tree.unflatten(structure, given)), None)(*leaves)

    return call


def _of_leaves(function: Callable, batch: int | None) -> Callable:
    """Return the same for a function of arrays that may have a trailing axis of a batch already."""
    # Under `jax.jit` constants stay inside. `custom_vmap` refuses to batch constants, which `jax.lax.cond` requires
    # where its condition differs between members of the batch.
    batched = jax.custom_batching.custom_vmap(jax.jit(function))

    @batched.def_vmap
    def rule(size, is_batched, *leaves):
        if not any(is_batched):  # in forward mode, where only the tangents are batched
            result = function(*leaves)
            return result, jax.tree.map(lambda _: False, result)

        def back(x: Array) -> Array:
            split = x if batch is None else x.reshape(*x.shape[:-1], batch, size)
            return jnp.moveaxis(split, -1, 0)

        moved = _moved_last(leaves, is_batched, size)
        if batch is not None:
            moved = [x.reshape(*x.shape[:-2], batch * size) for x in moved]
        result = _of_leaves(function, size if batch is None else batch * size)(*moved)
        return jax.tree.map(back, result), jax.tree.map(lambda _: True, result)

    return batched


def _moved_last(leaves: Sequence[Array], is_batched: Sequence[bool], size: int) -> list[Array]:
    """Return arrays with the batch as trailing axis; batched arrays of one type are moved in one operation."""
    moved = [
        None if has_batch else jnp.broadcast_to(x[..., None], (*x.shape, size))
        for x, has_batch in zip(leaves, is_batched, strict=True)
    ]
    by_type: dict[object, list[int]] = {}
    for place, has_batch in enumerate(is_batched):
        if has_batch:
            by_type.setdefault(leaves[place].dtype, []).append(place)
    for places in by_type.values():
        # An array that occurs twice is moved once.
        distinct = {id(leaves[place]): leaves[place] for place in places}
        rows = jnp.concatenate([leaf.reshape(size, -1) for leaf in distinct.values()], axis=1).T
        start, found = 0, {}
        for name, leaf in distinct.items():
            stop = start + math.prod(leaf.shape[1:])
            found[name], start = rows[start:stop].reshape(*leaf.shape[1:], size), stop
        for place in places:
            moved[place] = found[id(leaves[place])]
    return moved  # pyright: ignore[reportReturnType]


def runs(chosen: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Return ascending indices as slices: pairs of places among all entries and among the chosen ones."""
    cuts = [k for k in range(1, len(chosen)) if chosen[k] != chosen[k - 1] + 1]
    ends = zip([0, *cuts], [*cuts, len(chosen)], strict=True)
    return [(slice(chosen[a], chosen[a] + b - a), slice(a, b)) for a, b in ends if b > a]


def take(x: _Items, chosen: tuple[int, ...]) -> Float[Array, "m *rest"]:
    """Return entries at ascending constant indices."""
    parts = [x[target] for target, _ in runs(chosen)]
    return parts[0] if len(parts) == 1 else jnp.concatenate([x[:0], *parts])


def add_at(x: _Items, chosen: tuple[int, ...], part: Float[Array, "m *rest"]) -> _Items:
    """Return x with `part` added to the entries at ascending constant indices."""
    for target, source in runs(chosen):
        x = _add_block(x, (target,), part[source])
    return x


def add_to_block(matrix: _Matrix, chosen: tuple[int, ...], part: Float[Array, "m m *batch"]) -> _Matrix:
    """Return a matrix with `part` added to the chosen rows and columns."""
    for down, left in runs(chosen):
        for across, right in runs(chosen):
            matrix = _add_block(matrix, (down, across), part[left, right])
    return matrix


def add_to_diagonal(matrix: _Matrix, chosen: tuple[int, ...], part: Float[Array, "m *batch"]) -> _Matrix:
    """Return a matrix with `part` added to the chosen entries of the diagonal."""
    for place, k in enumerate(chosen):
        matrix = _add_block(matrix, (slice(k, k + 1), slice(k, k + 1)), part[place][None, None])
    return matrix


def _add_block(x: Array, where: tuple[slice, ...], part: Array) -> Array:
    """Return x with `part` added to a block."""
    # A CPU adds in place and touches no other entry. A GPU spends more on starting an operation than on a whole array,
    # and sums many padded blocks in one operation.
    if part.shape == x.shape:
        return x + part
    if device.is_cpu():
        return x.at[where].add(part)
    margins = [(axis.start, size - axis.stop, 0) for axis, size in zip(where, x.shape, strict=False)]
    return x + jax.lax.pad(part, jnp.zeros((), x.dtype), [*margins, *[(0, 0, 0)] * (x.ndim - len(where))])


def add(terms: Iterable[Array]) -> Array:
    """Return a sum, written out."""
    return functools.reduce(operator.add, terms)


def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return eigenvalues, in no order, and eigenvectors as columns, by Jacobi's rotations; for up to six rows or so.

    Source: Golub and Van Loan, Matrix Computations, section 8.5.
    """
    # Libraries take one matrix after the other. Rotations, entry by entry, are one kernel for thousands of matrices.
    size = len(matrix)
    if size == 1:
        return matrix[0], jnp.ones_like(matrix)

    def sweep(_: Array, state: tuple[list[list[Array]], list[list[Array]]]) -> tuple:
        entries, vectors = ([list(row) for row in x] for x in state)
        for p, q in itertools.combinations(range(size), 2):
            cosine, sine = _rotation(entries[p][p], entries[p][q], entries[q][q])
            for row in (*entries, *vectors):
                row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
            both = list(zip(entries[p], entries[q], strict=True))
            entries[p], entries[q] = [cosine * x - sine * y for x, y in both], [sine * x + cosine * y for x, y in both]
        return entries, vectors

    state = tuple([list(row) for row in x] for x in (matrix, jnp.eye(size, dtype=matrix.dtype)))
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
