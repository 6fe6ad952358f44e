"""Comparison of estimators at an equal number of rollouts, with intervals for errors and biases."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray
from numpy.typing import ArrayLike
from scipy import stats

from mjxgrad.diagnostics.bias_variance import map_in_chunks
from mjxgrad.diagnostics.statistics import checked
from mjxgrad.estimators.estimate import Estimator, GradientEstimate
from mjxgrad.objective import Objective

# Rollouts at a time over all repetitions that run together: enough to fill a CPU's vector units.
_ROLLOUTS_AT_A_TIME = 4096
# An estimator may refuse a number of samples (odd ones, say) and take the next smaller one.
_NEIGHBOURS = 3


class Comparison(eqx.Module):
    """The results of `compare`, one row per estimator in the order of `names`; they concern whole estimates, not samples.

    Attributes:
        names: names of the estimators.
        num_samples: number of samples requested from each estimator.
        num_rollouts: number of rollouts that one estimate reports, at most the budget.
        num_finite: number of finite estimates; all fields below use these alone.
        mean: mean estimate.
        bias: mean less reference.
        bias_interval: lower and upper end of Student's interval.
        rmse: root-mean-square distance to the truth.
        rmse_interval: lower and upper end, see `root_mean_square_interval`.
        variance: trace of the covariance of the estimates.
        claimed_variance: mean variance claimed by the estimates, the sum of their squared standard errors; an honest
            estimator has it equal to `variance`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    num_samples: Int[np.ndarray, " estimators"]
    num_rollouts: Int[np.ndarray, " estimators"]
    num_finite: Int[np.ndarray, " estimators"]
    mean: Float[np.ndarray, "estimators dim"]
    bias: Float[np.ndarray, "estimators dim"]
    bias_interval: Float[np.ndarray, "2 estimators dim"]
    rmse: Float[np.ndarray, " estimators"]
    rmse_interval: Float[np.ndarray, "2 estimators"]
    variance: Float[np.ndarray, " estimators"]
    claimed_variance: Float[np.ndarray, " estimators"]


def compare(
    estimators: Mapping[str, Estimator],
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    budget: int,
    reference: ArrayLike,
    num_repeats: int = 200,
    confidence: float = 0.95,
) -> Comparison:
    """Measure root-mean-square error, bias and variance of estimators under an equal budget.

    Each estimator gets the largest `num_samples` whose reported rollouts stay within the budget. Its repetitions are
    independent and run in one compiled program. All estimators share the same keys, which reduces chance differences.

    Args:
        estimators: estimators by name; each is called like `mjxgrad.estimators.zeroth_order`. Bind settings by
            `functools.partial`.
        objective: the objective to differentiate.
        params: the point.
        key: consumed here.
        budget: rollouts of one estimate, as the estimate itself counts them. At least 2.
        reference: the true gradient, of the shape of `params`.
        num_repeats: number of estimates per estimator. At least 2.
        confidence: coverage of the intervals.

    Returns:
        The comparison. Estimates that are not finite are counted and left out.

    Raises:
        ValueError: if there is no estimator, the budget buys no estimate of one, fewer than two of its estimates are
            finite, shapes do not fit, or a number is out of range.
    """
    checked(confidence)
    if not estimators:
        raise ValueError("estimators must have at least one entry, got none")
    if num_repeats < 2:
        raise ValueError(f"num_repeats must be at least 2, got {num_repeats}")
    truth = np.asarray(reference, float)
    if truth.shape != params.shape or not np.isfinite(truth).all():
        raise ValueError(f"reference must be finite, of the shape {params.shape} of params, got {truth}")
    timing_key, repeats_key = jax.random.split(key)
    rows = []
    for name, estimator in estimators.items():
        try:
            num_samples = affordable(estimator, objective, params, timing_key, budget)
        except ValueError as refusal:
            raise ValueError(f"{name}: {refusal}") from refusal
        at_a_time = max(1, min(num_repeats, _ROLLOUTS_AT_A_TIME // num_samples))
        keys = jax.random.split(repeats_key, num_repeats)
        estimates = jax.tree.map(np.asarray, _repeat(estimator, objective, params, keys, num_samples, at_a_time))
        rows.append({"num_samples": num_samples, **_row(name, estimates, truth, confidence)})
    columns = {name: np.stack([np.asarray(row[name]) for row in rows]) for name in rows[0]}
    intervals = {name: np.moveaxis(columns.pop(name), 1, 0) for name in list(columns) if name.endswith("interval")}
    return Comparison(names=tuple(estimators), **columns, **intervals)


@eqx.filter_jit
def _repeat(
    estimator: Estimator,
    objective: Objective,
    params: Float[Array, " dim"],
    keys: Key[Array, " repeats"],
    num_samples: int,
    at_a_time: int,
) -> GradientEstimate:
    return map_in_chunks(lambda key: estimator(objective, params, key, num_samples=num_samples), keys, at_a_time)


def _row(
    name: str, estimates: GradientEstimate, truth: Float[np.ndarray, " dim"], confidence: float
) -> dict[str, object]:
    """Compute all columns for one estimator."""
    is_finite = np.isfinite(estimates.value).all(axis=-1)
    count = int(is_finite.sum())
    if count < 2:
        raise ValueError(
            f"{name} must give at least 2 finite estimates, got {count} of {is_finite.size}: its rollouts, or their "
            "derivatives, are not finite; more samples or another estimator may help"
        )
    values = np.asarray(estimates.value, float)[is_finite]
    mean, spread = values.mean(axis=0), values.std(axis=0, ddof=1)
    bias = mean - truth
    rmse, rmse_ends = root_mean_square_interval(((values - truth) ** 2).sum(axis=1), confidence)
    return {
        "num_rollouts": estimates.num_rollouts.flat[0],
        "num_finite": count,
        "mean": mean,
        "bias": bias,
        "bias_interval": bias_interval(mean, spread / np.sqrt(count), count, truth, confidence=confidence),
        "rmse": rmse,
        "rmse_interval": rmse_ends,
        "variance": float((spread**2).sum()),
        "claimed_variance": float((np.asarray(estimates.standard_error, float)[is_finite] ** 2).sum(axis=1).mean()),
    }


def affordable(
    estimator: Estimator, objective: Objective, params: Float[Array, " dim"], key: PRNGKeyArray, budget: int
) -> int:
    """Return the largest number of samples within a budget of rollouts, as the estimator itself counts them."""
    if budget < 2:
        raise ValueError(f"budget must be at least 2 rollouts, got {budget}")

    def reported(num_samples: int) -> int:
        return int(_num_rollouts(estimator, objective, params, key, num_samples))

    num_samples, rollouts = _accepted(reported, budget)
    while rollouts > budget:
        # Proportional, since an estimator may roll out several times per sample.
        fewer = min(num_samples - 1, num_samples * budget // rollouts)
        num_samples, rollouts = _accepted(reported, fewer, f"budget of {budget} rollouts buys no estimate; ")
    return num_samples


@eqx.filter_jit
def _num_rollouts(
    estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, num_samples: int
) -> Int[Array, ""]:
    # XLA drops all but the count as dead code.
    return estimator(objective, params, key, num_samples=num_samples).num_rollouts


def _accepted(measure: Callable[[int], Any], num_samples: int, context: str = "") -> tuple[int, Any]:
    """Measure at a number of samples, or at the next smaller one that the estimator accepts."""
    refusal = ValueError(f"num_samples must be positive, got {num_samples}")
    for candidate in range(num_samples, max(num_samples - _NEIGHBOURS, 0), -1):
        try:
            return candidate, measure(candidate)
        except ValueError as error:
            refusal = error
    raise ValueError(f"{context}{refusal}") from refusal


def bias_interval(
    mean: ArrayLike,
    standard_error: ArrayLike,
    count: ArrayLike,
    reference: ArrayLike,
    reference_error: ArrayLike = 0.0,
    reference_count: ArrayLike = np.inf,
    confidence: float = 0.95,
) -> Float[np.ndarray, "2 *shape"]:
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
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "2 *batch"]]:
    r"""Return the root-mean-square error of an estimate from its repetitions, with an interval.

    The mean squared error is positive and skewed. Its interval is that of a gamma distribution with equal mean and variance
    (a chi-square with Satterthwaite's degrees of freedom). For one unbiased normal coordinate with known kurtosis it is exact.
    Where a bias dominates it becomes the usual normal interval.

    Args:
        squared_errors: squared distance of each repetition to the reference.
        confidence: coverage of the interval.

    Returns:
        The root-mean-square error, and the ends of its interval.

    Raises:
        ValueError: if `confidence` is not between 0 and 1.

    References:
        Satterthwaite. An approximate distribution of estimates of variance components. Biometrics Bulletin 2, 1946.
    """
    tail = (1 - checked(confidence)) / 2
    squared_errors = np.asarray(squared_errors, float)
    repeats = squared_errors.shape[-1]
    mean = squared_errors.mean(axis=-1)
    variance = squared_errors.var(axis=-1, ddof=1) / repeats
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = 2 * mean**2 / variance
        ends = [mean * freedom / stats.chi2.isf(tail, freedom), mean * freedom / stats.chi2.ppf(tail, freedom)]
    # All errors are equal up to rounding: the mean is known.
    ends = np.where(freedom < 1e12, ends, mean)
    return np.sqrt(mean), np.sqrt(ends)
