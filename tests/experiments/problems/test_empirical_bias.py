"""The event that samples of a gradient miss, on the ramp whose every number is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.problems import textbook
from experiments.problems.empirical_bias import binomial_bound, binomial_interval, empirical_bias, first_order_samples
from mjxgrad.objective import parameter_noise

STDDEV, POINT, WIDTH = 0.1, 0.03, 0.02
RAMP = textbook.soft_heaviside(WIDTH)
P = float(RAMP.slope_probability(POINT, STDDEV))
GRADIENT = float(RAMP.gradient(POINT, STDDEV))
VARIANCE = float(RAMP.first_order_variance(POINT, STDDEV))


@pytest.fixture(scope="module")
def samples():
    draw = eqx.filter_jit(first_order_samples)
    return np.asarray(draw(RAMP.objective(STDDEV), jnp.array([POINT]), jax.random.key(3), num_samples=2000))


@pytest.fixture(scope="module")
def found(samples):
    return empirical_bias(samples)


def test_the_samples_are_slopes_with_the_chance_of_the_slope(samples):
    assert samples.shape == (2000, 1)
    np.testing.assert_allclose(np.unique(samples), [0.0, 2 / WIDTH])
    assert abs((samples > 0).mean() - P) < 4 * np.sqrt(P * (1 - P) / 2000)


def test_the_event_is_a_sample_off_the_slope(found, samples):
    assert found.num_outlying == (samples > 0).sum()
    assert found.spread == 0
    assert found.mean == 0
    assert found.share == pytest.approx(1.0)


def test_the_triple_is_that_of_the_closed_form(found):
    """β = p, Δ = F' = 2p/ν, S = 0."""
    low, high = found.probability_interval
    assert low < P < high
    low, high = found.distance_interval
    assert low < GRADIENT < high
    assert high / low < 2
    assert found.distance == pytest.approx(found.probability * 2 / WIDTH)
    assert found.probability_bound < found.probability_interval[1]


def test_the_implied_variance_is_all_of_the_variance_of_a_ramp(found):
    """Δ²(1 − β)/β = (2p/ν)²(1 − p)/p = (2/ν)² p (1 − p)."""
    slope_variance = (2 / WIDTH) ** 2 * found.probability * (1 - found.probability)
    assert found.implied_variance == pytest.approx(slope_variance, rel=1e-12)
    assert found.implied_variance == pytest.approx(found.variance * 1999 / 2000, rel=1e-12)
    assert found.implied_variance_bound < VARIANCE


def test_exact_probability_and_distance_give_the_exact_variance():
    """Samples with 3 on the slope of 100, as p = 0.03 would have it."""
    z = np.where(np.arange(100) < 3, 2 / WIDTH, 0.0)
    assert empirical_bias(z).implied_variance == pytest.approx((2 / WIDTH) ** 2 * 0.03 * 0.97, rel=1e-12)


def test_the_chance_that_samples_all_miss_is_the_frequency_with_which_they_do(found):
    """Simulated anew: 20 000 times N samples, and how often all are off the slope."""
    for count in (3, 10, 40):
        noise = np.random.default_rng(count).normal(POINT, STDDEV, (20_000, count))
        frequency = (np.abs(noise) > WIDTH / 2).all(axis=1).mean()
        exact = (1 - P) ** count
        assert abs(frequency - exact) < 4 * np.sqrt(exact * (1 - exact) / 20_000)
        low, high = found.miss_probability_interval(count)
        assert low < exact < high
        # The relative error of (1 − β)^N is N dβ/(1 − β), and β has five per cent.
        assert found.miss_probability(count) == pytest.approx(frequency, abs=0.1)


@pytest.mark.slow
def test_intervals_of_the_triple_cover_as_often_as_they_say():
    rng = np.random.default_rng(5)
    hits = np.zeros(3)
    for _ in range(300):
        one = empirical_bias(np.where(rng.random(150) < 0.05, 40.0, 0.0) + rng.normal(0, 1.0, 150), confidence=0.9)
        for i, (interval, truth) in enumerate(
            [
                (one.probability_interval, 0.05),
                (one.distance_interval, 2.0),
                (one.miss_probability_interval(20), 0.95**20),
            ]
        ):
            hits[i] += interval[0] <= truth <= interval[1]
    # Clopper-Pearson covers at least so often.
    assert (hits / 300 >= 0.9 - 4 * np.sqrt(0.09 / 300)).all()
    assert hits[0] / 300 < 0.995


def test_a_jump_that_was_never_seen_is_bounded_by_the_rule_of_three_and_by_the_discrepancy():
    """60 samples of a ramp so narrow that all miss it; the zeroth-order estimate is taken as exact."""
    narrow = textbook.soft_heaviside(1e-4)
    truth = float(narrow.gradient(POINT, STDDEV))
    found = empirical_bias(np.zeros((60, 1)), reference=(np.array([truth]), 0.0))
    bound = 1 - 0.05 ** (1 / 60)
    assert found.num_outlying == 0
    assert found.probability_bound == pytest.approx(bound)
    assert found.probability == 0
    assert found.distance == pytest.approx(truth)
    assert found.implied_variance == pytest.approx(truth**2 * (1 - bound) / bound)
    assert found.implied_variance == pytest.approx(truth**2 / (3 / 60), rel=0.1)
    # The samples say zero; the truth is far above even the bound.
    assert found.variance == 0
    assert found.implied_variance_bound <= narrow.first_order_variance(POINT, STDDEV)


def test_the_error_of_the_reference_widens_the_distance():
    found = empirical_bias(np.zeros(50), reference=(4.0, 1.0))
    # Student's t with 49 degrees of freedom at 95 % is 2.0096.
    np.testing.assert_allclose(found.distance_interval, [4 - 2.0096, 4 + 2.0096], rtol=1e-4)


@pytest.mark.parametrize("dim", [1, 4])
@pytest.mark.parametrize("law", ["normal", "uniform", "exponential"])
def test_smooth_samples_show_no_event(law, dim):
    rng = np.random.default_rng(8)
    seen = [empirical_bias(getattr(rng, law)(size=(count, dim))).num_outlying > 0 for count in [10, 30, 300] * 20]
    # At 95 %; ten samples of an exponential distribution may look like a group and an outlier.
    assert np.mean(seen) < (0.25 if law == "exponential" else 0.1)


def test_outliers_to_all_sides_are_variance_and_not_bias():
    rng = np.random.default_rng(9)
    z = rng.normal(size=(400, 1))
    z[:20] += np.where(np.arange(20) % 2, 30.0, -30.0)[:, None]
    assert empirical_bias(z).num_outlying == 0


def test_samples_that_are_not_finite_are_counted():
    z = np.concatenate([np.zeros(50), [np.nan, np.inf], np.full(4, 9.0)])
    found = empirical_bias(z)
    assert (found.num_samples, found.num_not_finite, found.num_outlying) == (54, 2, 4)


def test_the_derivative_of_a_diverged_rollout_is_no_sample():
    """An infinite cost with a derivative of zero."""
    objective = parameter_noise(lambda x: jnp.where(x[0] > 0, jnp.inf, x[0]), STDDEV, dim=1)
    z = first_order_samples(objective, jnp.zeros(1), jax.random.key(0), num_samples=64)
    assert 10 < np.isnan(z).sum() < 54
    assert np.nanmin(z) == np.nanmax(z) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"gradients": np.array([1.0, np.nan])}, "gradients must have at least 2 finite samples, got 1 of 2"),
        ({"gradients": np.zeros((2, 2, 2))}, r"gradients must have shape \(n, dim\) or \(n,\), got \(2, 2, 2\)"),
        ({"reference": np.zeros(2)}, r"reference must have the shape \(1,\) of a gradient, got \(2,\)"),
        ({"confidence": 0.0}, "confidence must be between 0 and 1, got 0.0"),
    ],
)
def test_what_is_no_sample_is_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        empirical_bias(**({"gradients": np.zeros(3)} | arguments))


@pytest.mark.parametrize("probability", [0.002, 0.03, 0.4])
def test_an_interval_of_a_probability_covers_at_least_as_often_as_it_says(probability):
    counts = np.random.default_rng(4).binomial(200, probability, 4000)
    intervals = np.array([binomial_interval(count, 200, 0.9) for count in range(201)])[counts]
    bounds = np.array([binomial_bound(count, 200, 0.9) for count in range(201)])[counts]
    assert ((intervals[:, 0] <= probability) & (probability <= intervals[:, 1])).mean() >= 0.9 - 4 * np.sqrt(
        0.09 / 4000
    )
    assert (bounds >= probability).mean() >= 0.9 - 4 * np.sqrt(0.09 / 4000)


def test_the_bound_of_what_was_never_seen_is_the_rule_of_three():
    """(1 − p)^n = 0.05 at p = 1 − 0.05^(1/n), which is ln 20 / n to first order."""
    assert binomial_bound(0, 1000) == pytest.approx(1 - 0.05 ** (1 / 1000), rel=1e-9)
    assert binomial_bound(0, 1000) == pytest.approx(3 / 1000, rel=4e-3)
    assert binomial_bound(7, 7) == 1
