"""Intervals for means and variances; on the host, in NumPy."""

from collections.abc import Iterator

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int
from scipy import stats

Interval = Float[np.ndarray, "2 *shape"]

# Counts of 50 resamples of 1e5 samples are 40 MB.
_RESAMPLES_AT_A_TIME = 50


def mean_interval(mean: ArrayLike, standard_error: ArrayLike, count: ArrayLike, confidence: float = 0.95) -> Interval:
    """Give Student's t interval of a mean.

    It covers as it says for samples near a normal distribution, or many of any with a variance; where a sample in a
    thousand carries most of the mean (the derivative of a stiff contact), a thousand samples are not many.

    Args:
        mean: of the samples.
        standard_error: of the mean.
        count: number of independent samples behind the standard error, at least 2.
        confidence: chance to cover the truth.

    Returns:
        Lower and upper ends, NaN where there is no standard error.

    Raises:
        ValueError: if `confidence` is not between 0 and 1.
    """
    mean, standard_error = np.asarray(mean, float), np.asarray(standard_error, float)
    freedom = np.maximum(np.asarray(count, float) - 1, 1)
    half = stats.t.ppf(0.5 + _checked(confidence) / 2, freedom) * standard_error
    return np.stack([mean - half, mean + half])


def chi_square_variance_interval(variance: ArrayLike, count: ArrayLike, confidence: float = 0.95) -> Interval:
    """Give the chi-square interval of a variance, exact for normal samples and wrong for heavy tails.

    Args:
        variance: of the samples, with N − 1.
        count: number of samples, at least 2.
        confidence: chance to cover the truth.

    Returns:
        Lower and upper ends.

    Raises:
        ValueError: if `confidence` is not between 0 and 1.
    """
    freedom = np.asarray(count, float) - 1
    tail = (1 - _checked(confidence)) / 2
    sum_of_squares = np.asarray(variance, float) * freedom
    return np.stack([sum_of_squares / stats.chi2.isf(tail, freedom), sum_of_squares / stats.chi2.ppf(tail, freedom)])


def bootstrap_variance_interval(
    samples: Float[np.ndarray, "samples dim"],
    confidence: float = 0.95,
    *,
    num_resamples: int = 1000,
    seed: int = 0,
) -> Float[np.ndarray, " 2"]:
    """Give the percentile bootstrap interval of a total variance, the trace of the covariance.

    It assumes no distribution. A tail that the samples have not met it cannot know: then it is too low.

    Args:
        samples: independent; those that are not finite are left out.
        confidence: chance to cover the truth.
        num_resamples: how often the samples are drawn anew.
        seed: of the draws; the same seed and number of samples give the same draws.

    Returns:
        Lower and upper end, NaN for fewer than two finite samples.

    Raises:
        ValueError: if `confidence` is not between 0 and 1, or `num_resamples` is below 1.

    References:
        Efron, Tibshirani. An Introduction to the Bootstrap. Chapman & Hall 1993, section 13.3.
    """
    tail = (1 - _checked(confidence)) / 2
    if num_resamples < 1:
        raise ValueError(f"num_resamples must be at least 1, got {num_resamples}")
    samples = np.asarray(samples, float)
    samples = samples[np.isfinite(samples).all(axis=1)]
    count = len(samples)
    if count < 2:
        return np.full(2, np.nan)
    centred = samples - samples.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    variances = []
    for times in _resampling_counts(count, num_resamples, seed):
        shift = times @ centred / count
        variances.append((times @ squares - count * (shift**2).sum(axis=1)) / (count - 1))
    return np.quantile(np.concatenate(variances), [tail, 1 - tail])


def _resampling_counts(count: int, num_resamples: int, seed: int) -> Iterator[Int[np.ndarray, "resamples samples"]]:
    """Give how often each sample is drawn in each resample."""
    rng = np.random.default_rng(seed)
    sizes = [min(_RESAMPLES_AT_A_TIME, num_resamples - i) for i in range(0, num_resamples, _RESAMPLES_AT_A_TIME)]
    for size in sizes:
        yield rng.multinomial(count, np.full(count, 1 / count), size)


def _checked(confidence: float) -> float:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    return confidence
