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
    """Products that are known for sure."""
    own, across = gradient @ gradient, first @ gradient
    known = map(jnp.asarray, (first @ first, first_noise, own, zeroth_noise, across, 0.0, 0.0))
    return Products(*known, last=jnp.stack([own, across]))


def share(found):
    """α, of weights whose larger one is 1."""
    a, b = found.weights()
    assert max(a, b) == 1
    return a / (a + b)


def least_error(first, gradient, first_noise, zeroth_noise):
    """Of the mean of forty updates, each a first + b zeroth, both from zero, the share of a."""

    def error(ab):
        mean = ab[0] * first + ab[1] * gradient - gradient
        return mean @ mean + (ab[0] ** 2 * first_noise + ab[1] ** 2 * zeroth_noise) / 40

    a, b = minimize(error, [0.5, 0.5], bounds=[(0, None)] * 2, options={"ftol": 1e-14, "gtol": 1e-12}).x
    return a / (a + b)


@pytest.mark.parametrize("seed", range(8))
def test_no_other_weights_have_less_error(seed):
    """Of means in any direction to each other, three of the eight opposed."""
    random = np.random.default_rng(seed)
    means, noises = random.normal(size=(2, 3)), random.uniform(0.1, 3, 2)
    case = means[0], means[1], noises[0], noises[1]
    assert_allclose(share(products(*case)), least_error(*case), atol=2e-5)


def test_without_bias_it_weighs_by_inverse_variance_and_a_wrong_direction_counts_for_nothing():
    up, along = jnp.array([0.0, 1.0]), jnp.array([2.0, 0.0])
    assert_allclose(share(products(along, along, 1.0, 3.0)), 3 / 4)
    assert share(products(up, along, 1e-6, 3.0)) == 0
    assert share(products(-along, along, 1e-6, 3.0)) == 0


def test_what_is_not_sure_counts_for_first_order():
    """A standard error of a running mean, the root of 0.02/1.98 of a deviation, hides a bias or an opposition."""
    up, along = jnp.array([0.0, 1.0]), jnp.array([2.0, 0.0])
    for biased, name in ((products(up, along, 0.1, 3.0), "zeroth"), (products(-along, along, 1e-6, 3.0), "across")):
        for deviation, hides in ((10.2, True), (9.7, False)):
            spread = (deviation * getattr(biased, name)) ** 2
            found = eqx.tree_at(lambda p, n=f"{name}_spread": getattr(p, n), biased, spread)
            assert (share(found) > 0) == hides


def test_halves_tell_the_products_of_means_without_their_noise():
    """Drawn 50 000 times, within four standard errors of what was put in; the noise is three times the means."""
    first, gradient = np.array([1.0, 0.5, 0.0]), np.array([0.5, 1.0, 0.2])
    keys = jax.random.split(jax.random.key(0), 50_000)

    def draw(key):
        noise = jax.random.normal(key, (4, 3)) * jnp.array([1.0, 1.0, 3.0, 3.0])[:, None]
        halves = [(mean + part) / 2 for mean, part in zip((first, first, gradient, gradient), noise, strict=True)]
        found = Products.none().with_more(tuple(halves[:2]), tuple(halves[2:]))
        total = sum((half**2).sum() for half in halves)
        return [x * total / 0.02 for x in jax.tree.leaves(found)[:5]]

    found = jax.jit(jax.vmap(draw))(keys)
    wanted = jax.tree.leaves(products(first, gradient, 3 / 2, 27 / 2))[:5]
    for values, value in zip(found, wanted, strict=True):
        assert abs(values.mean() - value) < 4 * values.std() / len(keys) ** 0.5


def test_an_update_counts_for_a_fiftieth_and_one_that_is_no_number_for_nothing():
    first, zeroth = (jnp.array([1.0, 0.0]), jnp.array([1.0, 0.0])), (jnp.array([1.0, 2.0]), jnp.array([1.0, -2.0]))
    once = Products.none().with_more(first, zeroth)
    one = np.array([4, 0, -12, 16, 4]) / 12
    numbers = [np.asarray(x) for x in jax.tree.leaves(once)]
    assert_allclose(numbers[:5], 0.02 * one)
    assert_allclose(numbers[5:7], 0.02 * np.array([1, 1 / 9]) / 2)
    assert_allclose(numbers[7], [-1, 1 / 3])
    twice = jax.tree.leaves(once.with_more(first, zeroth))
    assert_allclose(twice[:5], 1.98 * 0.02 * one)
    assert_allclose(twice[5:7], 0.98 * np.array(numbers[5:7]))  # nothing has changed
    for bad in itertools.product((jnp.nan, jnp.inf), (first, zeroth)):
        broken = (bad[1][0].at[0].set(bad[0]), bad[1][1])
        parts = (broken, zeroth) if bad[1] is first else (first, broken)
        for x, y in zip(jax.tree.leaves(once.with_more(*parts)), numbers, strict=True):
            assert_allclose(x, y)
