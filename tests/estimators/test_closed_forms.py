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
from tests.estimators.textbook import CONTROLS, POLICY_PARAMS, STDDEV, assert_within_error, first_order, zeroth_order

N = 40_000
# On all of the problems below α-order must be as right as the unbiased ones, whichever part it chooses.
ESTIMATORS = {
    "first_order": first_order,
    "zeroth_order": zeroth_order,
    "pairs": functools.partial(zeroth_order, antithetic=True),
    "control_variate": eqx.filter_jit(estimators.control_variate),
    "alpha_order": eqx.filter_jit(estimators.alpha_order),
}
RAMP = textbook.ramp(0.03)
SINGLE = (RAMP, textbook.quadratic_sine, textbook.step)


class OneOf(eqx.Module):
    """A function of one number, chosen when it is called: each estimator is compiled once for all of them."""

    index: jax.Array

    def __call__(self, x):
        return jax.lax.switch(self.index, SINGLE, x)


def noisy(function):
    return parameter_noise(OneOf(jnp.array(SINGLE.index(function))), STDDEV)


def a_ramp():
    """A steep one: its derivative is 2/ν with probability p, else 0."""
    return noisy(RAMP), [0.04], 2 * textbook.ramp_probability(0.04, 0.03) / 0.03


def a_quadratic_with_a_sine():
    return noisy(textbook.quadratic_sine), [0.3], textbook.quadratic_sine_gradient(0.3)


def noise_of_each_parameter():
    point, stddev = np.array([0.5, -1.2, 0.4]), np.array([0.1, 0.4, 0.2])
    return parameter_noise(textbook.bumpy, jnp.asarray(stddev)), point, textbook.bumpy_gradient(point, stddev)


@functools.cache
def a_policy():
    """A linear system under a linear policy: mean and covariance, so the expected cost, by recursion."""
    task = textbook.LinearSystem()
    objective = closed_loop(task, textbook.linear_policy, 0.3, params=POLICY_PARAMS)
    at = objective.ravel(POLICY_PARAMS)
    return objective, at, jax.jit(jax.grad(lambda p: task.expected_cost(objective.unravel(p), 0.3)))(at)


@functools.cache
def controls():
    """The cost is quadratic in the controls, so noise adds a constant: the gradient is that without noise."""
    task, objective = textbook.LinearSystem(), open_loop(textbook.LinearSystem(), jnp.array([0.3]))
    np.testing.assert_array_equal(objective.unravel(objective.ravel(CONTROLS)), CONTROLS)
    return objective, objective.ravel(CONTROLS), jax.jit(jax.grad(lambda u: task.run(u).cost))(CONTROLS).ravel()


PROBLEMS = [a_ramp, a_quadratic_with_a_sine, noise_of_each_parameter, a_policy, controls]
# Of the control variate itself `test_control_variate` has the others.
SOME = {"pairs": (a_policy,), "control_variate": (a_ramp, a_quadratic_with_a_sine)}
CASES = [(name, problem) for name in ESTIMATORS for problem in SOME.get(name, PROBLEMS)]


@pytest.mark.parametrize(("name", "problem"), CASES)
def test_what_does_not_jump_is_known_to_all(key, name, problem):
    objective, point, truth = problem()
    assert_within_error(ESTIMATORS[name](objective, jnp.asarray(point), key, num_samples=N), truth)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_step_is_seen_by_all_but_first_order(key, name):
    estimate = ESTIMATORS[name](noisy(textbook.step), jnp.array([0.07]), key, num_samples=N)
    if name == "first_order":
        assert estimate.value == estimate.variance == 0
    else:
        assert_within_error(estimate, textbook.step_gradient(0.07))
