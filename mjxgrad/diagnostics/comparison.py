"""Comparison of estimators at an equal number of rollouts or equal time."""

import dataclasses
import functools
import math
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from mjxgrad.diagnostics.bias_variance import map_in_chunks
from mjxgrad.diagnostics.statistics import bias_interval, checked, root_mean_square_interval, variance_interval
from mjxgrad.estimators.estimate import Estimator, GradientEstimate
from mjxgrad.objective import Objective, as_vector, flattened

# Rollouts at a time over all repetitions that run together: enough to fill a CPU's vector units.
_ROLLOUTS_AT_A_TIME = 4096
# An estimator may refuse a number of samples (odd ones, say) and take the next smaller one.
_NEIGHBOURS = 3
# Time grows nearly linearly, so a line through two measurements hits at the second or third try.
_CORRECTIONS = 4
_FEWEST_TIMED = 4
_MOST_SAMPLES = 1_000_000  # upper end of the search, for very cheap samples


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """A budget of rollouts per estimate, as the estimate itself counts them; at least 2."""

    count: int

    def __post_init__(self):
        if self.count < 2:
            raise ValueError(f"count must be at least 2 rollouts, got {self.count}")


@dataclasses.dataclass(frozen=True)
class Seconds:
    """A budget of wall time per compiled estimate: the median over repeated runs at each number of samples."""

    seconds: float
    num_runs: int = 7

    def __post_init__(self):
        if not 0 < self.seconds < math.inf:
            raise ValueError(f"seconds must be positive and finite, got {self.seconds}")
        if self.num_runs < 1:
            raise ValueError(f"num_runs must be at least 1, got {self.num_runs}")


class Affordable(NamedTuple):
    """The number of samples that a budget allows, and the median time of one such estimate; NaN if it was not measured."""

    num_samples: int
    seconds: float


class Comparison(eqx.Module):
    r"""The results of `compare`, one row per estimator in the order of `names`.

    All numbers concern the whole estimate, not a single sample. The first axis of an interval holds its lower and upper end.

    Attributes:
        names: names of the estimators.
        num_samples: number of samples requested from each estimator.
        num_rollouts: number of rollouts that one estimate reports, at most the budget.
        num_gradient_rollouts: number of differentiated rollouts among them.
        seconds: median time of one compiled estimate; NaN for a budget of rollouts.
        num_repeats: number of estimates per estimator.
        num_finite: number of finite estimates; all fields below use these alone.
        finite_fraction: mean share of finite samples within the finite estimates.
        mean: mean estimate.
        bias: mean less reference.
        bias_interval: Welch's interval, with the reference's own error.
        rmse: root-mean-square distance to the truth, corrected for the reference's variance.
        rmse_interval: interval of `rmse`, see `root_mean_square_interval`.
        variance: trace of the covariance of the estimates.
        variance_interval: interval of the variance.
        variance_methods: method of each variance interval, "chi_square" or "bootstrap".
        claimed_variance: mean variance claimed by the estimates, the sum of their squared standard errors; an honest
            estimator has it equal to `variance`.
        reference: the true gradient.
        reference_error: standard error of the reference.
        confidence: coverage of every interval.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    num_samples: Int[np.ndarray, " estimators"]
    num_rollouts: Int[np.ndarray, " estimators"]
    num_gradient_rollouts: Int[np.ndarray, " estimators"]
    seconds: Float[np.ndarray, " estimators"]
    num_repeats: int = eqx.field(static=True)
    num_finite: Int[np.ndarray, " estimators"]
    finite_fraction: Float[np.ndarray, " estimators"]
    mean: Float[np.ndarray, "estimators dim"]
    bias: Float[np.ndarray, "estimators dim"]
    bias_interval: Float[np.ndarray, "2 estimators dim"]
    rmse: Float[np.ndarray, " estimators"]
    rmse_interval: Float[np.ndarray, "2 estimators"]
    variance: Float[np.ndarray, " estimators"]
    variance_interval: Float[np.ndarray, "2 estimators"]
    variance_methods: tuple[str, ...] = eqx.field(static=True)
    claimed_variance: Float[np.ndarray, " estimators"]
    reference: Float[np.ndarray, " dim"]
    reference_error: Float[np.ndarray, " dim"]
    confidence: float = eqx.field(static=True)

    @property
    def is_biased(self) -> Bool[np.ndarray, " estimators"]:
        """Whether the bias interval of some coordinate excludes zero; with many coordinates some do by chance."""
        low, high = self.bias_interval
        return ((low > 0) | (high < 0)).any(axis=-1)


def compare(
    estimators: Mapping[str, Estimator],
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    budget: Rollouts | Seconds,
    reference: tuple[PyTree, PyTree] | PyTree,
    num_repeats: int = 200,
    confidence: float = 0.95,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Measure root-mean-square error, bias and variance of estimators under an equal budget.

    Each estimator gets the largest `num_samples` whose reported rollouts, or measured time, stay within the budget. Its
    repetitions are independent and run in one compiled program. A later call with the same estimator and shapes reuses that
    program. All estimators share the same keys, which reduces chance differences.

    Args:
        estimators: estimators by name; each is called like `mjxgrad.estimators.zeroth_order`. Bind settings by
            `functools.partial`.
        objective: the objective to differentiate.
        params: the point: a vector, or a pytree whose floating-point arrays the comparison then has as one vector.
        key: consumed here.
        budget: `Rollouts(count)` or `Seconds(seconds)` for one estimate.
        reference: the true gradient, in the form of `params`, and its standard error; or the gradient alone if it is exact (a
            closed form). The error must be well known, from many more samples than an estimate has.
        num_repeats: number of estimates per estimator. At least 2.
        confidence: coverage of the intervals.
        progress: called after every estimator with the number done and the total.

    Returns:
        The comparison. Estimates that are not finite are counted and left out.

    Raises:
        ValueError: if there is no estimator, the budget buys no estimate of one, fewer than two of its estimates are
            finite, shapes do not fit, or a number is out of range.

    Example:
        >>> compare(
        ...     {"first": first_order, "pairs": functools.partial(zeroth_order, antithetic=True)},
        ...     objective, params, key, budget=Rollouts(100), reference=(truth, standard_error),
        ... )
    """
    checked(confidence)
    if not estimators:
        raise ValueError("estimators must have at least one entry, got none")
    if num_repeats < 2:
        raise ValueError(f"num_repeats must be at least 2, got {num_repeats}")
    objective, params, _ = as_vector(objective, params)
    truth, error = _reference(reference, params.shape)
    timing_key, repeats_key = jax.random.split(key)
    rows = []
    for name, estimator in estimators.items():
        try:
            bought = affordable(estimator, objective, params, timing_key, budget)
        except ValueError as refusal:
            raise ValueError(f"{name}: {refusal}") from refusal
        at_a_time = max(1, min(num_repeats, _ROLLOUTS_AT_A_TIME // bought.num_samples))
        estimates = _repeat(
            estimator, objective, params, jax.random.split(repeats_key, num_repeats), bought.num_samples, at_a_time
        )
        rows.append(_row(name, jax.tree.map(np.asarray, estimates), bought, truth, error, confidence))
        if progress is not None:
            progress(len(rows), len(estimators))
    columns = {name: np.stack([np.asarray(row[name]) for row in rows]) for name in rows[0]}
    intervals = {name: np.moveaxis(columns.pop(name), 1, 0) for name in list(columns) if name.endswith("interval")}
    methods = tuple(str(method) for method in columns.pop("variance_methods"))
    return Comparison(
        names=tuple(estimators),
        num_repeats=num_repeats,
        variance_methods=methods,
        reference=truth,
        reference_error=error,
        confidence=confidence,
        **columns,
        **intervals,
    )


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
    name: str,
    estimates: GradientEstimate,
    bought: Affordable,
    truth: Float[np.ndarray, " dim"],
    error: Float[np.ndarray, " dim"],
    confidence: float,
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
    rmse, rmse_ends = root_mean_square_interval(
        ((values - truth) ** 2).sum(axis=1),
        confidence,
        reference_variance=(error**2).sum(),
        cross_variance=(4 * (bias * error) ** 2 + 2 * error**4).sum(),
    )
    spread_interval = variance_interval(values, confidence)
    return {
        "num_samples": bought.num_samples,
        "num_rollouts": estimates.num_rollouts.flat[0],
        "num_gradient_rollouts": estimates.num_gradient_rollouts.flat[0],
        "seconds": bought.seconds,
        "num_finite": count,
        "finite_fraction": float((estimates.num_finite / estimates.num_samples)[is_finite].mean()),
        "mean": mean,
        "bias": bias,
        "bias_interval": bias_interval(mean, spread / np.sqrt(count), count, truth, error, confidence=confidence),
        "rmse": rmse,
        "rmse_interval": rmse_ends,
        "variance": spread_interval.value,
        "variance_interval": spread_interval.ends,
        "variance_methods": spread_interval.method,
        "claimed_variance": float((np.asarray(estimates.standard_error, float)[is_finite] ** 2).sum(axis=1).mean()),
    }


def _reference(
    reference: tuple[PyTree, PyTree] | PyTree, shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
    both = reference if isinstance(reference, tuple) else (reference, 0.0)
    value, error = (np.asarray(flattened(one)[0], float) for one in both)
    # One number is enough for one parameter.
    value = value.reshape(shape) if value.shape == () and shape == (1,) else value
    if value.shape != shape or error.shape not in ((), shape):
        raise ValueError(
            f"reference must have the shape {shape} of params, got {value.shape} with an error of shape {error.shape}; "
            "pass (value, standard_error), or the value alone if it is exact"
        )
    error = np.broadcast_to(error, shape)
    if not np.isfinite(value).all() or not (error >= 0).all():
        raise ValueError(f"reference must be finite with errors of at least 0, got {value} ± {error}")
    return value, error


def affordable(
    estimator: Estimator,
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    budget: Rollouts | Seconds,
) -> Affordable:
    """Return the largest number of samples within a budget: rollouts are counted by tracing, seconds measured by running."""
    run = functools.partial(_estimate, estimator, objective, params, key)
    if isinstance(budget, Rollouts):
        return Affordable(_within_rollouts(run, budget.count), math.nan)
    return _within_seconds(run, budget)


def _within_rollouts(run: Callable[..., Any], count: int) -> int:
    def reported(num_samples: int) -> int:  # XLA drops all but the count as dead code
        return int(run(num_samples, True))

    num_samples, rollouts = _accepted(reported, count)
    while rollouts > count:
        # Proportional, since an estimator may roll out several times per sample.
        fewer = min(num_samples - 1, num_samples * count // rollouts)
        num_samples, rollouts = _accepted(reported, fewer, f"budget of {count} rollouts buys no estimate; ")
    return num_samples


def _within_seconds(run: Callable[..., Any], budget: Seconds) -> Affordable:
    def timed(num_samples: int) -> float:
        runs = []
        for _ in range(1 + budget.num_runs):
            start = time.perf_counter()
            jax.block_until_ready(run(num_samples, False))
            runs.append(time.perf_counter() - start)
        # The first run compiled.
        return statistics.median(runs[1:])

    low, low_time = _accepted(timed, _FEWEST_TIMED)
    if low_time > budget.seconds:
        raise ValueError(
            f"budget of {budget.seconds:g} s buys no estimate: {low} samples take {low_time:.3g} s; give more seconds"
        )
    high, high_time = low, low_time
    while high_time <= budget.seconds and high < _MOST_SAMPLES:
        low, low_time = high, high_time
        high, high_time = _accepted(timed, min(8 * high, _MOST_SAMPLES))
    if high_time <= budget.seconds:
        return Affordable(high, high_time)
    for _ in range(_CORRECTIONS):
        slope = max((high_time - low_time) / (high - low), 1e-12)
        guess = int(low + (budget.seconds - low_time) / slope)
        guess = min(max(guess, low + 1), high - 1)
        if guess - low <= low // 50:  # within the accuracy of the clock
            break
        tried, seconds = _accepted(timed, guess)
        if seconds <= budget.seconds:
            low, low_time = max((low, low_time), (tried, seconds))
        else:
            high, high_time = tried, seconds
    return Affordable(low, low_time)


@eqx.filter_jit
def _estimate(
    estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, num_samples: int, is_counted: bool
) -> GradientEstimate | Int[Array, ""]:
    estimate = estimator(objective, params, key, num_samples=num_samples)
    return estimate.num_rollouts if is_counted else estimate


def _accepted(measure: Callable[[int], Any], num_samples: int, context: str = "") -> tuple[int, Any]:
    """Measure at a number of samples, or at the next smaller one that the estimator accepts."""
    refusal = ValueError(f"num_samples must be positive, got {num_samples}")
    for candidate in range(num_samples, max(num_samples - _NEIGHBOURS, 0), -1):
        try:
            return candidate, measure(candidate)
        except ValueError as error:
            refusal = error
    raise ValueError(f"{context}{refusal}") from refusal
