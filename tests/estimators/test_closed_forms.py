"""Estimates against closed forms, where each is unbiased and where it is not."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad import estimators
from mjxgrad.objective import closed_loop, open_loop, parameter_noise
from tests.estimators import textbook
from tests.estimators.textbook import STDDEV, assert_within_error, first_order, zeroth_order

N = 100_000
EVERY_WAY = [(baseline, pairs) for baseline in ("leave_one_out", "zero_noise", "none") for pairs in (False, True)]


# On all of the problems below α-order must be as right as the unbiased ones, whichever part it chooses.
WITH_DERIVATIVES = [
    pytest.param(eqx.filter_jit(estimators.control_variate), id="control_variate"),
    pytest.param(eqx.filter_jit(estimators.alpha_order), id="alpha_order"),
]


@pytest.fixture
def key():
    return jax.random.key(7)


@pytest.mark.parametrize(
    "estimator",
    [
        *(functools.partial(zeroth_order, baseline=baseline, antithetic=pairs) for baseline, pairs in EVERY_WAY),
        *WITH_DERIVATIVES,
    ],
)
def test_a_step_is_seen_by_all_but_first_order(key, estimator):
    estimate = estimator(parameter_noise(textbook.step, STDDEV), jnp.array([0.07]), key, num_samples=N)
    assert_within_error(estimate, textbook.step_gradient(0.07))


def test_first_order_does_not_see_a_step(key):
    estimate = first_order(parameter_noise(textbook.step, STDDEV), jnp.array([0.07]), key, num_samples=N)
    assert estimate.value == 0
    assert estimate.variance == 0


def test_a_steep_ramp_has_the_variance_of_rare_large_slopes(key):
    """The derivative is 2/ν with probability p, else 0: a Bernoulli variable."""
    width, point = 0.03, 0.04
    p = textbook.ramp_probability(point, width)
    estimate = first_order(parameter_noise(textbook.ramp(width), STDDEV), jnp.array([point]), key, num_samples=N)
    assert_within_error(estimate, 2 * p / width)
    # Var of a Bernoulli's sample variance: p(1-p)(1-2p)²/N to leading order.
    error = (2 / width) ** 2 * np.sqrt(p * (1 - p) * (1 - 2 * p) ** 2 / N)
    assert abs(estimate.variance - (2 / width) ** 2 * p * (1 - p)) < 4 * error


@pytest.mark.parametrize("estimator", [zeroth_order, *WITH_DERIVATIVES])
def test_a_steep_ramp_is_no_trap_for_those_that_look_at_costs(key, estimator):
    width, point = 0.03, 0.04
    estimate = estimator(parameter_noise(textbook.ramp(width), STDDEV), jnp.array([point]), key, num_samples=N)
    assert_within_error(estimate, 2 * textbook.ramp_probability(point, width) / width)


@pytest.mark.parametrize("estimator", [first_order, zeroth_order, *WITH_DERIVATIVES])
def test_a_quadratic_with_a_sine_is_smoothed(key, estimator):
    estimate = estimator(parameter_noise(textbook.quadratic_sine, STDDEV), jnp.array([0.3]), key, num_samples=N)
    assert_within_error(estimate, textbook.quadratic_sine_gradient(0.3))


@pytest.mark.parametrize("estimator", [first_order, zeroth_order, *WITH_DERIVATIVES])
def test_the_throw_that_clears_the_wall_is_seen_by_all_but_first_order(key, estimator):
    """First order has the wrong sign: it converges to E f', without the jumps."""
    smooth, truth = textbook.ball_over_wall_gradients(0.8)
    assert smooth > 0 > truth
    estimate = estimator(parameter_noise(textbook.ball_over_wall, STDDEV), jnp.array([0.8]), key, num_samples=N)
    assert_within_error(estimate, smooth if estimator is first_order else truth)


@pytest.mark.parametrize("estimator", [first_order, zeroth_order, *WITH_DERIVATIVES])
def test_each_parameter_may_have_its_own_noise(key, estimator):
    point, stddev = np.array([0.5, -1.2, 0.4]), np.array([0.1, 0.4, 0.2])
    objective = parameter_noise(textbook.bumpy, jnp.asarray(stddev))
    estimate = estimator(objective, jnp.asarray(point), key, num_samples=N)
    assert_within_error(estimate, textbook.bumpy_gradient(point, stddev))


@pytest.mark.parametrize(
    "estimator", [first_order, zeroth_order, functools.partial(zeroth_order, antithetic=True), *WITH_DERIVATIVES]
)
def test_estimates_follow_a_policy_through_its_states(key, estimator):
    """A linear system under a linear policy: mean and covariance, so the expected cost, by recursion."""
    task = textbook.LinearSystem()
    policy_params = {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.25])}
    objective = closed_loop(task, textbook.linear_policy, 0.3, params=policy_params)
    exact = jax.grad(lambda p: task.expected_cost(objective.unravel(p), 0.3))(objective.ravel(policy_params))
    assert_within_error(estimator(objective, objective.ravel(policy_params), key, num_samples=N), exact)


@pytest.mark.parametrize("estimator", [first_order, zeroth_order, *WITH_DERIVATIVES])
def test_open_loop_controls_have_the_gradient_of_a_quadratic(key, estimator):
    """The cost is quadratic in the controls, so noise adds a constant: the gradient is that without noise."""
    task = textbook.LinearSystem()
    controls = jnp.array([[0.4], [-0.7], [0.2], [0.9]])
    objective = open_loop(task, jnp.array([0.3]))
    exact = jax.grad(lambda u: task.run(u).cost)(controls)
    estimate = estimator(objective, objective.ravel(controls), key, num_samples=N)
    np.testing.assert_array_equal(objective.unravel(objective.ravel(controls)), controls)
    assert_within_error(estimate, exact.ravel())
