"""Sequential Monte Carlo search for motions that jump with every parameter.

Hard contacts chatter. Each switch of a contact makes the later motion jump, and the sum of squares has a minimum in every
cell between two jumps. Descent ends in the first of them. The first moments of a motion have few jumps and locate the
parameters roughly; later moments select among the points that remain. Many points therefore see the measurements one row
after the other.

References:
    Chopin. A sequential particle filter method for static models. Biometrika 89(3), 2002.
    Del Moral, Doucet, Jasra. Sequential Monte Carlo samplers. JRSS B 68(3), 2006 (steps of a size that keeps half of the
    points).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

_KEPT = 0.5  # effective share of the points that each step keeps
_MOVES = (1.2, 0.4, 0.13)  # step sizes as shares of the points' spread, from far to near
_BEYOND = 5.0  # largest misfit of the best point, in standard deviations of chi-square
_MOST_STEPS = 200

Sums = Float[np.ndarray, "points rows"]


def best_point(
    sums_at: Callable[[np.ndarray], Sums],
    lower: Float[np.ndarray, " dim"],
    upper: Float[np.ndarray, " dim"],
    counts: Float[np.ndarray, " rows"],
    num_points: int,
) -> Float[np.ndarray, " dim"] | None:
    """Return the point of least squares among those that survive all rows; None if none explains the measurements.

    Args:
        sums_at: function from points to their cumulative sums of squared residuals over the rows, in units of the noise.
        lower: least numbers, finite.
        upper: greatest numbers.
        counts: cumulative number of measurements over the rows.
        num_points: number of points that move side by side.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform(lower, upper, (num_points, len(lower)))
    sums, row = sums_at(points), 0.0
    for _ in range(_MOST_STEPS):
        row, weights = _advanced(sums, row)
        places = (np.arange(num_points) + rng.uniform()) / num_points
        chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), num_points - 1)
        points, sums = points[chosen], sums[chosen]
        spread = np.atleast_2d(np.cov(points.T)) + np.diag((1e-9 * (upper - lower)) ** 2)
        axes = np.linalg.cholesky(spread)
        for size in _MOVES:
            moved = points + size * rng.normal(size=points.shape) @ axes.T
            is_inside = ((moved >= lower) & (moved <= upper)).all(axis=1)
            found = sums_at(np.clip(moved, lower, upper))
            gain = 0.5 * (_at(sums, row) - _at(found, row))
            is_taken = is_inside & (np.log(rng.uniform(size=num_points)) < gain)
            points, sums = np.where(is_taken[:, None], moved, points), np.where(is_taken[:, None], found, sums)
        seen = counts[int(row) - 1] if row >= 1 else 0.0
        if _at(sums, np.floor(row)).min() > seen + _BEYOND * np.sqrt(2 * seen + 1):
            return None
        if row == len(counts):
            return points[np.argmin(sums[:, -1])]
    return None


def _at(sums: Sums, row: float) -> Float[np.ndarray, " points"]:
    """Return the cumulative sums up to a row number, interpolated within the last row."""
    whole = int(row)
    before = sums[:, whole - 1] if whole else np.zeros(len(sums))
    return before if row == whole else before + (row - whole) * (sums[:, whole] - before)


def _advanced(sums: Sums, row: float) -> tuple[float, Float[np.ndarray, " points"]]:
    """Return the next row up to which enough points keep their weight, and the weights there."""

    def weights(to: float) -> np.ndarray:
        excess = 0.5 * (_at(sums, to) - _at(sums, row))
        found = np.exp(excess.min() - excess)
        return found / found.sum()

    low, high = row, float(sums.shape[1])
    if 1 / (weights(high) ** 2).sum() >= _KEPT * len(sums):
        return high, weights(high)
    while high - low > 1e-3 * max(low - row, 1e-6):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 1 / (weights(middle) ** 2).sum() >= _KEPT * len(sums) else (low, middle)
    return (low if low > row else high), weights(low if low > row else high)
