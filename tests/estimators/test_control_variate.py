"""The control-variate estimate: unbiased whatever derivatives say, and exact where they say all."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from mjxgrad import estimators
from mjxgrad.estimators import Diagnosis, rules
from mjxgrad.objective import closed_loop, parameter_noise
from tests.estimators import textbook
from tests.estimators.textbook import POINT, POLICY_PARAMS, STDDEVS, repeat
from tests.objective.test_objective import Laplace

control_variate = eqx.filter_jit(estimators.control_variate)


def jumpy(x):
    """Jumps by 0.3 in the second coordinate, smooth and curved in the others."""
    return textbook.bumpy(x) + jnp.where(x[1] > 0.15, 0.3, 0.0)


def jumpy_gradient():
    jump = 0.3 * norm.pdf((0.15 - POINT[1]) / STDDEVS[1]) / STDDEVS[1]
    return textbook.bumpy_gradient(np.asarray(POINT), np.asarray(STDDEVS)) + np.array([0, jump, 0])


def assert_unbiased_with_right_errors(estimates, truth, num_samples):
    values, times = np.asarray(estimates.value), len(estimates.value)
    spread = values.std(axis=0)
    np.testing.assert_array_less(np.abs(values.mean(axis=0) - truth), 4 * spread / np.sqrt(times))
    # Terms depend on each other through the mean derivative they share, by a share of 1/n² of their squares; that is not
    # counted. 0.05 is three errors of the ratio itself.
    ratio = (np.asarray(estimates.standard_error) ** 2).mean(axis=0) / spread**2
    np.testing.assert_allclose(ratio, 1, atol=0.05 + 2 / num_samples**2)


@pytest.mark.parametrize("num_samples", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_it_is_unbiased_at_a_jump_from_few_samples_on(num_samples):
    objective = parameter_noise(jumpy, STDDEVS)
    estimates = repeat(estimators.control_variate, objective, POINT, 40_000, seed=3, num_samples=num_samples)
    assert_unbiased_with_right_errors(estimates, jumpy_gradient(), num_samples)


class TwoStarts(textbook.LinearSystem):
    """The same system from either of two starts, so that its expected cost is the mean of two."""

    def sample_start(self, key):
        return self.start + jnp.array([0.5, -0.3]) * jax.random.rademacher(key, (), float)

    def expected_cost(self, policy_params, stddev):
        starts = [self.start + sign * jnp.array([0.5, -0.3]) for sign in (-1, 1)]
        costs = [textbook.LinearSystem(start=start).expected_cost(policy_params, stddev) for start in starts]
        return sum(costs) / 2


@pytest.mark.parametrize(
    ("estimator", "num_rollouts"),
    [
        (estimators.control_variate, 8),
        (functools.partial(estimators.zeroth_order, baseline="zero_noise"), 16),
        (functools.partial(estimators.zeroth_order, baseline="zero_noise", antithetic=True), 12),
    ],
    ids=["control variate", "zero noise", "zero noise, pairs"],
)
def test_it_is_unbiased_in_closed_loop_from_random_starts_and_so_are_baselines_from_the_same_start(
    estimator, num_rollouts
):
    task = TwoStarts()
    objective = closed_loop(task, textbook.linear_policy, 0.2, params=POLICY_PARAMS)
    flat = objective.ravel(POLICY_PARAMS)
    estimates = repeat(estimator, objective, flat, 20_000, seed=3, num_samples=8)
    truth = jax.jit(jax.grad(lambda at: task.expected_cost(objective.unravel(at), 0.2)))(flat)
    assert_unbiased_with_right_errors(estimates, np.asarray(truth), 8)
    assert np.all(np.asarray(estimates.num_rollouts) == num_rollouts)


@pytest.mark.slow
def test_baselines_from_the_same_start_take_away_what_starts_do():
    """Starts a hundred times as far apart as the noise: the mean of other starts would be no baseline at all."""

    class FarStarts(textbook.LinearSystem):
        def sample_start(self, key):
            return self.start + 10 * jax.random.normal(key, (2,))

    objective = closed_loop(FarStarts(), textbook.linear_policy, 0.1, params=POLICY_PARAMS)
    flat = objective.ravel(POLICY_PARAMS)
    paired = functools.partial(estimators.alpha_order, rule=rules.FixedAlpha(0.0), control_variate=False)
    from_same_start = functools.partial(estimators.zeroth_order, baseline="zero_noise")
    partner, silence, others = (
        np.asarray(repeat(estimator, objective, flat, 500, seed=3, num_samples=20).value).std(axis=0)
        for estimator in (paired, from_same_start, estimators.zeroth_order)
    )
    np.testing.assert_array_less(partner, 0.3 * others)
    np.testing.assert_array_less(silence, 0.3 * others)


def test_the_linear_part_of_a_cost_makes_no_noise(key):
    slope = jnp.array([1.0, -2.0, 0.5])
    estimate = control_variate(parameter_noise(lambda x: 7 + slope @ x, STDDEVS), POINT, key, num_samples=8)
    np.testing.assert_allclose(estimate.value, slope, rtol=1e-12)
    np.testing.assert_array_less(estimate.standard_error, 1e-12)


def test_derivatives_that_explain_nothing_leave_zeroth_order(key):
    """The derivative of a step is zero: what remains is the leave-one-out estimate from the same noise."""
    objective, point = parameter_noise(textbook.step, 0.1, dim=1), jnp.array([0.05])
    estimate = control_variate(objective, point, key, num_samples=50)
    zeroth = textbook.zeroth_order(objective, point, key, num_samples=50)
    np.testing.assert_allclose(estimate.value, zeroth.value, rtol=1e-12)
    np.testing.assert_allclose(estimate.standard_error, zeroth.standard_error, rtol=1e-12)


def test_derivatives_that_lie_do_no_harm(key):
    """A tenth of a million times the true slope: beta must go to zero, or the estimate would be worthless."""

    @jax.custom_jvp
    def lies(x):
        return x @ jnp.array([1.0, -2.0, 0.5])

    lies.defjvp(lambda point, tangent: (lies(*point), 1e5 * (jnp.ones(3) @ tangent[0])))
    objective = parameter_noise(lies, STDDEVS)
    estimate = control_variate(objective, POINT, key, num_samples=200)
    zeroth = textbook.zeroth_order(objective, POINT, key, num_samples=200)
    np.testing.assert_array_less(estimate.standard_error, 1.1 * np.asarray(zeroth.standard_error))


@pytest.mark.slow
def test_chunks_are_averaged_and_a_short_last_one_counts_by_its_samples(key):
    objective = parameter_noise(jumpy, STDDEVS)
    estimate = control_variate(objective, POINT, key, num_samples=20_001, chunk_size=100)
    assert estimate.num_finite == 20_001
    error = np.abs(np.asarray(estimate.value) - jumpy_gradient())
    np.testing.assert_array_less(error, 4 * np.asarray(estimate.standard_error))
    whole = control_variate(objective, POINT, key, num_samples=20_001, chunk_size=300)
    np.testing.assert_allclose(estimate.standard_error, whole.standard_error, rtol=0.1)


def test_costs_that_are_not_finite_are_left_out_and_one_that_is_left_is_no_estimate(key):
    objective = parameter_noise(lambda x: jnp.where(x[0] > 0.3, jnp.nan, x[0] ** 2), 0.1, dim=1)
    estimate = control_variate(objective, POINT[:1], key, num_samples=100)
    assert 30 < estimate.num_finite < 70
    assert Diagnosis[estimate.diagnosis] == Diagnosis[Diagnosis.some_not_finite]
    assert np.isfinite(estimate.value)
    hopeless = parameter_noise(lambda x: jnp.where(x[0] > -9.0, jnp.nan, x[0] ** 2), 0.1, dim=1)
    estimate = control_variate(hopeless, POINT[:1], key, num_samples=100)
    assert np.isnan(estimate.value)
    assert Diagnosis[estimate.diagnosis] == Diagnosis[Diagnosis.too_few_finite]


def test_an_objective_that_does_not_know_its_noise_is_refused(key):
    with pytest.raises(ValueError, match="objective must know its noise, got Laplace"):
        estimators.control_variate(Laplace(), POINT, key, num_samples=10)
