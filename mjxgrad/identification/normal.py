"""Linear least squares of parameters that all windows share, and of a start that each window has to itself.

The factors of a window are the triangle of a QR decomposition of its derivative by the start, by the values, and its residual.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

_FAINT = 1e-14  # of a column, squared: what is less is rounding


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


def distinct(gram: Float[np.ndarray, "dim dim"], error: Float[np.ndarray, "dim dim"]) -> Float[np.ndarray, "dim dim"]:
    """Return what columns are to be multiplied with, so that what tells them apart by their own errors alone is gone.

    Columns are differences of motions, whose widths and jumps err. Two columns of one effect differ by these errors, which no
    regression tells from a small effect of a difference: as a rule they promise values of both where there is one of the sum.
    Directions in which columns have no more effect than errors can have are therefore taken to have none. A single number stays
    as it is, for its size errs and not what it is told from.

    Args:
        gram: products of the columns.
        error: products that their errors have at most.
    """
    lengths = np.sqrt(np.maximum(np.diag(gram), 0.0))
    is_felt = np.flatnonzero(lengths > 1e-12 * lengths.max(initial=0.0))
    found, lengths = np.eye(len(gram)), lengths[is_felt]
    if len(is_felt) < 2:
        return found
    block, across = np.ix_(is_felt, is_felt), np.outer(lengths, lengths)
    effect, doubt = gram[block] / across, error[block] / across + _FAINT * np.eye(len(is_felt))
    ratios, vectors = scipy.linalg.eigh(effect, doubt)
    kept = []
    for row in simple(vectors[:, ratios <= 1.0].T):
        # Shares of further numbers are errors, too, unless the direction has an effect without them.
        parts, least = np.flatnonzero(row), row[row != 0]
        for i in np.argsort(np.abs(row))[:-1]:
            fewer = parts[parts != i]
            ratio, those = scipy.linalg.eigh(effect[np.ix_(fewer, fewer)], doubt[np.ix_(fewer, fewer)])
            # Two of which each alone could be error, but not both, are told by their sum.
            is_pair = len(fewer) == 1 and effect[i, i] <= doubt[i, i]
            if ratio[0] <= 1.0 and not is_pair:
                parts, least = fewer, those[:, 0]
        if len(parts) > 1:
            one = np.zeros_like(row)
            one[parts] = least / np.linalg.norm(least)
            kept.append(one)
    if kept:
        # As in a regression on the others alone: their errors do not take part in those of what is gone.
        lost = np.array(kept)
        gone = lost.T @ np.linalg.pinv(lost @ doubt @ lost.T, hermitian=True) @ lost @ doubt
        found[block] -= gone * lengths / lengths[:, None]
    return found


def simple(rows: Float[np.ndarray, "rows dim"]) -> Float[np.ndarray, "rows dim"]:
    """Return rows that span the same, in each of which a number is that is in no other."""
    if not len(rows):
        return rows
    *_, order = scipy.linalg.qr(rows, mode="economic", pivoting=True)
    return np.linalg.solve(rows[:, order[: len(rows)]], rows)


def at(factors: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the best starts at a step of the values, and the sum of squares there."""
    by_start, mixed, slope, residual = split(factors, len(values))
    left = mixed @ np.append(values, 1.0)
    starts = -np.einsum("wij,wj->wi", np.linalg.pinv(by_start), left)
    missed = left + np.einsum("wij,wj->wi", by_start, starts)
    return starts, float(np.sum(missed**2) + np.sum((slope @ values + residual) ** 2))
