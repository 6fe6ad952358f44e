"""Searches that experiments compare with, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.optimisation.searches import mppi, predictive_sampling
from tests.test_baselines import START, bowl, objective

METHODS = {"mppi": mppi, "predictive_sampling": predictive_sampling}


@pytest.fixture(params=METHODS)
def method(request):
    return functools.partial(METHODS[request.param], num_samples=40)


def test_every_method_ends_at_the_minimum(method, key):
    result = method(objective, START, jax.random.split(key, 2), num_steps=60, evaluate=bowl, evaluate_every=1)
    assert np.all(result.best_cost < 0.02)
    assert np.all(result.final_cost < 0.1)


def test_candidates_that_are_not_finite_are_never_followed(method, key):
    """Half of the plane is NaN and would be the better half."""
    cost = mg.parameter_noise(lambda x: jnp.where(x[0] > 0.5, jnp.nan, bowl(x)), 0.3, dim=2)
    result = method(cost, START, key, num_steps=30)
    assert result.params[0] <= 0.5
    assert np.abs(result.params[1] + 2) < 0.3


def test_predictive_sampling_never_goes_up(key):
    result = predictive_sampling(objective, START, key, num_samples=40, num_steps=60, evaluate=bowl, evaluate_every=1)
    assert np.all(np.diff(np.append(result.history.noise_free_cost, result.final_cost)) <= 0)


def test_mppi_is_the_mean_of_a_tilted_gaussian(key):
    """exp(-x²/2λ) times N(μ, σ²) is Gaussian about μ / (1 + σ²/λ); x²/2 has the variance σ⁴/2 + μ²σ²."""
    stddev, temperature, start = 0.5, 0.4, 0.8
    unit = np.sqrt(stddev**4 / 2 + start**2 * stddev**2)
    result = mppi(
        mg.parameter_noise(lambda x: 0.5 * x[0] ** 2, 1.0),
        jnp.array([start]),
        key,
        num_samples=50_000,
        num_steps=1,
        temperature=temperature,
        stddev=stddev,
    )
    expected = start / (1 + stddev**2 / (temperature * unit))
    np.testing.assert_allclose(result.params[0], expected, atol=4 * stddev / np.sqrt(10_000))


def test_the_temperature_does_not_know_the_unit_of_the_cost(key):
    scaled = mg.parameter_noise(lambda x: 1e4 * bowl(x) - 7e3, 0.3, dim=2)
    runs = [mppi(cost, START, key, num_samples=40, num_steps=5).params for cost in (objective, scaled)]
    np.testing.assert_allclose(*runs, rtol=1e-9)


def test_a_temperature_without_meaning_is_refused(key):
    with pytest.raises(ValueError, match="temperature must be positive"):
        mppi(objective, START, key, num_samples=40, num_steps=1, temperature=0.0)
