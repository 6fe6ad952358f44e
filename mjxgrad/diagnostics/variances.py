"""The interval of a variance, by the method that the samples deserve."""

from typing import Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import stats

from mjxgrad.diagnostics.statistics import bootstrap_variance_interval, checked, chi_square_variance_interval

Method = Literal["chi_square", "bootstrap"]

# Below this number a bootstrap knows too little of the tails, and a test of normality finds nothing.
_FEWEST_FOR_BOOTSTRAP = 20


class VarianceInterval(eqx.Module):
    """A variance with its interval, and how that was found.

    Attributes:
        value: the trace of the covariance, with N − 1.
        ends: lower and upper.
        method: "chi_square" or "bootstrap".
    """

    value: float
    ends: Float[np.ndarray, " 2"]
    method: Method = eqx.field(static=True)


def variance_interval(
    samples: Float[np.ndarray, "samples dim"],
    confidence: float = 0.95,
    *,
    method: Method | None = None,
    num_resamples: int = 1000,
    seed: int = 0,
) -> VarianceInterval:
    """Give the interval of a total variance by the method that the samples deserve, and say which.

    Chi-square is exact for normal samples of one coordinate (with several the degrees of freedom follow from the
    eigenvalues of the covariance) and wrong for any others; the bootstrap assumes no distribution but needs samples.

    Args:
        samples: independent; those that are not finite are left out.
        confidence: chance to cover the truth.
        method: None takes the bootstrap where there are at least 20 samples and a test of their kurtosis refuses the
            normal distribution in some coordinate (5 % over all of them), else chi-square.
        num_resamples: of the bootstrap.
        seed: of the bootstrap.

    Returns:
        The variance, its interval and the method; NaN for fewer than two finite samples.

    Raises:
        ValueError: if `confidence` is not between 0 and 1, or `method` is none of the choices.
    """
    checked(confidence)
    if method not in (None, *get_args(Method)):
        raise ValueError(f"method must be one of {', '.join(map(repr, get_args(Method)))} or None, got {method!r}")
    samples = np.asarray(samples, float)
    samples = samples[np.isfinite(samples).all(axis=1)]
    if len(samples) < 2:
        return VarianceInterval(np.nan, np.full(2, np.nan), method or "chi_square")
    method = method or ("bootstrap" if _has_other_tails(samples) else "chi_square")
    covariance = np.atleast_2d(np.cov(samples, rowvar=False))
    total = float(np.trace(covariance))
    if method == "bootstrap":
        ends = bootstrap_variance_interval(samples, confidence, num_resamples=num_resamples, seed=seed)
        return VarianceInterval(total, ends, method)
    squares = (covariance**2).sum()
    freedom = (len(samples) - 1) * (total**2 / squares if squares > 0 else 1.0)
    return VarianceInterval(total, chi_square_variance_interval(total, freedom + 1, confidence), method)


def _has_other_tails(samples: Float[np.ndarray, "samples dim"]) -> bool:
    """Tell whether the kurtosis of some coordinate is not that of a normal distribution."""
    varied = samples[:, np.ptp(samples, axis=0) > 0]
    if len(samples) < _FEWEST_FOR_BOOTSTRAP or varied.shape[1] == 0:
        return False
    return bool(stats.kurtosistest(varied).pvalue.min() < 0.05 / varied.shape[1])
