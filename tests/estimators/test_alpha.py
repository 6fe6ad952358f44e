"""The α-order estimate: what it mixes, where it trusts derivatives, and what it says about it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.stats import norm

from mjxgrad import estimators
from mjxgrad.estimators import Diagnosis, Reason, rules
from mjxgrad.objective import parameter_noise
from mjxgrad.objective.base import Differentiated, ParameterNoise
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


def error_of(estimates, truth):
    """Mean squared error, and its standard error."""
    squares = ((np.asarray(estimates.value) - truth) ** 2).sum(axis=-1)
    return squares.mean(), squares.std() / np.sqrt(len(squares))


MATRIX = jnp.array([[30.0, 1.0, 0.0], [1.0, 0.01, 0.2], [0.0, 0.2, -4.0]])


def scattered(x):
    """Teeth of slope -1, twenty to a standard deviation, in 30 coordinates: the derivative knows the trend, but for 2 %."""
    return (2 * x + 0.002 * jnp.sin(x / 0.001)).sum()


def half_step(x):
    return x[0] + jnp.where(x >= 0, 0.2, 0.0).sum()


STEP = 1 / (np.sqrt(2 * np.pi) * 0.1)  # slope of a smoothed step of height 1 at its edge


@pytest.mark.parametrize(
    ("function", "dim", "truth", "num_samples", "most"),
    [
        # Derivatives are right: no more than the noise of α is lost.
        pytest.param(lambda x: 1e4 + x @ MATRIX @ x, 3, 0.0, 10, 1.1, id="quadratic"),
        pytest.param(lambda x: ((x - 1) ** 2).sum(), 100, -2.0, 16, 1.02, id="quadratic, many dimensions"),
        # Their scatter is noise, not bias: V¹ = 2 per coordinate, V⁰ far more.
        pytest.param(scattered, 30, 2.0, 16, 1.1, id="scatter"),
        # They miss a jump, in one coordinate and in many, where the jump is large and where it is hidden in noise.
        pytest.param(lambda x: 3 * x[0] + 2 * jnp.where(x[0] >= 0, 1.0, 0.0), 1, 3 + 2 * STEP, 16, 1.15, id="jump"),
        pytest.param(lambda x: jnp.where(x >= 0, 1.0, 0.0).sum(), 40, STEP, 16, 1.0, id="jumps"),
        pytest.param(lambda x: jnp.where(x >= 0, 1.0, 0.0).sum(), 40, STEP, 64, 0.8, id="jumps, more samples"),
        pytest.param(lambda x: jnp.where(x[0] >= 0.2, 1.0, 0.0), 1, STEP * np.exp(-2), 16, 1.4, id="rare jump"),
        pytest.param(lambda x: jnp.where(x[0] >= 0.1, 1.0, 0.0), 1, STEP * np.exp(-0.5), 16, 1.5, id="hidden jump"),
    ],
)
def test_alpha_order_is_as_good_as_the_better_part(function, dim, truth, num_samples, most):
    """At each by mean squared error over batches, in units of the better of first and zeroth order."""
    objective = parameter_noise(function, 0.1, dim=dim)
    # Errors of many coordinates add up to nearly the same in every batch.
    count = 1000 if dim < 30 else 250
    first, zeroth, mixed = (
        error_of(repeat(f, objective, jnp.zeros(dim), count, seed=0, num_samples=num_samples), truth)
        for f in (estimators.first_order, estimators.zeroth_order, estimators.alpha_order)
    )
    best = min(first, zeroth)
    assert mixed[0] < most * best[0] + 3 * mixed[1]


def test_a_memory_shows_a_bias_that_no_batch_shows(key):
    """A jump of 0.2 in one of 40 coordinates, whose bias of 0.8 is lost in the noise of 16 samples, and is a seventh of it."""
    objective = parameter_noise(lambda x: x.sum() + 0.2 * jnp.where(x[0] >= 0, 1.0, 0.0), 0.1, dim=40)
    once = eqx.filter_jit(functools.partial(estimators.alpha_order, objective, jnp.zeros(40), num_samples=16))
    memory, alphas = None, []
    for k in jax.random.split(key, 60):
        estimate = once(k, memory=memory)
        memory = estimate.memory
        alphas.append(float(estimate.alpha))
    assert np.mean(alphas[:3]) > 0.8
    assert np.mean(alphas[-20:]) < 0.35
    off = memory.difference - jnp.zeros(40).at[0].set(0.2 * STEP)
    # The squared error of the mean of 40 coordinates has a relative spread of sqrt(2/40).
    assert abs((off**2).sum() / memory.noise - 1) < 1.0


def test_a_memory_is_the_weighted_mean_of_its_estimates(key):
    objective = BUMPY.sized_for(POINT)
    found = [alpha_order(objective, POINT, k, num_samples=20).memory for k in jax.random.split(key, 5)]
    memory = found[0]
    for one in found[1:]:
        memory = memory.with_more(one)
    weights = 0.98 ** np.arange(4, -1, -1.0) / (0.98 ** np.arange(5)).sum()
    for name, power in (
        ("difference", 1),
        ("bound", 1),
        ("jump_bound", 1),
        ("zeroth_width", 1),
        ("noise", 2),
        ("noise_square", 2),
    ):
        expected = sum(w**power * np.asarray(getattr(one, name)) for w, one in zip(weights, found, strict=True))
        np.testing.assert_allclose(getattr(memory, name), expected, rtol=1e-9, err_msg=name)
    np.testing.assert_allclose(1 / memory.concentration, 1 / (weights**2).sum(), rtol=1e-9)


def test_the_noise_of_a_squared_bias_is_its_spread():
    """Rows of unequal variances; without a bias the variance of the mean product of two is 2 tr Σ²/n(n - 1)."""
    slopes = jnp.linspace(1, 0.2, 8)
    objective = parameter_noise(lambda x: (slopes * x**2).sum() / 2, 0.1, dim=8)
    facts = repeat(estimators.alpha_order, objective, jnp.zeros(8), 4000, seed=0, num_samples=12).memory
    squared_bias = (np.asarray(facts.difference) ** 2).sum(axis=1) - facts.noise
    standard_error = squared_bias.std() / np.sqrt(4000)
    assert abs(squared_bias.mean()) < 4 * standard_error
    np.testing.assert_allclose(np.sqrt(2 * (np.asarray(facts.noise_square) ** 2).mean()), squared_bias.std(), rtol=0.25)


def test_an_estimate_that_is_not_finite_leaves_the_memory_as_it_is(key):
    good = alpha_order(BUMPY, POINT, key, num_samples=20).memory
    broken = parameter_noise(lambda x: textbook.bumpy(x) * jnp.nan, STDDEVS)
    after = alpha_order(broken, POINT, key, num_samples=20, memory=good).memory
    assert all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(good), jax.tree.leaves(after), strict=True))


def test_the_bound_on_the_bias_holds_for_a_small_jump_in_many_dimensions(key):
    """A jump of 0.05 in one of 40 coordinates; its bias is 0.05 φ(0)/σ, its bound sd(J)/σ."""
    slope = jnp.linspace(1, 2, 40)
    objective = parameter_noise(lambda x: slope @ x + 0.05 * jnp.where(x[0] >= 0, 1.0, 0.0), 0.1, dim=40)
    estimate = alpha_order(objective, jnp.zeros(40), key, num_samples=200)
    assert estimate.alpha > 0.1
    bias = 0.05 * norm.pdf(0) / 0.1
    assert bias * estimate.alpha < estimate.bias_bound
    # The standard deviation of a jump that half of the samples take is half of it.
    np.testing.assert_allclose(estimate.bias_bound, estimate.alpha * 0.5 * 0.05 / 0.1, rtol=0.2)


def test_scatter_explains_what_derivatives_miss_of_teeth_and_nothing_of_a_jump(key):
    """Both bound the bias alike; by the right derivatives of teeth, and of a quartic, nothing speaks for a jump."""
    jump = lambda x: x[0] + 0.04 * jnp.where(x[0] >= 0, 1.0, 0.0)  # noqa: E731
    for function, share in ((scattered, 0), (lambda x: (x**4).sum(), 0), (jump, 1)):
        objective = parameter_noise(function, 0.1, dim=30)
        known = alpha_order(objective, jnp.zeros(30), key, num_samples=64).memory
        assert known.bound > 0
        np.testing.assert_allclose(known.jump_bound, share * known.bound, rtol=1e-6)


class Shifted(ParameterNoise):
    """Noise on forty numbers, which the only parameter shifts alike."""

    def sample_noise(self, key):
        return self.stddev * jax.random.normal(key, (40,))

    def differentiate(self, params, noise):
        cost, slopes = jax.value_and_grad(self.function)(params[0] + noise)
        score, stddev = noise / self.stddev**2, jnp.broadcast_to(self.stddev, (40,))
        return Differentiated(cost, slopes, score, stddev, Partial(lambda x: x.sum()[None]))


def test_of_one_number_first_order_counts_where_scatter_alone_is_unexplained(key):
    """Derivatives by the noise scatter, and not along the shift: that of the parameter is exact, and zeroth order is far off."""
    objective = Shifted(lambda at: at.sum() + 0.3 * jnp.sin((at - at.mean()) / 0.02).sum(), jnp.array(0.1), 1)
    first, unbiased, mixed = (
        error_of(repeat(f, objective, jnp.zeros(1), 1000, seed=1, num_samples=16), 40.0)[0]
        for f in (estimators.first_order, estimators.control_variate, estimators.alpha_order)
    )
    assert first < 1e-6 * unbiased
    assert mixed < 0.1 * unbiased  # a third if nothing is taken off


def test_a_large_constant_changes_nothing_in_single_precision(key):
    def cost(x):
        return jnp.float32(0.3) * x[0] + x[0] ** 2

    point, stddev = jnp.array([0.1], jnp.float32), jnp.float32(0.1)
    plain = alpha_order(parameter_noise(cost, stddev), point, key, num_samples=64)
    lifted = alpha_order(parameter_noise(lambda x: cost(x) + 1000.0, stddev), point, key, num_samples=64)
    assert plain.value.dtype == jnp.float32
    np.testing.assert_allclose(lifted.value, plain.value, rtol=0.05)


def test_derivatives_whose_fourth_powers_overflow_are_left_to_zeroth_order(key):
    """1e11 and of either sign, in single precision; also for a descent whose memory is still empty."""
    objective = parameter_noise(lambda x: (x + jnp.sin(jnp.float32(1e11) * x)).sum(), jnp.float32(0.1))
    point = jnp.zeros(3, jnp.float32)
    alone = alpha_order(objective, point, key, num_samples=16)
    empty = jax.tree.map(jnp.zeros_like, alone.memory)
    assert not np.isfinite(alone.memory.noise_square)
    for estimate in (alone, alpha_order(objective, point, key, num_samples=16, memory=empty)):
        assert estimate.alpha < 1e-6
        assert np.isfinite(estimate.value).all()


def test_without_finite_derivatives_the_unbiased_part_stands_alone(key):
    objective = parameter_noise(lambda x: jnp.sqrt(jnp.maximum(x[0], 0)), 0.1, dim=1)
    # Everything is at -1 or below: costs are zero and derivatives NaN.
    estimate = alpha_order(objective, jnp.array([-1.0]), key, num_samples=20)
    assert Reason[estimate.reason] == Reason[Reason.not_finite]
    assert Diagnosis[estimate.diagnosis] == Diagnosis[Diagnosis.fine]
    assert estimate.value == 0
