"""Bilinear maps of short vectors whose reverse mode costs no more than the map.

A cross product is written in components: slices, products, one concatenation. XLA fuses that into one loop. JAX's
derivative of a slice, though, is a padded array, and the sum of many of those is what makes reverse mode slow. A
batched matrix product instead keeps one factor, arranged as a matrix, for the backward pass, and runs as one small
product after another.

So the map is a primitive of its own. Its transposes with respect to either factor are again bilinear maps of short
vectors, with the same terms in another order; hence derivatives of every order and mode are such maps.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

# (entry of the result, entry of the first factor, entry of the second, coefficient)
_Term = tuple[int, int, int, float]


class Bilinear:
    """The map c_k = Σ_ij T_kij a_i b_j along the last axis, for a constant T."""

    def __init__(self, table: np.ndarray):
        """Keep the terms of T that are not zero."""
        self._size = len(table)
        self._terms = _ordered([(*map(int, index), float(table[tuple(index)])) for index in np.argwhere(table)])  # pyright: ignore[reportArgumentType]

    def __call__(self, a: Float[Array, "*n i"], b: Float[Array, "*n j"]) -> Float[Array, "*n k"]:
        """Return c; both factors have the same leading axes."""
        return _bilinear.bind(a, b, terms=self._terms, size=self._size)


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
    return jnp.concatenate([none if x is None else x for x in entries], axis=last)


def _transpose_first(cotangent, a, b, *, terms, size):
    swapped = _ordered([(i, k, j, c) for k, i, j, c in terms])
    return _bilinear.bind(cotangent, b, terms=swapped, size=a.aval.shape[-1])


def _transpose_second(cotangent, a, b, *, terms, size):
    swapped = _ordered([(j, i, k, c) for k, i, j, c in terms])
    return _bilinear.bind(a, cotangent, terms=swapped, size=b.aval.shape[-1])


def _batch(factors, axes, **parameters):
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
ad.defbilinear(_bilinear, _transpose_first, _transpose_second)
batching.primitive_batchers[_bilinear] = _batch
