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
# Below this number a bootstrap knows too little of the tails, and a test of normality finds nothing.
_FEWEST_FOR_BOOTSTRAP = 20


def mean_interval(mean: ArrayLike, standard_error: ArrayLike, count: ArrayLike, confidence: float = 0.95) -> Interval:
    """Give Student's t interval of a mean.

    It covers as it says for samples near a normal distribution, or many of any with a variance; where a sample in a
    thousand carries most of the mean (the derivative of a stiff contact), a thousand samples are not many.

    Arguments, result and refusals are those of `bias_interval`.
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
    """Give Welch's interval of a bias, the difference of a mean to a reference that has an error of its own.

    Args:
        mean: of the samples.
        standard_error: of the mean.
        count: number of independent samples behind it, at least 2.
        reference: what the mean should be; independent of the samples.
        reference_error: its standard error, zero for a closed form.
        reference_count: number of independent samples behind that error; infinite if it is known.
        confidence: chance to cover the bias.

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
    r"""Give the root-mean-square error of an estimate from its repetitions, with an interval.

    The mean of squared errors is never negative and skewed, so its interval is that of a gamma distribution with the
    same mean and variance (a chi-square with Satterthwaite's degrees of freedom): exact for one unbiased normal
    coordinate if its kurtosis were known, the usual normal interval where a bias dominates.

    A reference with a variance $v$ of its own adds $v$ to the mean, which is taken off again, and its error is common
    to all repetitions, so it widens the interval.

    Args:
        squared_errors: squared distance of each repetition to the reference.
        confidence: chance to cover the truth.
        reference_variance: $v$, the sum over coordinates of the reference's squared standard errors.
        cross_variance: $\sum_j (2 b_j e_j)^2 + 2 e_j^4$, what the error $e$ of the reference adds to the variance of the
            mean, $b$ being the bias.

    Returns:
        The root-mean-square error, zero where the reference is too uncertain to see one, and the ends of its interval.

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
    # All errors alike, by rounding or in truth: the error is known.
    ends = np.where(freedom < 1e12, ends, mean)
    taken_off = np.asarray(reference_variance, float)
    return np.asarray(np.sqrt(np.maximum(mean - taken_off, 0))), np.sqrt(np.maximum(ends - taken_off, 0))


def bootstrap_variance_interval(
    samples: Float[np.ndarray, "samples dim"], confidence: float = 0.95, *, num_resamples: int = 1000
) -> Float[np.ndarray, " 2"]:
    """Give the percentile bootstrap interval of a total variance, the trace of the covariance.

    It assumes no distribution. A tail that the samples have not met it cannot know: then it is too low. Samples that are
    not finite are left out; fewer than two give NaN. The same number of samples has the same draws.

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
        # How often each sample is drawn in each resample.
        times = rng.multinomial(count, np.full(count, 1 / count), min(_RESAMPLES_AT_A_TIME, num_resamples - done))
        shift = times @ centred / count
        variances.append((times @ squares - count * (shift**2).sum(axis=1)) / (count - 1))
    return np.quantile(np.concatenate(variances), [tail, 1 - tail])


class VarianceInterval(eqx.Module):
    """A variance, the trace of the covariance with N − 1, with the ends of its interval, and how that was found."""

    value: float
    ends: Float[np.ndarray, " 2"]
    method: Literal["chi_square", "bootstrap"] = eqx.field(static=True)


def variance_interval(
    samples: Float[np.ndarray, "samples dim"], confidence: float = 0.95, *, num_resamples: int = 1000
) -> VarianceInterval:
    """Give the interval of a total variance by the method that the samples deserve, and say which.

    Chi-square is exact for normal samples of one coordinate (with several the degrees of freedom follow from the
    eigenvalues of the covariance) and wrong for any others; the bootstrap assumes no distribution but needs samples. It
    is taken where there are at least 20 and a test of their kurtosis refuses the normal distribution in some coordinate
    (5 % over all of them).

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
    """Tell whether the kurtosis of some coordinate is not that of a normal distribution."""
    varied = samples[:, np.ptp(samples, axis=0) > 0]
    if len(samples) < _FEWEST_FOR_BOOTSTRAP or varied.shape[1] == 0:
        return False
    return bool(stats.kurtosistest(varied).pvalue.min() < 0.05 / varied.shape[1])


def checked(confidence: float) -> float:
    """Give the confidence of an interval back, refusing what is no chance."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    return confidence
