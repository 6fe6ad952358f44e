"""Functions of few of many: what is not asked for takes no time, also where a batch is stepped together."""

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, PyTree

# Into how many parts a batch is divided, of which those are left out that nobody asks for; and the least part.
_PARTS, _LEAST = 8, 8


def sparsely(function: Callable, is_wanted: Bool[Array, " n"], each: PyTree, common: PyTree) -> PyTree:
    """Return a function of each of n things where it is wanted, and zeros elsewhere."""
    # The function takes one thing and what is common to all, which may be batched, and returns a tree of arrays. Under
    # `jax.vmap` the wanted ones of the whole batch are gathered, so that time goes with their number.
    traced, known = eqx.partition(common, lambda x: isinstance(x, jax.core.Tracer))
    leaves, form = jax.tree.flatten((each, traced))

    def at(*values: Array) -> PyTree:
        each, traced = jax.tree.unflatten(form, values)
        return function(each, eqx.combine(traced, known))

    num_each = len(jax.tree.leaves(each))
    kinds = ["each"] * num_each + ["common"] * (len(leaves) - num_each)
    return _gathered(jax.jit(at), kinds)(is_wanted, *leaves)


def _gathered(function: Callable, kinds: list[str]) -> Callable:
    """Return the same of a flat list of arrays: of each thing, of equal groups of them, and common to all."""

    @custom_vmap
    def run(is_wanted: Array | np.ndarray, *leaves: Array | np.ndarray) -> PyTree:
        count = len(is_wanted)
        groups = next((len(x) for x, kind in zip(leaves, kinds, strict=True) if kind == "group"), 1)
        size = min(count, max(_LEAST, math.ceil(count / _PARTS)))
        room = size * math.ceil(count / size)
        order = jnp.flatnonzero(jnp.asarray(is_wanted), size=room, fill_value=count).astype(jnp.int32)
        own = jax.vmap(function, [None if kind == "common" else 0 for kind in kinds])

        def part(first: Array) -> tuple[Array, PyTree]:
            index = jax.lax.dynamic_slice(order, (first,), (size,))
            places = {"each": index, "group": index // (count // groups)}
            both = zip(leaves, kinds, strict=True)
            return index, own(*(x if kind == "common" else x.at[places[kind]].get(mode="clip") for x, kind in both))

        def go_on(state: tuple) -> tuple:
            first, found = state
            index, some = part(first)
            return first + size, jax.tree.map(lambda x, y: x.at[index].set(y, mode="drop"), found, some)

        shapes = jax.eval_shape(lambda: part(jnp.int32(0))[1])
        found = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
        wanted = jnp.sum(is_wanted)
        return jax.lax.while_loop(lambda state: state[0] < wanted, go_on, (jnp.int32(0), found))[1]

    @run.def_vmap
    def _(
        size: int, is_batched: Sequence[bool], is_wanted: Array | np.ndarray, *leaves: Array | np.ndarray
    ) -> tuple[PyTree, PyTree]:
        every = zip(leaves, kinds, is_batched[1:], strict=True)
        groups = next((jnp.shape(x)[batched] for x, kind, batched in every if kind == "group"), 1)
        flat, after = [], []
        for x, kind, batched in zip((is_wanted, *leaves), ["each", *kinds], is_batched, strict=True):
            if kind == "common" and not batched:
                flat.append(x)
                after.append(kind)
                continue
            x = x if batched else jnp.broadcast_to(x, (size, *x.shape))
            if kind == "common":
                x = jnp.broadcast_to(x[:, None], (size, groups, *x.shape[1:]))
            flat.append(x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]))
            after.append("each" if kind == "each" else "group")
        found = _gathered(function, after[1:])(*flat)
        found = jax.tree.map(lambda x: x.reshape(size, len(x) // size, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return run
