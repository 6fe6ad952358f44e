"""Linear and bilinear maps and Einstein sums of many short vectors, with derivatives of the same kind; see `primitives`.

The norms here have a derivative of zero at zero, where the usual norm has none.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjxgrad.batched import primitives


class Bilinear:
    """The map c_k = Σ_ij T_kij a_i b_j along the last axis, for a constant T."""

    def __init__(self, table: np.ndarray):
        """Keep the terms of T that are not zero."""
        self._size = len(table)
        self._terms = primitives.ordered((*map(int, index), float(table[tuple(index)])) for index in np.argwhere(table))  # pyright: ignore[reportArgumentType]

    def __call__(self, a: Float[Array, "*n i"], b: Float[Array, "*n j"]) -> Float[Array, "*n k"]:
        """Return c; both factors have the same leading axes."""
        return primitives.bilinear(a, b, self._terms, self._size)


def combine(matrix: np.ndarray, x: Float[Array, "n *item"]) -> Float[Array, "m *item"]:
    """Return the weighted sums of items, one for each row of a constant matrix."""
    if matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(len(matrix))):
        return x
    return primitives.linear(x, np.asarray(matrix, float))


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
    return primitives.contract(jnp.asarray(a, dtype), jnp.asarray(b, dtype), subscripts)


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root, whose derivative at zero is zero instead of infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm over the last axis, with derivative zero at the zero vector."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))
