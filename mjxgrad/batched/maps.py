r"""Linear and bilinear maps and Einstein sums of many short vectors: JAX primitives whose derivatives are sums of the same kind.

JAX's derivative of a slice is a padded array, that of a gather a scatter, which make reverse mode slow.

**On a CPU** the batch of `jax.vmap`, which JAX puts first, is last in memory, so that operations run along whole vectors of
states. XLA propagates layouts: it suffices that all primitives request this one. A hopper's gradient takes less than half the
time. A matrix product would need the batch first, so Einstein sums are written out.

**On a GPU** any operation takes at least a microsecond. There linear and bilinear maps are sums of gathers, which XLA fuses with
their neighbours.

The norms here have a derivative of zero at zero, where the usual norm has none.
"""

import dataclasses
import functools
import inspect
import itertools
import operator
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jax.extend.core import Primitive
from jax.interpreters import ad, batching
from jaxtyping import Array, Float, Int

from mjxgrad.batched import device
from mjxgrad.batched.linear import LONGEST_SUM, add

Term = tuple[int, int, int, float]  # (entry of the result, entry of the first factor, entry of the second, coefficient)
_MOST_GATHERED = 32  # longest sum that a GPU gathers; a longer one is a matrix product
_MOST_SLICED = 96  # largest total number of terms that are sliced, since each slice is an operation to compile
_MOST_FUSED = 4  # longest gathered sum that is fused with its inputs, which XLA then computes again for every term


class Bilinear:
    """The map c_k = Σ_ij T_kij a_i b_j along the last axis, for a constant T; both factors have the same leading axes."""

    def __init__(self, table: np.ndarray):
        self._size = len(table)
        self._terms = _ordered((*map(int, index), float(table[tuple(index)])) for index in np.argwhere(table))  # pyright: ignore[reportArgumentType]

    def __call__(self, a: Float[Array, "*n i"], b: Float[Array, "*n j"]) -> Float[Array, "*n k"]:
        return _bilinear.bind(a, b, terms=self._terms, size=self._size, batch=0)


def combine(matrix: np.ndarray, x: Float[Array, "n *item"]) -> Float[Array, "m *item"]:
    """Return the weighted sums of items, one for each row of a constant matrix."""
    if matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(len(matrix))):
        return x
    return _linear.bind(x, matrix=_constant(matrix), batch=0)


def pick(
    index: Int[Array | np.ndarray, " m"], x: Float[Array, "n *item"], default: np.ndarray | float = 0.0
) -> Float[Array, "m *item"]:
    """Return the items at an index; where a constant index is negative, the default."""
    if not isinstance(index, np.ndarray):
        return choose(index, x)
    selected = combine(index[:, None] == np.arange(len(x)), x)
    if (index >= 0).all() or not np.any(default):
        return selected
    missing = (index < 0).reshape((-1,) + (1,) * (x.ndim - 1))
    return selected + jnp.asarray(missing * default, x.dtype)


@jax.custom_jvp
def choose(index: Int[Array, "*m"], x: Float[Array, "n *item"]) -> Float[Array, "..."]:
    """Return the items at an index that is known only at run time."""
    return x[index]


@choose.defjvp
def _choose_jvp(primals, tangents):
    (index, x), (_, change) = primals, tangents
    # A sum over all items, since the transpose of a gather is a scatter; items not chosen may have infinite derivatives.
    is_chosen = index[..., None] == jnp.arange(len(x))
    of_any = is_chosen.any(axis=tuple(range(index.ndim))).reshape(-1, *(1,) * (x.ndim - 1))
    change = jnp.where(of_any, change, 0.0)
    chosen = contract("mn,nk->mk", is_chosen.reshape(-1, len(x)).astype(x.dtype), change.reshape(len(x), -1))
    return choose(index, x), chosen.reshape(*index.shape, *x.shape[1:])


def dot(a: Float[Array, "n k"], b: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Return the scalar product of each item."""
    return Bilinear(np.eye(a.shape[1])[None])(a, b)[:, 0]


@jax.custom_jvp
def scale(factor: Float[Array, " n"], x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return each item times its factor."""
    return factor[:, None] * x


@scale.defjvp
def _scale_jvp(primals, tangents):
    (factor, x), (change, dx) = primals, tangents
    scaled = Bilinear(np.eye(x.shape[1])[:, None])
    return scale(factor, x), scaled(change[:, None], x) + scaled(factor[:, None], dx)


def contract(subscripts: str, a: Array, b: Array) -> Array:
    """Return an Einstein sum at full precision; each index of one factor is in the other or in the result."""
    dtype = jnp.result_type(a, b)
    letters = _Subscripts(*subscripts.replace("->", ",").split(","))
    return _contract.bind(jnp.asarray(a, dtype), jnp.asarray(b, dtype), subscripts=letters, batch=0)


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root, whose derivative at zero is zero instead of infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm over the last axis, with derivative zero at the zero vector."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))


def _define(name: str, infer: Callable, evaluate: Callable, on_gpu: Callable) -> Primitive:
    """Return a primitive without its derivative; the first `batch` axes of all arrays are those of `jax.vmap`."""
    primitive = Primitive(name)

    def batch_last(*factors, batch, **parameters):
        factors = [_batch_last(x, batch) for x in factors]
        return _batch_last(evaluate(*factors, batch=batch, **parameters), batch)

    def batched(factors, axes, *, batch, **parameters):
        size = next(x.shape[axis] for x, axis in zip(factors, axes, strict=True) if axis is not None)
        spread = [
            jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(factors, axes, strict=True)
        ]
        return primitive.bind(*spread, batch=batch + 1, **parameters), 0

    names = [one.name for one in inspect.signature(evaluate).parameters.values() if one.kind is one.KEYWORD_ONLY]
    primitive.def_impl(jax.jit(evaluate, static_argnames=names))
    primitive.def_abstract_eval(infer)
    device.set_lowerings(primitive, default=evaluate, cpu=batch_last, gpu=on_gpu)
    batching.primitive_batchers[primitive] = batched
    return primitive


def _batch_last(x: Array, batch: int) -> Array:
    """Return the array, laid out in memory with the batch last."""
    if not 0 < batch < x.ndim:
        return x
    return with_layout_constraint(x, Layout(major_to_minor=(*range(batch, x.ndim), *range(batch))))


def _ordered(terms: Iterable[Term]) -> tuple[Term, ...]:
    return tuple(sorted(terms, key=lambda term: (term[0], -term[3], term[1:3])))


@functools.cache
def _transposed(terms: tuple[Term, ...], places: tuple[int, int, int]) -> tuple[Term, ...]:
    return _ordered(map(operator.itemgetter(*places, 3), terms))


def _bilinear_by_slices(a: Array, b: Array, *, terms: tuple[Term, ...], size: int, batch: int) -> Array:
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
    return jnp.concatenate([none if x is None else x for x in entries], axis=last)


def _bilinear_by_gathers(a: Array, b: Array, *, terms: tuple[Term, ...], size: int, batch: int) -> Array:
    """Return the same map as sums of gathers: the first terms of all entries, then the second ones, and so on."""
    by_entry = [[term for term in terms if term[0] == k] for k in range(size)]
    layers = []
    for layer in range(max(map(len, by_entry), default=0)):
        # Missing terms repeat a term of the same entry with weight zero, so that no other entry can make it NaN.
        chosen = [
            of_one[layer] if layer < len(of_one) else (*(of_one or [(k, 0, 0)])[0][:3], 0.0)
            for k, of_one in enumerate(by_entry)
        ]
        _, i, j, coefficients = map(np.array, zip(*chosen, strict=True))
        product = _entries(a, i, a.ndim - 1) * _entries(b, j, b.ndim - 1)
        layers.append(product if (coefficients == 1).all() else product * jnp.asarray(coefficients, a.dtype))
    if not layers:
        return jnp.zeros((*a.shape[:-1], size), a.dtype)
    return _where_terms(add(layers), np.array([bool(of_one) for of_one in by_entry]))


def _where_terms(total: Array, has_terms: np.ndarray) -> Array:
    return total if has_terms.all() else jnp.where(has_terms, total, 0.0)


def _entries(x: Array, index: np.ndarray, axis: int) -> Array:
    if np.array_equal(index, np.arange(x.shape[axis])):
        return x
    return jnp.take(x, index, axis=axis, mode="clip")


def _transpose_first(cotangent, a, b, *, terms, size, batch):
    return _bilinear.bind(cotangent, b, terms=_transposed(terms, (1, 0, 2)), size=a.aval.shape[-1], batch=batch)


def _transpose_second(cotangent, a, b, *, terms, size, batch):
    return _bilinear.bind(a, cotangent, terms=_transposed(terms, (2, 1, 0)), size=b.aval.shape[-1], batch=batch)


_bilinear = _define(
    "bilinear",
    lambda a, b, *, terms, size, batch: jax.core.ShapedArray((*a.shape[:-1], size), a.dtype),
    _bilinear_by_slices,
    _bilinear_by_gathers,
)
ad.defbilinear(_bilinear, _transpose_first, _transpose_second)


@dataclasses.dataclass(frozen=True, eq=False)
class _Matrix:
    """A constant matrix; there is one object for all of equal entries, so that JAX compares them quickly."""

    entries: np.ndarray


def _constant(entries: np.ndarray) -> _Matrix:
    entries = np.asarray(entries, float)
    return _kept(entries.shape, entries.tobytes())


@functools.cache
def _kept(shape: tuple[int, int], contents: bytes) -> _Matrix:
    return _Matrix(np.frombuffer(contents).reshape(shape))


def _linear_by_slices(x: Array, *, matrix: _Matrix, batch: int) -> Array:
    count = (matrix.entries != 0).sum(axis=1)
    most = count.max(initial=0)
    if not batch or not 0 < most <= LONGEST_SUM or (most > 1 and count.sum() > _MOST_SLICED):
        return _linear_by_product(x, matrix=matrix, batch=batch)
    items = jax.lax.split(x, (1,) * x.shape[batch], batch)
    none = jnp.zeros_like(items[0])

    def row(weights: np.ndarray) -> Array:
        terms = [items[k] if (w := float(weights[k])) == 1 else w * items[k] for k in np.flatnonzero(weights).tolist()]
        return add(terms or [none])

    rows, place = np.unique(matrix.entries, axis=0, return_inverse=True)
    sums = [row(weights) for weights in rows]
    return jnp.concatenate([sums[k] for k in place.reshape(-1)], axis=batch)


def _linear_by_product(x: Array, *, matrix: _Matrix, batch: int) -> Array:
    # The batch last, as in a CPU's memory.
    x = jnp.moveaxis(x, range(batch), range(x.ndim - batch, x.ndim))
    product = jnp.tensordot(jnp.asarray(matrix.entries, x.dtype), x, axes=1, precision="highest")
    return jnp.moveaxis(product, range(x.ndim - batch, x.ndim), range(batch))


def _linear_by_gathers(x: Array, *, matrix: _Matrix, batch: int) -> Array:
    """Return the same map as sums of gathers, as for bilinear maps; sums of many terms are formed separately."""
    rows, place = np.unique(matrix.entries, axis=0, return_inverse=True)
    count = (rows != 0).sum(axis=1)
    order = np.argsort(count, kind="stable")
    if count.max(initial=0) > _MOST_FUSED:
        x = jax.lax.optimization_barrier(x)
    parts = [_gathered(x, rows[part], batch) for part in np.split(order, _where_longer(count[order])) if part.size]
    if not parts:
        return _linear_by_product(x, matrix=matrix, batch=batch)
    return _entries(jnp.concatenate(parts, axis=batch), np.argsort(order)[place.reshape(-1)], batch)


def _where_longer(count: np.ndarray) -> list[int]:
    """Return where to split sums sorted by length, since every sum of a part costs as much as its longest one."""
    lengths = [n * count[n - 1] + (len(count) - n) * count[-1] for n in range(1, len(count))]
    best = int(np.argmin(lengths)) if lengths else 0
    return [best + 1] if lengths and 2 * lengths[best] <= len(count) * count[-1] else []


def _gathered(x: Array, rows: np.ndarray, batch: int) -> Array:
    is_term = rows != 0
    count = int(is_term.sum(axis=1).max(initial=0))
    if not 0 < count <= _MOST_GATHERED:
        return _linear_by_product(x, matrix=_constant(rows), batch=batch)
    order = np.argsort(~is_term, axis=1, kind="stable")[:, :count]
    weights = np.take_along_axis(rows, order, axis=1)
    order = np.where(weights != 0, order, order[:, :1])
    along = (-1,) + (1,) * (x.ndim - batch - 1)
    layers = []
    for index, weight in zip(order.T, weights.T, strict=True):
        part = _entries(x, index, batch)
        layers.append(part if (weight == 1).all() else part * jnp.asarray(weight.reshape(along), x.dtype))
    return _where_terms(add(layers), is_term.any(axis=1).reshape(along))


def _linear_shape(x, *, matrix, batch):
    return jax.core.ShapedArray((*x.shape[:batch], len(matrix.entries), *x.shape[batch + 1 :]), x.dtype)


def _transpose_linear(cotangent, x, *, matrix, batch):
    return (_linear.bind(cotangent, matrix=_constant(matrix.entries.T), batch=batch),)


_linear = _define("linear", _linear_shape, _linear_by_slices, _linear_by_gathers)
ad.deflinear2(_linear, _transpose_linear)


class _Subscripts(NamedTuple):
    """One letter for each axis of both factors and of the result, without the axes of the batch."""

    first: str
    second: str
    result: str

    @property
    def summed(self) -> str:
        return "".join(letter for letter in self.first if letter not in self.result)

    def sizes(self, a: Any, b: Any, batch: int) -> dict[str, int]:
        return dict(zip(self.first + self.second, (*a.shape[batch:], *b.shape[batch:]), strict=True))


def _contract_written_out(a: Array, b: Array, *, subscripts: _Subscripts, batch: int) -> Array:
    sizes = subscripts.sizes(a, b, batch)
    summed = [range(sizes[letter]) for letter in subscripts.summed]
    if not batch or not 0 < np.prod([len(places) for places in summed]) <= LONGEST_SUM:
        return _contract_by_product(a, b, subscripts=subscripts, batch=batch)

    def at(x: Array, letters: str, place: dict[str, int]) -> Array:
        chosen = x[(..., *(place.get(letter, slice(None)) for letter in letters))]
        kept = [letter for letter in letters if letter not in place]
        order = [batch + kept.index(letter) for letter in subscripts.result if letter in kept]
        chosen = chosen.transpose(*range(batch), *order)
        return jnp.expand_dims(chosen, [batch + k for k, letter in enumerate(subscripts.result) if letter not in kept])

    places = (dict(zip(subscripts.summed, place, strict=True)) for place in itertools.product(*summed))
    return add(at(a, subscripts.first, place) * at(b, subscripts.second, place) for place in places)


def _contract_by_product(a: Array, b: Array, *, subscripts: _Subscripts, batch: int) -> Array:
    first, second, result = subscripts
    return jnp.einsum(f"...{first},...{second}->...{result}", a, b, precision="highest")


def _contract_shape(a, b, *, subscripts, batch):
    sizes = subscripts.sizes(a, b, batch)
    return jax.core.ShapedArray((*a.shape[:batch], *map(sizes.__getitem__, subscripts.result)), a.dtype)


def _contract_first(cotangent, a, b, *, subscripts, batch):
    first, second, result = subscripts
    return _contract.bind(cotangent, b, subscripts=_Subscripts(result, second, first), batch=batch)


def _contract_second(cotangent, a, b, *, subscripts, batch):
    first, second, result = subscripts
    return _contract.bind(a, cotangent, subscripts=_Subscripts(first, result, second), batch=batch)


_contract = _define("contract", _contract_shape, _contract_written_out, _contract_written_out)
ad.defbilinear(_contract, _contract_first, _contract_second)
