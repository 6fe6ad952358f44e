"""The linear fit to samples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from mjxgrad import estimators
from mjxgrad.objective import closed_loop, open_loop, parameter_noise
from tests.estimators import textbook

least_squares = eqx.filter_jit(estimators.least_squares)
STDDEVS = jnp.array([0.1, 0.2, 0.3])
POINT = jnp.array([0.3, 0.1, -0.5])


def test_a_linear_cost_is_found_exactly(key):
    slope = jnp.array([1.0, -2.0, 0.5])
    estimate = least_squares(parameter_noise(lambda x: 7 + slope @ x, STDDEVS), POINT, key, num_samples=6)
    np.testing.assert_allclose(estimate.value, slope, rtol=1e-10)
    np.testing.assert_array_less(estimate.standard_error, 1e-10)
    assert estimate.num_gradient_rollouts == 0


def test_it_is_numpys_fit_to_the_same_samples_chunks_and_missing_ones_included(key):
    def cost(x):
        return jnp.where(x[2] > -0.3, jnp.nan, textbook.bumpy(x))

    objective = parameter_noise(cost, STDDEVS)
    estimate = least_squares(objective, POINT, key, num_samples=50, chunk_size=7)
    noise = np.array([objective.sample_noise(jax.random.fold_in(key, i)) for i in range(50)])
    costs = np.array([cost(POINT + w) for w in noise])
    kept = np.isfinite(costs)
    assert estimate.num_finite == kept.sum() < 50
    design = np.column_stack([np.ones(kept.sum()), noise[kept]])
    fit, *_ = np.linalg.lstsq(design, costs[kept])
    np.testing.assert_allclose(estimate.value, fit[1:], rtol=1e-9)


def test_it_finds_the_slope_of_a_smoothed_step_and_its_error(key):
    objective, point, times = parameter_noise(textbook.step, 0.1, dim=1), jnp.array([0.05]), 4000
    run = jax.jit(jax.vmap(lambda k: estimators.least_squares(objective, point, k, num_samples=200)))
    estimates = run(jax.random.split(key, times))
    values = np.asarray(estimates.value)[:, 0]
    # The fit's own bias falls as 1/N: 0.5 % at 200 samples is generous.
    np.testing.assert_allclose(values.mean(), norm.pdf(0.05, scale=0.1), rtol=0.005)
    ratio = (np.asarray(estimates.standard_error) ** 2).mean() / values.var()
    assert 0.95 < ratio < 1.15  # HC3 is on the safe side


def test_too_few_samples_and_noise_that_is_not_on_the_parameters_are_refused(key):
    with pytest.raises(ValueError, match=r"num_samples must be more than dim \+ 1 = 4, got 4"):
        estimators.least_squares(parameter_noise(textbook.bumpy, STDDEVS), POINT, key, num_samples=4)
    params = {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.1])}
    objective = closed_loop(textbook.LinearSystem(), textbook.linear_policy, 0.2, params=params)
    with pytest.raises(ValueError, match="noise on the parameters"):
        estimators.least_squares(objective, objective.ravel(params), key, num_samples=40)


def test_open_loop_noise_is_noise_on_the_parameters(key):
    task = textbook.LinearSystem()
    estimate = least_squares(open_loop(task, 0.1), jnp.full(4, 0.2), key, num_samples=4000)
    truth = jax.grad(lambda u: task.run(u[:, None]).cost)(jnp.full(4, 0.2))
    np.testing.assert_array_less(np.abs(estimate.value - truth), 4 * np.asarray(estimate.standard_error))
