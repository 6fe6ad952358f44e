"""Intervals for means and variances; on the host, in NumPy."""

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy import stats

# So many resamples at a time: for 1e5 samples 40 MB.
_BATCH = 50


def mean_interval(
    mean: ArrayLike, standard_error: ArrayLike, count: ArrayLike, confidence: float = 0.95
) -> Float[np.ndarray, "2 *shape"]:
    """Return Student's t interval of a mean: its lower and upper ends, NaN where there is no standard error.

    Its coverage, `confidence`, holds for nearly normal samples, or many samples with a variance; `count`, at least 2, is the
    number of independent samples. A thousand samples are not many where one in a thousand carries most of the mean (the
    derivative of a stiff contact).

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
    """
    samples = np.asarray(samples, float)
    samples = samples[np.isfinite(samples).all(axis=1)]
    if len(samples) < 2:
        return np.full(2, np.nan)

    def variance(index: np.ndarray, axis: int) -> np.ndarray:
        return samples[index].var(axis=axis - 1, ddof=1).sum(axis=-1)

    settings = {"n_resamples": 1000, "batch": _BATCH, "vectorized": True, "method": "percentile", "rng": 0}
    chosen = (np.arange(len(samples)),)
    with np.errstate(over="ignore", invalid="ignore"):  # derivatives that explode have an infinite one
        found = stats.bootstrap(chosen, variance, confidence_level=checked(confidence), **settings)
    return np.array(found.confidence_interval)


def checked(confidence: float) -> float:
    """Return the confidence of an interval; refuse numbers outside (0, 1)."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    return confidence
