"""Networks and the moments of what they see; jitted, for each operation alone would be a program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from mjxgrad.learning.networks import Network, Normaliser, ValueFunction


def test_moments_are_those_of_all_batches_together(key):
    batches = [
        3.0 + 2 * jax.random.normal(k, (n, 4)) for k, n in zip(jax.random.split(key, 3), (5, 17, 40), strict=True)
    ]
    normaliser = Normaliser.make(4)
    for batch in batches:
        normaliser = jax.jit(Normaliser.with_more)(normaliser, batch)
    everything = np.concatenate(batches)
    mean, spread = everything.mean(axis=0), everything.std(axis=0)
    assert_allclose(normaliser.mean, mean, rtol=1e-12)
    assert_allclose(normaliser(jnp.asarray(everything[0])), (everything[0] - mean) / spread, rtol=1e-9)


def test_observations_that_are_no_numbers_are_left_out():
    rows = jnp.array([[1.0, 2.0], [jnp.nan, 0.0], [3.0, 6.0]])
    assert_allclose(Normaliser.make(2).with_more(rows).mean, [2.0, 4.0])


def test_a_number_that_never_changes_stays_finite():
    normaliser = Normaliser.make(1).with_more(jnp.full((10, 1), 7.0))
    assert_allclose(normaliser(jnp.array([8.0])), [1.0])


def test_before_it_has_seen_anything_it_changes_nothing():
    assert_allclose(Normaliser.make(2)(jnp.array([3.0, -1.0])), [3.0, -1.0])


def test_a_network_is_its_formula(key):
    """One hidden layer: W₂ n(elu(W₁ x + b₁)) + b₂, n of mean zero and variance one."""
    network = eqx.filter_jit(Network.make)([3, 5, 2], key)
    x = np.array([0.3, -1.0, 2.0])
    first, last = network.layers
    hidden = np.asarray(first.weight) @ x + np.asarray(first.bias)
    hidden = np.where(hidden > 0, hidden, np.expm1(hidden))
    hidden = (hidden - hidden.mean()) / np.sqrt(hidden.var() + 1e-5)  # equinox's default for what keeps it from zero
    assert_allclose(
        eqx.filter_jit(network)(jnp.asarray(x)), np.asarray(last.weight) @ hidden + np.asarray(last.bias), rtol=1e-12
    )


def test_only_hidden_layers_are_scaled(key):
    plain, scaled = (eqx.filter_jit(Network.make)((4, 8, 8, 2), key, hidden_scale=scale) for scale in (1.0, 0.01))
    for layer, other in zip(plain.layers[:-1], scaled.layers[:-1], strict=True):
        assert_allclose(other.weight, 0.01 * layer.weight)
        assert_allclose(other.bias, 0.01 * layer.bias)
    assert_allclose(scaled.layers[-1].weight, plain.layers[-1].weight)


def test_a_value_function_keeps_its_values_when_its_units_change(key):
    obs, (before, after) = jax.random.normal(key, (50, 3)), 400 + 90 * jax.random.normal(key, (2, 50))

    @eqx.filter_jit
    def valued():
        value = ValueFunction.make((3, 8, 1), key).with_more(before)
        changed = value.with_more(3 * after)
        return value, changed, jax.vmap(value)(obs), jax.vmap(changed)(obs)

    value, changed, values, same = valued()
    assert_allclose(same, values, rtol=1e-10)
    assert changed.moments.scale[0] > 3 * value.moments.scale[0]


def test_rewards_of_any_size_are_fitted_alike(key):
    """The loss has the same gradient for returns a thousand times as large, but for the first values, 1e-4 of the small ones."""
    obs, returns = jax.random.normal(key, (50, 3)), 400 + 90 * jax.random.normal(key, (50,))

    @jax.jit
    def slope(size):
        value = ValueFunction.make((3, 8, 1), key).with_more(size * returns)
        loss = jax.grad(lambda network: ValueFunction(network, value.moments).loss(obs, size * returns))
        return loss(value.network).layers[1].weight

    assert_allclose(slope(1.0), slope(1000.0), rtol=1e-3)
