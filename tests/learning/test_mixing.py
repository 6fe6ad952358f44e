"""The weight of least error against a search for it, and what halves say of means."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from mjxgrad.learning.mixing import Products


def products(first, gradient, first_noise, zeroth_noise):
    numbers = first @ first, first_noise, gradient @ gradient, zeroth_noise, first @ gradient
    return Products(*map(jnp.asarray, numbers))


def least_error(first, gradient, first_noise, zeroth_noise):
    """Of a first + b zeroth, both from zero, the share of a."""

    def error(ab):
        mean = ab[0] * first + ab[1] * gradient - gradient
        return mean @ mean + ab[0] ** 2 * first_noise + ab[1] ** 2 * zeroth_noise

    a, b = minimize(error, [0.5, 0.5], bounds=[(0, None)] * 2, options={"ftol": 1e-14, "gtol": 1e-12}).x
    return a / (a + b)


@pytest.mark.parametrize("seed", range(8))
def test_no_other_weights_have_less_error(seed):
    """Of means in any direction to each other, three of the eight opposed."""
    random = np.random.default_rng(seed)
    means, noises = random.normal(size=(2, 3)), random.uniform(0.1, 3, 2)
    case = means[0], means[1], noises[0], noises[1]
    assert_allclose(products(*case).weight(), least_error(*case), atol=2e-5)


def test_without_bias_it_weighs_by_inverse_variance_and_a_wrong_direction_counts_for_nothing():
    up, along = jnp.array([0.0, 1.0]), jnp.array([2.0, 0.0])
    assert_allclose(products(along, along, 1.0, 3.0).weight(), 3 / 4)
    assert products(up, along, 1e-6, 3.0).weight() == 0
    assert products(-along, along, 1e-6, 3.0).weight() == 0
    # Zeroth order shows nothing but noise, which agrees with first order.
    hidden = products(along, along, 0.1, 5.0)
    assert eqx.tree_at(lambda p: p.zeroth, hidden, -0.2).weight() == 1


def test_halves_tell_the_products_of_means_without_their_noise():
    """Drawn 50 000 times, within four standard errors of what was put in; the noise is three times the means."""
    first, gradient = np.array([1.0, 0.5, 0.0]), np.array([0.5, 1.0, 0.2])
    keys = jax.random.split(jax.random.key(0), 50_000)

    def draw(key):
        noise = jax.random.normal(key, (4, 3)) * jnp.array([1.0, 1.0, 3.0, 3.0])[:, None]
        halves = [(mean + part) / 2 for mean, part in zip((first, first, gradient, gradient), noise, strict=True)]
        found = Products.none().with_more(tuple(halves[:2]), tuple(halves[2:]))
        total = sum((half**2).sum() for half in halves)
        return jax.tree.map(lambda x: x * total / 0.05, found)

    found = jax.tree.leaves(jax.vmap(draw)(keys))
    wanted = jax.tree.leaves(products(first, gradient, 3 / 2, 27 / 2))
    for values, value in zip(found, wanted, strict=True):
        assert abs(values.mean() - value) < 4 * values.std() / len(keys) ** 0.5


def test_an_update_counts_for_a_twentieth_and_one_that_is_no_number_for_nothing():
    first, zeroth = (jnp.array([1.0, 0.0]), jnp.array([1.0, 0.0])), (jnp.array([1.0, 2.0]), jnp.array([1.0, -2.0]))
    once = Products.none().with_more(first, zeroth)
    assert_allclose(jax.tree.leaves(once), 0.05 * np.array([4, 0, -12, 16, 4]) / 12)
    assert_allclose(jax.tree.leaves(once.with_more(first, zeroth)), 1.95 * np.array(jax.tree.leaves(once)))
    for bad in itertools.product((jnp.nan, jnp.inf), (first, zeroth)):
        broken = tuple(half.at[0].set(bad[0]) for half in bad[1])
        parts = (broken, zeroth) if bad[1] is first else (first, broken)
        assert_allclose(jax.tree.leaves(once.with_more(*parts)), jax.tree.leaves(once))
