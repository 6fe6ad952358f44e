"""The horizon beyond which zeroth order is as good as first."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from mjxgrad.diagnostics.statistics import checked


class Crossover(eqx.Module):
    """The horizon from which the second estimator is at least as good as the first.

    Attributes:
        horizon: interpolated horizon; infinite if there is no crossing, the first horizon if it is so from the beginning.
        low: lower end of its interval.
        high: upper end, infinite if resamples do not reach it.
        log_ratio: logarithm of the first estimator's mean squared error over the second's.
    """

    horizon: float
    low: float
    high: float
    log_ratio: Float[np.ndarray, " horizons"]


def crossover(
    horizons: Float[np.ndarray, " horizons"],
    first: Float[np.ndarray, "repeats horizons"],
    second: Float[np.ndarray, "repeats horizons"],
    *,
    confidence: float = 0.95,
    num_resamples: int = 1000,
) -> Crossover:
    """Find the last crossing of two estimators' mean squared errors, with a bootstrap interval over repeats.

    The crossing follows the last horizon at which the first estimator is better, so brief draws before it do not count. The
    logarithm of the error ratio is interpolated between horizons.

    Args:
        horizons: the horizons, increasing, in any unit.
        first: squared errors of repeated estimates by the first estimator.
        second: squared errors by the second estimator, as many; repeats of both are resampled together, since they may share
            rollouts.
        confidence: coverage of the interval.
        num_resamples: number of bootstrap resamples.

    Returns:
        The horizon and its interval.

    Raises:
        ValueError: if shapes differ, horizons do not increase, there are fewer than two repeats, or `confidence` is not
            between 0 and 1.
    """
    tail = (1 - checked(confidence)) / 2
    if first.shape != second.shape or first.shape[1:] != horizons.shape or len(first) < 2:
        raise ValueError(
            "first and second must hold at least two repeats of one number per horizon, got shapes "
            f"{first.shape} and {second.shape} for {len(horizons)} horizons"
        )
    if not (np.diff(horizons) > 0).all():
        raise ValueError(f"horizons must increase, got {horizons.tolist()}")
    log_ratio = _log_ratio(first.mean(axis=0), second.mean(axis=0))
    draws = np.random.default_rng(0).integers(len(first), size=(num_resamples, len(first)))
    found = [_last_crossing(horizons, _log_ratio(first[one].mean(axis=0), second[one].mean(axis=0))) for one in draws]
    # Without interpolation, since infinity minus infinity is NaN.
    low, high = np.quantile(found, [tail, 1 - tail], method="nearest")
    return Crossover(_last_crossing(horizons, log_ratio), float(low), float(high), log_ratio)


def _log_ratio(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    # Two errors of zero are equal.
    tiny = np.finfo(float).tiny
    return np.log(np.maximum(first, tiny)) - np.log(np.maximum(second, tiny))


def _last_crossing(horizons: np.ndarray, log_ratio: np.ndarray) -> float:
    is_better = log_ratio < 0
    if not is_better.any():
        return float(horizons[0])
    last = int(np.flatnonzero(is_better)[-1])
    if last == len(horizons) - 1:
        return np.inf
    below, above = log_ratio[last], log_ratio[last + 1]
    return float(horizons[last] - below / (above - below) * (horizons[last + 1] - horizons[last]))
