"""Intervals for means, biases, variances and errors; on the host, in NumPy."""

from typing import Literal

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy import stats

Interval = Float[np.ndarray, "2 *shape"]

# Counts of 50 resamples of 1e5 samples are 40 MB.
_RESAMPLES_AT_A_TIME = 50
# With fewer samples a bootstrap misses the tails, and a test of normality has no power.
_FEWEST_FOR_BOOTSTRAP = 20


def mean_interval(mean: ArrayLike, standard_error: ArrayLike, count: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return Student's t interval of a mean.

    Its coverage holds for nearly normal samples, or many samples with a variance. A thousand samples are not many where one
    in
    a thousand carries most of the mean (the derivative of a stiff contact).

    Arguments, result and errors are as in `bias_interval`.
    """
    return bias_interval(mean, standard_error, count, 0.0, confidence=confidence)


def bias_interval(
    mean: ArrayLike,
    standard_error: ArrayLike,
    count: ArrayLike,
    reference: ArrayLike,
    reference_error: ArrayLike = 0.0,
    reference_count: ArrayLike = np.inf,
    confidence: float = 0.95,
) -> Interval:
    """Return Welch's interval of a bias: the difference of a mean to a reference with an error of its own.

    Args:
        mean: mean of the samples.
        standard_error: standard error of the mean.
        count: number of independent samples behind it, at least 2.
        reference: the true mean, or an estimate independent of the samples.
        reference_error: standard error of the reference, zero for a closed form.
        reference_count: number of independent samples behind that error; infinite if it is known.
        confidence: coverage of the interval.

    Returns:
        Lower and upper ends, with the Welch-Satterthwaite degrees of freedom; NaN where there is no standard error.

    Raises:
        ValueError: if `confidence` is not between 0 and 1.

    References:
        Welch. The generalization of 'Student's' problem when several different population variances are involved.
        Biometrika 34, 1947, equation 28.
    """
    own, other = np.square(np.asarray(standard_error, float)), np.square(np.asarray(reference_error, float))
    freedom = np.maximum(np.asarray(count, float) - 1, 1)
    reference_freedom = np.maximum(np.asarray(reference_count, float) - 1, 1)
    both = own + other
    scale = np.where(both > 0, both, 1)
    # As shares of the whole, so that errors of 1e-200 do not underflow when squared.
    inverse = (own / scale) ** 2 / freedom + (other / scale) ** 2 / reference_freedom
    with np.errstate(divide="ignore"):
        freedom = 1 / inverse
    half = stats.t.ppf(0.5 + checked(confidence) / 2, freedom) * np.sqrt(both)
    bias = np.asarray(mean, float) - np.asarray(reference, float)
    return np.stack([bias - half, bias + half])


def root_mean_square_interval(
    squared_errors: Float[np.ndarray, "*batch repeats"],
    confidence: float = 0.95,
    *,
    reference_variance: ArrayLike = 0.0,
    cross_variance: ArrayLike = 0.0,
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "2 *batch"]]:
    r"""Return the root-mean-square error of an estimate from its repetitions, with an interval.

    The mean squared error is positive and skewed. Its interval is that of a gamma distribution with equal mean and variance
    (a
    chi-square with Satterthwaite's degrees of freedom). For one unbiased normal coordinate with known kurtosis it is exact.
    Where a bias dominates it becomes the usual normal interval.

    The variance $v$ of a reference adds to the mean and is subtracted. The error of the reference is common to all
    repetitions, so it widens the interval.

    Args:
        squared_errors: squared distance of each repetition to the reference.
        confidence: coverage of the interval.
        reference_variance: $v$, the sum over coordinates of the reference's squared standard errors.
        cross_variance: $\sum_j (2 b_j e_j)^2 + 2 e_j^4$, the variance that the error $e$ of the reference adds to the mean,
            with the bias $b$.

    Returns:
        The root-mean-square error, zero where the reference's error hides it, and the ends of its interval.

    Raises:
        ValueError: if `confidence` is not between 0 and 1.

    References:
        Satterthwaite. An approximate distribution of estimates of variance components. Biometrics Bulletin 2, 1946.
    """
    tail = (1 - checked(confidence)) / 2
    squared_errors = np.asarray(squared_errors, float)
    repeats = squared_errors.shape[-1]
    mean = squared_errors.mean(axis=-1)
    variance = squared_errors.var(axis=-1, ddof=1) / repeats + np.asarray(cross_variance, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = 2 * mean**2 / variance
        ends = [mean * freedom / stats.chi2.isf(tail, freedom), mean * freedom / stats.chi2.ppf(tail, freedom)]
    # All errors are equal up to rounding: the mean is known.
    ends = np.where(freedom < 1e12, ends, mean)
    taken_off = np.asarray(reference_variance, float)
    return np.asarray(np.sqrt(np.maximum(mean - taken_off, 0))), np.sqrt(np.maximum(ends - taken_off, 0))


def bootstrap_variance_interval(
    samples: Float[np.ndarray, "samples dim"], confidence: float = 0.95, *, num_resamples: int = 1000
) -> Float[np.ndarray, " 2"]:
    """Return the percentile bootstrap interval of a total variance, the trace of the covariance.

    It assumes no distribution, but is too low where the samples miss a tail. Samples that are not finite are left out; fewer
    than two give NaN. Equal numbers of samples share the same draws.

    References:
        Efron, Tibshirani. An Introduction to the Bootstrap. Chapman & Hall 1993, section 13.3.
    """
    tail = (1 - checked(confidence)) / 2
    if num_resamples < 1:
        raise ValueError(f"num_resamples must be at least 1, got {num_resamples}")
    samples = np.asarray(samples, float)
    samples = samples[np.isfinite(samples).all(axis=1)]
    count = len(samples)
    if count < 2:
        return np.full(2, np.nan)
    centred = samples - samples.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    rng, variances = np.random.default_rng(0), []
    for done in range(0, num_resamples, _RESAMPLES_AT_A_TIME):
        # The number of times that each resample draws each sample.
        times = rng.multinomial(count, np.full(count, 1 / count), min(_RESAMPLES_AT_A_TIME, num_resamples - done))
        shift = times @ centred / count
        variances.append((times @ squares - count * (shift**2).sum(axis=1)) / (count - 1))
    return np.quantile(np.concatenate(variances), [tail, 1 - tail])


class VarianceInterval(eqx.Module):
    """A variance (the trace of the covariance with N − 1), the ends of its interval, and the method."""

    value: float
    ends: Float[np.ndarray, " 2"]
    method: Literal["chi_square", "bootstrap"] = eqx.field(static=True)


def variance_interval(
    samples: Float[np.ndarray, "samples dim"], confidence: float = 0.95, *, num_resamples: int = 1000
) -> VarianceInterval:
    """Return the interval of a total variance, by chi-square or bootstrap, whichever suits the samples.

    Chi-square is exact for normal samples of one coordinate and wrong for other distributions. For several coordinates its
    degrees of freedom follow from the eigenvalues of the covariance. The bootstrap assumes no distribution but needs samples.
    It is used from 20 samples on, if a kurtosis test rejects normality in some coordinate (5 % over all of them).

    Samples that are not finite are left out; fewer than two give NaN.
    """
    tail = (1 - checked(confidence)) / 2
    samples = np.asarray(samples, float)
    samples = samples[np.isfinite(samples).all(axis=1)]
    if len(samples) < 2:
        return VarianceInterval(np.nan, np.full(2, np.nan), "chi_square")
    covariance = np.atleast_2d(np.cov(samples, rowvar=False))
    total = float(np.trace(covariance))
    if _has_other_tails(samples):
        ends = bootstrap_variance_interval(samples, confidence, num_resamples=num_resamples)
        return VarianceInterval(total, ends, "bootstrap")
    squares = (covariance**2).sum()
    freedom = (len(samples) - 1) * (total**2 / squares if squares > 0 else 1.0)
    return VarianceInterval(total, total * freedom / stats.chi2.isf([tail, 1 - tail], freedom), "chi_square")


def _has_other_tails(samples: Float[np.ndarray, "samples dim"]) -> bool:
    """Return whether some coordinate has another kurtosis than a normal distribution."""
    varied = samples[:, np.ptp(samples, axis=0) > 0]
    if len(samples) < _FEWEST_FOR_BOOTSTRAP or varied.shape[1] == 0:
        return False
    return bool(stats.kurtosistest(varied).pvalue.min() < 0.05 / varied.shape[1])


def checked(confidence: float) -> float:
    """Return the confidence of an interval; refuse numbers outside (0, 1)."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    return confidence
