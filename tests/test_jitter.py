"""Derivatives held against the slope over jittered starts: on functions whose means are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.diagnostics import derivative_under_jitter

INTERVAL = (0.2, 0.7)
TOOTH, RISE, LEVER = 1.0, 20.0, 0.3
KEY = jax.random.key(4)


def uniform(key):
    return jax.random.uniform(key)


def landing(x, jitter, gradient):
    """x² with teeth along `LEVER` x + jitter, of which the interval holds a seventh; "event" takes their flanks back."""
    place = LEVER * x + jitter
    teeth = RISE * (place - TOOTH * jnp.floor(place / TOOTH))
    return x**2 + (jax.lax.stop_gradient(teeth) if gradient == "event" else teeth)


def scaled(x, jitter, gradient):
    return jitter * x


def test_teeth_that_the_parameter_hardly_moves_are_averaged_by_jitter():
    """Over a uniform phase teeth have no mean slope: 0.9 of x² is left, and flanks add 6 to the discrete derivative."""
    found = derivative_under_jitter(landing, INTERVAL, KEY, jitter=uniform, num_samples=1024)
    # The mean of 2x over (0.2, 0.7).
    assert abs(float(found.slope) - 0.9) < 3 * float(found.slope_error)
    assert found.mean[1] == pytest.approx(0.9, abs=1e-3)
    assert found.mean[0] == pytest.approx(0.9 + RISE * LEVER, abs=1e-3)
    # A difference holds a jump of 20/0.5 with probability 0.15: its standard deviation is 40 √(0.15·0.85) = 14.28.
    assert float(found.slope_error) == pytest.approx(14.28 / 32, rel=0.1)
    assert found.is_off().tolist() == [True, False]


def test_jitter_shared_by_derivative_and_difference_is_no_error_between_them():
    """Of ξx both are ξ, sample by sample."""
    found = derivative_under_jitter(scaled, INTERVAL, KEY, jitter=jax.random.normal, gradients=("exact",))
    assert float(found.slope_error) == pytest.approx(1 / 16, rel=0.2)
    assert float(found.mean_error[0]) == pytest.approx(float(found.slope_error))
    assert float(found.standard_error[0]) < 1e-12
    assert bool(found.is_close(1e-9)[0])


def test_the_error_bar_covers_the_error():
    """Over 100 keys the discrete derivative less the slope is 6 to within two standard errors in 95 of 100."""
    errors, bars = [], []
    for key in jax.random.split(KEY, 100):
        found = derivative_under_jitter(landing, INTERVAL, key, jitter=uniform, gradients=("discrete",))
        errors.append(float(found.error[0]) - RISE * LEVER)
        bars.append(float(found.standard_error[0]))
    # Binomial: 95 ± 2.2.
    assert 88 <= np.count_nonzero(np.abs(errors) <= 2 * np.array(bars)) <= 100
    assert np.mean(bars) == pytest.approx(np.std(errors), rel=0.25)


@pytest.mark.parametrize(("jitter", "is_heavy"), [(jax.random.normal, False), (jax.random.cauchy, True)])
def test_a_mean_that_hangs_on_few_samples_is_flagged(jitter, is_heavy):
    """The largest hundredth of normal samples carries 2 (z φ(z) + 0.005) = 0.085 of the squares, z = 2.576."""
    found = derivative_under_jitter(scaled, INTERVAL, KEY, jitter=jitter, num_samples=1000, gradients=("exact",))
    assert bool(found.is_heavy[0]) == is_heavy
    if not is_heavy:
        assert float(found.tail_share[0]) == pytest.approx(0.085, rel=0.25)


def test_samples_that_are_not_finite_are_left_out_and_counted():
    def simulate(x, jitter, gradient):
        return jnp.stack([x, jnp.where(jitter < 0.25, jnp.nan, x), jnp.nan * x])

    found = derivative_under_jitter(simulate, INTERVAL, KEY, jitter=uniform, gradients=("exact",))
    assert found.num_finite[0] == 256
    # 192 ± 7.
    assert 160 < found.num_finite[1] < 224
    assert found.num_finite[2] == 0
    assert found.slope[:2] == pytest.approx(1)
    assert found.mean[0, :2] == pytest.approx(1)
    assert np.isnan(found.slope[2])
    assert found.is_resolved().tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("interval", "options", "sentence"),
    [
        ((0.3, 0.3), {}, "interval must be two finite numbers"),
        ((0.0, 1.0), {"num_samples": 31}, "num_samples must be at least 32, got 31"),
        ((0.0, 1.0), {"gradients": ()}, "gradients must name at least one"),
    ],
)
def test_an_interval_or_a_number_without_meaning_is_refused(interval, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        derivative_under_jitter(landing, interval, KEY, jitter=uniform, **options)
