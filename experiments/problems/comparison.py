"""Comparison of estimators of one number at an equal number of rollouts, with intervals for errors and biases."""

from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray
from scipy import stats

from mjxgrad.diagnostics import mean_interval
from mjxgrad.diagnostics.bias_variance import map_in_chunks
from mjxgrad.diagnostics.statistics import checked
from mjxgrad.estimators.estimate import Estimator, GradientEstimate
from mjxgrad.objective import Objective

# Rollouts at a time over all repetitions that run together: enough to fill a CPU's vector units.
_ROLLOUTS_AT_A_TIME = 4096


def compare(
    estimators: Mapping[str, Estimator],
    objective: Objective,
    params: Float[Array, " 1"],
    key: PRNGKeyArray,
    *,
    budget: int,
    reference: float,
    num_repeats: int = 200,
    confidence: float = 0.95,
) -> xr.Dataset:
    """Measure root-mean-square error, bias and variance of estimates whose number of rollouts is within a budget.

    All estimators share the same keys, which reduces chance differences. The result is by `estimator`, of whole estimates, not
    samples; those that are not finite are left out. It has the `num_samples` that were asked for, the `num_rollouts` that one
    estimate reports, `num_finite` estimates; their `mean`, its `bias` and the `rmse`, the last two with `_low` and `_high` of
    their intervals; their `variance`, and the `claimed_variance`, the mean squared standard error of the estimates, which an
    honest estimator has equal to `variance`.
    """
    timing_key, repeats_key = jax.random.split(key)
    rows = []
    for name, estimator in estimators.items():
        num_samples = affordable(estimator, objective, params, timing_key, budget)
        at_a_time = max(1, min(num_repeats, _ROLLOUTS_AT_A_TIME // num_samples))
        keys = jax.random.split(repeats_key, num_repeats)
        found = over_keys(estimator, objective, params, keys, num_samples, at_a_time=at_a_time)
        estimates = jax.tree.map(np.asarray, found)
        rows.append({"num_samples": num_samples, **_row(name, estimates, reference, confidence)})
    return xr.Dataset(
        {name: ("estimator", [row[name] for row in rows]) for name in rows[0]}, {"estimator": [*estimators]}
    )


@eqx.filter_jit
def over_keys(
    estimator: Estimator,
    objective: Objective,
    params: Float[Array, " dim"],
    keys: Key[Array, " repeats"],
    num_samples: int,
    *,
    at_a_time: int = 1,
) -> GradientEstimate:
    """Return an estimate for each key, in one program; some at a time."""
    return map_in_chunks(lambda key: estimator(objective, params, key, num_samples=num_samples), keys, at_a_time)


def _row(name: str, estimates: GradientEstimate, truth: float, confidence: float) -> dict[str, float]:
    """Compute all columns for one estimator."""
    is_finite = np.isfinite(estimates.value[:, 0])
    count = int(is_finite.sum())
    if count < 2:
        raise ValueError(
            f"{name} must give at least 2 finite estimates, got {count} of {is_finite.size}: its rollouts, or their "
            "derivatives, are not finite; more samples or another estimator may help"
        )
    values, claimed = (np.asarray(x, float)[is_finite, 0] for x in (estimates.value, estimates.standard_error))
    found = {"num_rollouts": int(estimates.num_rollouts.flat[0]), "num_finite": count, "mean": values.mean()}
    found |= {"variance": values.var(ddof=1), "claimed_variance": np.mean(claimed**2)}
    bias = values.mean() - truth
    rmse, (rmse_low, rmse_high) = root_mean_square_interval((values - truth) ** 2, confidence)
    low, high = mean_interval(bias, values.std(ddof=1) / np.sqrt(count), count, confidence)
    found |= {"bias": bias, "bias_low": low, "bias_high": high}
    return found | {"rmse": rmse, "rmse_low": rmse_low, "rmse_high": rmse_high}


def affordable(
    estimator: Estimator, objective: Objective, params: Float[Array, " dim"], key: PRNGKeyArray, budget: int
) -> int:
    """Return the largest number of samples within a budget of rollouts, as the estimator itself counts them."""
    num_samples, refusal = budget, None
    while num_samples > 0:
        try:
            spent = int(_num_rollouts(estimator, objective, params, key, num_samples))
        except ValueError as error:  # of odd ones, say: the next smaller one may do
            num_samples, refusal = num_samples - 1, error
            continue
        if spent <= budget:
            return num_samples
        # Proportional, since an estimator may roll out several times per sample.
        num_samples = min(num_samples - 1, num_samples * budget // spent)
    raise ValueError(f"budget of {budget} rollouts buys no estimate; {refusal}") from refusal


@eqx.filter_jit
def _num_rollouts(
    estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, num_samples: int
) -> Int[Array, ""]:
    # XLA drops all but the count as dead code.
    return estimator(objective, params, key, num_samples=num_samples).num_rollouts


def root_mean_square_interval(
    squared_errors: Float[np.ndarray, "*batch repeats"],
    confidence: float = 0.95,
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "2 *batch"]]:
    r"""Return the root-mean-square error of an estimate from its repetitions, with an interval.

    The mean squared error is positive and skewed. Its interval is that of a gamma distribution with equal mean and variance
    (a chi-square with Satterthwaite's degrees of freedom). For one unbiased normal coordinate with known kurtosis it is exact.
    Where a bias dominates it becomes the usual normal interval.

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
