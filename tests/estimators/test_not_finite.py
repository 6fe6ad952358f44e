"""Samples that are not finite are left out, counted and named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.estimators import Diagnosis
from mjxgrad.objective import parameter_noise
from tests.estimators.textbook import first_and_zeroth_order, first_order, zeroth_order

POINT = jnp.array([0.05])


def noises(objective, key, num_samples):
    return np.array([objective.sample_noise(jax.random.fold_in(key, i))[0] for i in range(num_samples)])


def test_samples_that_are_not_finite_are_left_out_and_counted(key):
    objective = parameter_noise(lambda x: jnp.where(x[0] > 0.1, jnp.nan, x[0] ** 2), 0.1, dim=1)
    x = 0.05 + noises(objective, key, 60)
    kept = x[x <= 0.1]
    assert 0 < len(kept) < 60
    for estimate in (
        first_order(objective, POINT, key, num_samples=60, chunk_size=9),
        *first_and_zeroth_order(objective, POINT, key, num_samples=60),
    ):
        assert estimate.num_finite == len(kept)
        assert estimate.finite_fraction == pytest.approx(len(kept) / 60)
        assert Diagnosis[estimate.diagnosis] == Diagnosis[Diagnosis.some_not_finite]
        np.testing.assert_allclose(estimate.objective_mean, (kept**2).mean(), rtol=1e-9)
    first = first_order(objective, POINT, key, num_samples=60)
    np.testing.assert_allclose(first.value[0], (2 * kept).mean(), rtol=1e-9)
    np.testing.assert_allclose(first.variance, (2 * kept).var(ddof=1), rtol=1e-9)
    zeroth = zeroth_order(objective, POINT, key, num_samples=60)
    # The leave-one-out estimate is the sample covariance of cost and score.
    np.testing.assert_allclose(zeroth.value[0], np.cov(kept**2, (kept - 0.05) / 0.01)[0, 1], rtol=1e-9)


def test_a_pair_is_left_out_whole(key):
    objective = parameter_noise(lambda x: jnp.where(x[0] > 0.1, jnp.inf, x[0] ** 2), 0.1, dim=1)
    w = noises(objective, key, 30)
    is_kept = np.abs(w) <= 0.05
    estimate = zeroth_order(objective, POINT, key, num_samples=60, antithetic=True)
    assert 0 < is_kept.sum() < 30
    assert estimate.num_finite == 2 * is_kept.sum()
    # Half the difference of the costs times the score, from pairs with both costs finite.
    pairs = ((0.05 + w) ** 2 - (0.05 - w) ** 2) / 2 * w / 0.01
    np.testing.assert_allclose(estimate.value[0], pairs[is_kept].mean(), rtol=1e-9)


def test_a_derivative_that_is_not_finite_spoils_only_first_order(key):
    """The root of max(x, 0) has no finite derivative below zero."""
    objective = parameter_noise(lambda x: jnp.sqrt(jnp.maximum(x[0], 0)), 0.1, dim=1)
    num_positive = (0.05 + noises(objective, key, 50) > 0).sum()
    first, zeroth = first_and_zeroth_order(objective, POINT, key, num_samples=50)
    assert first.num_finite == num_positive < 50
    assert zeroth.num_finite == 50
    assert zeroth.diagnosis == Diagnosis.fine


@pytest.mark.parametrize("estimator", [first_order, zeroth_order, first_and_zeroth_order])
def test_without_finite_samples_there_is_no_estimate(key, estimator):
    objective = parameter_noise(lambda x: jnp.where(x[0] > -5, jnp.nan, x[0]), 0.1)
    estimates = estimator(objective, POINT, key, num_samples=10)
    for estimate in estimates if isinstance(estimates, tuple) else [estimates]:
        assert np.isnan(estimate.value).all()
        assert np.isnan(estimate.variance)
        assert np.isnan(estimate.objective_mean)
        assert estimate.num_finite == 0
        assert estimate.diagnosis == Diagnosis.too_few_finite


def test_one_finite_sample_is_no_estimate(key):
    objective = parameter_noise(lambda x: x[0], 0.1, dim=1)
    largest, second = np.sort(0.05 + noises(objective, key, 10))[[-1, -2]]
    bound = (largest + second) / 2
    one_left = parameter_noise(lambda x: jnp.where(x[0] > bound, x[0], jnp.nan), 0.1)
    estimate = zeroth_order(one_left, POINT, key, num_samples=10)
    assert estimate.num_finite == 1
    assert np.isnan(estimate.value).all()
    assert estimate.diagnosis == Diagnosis.too_few_finite


def test_a_baseline_that_is_not_finite_is_named(key):
    objective = parameter_noise(lambda x: jnp.where(x[0] == 0.05, jnp.nan, x[0]), 0.1)
    estimate = zeroth_order(objective, POINT, key, num_samples=10, baseline="zero_noise")
    assert np.isnan(estimate.value).all()
    assert estimate.num_finite == 10
    assert estimate.diagnosis == Diagnosis.baseline_not_finite
