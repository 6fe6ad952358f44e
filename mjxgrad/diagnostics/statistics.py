"""Intervals for means and variances; on the host, in NumPy."""

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy import stats

_NUM_RESAMPLES = 1000
# Counts of 50 resamples of 1e5 samples are 40 MB.
_RESAMPLES_AT_A_TIME = 50


def mean_interval(
    mean: ArrayLike, standard_error: ArrayLike, count: ArrayLike, confidence: float = 0.95
) -> Float[np.ndarray, "2 *shape"]:
    """Return Student's t interval of a mean: its lower and upper ends, NaN where there is no standard error.

    Its coverage holds for nearly normal samples, or many samples with a variance. A thousand samples are not many where
    one in a thousand carries most of the mean (the derivative of a stiff contact).

    Args:
        mean: mean of the samples.
        standard_error: standard error of the mean.
        count: number of independent samples behind it, at least 2.
        confidence: coverage of the interval.

    Raises:
        ValueError: if `confidence` is not between 0 and 1.
    """
    quantile = stats.t.ppf(0.5 + checked(confidence) / 2, np.maximum(np.asarray(count, float) - 1, 1))
    mean, half = np.asarray(mean, float), quantile * np.asarray(standard_error, float)
    return np.stack([mean - half, mean + half])


def bootstrap_variance_interval(
    samples: Float[np.ndarray, "samples dim"], confidence: float = 0.95
) -> Float[np.ndarray, " 2"]:
    """Return the percentile bootstrap interval of a total variance, the trace of the covariance.

    It assumes no distribution, but is too low where the samples miss a tail. Samples that are not finite are left out; fewer
    than two give NaN. Equal numbers of samples share the same draws.

    References:
        Efron, Tibshirani. An Introduction to the Bootstrap. Chapman & Hall 1993, section 13.3.
    """
    tail = (1 - checked(confidence)) / 2
    samples = np.asarray(samples, float)
    samples = samples[np.isfinite(samples).all(axis=1)]
    count = len(samples)
    if count < 2:
        return np.full(2, np.nan)
    centred = samples - samples.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    rng, variances = np.random.default_rng(0), []
    for _ in range(0, _NUM_RESAMPLES, _RESAMPLES_AT_A_TIME):
        # The number of times that each resample draws each sample.
        times = rng.multinomial(count, np.full(count, 1 / count), _RESAMPLES_AT_A_TIME)
        shift = times @ centred / count
        variances.append((times @ squares - count * (shift**2).sum(axis=1)) / (count - 1))
    return np.quantile(np.concatenate(variances), [tail, 1 - tail])


def checked(confidence: float) -> float:
    """Return the confidence of an interval; refuse numbers outside (0, 1)."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    return confidence
