"""Intervals cover as often as they say, and estimators are compared at what they really spend."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from experiments.problems.comparison import affordable, compare, root_mean_square_interval
from mjxgrad.estimators import first_order, zeroth_order
from mjxgrad.objective import parameter_noise
from tests.estimators.textbook import ramp, ramp_probability, step, step_gradient

STDDEV, POINT, REPEATS = 0.1, 0.03, 4000
WIDTH = 0.1
RAMP = parameter_noise(ramp(WIDTH), STDDEV, dim=1)
ON_SLOPE = ramp_probability(POINT, WIDTH)
TRUTH = 2 / WIDTH * ON_SLOPE
PAIRS = functools.partial(zeroth_order, antithetic=True)
ZERO_NOISE = functools.partial(zeroth_order, baseline="zero_noise")


def share(low, high, truth) -> float:
    return float(((low <= truth) & (truth <= high)).mean())


def near(confidence: float, slack: float = 0.0):
    """Four standard errors of a frequency over the repeats, and what an approximation may be off."""
    return pytest.approx(confidence, abs=4 * np.sqrt(confidence * (1 - confidence) / REPEATS) + slack)


@pytest.mark.parametrize("bias", [0.0, 1.0, 5.0])
def test_an_interval_of_a_root_mean_square_covers_whether_bias_or_variance_makes_it(bias):
    errors = np.random.default_rng(2).normal(bias, 1.0, (REPEATS, 100)) ** 2
    rmse, (low, high) = root_mean_square_interval(errors, 0.9)
    assert share(low, high, np.sqrt(bias**2 + 1)) == near(0.9, 0.01)
    assert np.mean(rmse**2) == pytest.approx(bias**2 + 1, rel=0.01)


@pytest.fixture(scope="module")
def table():
    """Four estimators on the ramp, against its closed form."""
    estimators = {"first": first_order, "zeroth": zeroth_order, "pairs": PAIRS, "zero noise": ZERO_NOISE}
    return compare(
        estimators, RAMP, jnp.array([POINT]), jax.random.key(0), budget=51, reference=TRUTH, num_repeats=1000
    )


def test_the_budget_is_of_rollouts_that_are_reported(table):
    """Pairs need an even number, and a baseline without noise costs one more."""
    assert list(table.estimator) == ["first", "zeroth", "pairs", "zero noise"]
    np.testing.assert_array_equal(table.num_samples, [51, 51, 50, 50])
    np.testing.assert_array_equal(table.num_rollouts, [51, 51, 50, 51])


def test_an_estimator_that_rolls_out_thrice_per_sample_gets_a_third_of_the_samples():
    def thrice(objective, params, key, *, num_samples):
        estimate = zeroth_order(objective, params, key, num_samples=num_samples)
        return eqx.tree_at(lambda e: e.num_rollouts, estimate, jnp.asarray(3 * num_samples + 1))

    assert affordable(thrice, RAMP, jnp.array([POINT]), jax.random.key(0), 100) == 33


def _expected(function) -> float:
    """The mean of a function of the ramp's value and the score w/σ², by quadrature between the kinks."""

    def density(w: float) -> float:
        return function(np.clip(2 * (POINT + w) / WIDTH, -1, 1), w / STDDEV**2) * norm.pdf(w, scale=STDDEV)

    return quad(density, -9 * STDDEV, 9 * STDDEV, points=[-WIDTH / 2 - POINT, WIDTH / 2 - POINT], limit=200)[0]


def test_errors_are_those_of_the_closed_forms(table):
    """With φ = f − E f, leaving one out of n has the variance V(φ s) / n + (V(f) V(s) + (E φ s)²) / (n (n − 1))."""
    mean, start = _expected(lambda f, s: f), 2 * POINT / WIDTH
    spread = _expected(lambda f, s: (f - mean) ** 2)
    first = (2 / WIDTH) ** 2 * ON_SLOPE * (1 - ON_SLOPE)  # the slope, or zero
    centred, from_start = (_expected(lambda f, s, c=c: ((f - c) * s) ** 2) - TRUTH**2 for c in (mean, start))
    left_out = centred / 51 + (spread / STDDEV**2 + TRUTH**2) / (51 * 50)
    exact = np.array([first / 51, left_out, np.nan, from_start / 50])
    known = ~np.isnan(exact)
    # 1000 estimates know a variance to 4.5 %, with somewhat longer tails; three are looked at.
    np.testing.assert_allclose(table.variance[known], exact[known], rtol=0.2)
    np.testing.assert_allclose(table.rmse[known], np.sqrt(exact[known]), rtol=0.1)
    np.testing.assert_allclose(table.claimed_variance, table.variance, rtol=0.15)
    assert (np.abs(table.bias) < 4 * np.sqrt(table.variance / 1000)).all()


def test_a_bias_shows_in_the_error_and_not_in_the_variance():
    """A step on a parabola: first order converges to 2θ and misses the density of the noise at the step."""
    objective = parameter_noise(lambda x: step(x) + x[0] ** 2, STDDEV, dim=1)
    missed = step_gradient(POINT)
    given = {"budget": 40, "reference": missed + 2 * POINT, "num_repeats": 300}
    table = compare({"first": first_order}, objective, jnp.array([POINT]), jax.random.key(1), **given)
    # Var 2w = 4σ².
    assert table.variance.item() == pytest.approx(4 * STDDEV**2 / 40, rel=0.3)
    low, high = table.bias_low[0], table.bias_high[0]
    assert low < -missed < high
    assert high < 0 or low > 0
    assert table.rmse.item() == pytest.approx(missed, rel=0.01)


@pytest.mark.parametrize("seed", range(2))
def test_estimates_that_are_not_finite_are_counted_and_left_out(seed):
    """Two samples, each infinite beyond one deviation (16 %): a few estimates have fewer than two and are NaN."""
    objective = parameter_noise(lambda x: jnp.where(x[0] > STDDEV, jnp.inf, x[0] ** 2), STDDEV, dim=1)
    given = {"budget": 2, "reference": 0.0, "num_repeats": 400}
    table = compare({"first": first_order}, objective, jnp.zeros(1), jax.random.key(seed), **given)
    expected = 400 * 0.8413447**2
    assert abs(table.num_finite[0] - expected) < 4 * np.sqrt(expected * 0.3)
    assert np.isfinite([table.rmse[0], table.variance[0], table["mean"][0]]).all()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"budget": 1}, "budget of 1 rollouts buys no estimate; num_samples must be at least 2, got 1"),
        ({"confidence": 95.0}, "confidence must be between 0 and 1, got 95.0"),
        (
            {"objective": parameter_noise(lambda x: x[0] * jnp.nan, 0.1, dim=1), "num_repeats": 3},
            "first must give at least 2 finite estimates, got 0 of 3",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, sentence):
    good = {"objective": RAMP, "estimators": {"first": first_order}, "reference": TRUTH}
    good |= {"budget": 4, "params": jnp.array([POINT]), "key": jax.random.key(0)}
    with pytest.raises(ValueError, match=sentence):
        compare(**(good | arguments))
