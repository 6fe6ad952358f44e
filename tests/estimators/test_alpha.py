"""The α-order estimate: what it mixes, where it trusts derivatives, and what it says about it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from mjxgrad import estimators
from mjxgrad.estimators import Diagnosis, Reason, rules
from mjxgrad.objective import parameter_noise
from tests.estimators import textbook
from tests.estimators.test_control_variate import assert_unbiased_with_right_errors
from tests.estimators.textbook import POINT, STDDEVS, repeat

alpha_order = eqx.filter_jit(estimators.alpha_order)
BUMPY = parameter_noise(textbook.bumpy, STDDEVS)


@pytest.fixture(scope="module")
def parts():
    """Both parts from the same 200 rollouts."""
    key = jax.random.key(11)
    first = textbook.first_order(BUMPY, POINT, key, num_samples=200)
    unbiased = eqx.filter_jit(estimators.control_variate)(BUMPY, POINT, key, num_samples=200)
    return key, first, unbiased


def test_the_ends_of_alpha_are_first_order_and_the_control_variate(parts):
    key, first, unbiased = parts
    for alpha, part in ((1.0, first), (0.0, unbiased)):
        estimate = alpha_order(BUMPY, POINT, key, num_samples=200, rule=rules.FixedAlpha(alpha))
        np.testing.assert_allclose(estimate.value, part.value, rtol=1e-9)
        np.testing.assert_allclose(estimate.standard_error, part.standard_error, rtol=1e-6)


def test_without_control_variate_the_unbiased_part_is_zeroth_order(parts):
    key, rule = parts[0], rules.FixedAlpha(0.0)
    # Up to 64 samples are one group, in which each leaves itself out, as in the zeroth-order estimate.
    estimate = alpha_order(BUMPY, POINT, key, num_samples=64, rule=rule, control_variate=False)
    zeroth = textbook.zeroth_order(BUMPY, POINT, key, num_samples=64)
    np.testing.assert_allclose(estimate.value, zeroth.value, rtol=1e-9)
    np.testing.assert_allclose(estimate.standard_error, zeroth.standard_error, rtol=1e-9)


@pytest.mark.slow
def test_the_error_bar_of_a_mixture_knows_that_its_parts_share_rollouts():
    rule = rules.FixedAlpha(0.5)
    estimates = repeat(estimators.alpha_order, BUMPY, POINT, 20_000, seed=2, num_samples=20, rule=rule)
    truth = textbook.bumpy_gradient(np.asarray(POINT), np.asarray(STDDEVS))
    assert_unbiased_with_right_errors(estimates, truth, num_samples=20)


def test_a_quadratic_is_always_left_to_first_order():
    """The trapezoidal rule is exact for it, whatever its curvature and however near its minimum."""
    matrix = jnp.array([[30.0, 1.0, 0.0], [1.0, 0.01, 0.2], [0.0, 0.2, -4.0]])
    objective = parameter_noise(lambda x: 1e4 + x @ matrix @ x, STDDEVS)
    estimates = repeat(estimators.alpha_order, objective, jnp.zeros(3), 500, seed=0, num_samples=10)
    assert not np.any(jax.tree.leaves(estimates.reason)[0] == jax.tree.leaves(Reason.inconsistent)[0])
    assert np.all(np.asarray(estimates.alpha) > 0)


def test_a_jump_between_samples_is_always_seen():
    """A step on a slope at ten samples: either all fall on one side, with chance 2/2^10 here, or the jump is seen."""
    objective = parameter_noise(lambda x: 3 * x[0] + jnp.where(x[0] >= 0, 1.0, 0.0), 0.1, dim=1)
    estimates = repeat(estimators.alpha_order, objective, jnp.zeros(1), 4000, seed=0, num_samples=10)
    assert (estimates.alpha > 0).mean() < 0.01


def test_the_bound_on_the_bias_holds_for_a_small_jump_in_many_dimensions(key):
    """A jump of 0.05 in one of 40 coordinates passes the test; its bias is 0.05 φ(0)/σ, its bound sd(J)/σ."""
    slope = jnp.linspace(1, 2, 40)
    objective = parameter_noise(lambda x: slope @ x + 0.05 * jnp.where(x[0] >= 0, 1.0, 0.0), 0.1, dim=40)
    rule = rules.Consistent(failure_probability=1e-9)
    estimate = alpha_order(objective, jnp.zeros(40), key, num_samples=200, rule=rule)
    assert estimate.alpha > 0.5
    bias = 0.05 * norm.pdf(0) / 0.1
    assert bias * estimate.alpha < estimate.bias_bound
    # The standard deviation of a jump that half of the samples take is half of it.
    np.testing.assert_allclose(estimate.bias_bound, estimate.alpha * 0.5 * 0.05 / 0.1, rtol=0.2)


def test_a_large_constant_changes_nothing_in_single_precision(key):
    def cost(x):
        return jnp.float32(0.3) * x[0] + x[0] ** 2

    point, stddev = jnp.array([0.1], jnp.float32), jnp.float32(0.1)
    plain = alpha_order(parameter_noise(cost, stddev), point, key, num_samples=64)
    lifted = alpha_order(parameter_noise(lambda x: cost(x) + 1000.0, stddev), point, key, num_samples=64)
    assert plain.value.dtype == jnp.float32
    assert Reason[lifted.reason] != Reason[Reason.inconsistent]
    np.testing.assert_allclose(lifted.value, plain.value, rtol=0.05)


def test_without_finite_derivatives_the_unbiased_part_stands_alone(key):
    objective = parameter_noise(lambda x: jnp.sqrt(jnp.maximum(x[0], 0)), 0.1, dim=1)
    # Everything is at -1 or below: costs are zero and derivatives NaN.
    estimate = alpha_order(objective, jnp.array([-1.0]), key, num_samples=20)
    assert Reason[estimate.reason] == Reason[Reason.not_finite]
    assert Diagnosis[estimate.diagnosis] == Diagnosis[Diagnosis.fine]
    assert estimate.value == 0
