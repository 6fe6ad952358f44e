"""How many samples an estimator can afford: by rollouts that it reports, or by time that it takes."""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mjxgrad.estimators.estimate import GradientEstimate
from mjxgrad.objective import Objective

# Numbers of samples that an estimator refuses (odd ones, say) lie between ones that it takes.
_NEIGHBOURS = 3
# Time grows nearly linearly, so a line through two measurements hits at the second or third try.
_CORRECTIONS = 4
_FEWEST_TIMED = 4


# Called as (objective, params, key, *, num_samples), which is what every function of mjxgrad.estimators is; settings are
# bound by functools.partial.
Estimator = Callable[..., GradientEstimate]


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """A budget of rollouts per estimate, those that the estimate itself reports.

    Attributes:
        count: at most; at least 2.
    """

    count: int

    def __post_init__(self):
        if self.count < 2:
            raise ValueError(f"count must be at least 2 rollouts, got {self.count}")


@dataclasses.dataclass(frozen=True)
class Seconds:
    """A budget of wall time per estimate, compiled and warm.

    Attributes:
        seconds: at most, as the median of the runs.
        num_runs: timed runs per number of samples that is tried.
        max_samples: where the search ends, however cheap samples are.
    """

    seconds: float
    num_runs: int = 7
    max_samples: int = 1_000_000

    def __post_init__(self):
        if not 0 < self.seconds < math.inf:
            raise ValueError(f"seconds must be positive and finite, got {self.seconds}")
        if self.num_runs < 1:
            raise ValueError(f"num_runs must be at least 1, got {self.num_runs}")


@dataclasses.dataclass(frozen=True)
class Affordable:
    """What a budget buys.

    Attributes:
        num_samples: to ask an estimator for.
        seconds: median time of one such estimate, NaN if it was not measured.
    """

    num_samples: int
    seconds: float


def affordable(
    estimator: Estimator,
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    budget: Rollouts | Seconds,
) -> Affordable:
    """Find the largest number of samples within a budget.

    Args:
        estimator: whose cost counts.
        objective: to estimate the gradient of.
        params: where.
        key: of the timed runs.
        budget: rollouts, found out by tracing alone, or seconds, found out by running.

    Returns:
        The number and the time.

    Raises:
        ValueError: if the budget buys no estimate, or the estimator refuses every number of samples.
    """
    if isinstance(budget, Rollouts):
        return Affordable(_within_rollouts(estimator, objective, params, key, budget.count), math.nan)
    return _within_seconds(estimator, objective, params, key, budget)


def _within_rollouts(estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, count: int) -> int:
    def reported(num_samples: int) -> int:
        return int(_reported_rollouts(estimator, objective, params, key, num_samples))

    num_samples, rollouts = _accepted(reported, count)
    while rollouts > count:
        # In proportion, for an estimator may roll out several times per sample.
        fewer = min(num_samples - 1, num_samples * count // rollouts)
        num_samples, rollouts = _accepted(reported, fewer, f"budget of {count} rollouts buys no estimate; ")
    return num_samples


def _within_seconds(
    estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, budget: Seconds
) -> Affordable:
    def timed(num_samples: int) -> float:
        runs = []
        for _ in range(1 + budget.num_runs):
            start = time.perf_counter()
            jax.block_until_ready(_estimate(estimator, objective, params, key, num_samples))
            runs.append(time.perf_counter() - start)
        # The first run compiled.
        return statistics.median(runs[1:])

    low, low_time = _accepted(timed, _FEWEST_TIMED)
    if low_time > budget.seconds:
        raise ValueError(
            f"budget of {budget.seconds:g} s buys no estimate: {low} samples take {low_time:.3g} s; give more seconds"
        )
    high, high_time = low, low_time
    while high_time <= budget.seconds and high < budget.max_samples:
        low, low_time = high, high_time
        high, high_time = _accepted(timed, min(8 * high, budget.max_samples))
    if high_time <= budget.seconds:
        return Affordable(high, high_time)
    for _ in range(_CORRECTIONS):
        slope = max((high_time - low_time) / (high - low), 1e-12)
        guess = int(low + (budget.seconds - low_time) / slope)
        guess = min(max(guess, low + 1), high - 1)
        if guess - low <= low // 50:  # nearer than a clock can tell
            break
        tried, seconds = _accepted(timed, guess)
        if seconds <= budget.seconds:
            low, low_time = max((low, low_time), (tried, seconds))
        else:
            high, high_time = tried, seconds
    return Affordable(low, low_time)


@eqx.filter_jit
def _reported_rollouts(
    estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, num_samples: int
) -> Int[Array, ""]:
    # All but the count is dead code, which is dropped before anything is compiled.
    return estimator(objective, params, key, num_samples=num_samples).num_rollouts


@eqx.filter_jit
def _estimate(
    estimator: Estimator, objective: Objective, params: Array, key: PRNGKeyArray, num_samples: int
) -> GradientEstimate:
    return estimator(objective, params, key, num_samples=num_samples)


def _accepted(measure: Callable[[int], Any], num_samples: int, context: str = "") -> tuple[int, Any]:
    """Measure at a number of samples, or at the next smaller one that the estimator takes."""
    refusal = ValueError(f"num_samples must be positive, got {num_samples}")
    for candidate in range(num_samples, max(num_samples - _NEIGHBOURS, 0), -1):
        try:
            return candidate, measure(candidate)
        except ValueError as error:
            refusal = error
    raise ValueError(f"{context}{refusal}") from refusal
