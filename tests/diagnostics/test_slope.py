"""Derivatives held against the slope: on functions whose slope and derivative are known."""

import numpy as np
import pytest

from mjxgrad.diagnostics import compare_to_slope, phases

INTERVAL = (0.2, 0.7)


def sawtooth(x, tooth, rise):
    """A smooth trend of slope 3x² with teeth on it, whose flanks add `rise` to the derivative and whose jumps take it back."""
    return x**3 + rise * tooth * (x / tooth - np.floor(x / tooth))


def compare(function, derivatives, num_phases=64, interval=INTERVAL):
    x = phases(interval, num_phases)
    return compare_to_slope(x, function(x), [d(x) for d in derivatives], [str(i) for i in range(len(derivatives))])


@pytest.mark.parametrize("power", [1, 2, 3])
def test_the_mean_of_a_polynomials_derivative_is_its_slope(power):
    """Both are the same average: by parts, whatever the curvature, but for the sum in place of the integral."""
    found = compare(lambda x: x**power, [lambda x: power * x ** (power - 1)])
    # Sums over jittered points replace integrals to about 1/N² of the change of the derivative.
    assert found.mean[0] == pytest.approx(found.slope, rel=2e-3)


def test_the_slope_of_a_cubic_is_its_derivative_averaged_with_a_quartic():
    """With weight k = 15/16 (1 − u²)², E u² = 1/7: the mean of 3x² is 3 (m² + w²/7), m the middle, w half the width."""
    found = compare(lambda x: x**3, [lambda x: 3 * x**2])
    middle, half = 0.45, 0.25
    # The points' own ends are within half a distance of those of the interval: 0.25/64 in m, twice that relatively in m².
    assert float(found.slope) == pytest.approx(3 * (middle**2 + half**2 / 7), rel=0.017)
    # Nor is curvature taken for error.
    assert float(found.slope_error) < 1e-12


def test_jumps_count_in_the_slope_and_not_in_the_derivative():
    """Teeth of rise 20 leave the slope where it was and add 20 to the derivative."""
    tooth, rise = 0.021, 20.0
    found = compare(lambda x: sawtooth(x, tooth, rise), [lambda x: 3 * x**2 + rise, lambda x: 3 * x**2], 256)
    smooth = compare(lambda x: x**3, [lambda x: 3 * x**2], 256)
    assert float(found.slope) == pytest.approx(float(smooth.slope), abs=3 * float(found.slope_error))
    assert float(found.slope_error) < 0.02 * rise
    assert found.mean[0] == pytest.approx(smooth.mean[0] + rise)
    assert found.relative_error[0] > 0.05 + 2 * found.standard_error[0] / found.scale
    assert found.relative_error[1] < 0.05
    assert bool(found.is_resolved())


def test_teeth_are_counted():
    found = compare(lambda x: sawtooth(x, 0.05, 20.0), [lambda x: 3 * x**2 + 20], 256)
    assert float(found.num_teeth) == pytest.approx(10, abs=1)


def test_the_error_bar_covers_the_slope_of_the_trend():
    """Teeth from a sixth of the points' distance to an eighth of the interval, 15 shifts each: two errors cover nine in ten."""
    x, rise, rng = phases(INTERVAL, 64), 20.0, np.random.default_rng(3)
    teeth = np.repeat(np.geomspace(0.0013, 0.0625, 20), 15)
    heights = rise * teeth * ((x[:, None] / teeth + rng.uniform(size=teeth.size)) % 1)
    found = compare_to_slope(x, heights, [np.full_like(heights, rise)], ["flank"])
    covered = np.abs(found.slope) <= 2 * found.slope_error
    # The points are the same for all, so the 300 cases are not independent; over other points it is 0.95 in the mean.
    assert covered.mean() >= 0.85
    # No idle bar: within three of the true errors in the mean over all teeth.
    assert (found.slope_error**2).mean() <= 9 * (found.slope**2).mean()


@pytest.mark.slow
def test_neighbours_that_err_together_do_not_count_as_many():
    """Fewest points, errors that four neighbours share: the bar is that of repetition, a tenth short of it at the most."""
    x = phases(INTERVAL, 32)
    noise = np.random.default_rng(5).normal(size=(8, 4000)).repeat(4, axis=0)
    found = compare_to_slope(x, noise, [noise], ["noise"])
    slope = np.sqrt((found.slope_error**2).mean()) / found.slope.std()
    mean = np.sqrt((found.mean_error**2).mean()) / found.mean.std()
    # 4000 repetitions are good for 1.5 %. Single residuals give 0.44; neither eight blocks nor four coefficients are many, and
    # what corrects for them is worth 0.06 and 0.11.
    assert 0.86 < slope < 1.1
    assert 0.9 < mean < 1.1
    exact = compare_to_slope(x, noise, [0 * noise], ["zero"])
    is_off = np.abs(exact.error) - 2 * exact.standard_error > 0.05 * exact.scale
    assert is_off.mean() < 0.15


def test_curvature_that_outcome_and_derivative_share_is_no_error():
    """Noise of 1 on a derivative that swings by 12: the bar is that of the noise, and covers it."""
    x, rng = phases(INTERVAL, 64)[:, None], np.random.default_rng(2)
    swing, noise = rng.uniform(0, 6, 2000), rng.normal(size=(64, 2000))
    found = compare_to_slope(x[:, 0], np.sin(12 * x + swing), [12 * np.cos(12 * x + swing) + noise], ["noisy"])
    assert 0.9 < np.sqrt((found.standard_error[0] ** 2).mean()) / found.error[0].std() < 1.1
    assert (np.abs(found.error[0]) <= 2 * found.standard_error[0]).mean() > 0.88  # 16 blocks: t quantile 2.13, not 1.96


def test_an_interval_within_one_tooth_is_not_resolved():
    """Two teeth cannot tell the trend from their flanks: errors of half the rise must not pass for a slope."""
    found = compare(lambda x: sawtooth(x, 0.26, 20.0), [lambda x: 3 * x**2 + 20])
    assert not bool(found.is_resolved())


def test_phases_that_are_not_finite_are_left_out_and_counted():
    x = phases(INTERVAL, 64)
    gaps = np.where(np.arange(64) % 16 == 5, np.nan, 1.0)
    outcomes = np.stack([x**2, gaps * x**2, x**2, np.full(64, np.nan)], axis=1)
    derivatives = np.stack([2 * x, 2 * x, gaps * 2 * x, 2 * x], axis=1)
    found = compare_to_slope(x, outcomes, [derivatives], ["exact"])
    assert found.num_finite.tolist() == [64, 60, 60, 0]
    for lost in (1, 2):
        assert found.slope[lost] == pytest.approx(found.slope[0], rel=1e-2)
        assert found.mean[0, lost] == pytest.approx(found.mean[0, 0], rel=1e-2)
    assert np.isnan(found.slope[3])
    assert not found.is_resolved()[3]


def test_an_error_of_rounding_alone_is_none():
    """Both derivatives of a constant are zero but for rounding; neither is to look wrong beside the other."""
    x = phases(INTERVAL, 64)
    found = compare_to_slope(x, np.ones(64), [np.full(64, 1e-16), np.zeros(64)], ["a", "b"])
    assert found.relative_error.tolist() == [0.0, 0.0]
