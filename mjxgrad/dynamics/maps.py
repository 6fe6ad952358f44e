"""Linear and bilinear maps of many short vectors, with constant coefficients, whose derivatives are maps of the same kind.

A cross product is written in components: slices, products, one concatenation. JAX's derivative of a slice, though, is a padded
array, and the sum of many of those is what makes reverse mode slow; and that of a gather is a scatter, which XLA's CPU back end
does one by one. A batched matrix product keeps one factor, arranged as a matrix, for the backward pass, and runs as one
small product after another. So both maps are primitives of their own. The transposes of either are again such maps, with the
same terms in another order; hence so are derivatives of every order and mode.

On a GPU an operation takes a microsecond however short it is, and a slice of an array that is used elsewhere, or the transpose
that a product of matrices asks for, is one. There both maps are sums of gathers, which are fused with what is before and after.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

# (entry of the result, entry of the first factor, entry of the second, coefficient)
_Term = tuple[int, int, int, float]
# Terms of a sum up to which a GPU gathers them; more are a product of matrices.
_MOST_GATHERED = 32
# Entries that are put together at once.
_MOST_JOINED = 8


class Bilinear:
    """The map c_k = Σ_ij T_kij a_i b_j along the last axis, for a constant T."""

    def __init__(self, table: np.ndarray):
        """Keep the terms of T that are not zero."""
        self._size = len(table)
        self._terms = _ordered([(*map(int, index), float(table[tuple(index)])) for index in np.argwhere(table)])  # pyright: ignore[reportArgumentType]

    def __call__(self, a: Float[Array, "*n i"], b: Float[Array, "*n j"]) -> Float[Array, "*n k"]:
        """Return c; both factors have the same leading axes."""
        return _bilinear.bind(a, b, terms=self._terms, size=self._size)


def combine(matrix: np.ndarray, x: Float[Array, "n *item"]) -> Float[Array, "m *item"]:
    """Return the sums over items that the rows of a constant matrix ask for."""
    if matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(len(matrix))):
        return x
    return _linear.bind(x, matrix=_Matrix(np.asarray(matrix, float)), axis=0)


def pick(
    index: Int[Array | np.ndarray, " m"], x: Float[Array, "n *item"], default: np.ndarray | float = 0.0
) -> Float[Array, "m *item"]:
    """Return the items of an index, and of a constant one a default where it is negative."""
    if not isinstance(index, np.ndarray):
        return choose(index, x)
    selected = combine(index[:, None] == np.arange(len(x)), x)
    if (index >= 0).all() or not np.any(default):
        return selected
    missing = (index < 0).reshape((-1,) + (1,) * (x.ndim - 1))
    return selected + jnp.asarray(missing * default, x.dtype)


@jax.custom_jvp
def choose(index: Int[Array, "*m"], x: Float[Array, "n *item"]) -> Float[Array, "..."]:
    """Return the items of an index that only the running program knows."""
    return x[index]


@choose.defjvp
def _choose_jvp(primals, tangents):
    (index, x), (_, change) = primals, tangents
    # A sum over all items, for its transpose is no scatter; what is not chosen may have no finite derivative.
    is_chosen = index[..., None] == jnp.arange(len(x))
    of_any = is_chosen.any(axis=tuple(range(index.ndim))).reshape(-1, *(1,) * (x.ndim - 1))
    change = jnp.where(of_any, change, 0.0)
    return choose(index, x), jnp.tensordot(is_chosen.astype(x.dtype), change, axes=1, precision="highest")


def dot(a: Float[Array, "n k"], b: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Return the scalar product of each item."""
    return Bilinear(np.eye(a.shape[1])[None])(a, b)[:, 0]


@jax.custom_jvp
def scale(factor: Float[Array, " n"], x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return items times a factor each."""
    return factor[:, None] * x


@scale.defjvp
def _scale_jvp(primals, tangents):
    (factor, x), (change, dx) = primals, tangents
    scaled = Bilinear(np.eye(x.shape[1])[:, None])
    return scale(factor, x), scaled(change[:, None], x) + scaled(factor[:, None], dx)


def contract(subscripts: str, *factors: Array) -> Array:
    """Return an Einstein sum at full precision."""
    return jnp.einsum(subscripts, *factors, precision="highest")


# The bilinear map as a primitive.


def _ordered(terms: Sequence[_Term]) -> tuple[_Term, ...]:
    """Return the terms by entry of the result, those that are added before those that are subtracted."""
    return tuple(sorted(terms, key=lambda term: (term[0], -term[3], term[1:3])))


def _evaluate(a: Array, b: Array, *, terms: tuple[_Term, ...], size: int) -> Array:
    last = a.ndim - 1
    a_entries, b_entries = (jax.lax.split(x, (1,) * x.shape[last], last) for x in (a, b))
    entries: list[Array | None] = [None] * size
    for k, i, j, coefficient in terms:
        product, so_far = a_entries[i] * b_entries[j], entries[k]
        if abs(coefficient) != 1:
            product = abs(coefficient) * product
        if coefficient < 0:
            entries[k] = -product if so_far is None else so_far - product
        else:
            entries[k] = product if so_far is None else so_far + product
    none = jnp.zeros((*a.shape[:last], 1), a.dtype)
    return _joined([none if x is None else x for x in entries], last)


def _joined(entries: list[Array], axis: int) -> Array:
    """Return entries as one array; more at a time XLA's CPU back end would compute by an operation each."""
    total = None
    for start in range(0, len(entries), _MOST_JOINED):
        part = jnp.concatenate(entries[start : start + _MOST_JOINED], axis=axis)
        after = len(entries) - start - part.shape[axis]
        if start or after:
            part = jax.lax.pad(part, jnp.zeros((), part.dtype), [(0, 0, 0)] * axis + [(start, after, 0)])
        total = part if total is None else total + part
    return total  # pyright: ignore[reportReturnType]


def _evaluate_by_gathers(a: Array, b: Array, *, terms: tuple[_Term, ...], size: int) -> Array:
    """Return the same: of all entries the first terms, then the second ones, and so on."""
    by_entry = [[term for term in terms if term[0] == k] for k in range(size)]
    layers = []
    for layer in range(max(map(len, by_entry), default=0)):
        # Filled up by what an entry has anyway: nothing else may spoil it.
        chosen = [
            of_one[layer] if layer < len(of_one) else (*(of_one or [(k, 0, 0)])[0][:3], 0.0)
            for k, of_one in enumerate(by_entry)
        ]
        _, i, j, coefficients = map(np.array, zip(*chosen, strict=True))
        product = _entries(a, i, a.ndim - 1) * _entries(b, j, b.ndim - 1)
        layers.append(product if (coefficients == 1).all() else product * jnp.asarray(coefficients, a.dtype))
    if not layers:
        return jnp.zeros((*a.shape[:-1], size), a.dtype)
    return _sum(layers, np.array([bool(of_one) for of_one in by_entry]))


def _sum(layers: list[Array], has_terms: np.ndarray) -> Array:
    """Return the sum of first, second, ... terms; zero where there are none."""
    total = sum(layers[1:], start=layers[0])
    return total if has_terms.all() else jnp.where(has_terms, total, 0.0)


def _entries(x: Array, index: np.ndarray, axis: int) -> Array:
    """Return entries at constant places along an axis."""
    if np.array_equal(index, np.arange(x.shape[axis])):
        return x
    return jnp.take(x, index, axis=axis, mode="clip")


def _transpose_first(cotangent, a, b, *, terms, size):
    swapped = _ordered([(i, k, j, c) for k, i, j, c in terms])
    return _bilinear.bind(cotangent, b, terms=swapped, size=a.aval.shape[-1])


def _transpose_second(cotangent, a, b, *, terms, size):
    swapped = _ordered([(j, i, k, c) for k, i, j, c in terms])
    return _bilinear.bind(a, cotangent, terms=swapped, size=b.aval.shape[-1])


def _batch_bilinear(factors, axes, **parameters):
    size = next(x.shape[axis] for x, axis in zip(factors, axes, strict=True) if axis is not None)
    spread = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(factors, axes, strict=True)
    ]
    return _bilinear.bind(*spread, **parameters), 0


_bilinear = Primitive("bilinear")
_bilinear.def_impl(jax.jit(_evaluate, static_argnames=("terms", "size")))
_bilinear.def_abstract_eval(lambda a, b, *, terms, size: jax.core.ShapedArray((*a.shape[:-1], size), a.dtype))
mlir.register_lowering(_bilinear, mlir.lower_fun(_evaluate, multiple_results=False))
mlir.register_lowering(_bilinear, mlir.lower_fun(_evaluate_by_gathers, multiple_results=False), platform="cuda")
ad.defbilinear(_bilinear, _transpose_first, _transpose_second)
batching.primitive_batchers[_bilinear] = _batch_bilinear


# The linear map as a primitive.


class _Matrix:
    """A constant matrix, compared by its entries."""

    def __init__(self, entries: np.ndarray):
        self.entries = entries
        self._contents = entries.shape, entries.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Matrix) and self._contents == other._contents

    def __hash__(self) -> int:
        return hash(self._contents)


def _combine(x: Array, *, matrix: _Matrix, axis: int) -> Array:
    product = jnp.tensordot(jnp.asarray(matrix.entries, x.dtype), x, axes=((1,), (axis,)), precision="highest")
    return jnp.moveaxis(product, 0, axis)


def _combine_by_gathers(x: Array, *, matrix: _Matrix, axis: int) -> Array:
    """Return the same: of all sums the first terms, then the second ones, and so on."""
    is_term = matrix.entries != 0
    count = int(is_term.sum(axis=1).max(initial=0))
    if not 0 < count <= _MOST_GATHERED:
        return _combine(x, matrix=matrix, axis=axis)
    order = np.argsort(~is_term, axis=1, kind="stable")[:, :count]
    weights = np.take_along_axis(matrix.entries, order, axis=1)
    order = np.where(weights != 0, order, order[:, :1])
    layers = []
    for index, weight in zip(order.T, weights.T, strict=True):
        part = _entries(x, index, axis)
        column = weight.reshape(-1, *(1,) * (x.ndim - axis - 1))
        layers.append(part if (weight == 1).all() else part * jnp.asarray(column, x.dtype))
    return _sum(layers, is_term.any(axis=1).reshape(-1, *(1,) * (x.ndim - axis - 1)))


def _transpose_linear(cotangent, x, *, matrix, axis):
    return (_linear.bind(cotangent, matrix=_Matrix(matrix.entries.T.copy()), axis=axis),)


def _batch_linear(given, axes, *, matrix, axis):
    (x,), (batch,) = given, axes
    return _linear.bind(x, matrix=matrix, axis=axis + (batch <= axis)), batch


_linear = Primitive("linear")
_linear.def_impl(jax.jit(_combine, static_argnames=("matrix", "axis")))
_linear.def_abstract_eval(
    lambda x, *, matrix, axis: jax.core.ShapedArray(
        (*x.shape[:axis], len(matrix.entries), *x.shape[axis + 1 :]), x.dtype
    )
)
mlir.register_lowering(_linear, mlir.lower_fun(_combine, multiple_results=False))
mlir.register_lowering(_linear, mlir.lower_fun(_combine_by_gathers, multiple_results=False), platform="cuda")
ad.deflinear2(_linear, _transpose_linear)
batching.primitive_batchers[_linear] = _batch_linear
