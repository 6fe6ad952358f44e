"""Linear least squares of parameters that all windows share, and of a start that each window has to itself.

The factors of a window are the triangle of a QR decomposition of its derivative by the start, by the values, and its residual.
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float


class Step(NamedTuple):
    """The step to the least squares, how far it goes in standard errors, squared, and the sum of squares there."""

    values: Float[np.ndarray, " dim"]
    starts: Float[np.ndarray, "windows free"]
    length: float
    squares: float


def factors_of(
    residual: Float[np.ndarray, "windows numbers"],
    slope: Float[np.ndarray, "windows numbers dim"],
    by_start: Float[np.ndarray, "windows numbers free"],
) -> Float[np.ndarray, "windows columns columns"]:
    """Return the factors of residuals and their derivatives."""
    return _triangle(np.concatenate([by_start, slope, residual[..., None]], axis=2))


def _triangle(columns: np.ndarray) -> np.ndarray:
    missing = max(columns.shape[2] - columns.shape[1], 0)
    return np.asarray(np.linalg.qr(np.pad(columns, ((0, 0), (0, missing), (0, 0))), mode="r"))


def split(factors: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows of the starts, then by values and residual what no start explains: its rows are those of a regression."""
    free = factors.shape[2] - count - 1
    rest = factors[:, free:, free:].reshape(-1, count + 1)
    return factors[:, :free, :free], factors[:, :free, free:], rest[:, :-1], rest[:, -1]


def solved(
    factors: np.ndarray, count: int, room: tuple[np.ndarray, np.ndarray] | None = None, damping: float = 0.0
) -> Step:
    """Return the step to the least squares.

    Args:
        factors: those of each window.
        count: number of values.
        room: the longest step of each value down and up.
        damping: Levenberg and Marquardt's, relative to each column.
    """
    if damping:
        sizes = np.sqrt(damping) * np.linalg.norm(factors, axis=1)
        sizes[:, -1] = 0.0
        factors = _triangle(np.concatenate([factors, sizes[:, :, None] * np.eye(sizes.shape[1])], axis=1))
    *_, slope, residual = split(factors, count)
    lengths = np.linalg.norm(slope, axis=0)
    lengths = np.where(lengths > 1e-12 * lengths.max(initial=0.0), lengths, np.inf)  # what has no effect stays
    scaled = slope / lengths
    values = np.linalg.lstsq(scaled, -residual, rcond=1e-12)[0] / lengths
    if room is not None and ((values < room[0]) | (values > room[1])).any():
        is_free, bounds = np.isfinite(lengths), np.array(room)
        bounds = bounds[:, is_free] * lengths[is_free]
        bounds = np.stack([bounds[0], np.maximum(bounds[1], bounds[0] + 1e-12)])
        values[is_free] = scipy.optimize.lsq_linear(scaled[:, is_free], -residual, bounds).x / lengths[is_free]
    starts, squares = at(factors, values)
    return Step(values, starts, float(np.sum((slope @ values) ** 2)), squares)


def at(factors: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the best starts at a step of the values, and the sum of squares there."""
    by_start, mixed, slope, residual = split(factors, len(values))
    left = mixed @ np.append(values, 1.0)
    starts = -np.einsum("wij,wj->wi", np.linalg.pinv(by_start), left)
    missed = left + np.einsum("wij,wj->wi", by_start, starts)
    return starts, float(np.sum(missed**2) + np.sum((slope @ values + residual) ** 2))
