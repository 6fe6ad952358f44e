"""Functions of few of many are those of all, with zeros elsewhere, however they are batched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.batched.sparse import sparsely


def _function(one, common):
    """Of a thing with an empty part, as states without activations are."""
    (x, nothing), (matrix, shift) = one, common
    return {"product": matrix @ x + shift, "nothing": nothing, "count": jnp.sum(x > 0)}


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("axes", [(), (0,), (None,), (0, None), (None, 0), (0, 0)], ids=str)
def test_the_wanted_ones_are_those_of_a_loop_over_all(share, axes):
    """Two batches of 7 and 3, of which the common part has some; 5 things each."""
    random, sizes = np.random.default_rng(0), (7, 3)[: len(axes)]
    batch = tuple(size for size, axis in zip(sizes, axes, strict=True) if axis == 0)
    things = (jnp.asarray(random.normal(size=(*sizes, 5, 4))), jnp.zeros((*sizes, 5, 0)))
    matrix, shift = jnp.asarray(random.normal(size=(*batch, 2, 4))), jnp.asarray(3.0)
    is_wanted = jnp.asarray(random.random((*sizes, 5)) < share)
    sparse = lambda wanted, things, matrix: sparsely(_function, wanted, things, (matrix, shift))  # noqa: E731
    dense = jax.vmap(lambda thing, matrix: _function(thing, (matrix, shift)), (0, None))
    for axis in reversed(axes):
        sparse, dense = jax.vmap(sparse, (0, 0, axis)), jax.vmap(dense, (0, axis))
    found, expected = jax.jit(sparse)(is_wanted, things, matrix), dense(things, matrix)
    for name, value in expected.items():
        chosen = is_wanted.reshape(*is_wanted.shape, *(1,) * (value.ndim - is_wanted.ndim))
        np.testing.assert_allclose(found[name], jnp.where(chosen, value, 0), rtol=1e-12)


def test_what_is_not_wanted_is_not_computed():
    """A loop that never ends but where it is wanted."""

    def count(start, common):
        return jax.lax.while_loop(lambda x: x != 0, lambda x: x - 1.0, start)

    starts = jnp.where(jnp.arange(64) % 9 == 0, 3.0, 0.5)
    found = jax.jit(lambda wanted: sparsely(count, wanted, starts, ()))(starts == 3.0)
    np.testing.assert_array_equal(found, jnp.zeros(64))
