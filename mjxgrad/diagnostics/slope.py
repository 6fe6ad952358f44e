r"""Comparison of derivatives of a simulated outcome with the slope of the outcome itself.

A simulated outcome depends on the phase of each contact within its time step. Along a parameter it is therefore a smooth
trend plus a sawtooth. A short difference quotient measures a tooth's flank, and so does the derivative of the discrete map.
The motion, and every cost averaged over a little noise, follows the trend. Here the outcome is simulated at many parameters
over an interval with many teeth, and the trend's slope is compared with the mean derivative over the same interval.

Both are averages with the same weight. A straight line fitted with weights $W(u) = 1 - u^2$, $u \in (-1, 1)$ being the
place in the interval, has the slope

$$\frac{\int u W f}{\int u^2 W} = \int k f', \qquad k(u) = \tfrac{15}{16} (1 - u^2)^2,$$

integrating by parts, since $k' = -\tfrac{15}{4} u W$ and $k$ vanishes at the ends. Wherever the outcome is smooth, the slope
equals its mean derivative with weight $k$ for any curvature. They differ by the jumps, which derivatives do not see. The
smooth weight also averages over teeth: it vanishes at the ends, where teeth are cut.
"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

_FEWEST_PHASES = 32  # for eight blocks of the error bar
_POINTS_PER_BLOCK = 4
_MOST_BLOCKS = 24
_DEGREE = 7  # of the trend beside which few derivatives are seen
_ROUNDINGS = 1e3  # rounding errors of the outcome that many steps may add up


class SlopeComparison(eqx.Module):
    """Derivatives beside the slope, in units of the outcome over those of the parameter.

    With fewer than 32 finite outcomes, numbers are NaN and `is_resolved` is False. A derivative may be known, that is finite, at
    some phases alone, at least 8 that are about evenly spread; then its mean is that beside a trend of the outcomes.

    Attributes:
        gradients: names of the derivatives, in the order of their axis.
        parameters: parameters of the simulated outcomes, increasing.
        outcomes: the simulated outcomes.
        derivatives: the derivatives at each phase.
        slope: slope of the simulated outcome, fitted over the interval.
        slope_error: standard error of the slope. Conservative where many phases share a tooth, for their errors then cancel.
        mean: mean of each derivative over the interval, weighted like the slope.
        mean_error: standard error of the mean.
        standard_error: standard error of `error`, the smaller of two that are too large rather than too small: both parts' own,
            and that of what the derivative leaves of changes between neighbours, where curvature that both share does not count.
        spread: standard deviation of each derivative over the phases.
        num_teeth: half the number of crossings of the outcome with its trend: about the number of teeth in the interval.
        num_finite: number of phases with a finite outcome and derivative, of the derivative that is known at most of them.
        resolution: error of the slope by rounding of the outcome; smaller errors mean nothing.
    """

    gradients: tuple[str, ...] = eqx.field(static=True)
    parameters: Float[np.ndarray, " phases"]
    outcomes: Float[np.ndarray, "phases *outcome"]
    derivatives: Float[np.ndarray, "gradients phases *outcome"]
    slope: Float[np.ndarray, "*outcome"]
    slope_error: Float[np.ndarray, "*outcome"]
    mean: Float[np.ndarray, "gradients *outcome"]
    mean_error: Float[np.ndarray, "gradients *outcome"]
    standard_error: Float[np.ndarray, "gradients *outcome"]
    spread: Float[np.ndarray, "gradients *outcome"]
    num_teeth: Float[np.ndarray, "*outcome"]
    num_finite: Int[np.ndarray, "*outcome"]
    resolution: Float[np.ndarray, "*outcome"]

    @property
    def error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Mean of each derivative less the slope."""
        return self.mean - self.slope

    @property
    def scale(self) -> Float[np.ndarray, "*outcome"]:
        """The unit of errors: the larger of the slope and the error of the first derivative named."""
        # Where both are mere rounding, no error must look large relative to it.
        return np.asarray(np.maximum(np.maximum(np.abs(self.slope), np.abs(self.error[0])), self.resolution))

    @property
    def relative_error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Size of `error` beyond rounding, over `scale`."""
        size = np.abs(self.error)
        return np.where(size > self.resolution, size, 0 * size) / self.scale

    def is_resolved(self, tolerance: float = 0.05) -> Bool[np.ndarray, "*outcome"]:
        """Return whether the slope is known well enough: its standard error is below `tolerance` times `scale`."""
        return np.asarray(self.slope_error <= np.maximum(tolerance * self.scale, self.resolution))


def phases(interval: tuple[float, float], num_phases: int) -> Float[np.ndarray, " phases"]:
    """Return parameters spread over an interval, one at a random place in each of equal parts.

    Evenly spaced ones might all have the same phase within the time step. For some lengths of tooth so might regular
    displacements (multiples of the golden ratio). The places are the same in every call, and increase.

    Raises:
        ValueError: if the interval is empty or `num_phases` is below 32.
    """
    low, high = interval
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"interval must be two finite numbers, the smaller one first, got {interval}")
    if num_phases < _FEWEST_PHASES:
        raise ValueError(f"num_phases must be at least {_FEWEST_PHASES}, got {num_phases}: fewer give no error bar")
    places = np.random.default_rng(0).uniform(size=num_phases)
    return low + (high - low) * (np.arange(num_phases) + places) / num_phases


def compare_to_slope(
    parameters: ArrayLike,
    outcomes: ArrayLike,
    derivatives: Sequence[ArrayLike],
    gradients: Sequence[str] = ("discrete", "slope"),
) -> SlopeComparison:
    """Compare given derivatives, for each named gradient one per outcome, with the slope of the outcomes.

    The parameters increase and are about evenly spaced, as `phases` returns them.

    Raises:
        ValueError: if shapes do not fit, parameters do not increase or there are fewer than 32.
    """
    x, y = np.asarray(parameters, float), np.asarray(outcomes)
    y, epsilon = y.astype(float), np.finfo(y.dtype if np.issubdtype(y.dtype, np.floating) else float).eps
    slopes = np.array([np.asarray(one, float) for one in derivatives])
    if slopes.shape != (len(gradients), *y.shape) or x.shape != y.shape[:1]:
        expected = f"of the shape of outcomes, for each of {len(gradients)} gradients and {len(x)} parameters"
        raise ValueError(f"derivatives must hold one array {expected}, got {slopes.shape} beside {y.shape}")
    if len(x) < _FEWEST_PHASES or not (np.diff(x) > 0).all():
        raise ValueError(f"parameters must be at least {_FEWEST_PHASES} and increase, got {len(x)}")
    width = (x[-1] - x[0]) * len(x) / (len(x) - 1)
    place = (x - (x[0] + x[-1]) / 2) / (width / 2)
    flat, flat_slopes = y.reshape(len(x), -1), slopes.reshape(len(slopes), len(x), -1)
    columns = [_column(place, width / 2, flat[:, j], flat_slopes[:, :, j]) for j in range(flat.shape[1])]
    stacked = {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}
    # Positive even for an outcome of zeros, since errors are divided by it.
    size = np.maximum(np.nanmax(np.abs(y), axis=0, initial=0), np.finfo(float).tiny)
    return SlopeComparison(
        **{name: part.reshape((*part.shape[:-1], *y.shape[1:])) for name, part in stacked.items()},
        gradients=tuple(gradients),
        parameters=x,
        outcomes=y,
        derivatives=slopes,
        resolution=np.asarray(_ROUNDINGS * epsilon * size / width),
    )


def _column(u: np.ndarray, half: float, y: np.ndarray, slopes: Float[np.ndarray, "gradients phases"]) -> dict[str, Any]:
    """Compare a single outcome over the interval (-1, 1), which is `half` times as wide in the parameter."""
    is_finite = np.isfinite(y)
    known = is_finite & np.isfinite(slopes)
    count = int(known.sum(axis=1).max(initial=0))
    if is_finite.sum() < _FEWEST_PHASES:
        nothing = dict.fromkeys(("mean", "mean_error", "standard_error", "spread"), np.full(len(slopes), np.nan))
        nothing |= dict.fromkeys(("slope", "slope_error", "num_teeth"), np.nan)
        return {**nothing, "num_finite": count}
    lever, _ = _weights(u[is_finite], half)
    # A trend of degree 3, since curvature is no error of the slope.
    rest = _residuals(u[is_finite], y[is_finite], 1 - u[is_finite] ** 2, 3)
    slope_error = _clustered(lever * rest)
    # Where few derivatives are known, what they leave of the trend's tells more than they do.
    root = np.sqrt(1 - u[is_finite] ** 2)
    trend = np.polynomial.legendre.Legendre.fit(u[is_finite], y[is_finite], _DEGREE, [-1, 1], w=root)
    rise = lever @ trend(u[is_finite])
    beside, around = rise - trend.deriv()(u) / half, rise * half * u - trend(u)
    means = []
    for own, one in zip(known, slopes, strict=True):
        few = own.sum() < is_finite.sum()
        means.append(_mean(u[own], half, (y + few * around)[own], (one + few * beside)[own], slope_error))
    return {
        "slope": lever @ y[is_finite],
        "slope_error": slope_error,
        "num_teeth": np.count_nonzero(np.diff(np.signbit(rest))) / 2,
        "num_finite": count,
        **dict(zip(("mean", "mean_error", "standard_error", "spread"), np.transpose(means), strict=True)),
    }


def _weights(u: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of outcomes in the slope of the weighted line, and by parts those of secants between neighbours."""
    weight = 1 - u**2
    centred = u - (weight @ u) / weight.sum()
    lever = weight * centred / (weight @ centred**2) / half
    return lever, -np.cumsum(lever)[:-1] * half * np.diff(u)


def _mean(u: np.ndarray, half: float, y: np.ndarray, one: np.ndarray, slope_error: float) -> tuple[float, ...]:
    """Return a derivative's weighted mean, its error, that of its distance from the slope, and the spread."""
    if len(u) < 2 * _POINTS_PER_BLOCK:
        return math.nan, math.nan, math.nan, math.nan
    _, between = _weights(u, half)
    # Trapezoids of the secants' weights give the derivatives' mean.
    kernel, middles = (np.append(between, 0) + np.append(0, between)) / 2, (u[1:] + u[:-1]) / 2
    missed = _residuals(middles, (one[1:] + one[:-1]) / 2 - np.diff(y) / (half * np.diff(u)), between, 1)
    error = _clustered(kernel * _residuals(u, one, kernel, 1))
    apart = min(math.hypot(error, slope_error), _clustered(between * missed))
    return float(one @ kernel), error, apart, float(one.std(ddof=1))


def _residuals(u: np.ndarray, y: np.ndarray, weight: np.ndarray, degree: int) -> np.ndarray:
    """Return the leave-one-out residuals of a polynomial trend."""
    root = np.sqrt(np.maximum(weight, 0))
    basis, _ = np.linalg.qr(root[:, None] * np.polynomial.legendre.legvander(u, degree))
    leverage = (basis**2).sum(axis=1)
    fitted = basis @ (basis.T @ (root * y))
    return (y - fitted / np.where(root > 0, root, 1)) / (1 - leverage)


def _clustered(terms: np.ndarray) -> float:
    """Return the standard error of a sum of weighted residuals, clustered in blocks of neighbours.

    Neighbours on one tooth have correlated errors, so single residuals would understate it.

    References:
        Bell, McCaffrey. Bias reduction in standard errors for linear regression with multi-stage samples. Survey
        Methodology 28, 2002 (the jackknifed residuals).
    """
    blocks = np.array_split(terms, max(2, min(_MOST_BLOCKS, len(terms) // _POINTS_PER_BLOCK)))
    sums = np.array([block.sum() for block in blocks])
    return float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)))
