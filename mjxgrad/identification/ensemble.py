r"""Values by the mean of many motions, for scenes whose contacts chatter, so that no single motion tells.

Each switch of a chattering contact makes the later motion jump, and the sum of squares of one motion has a minimum in every
cell between two jumps. The mean of motions whose values and starts differ a little is smooth. Let $r_i$ be the residuals of a
window, in units of the noise, of motions with values $\theta_i$ about $\bar\theta$ and starts $s_i$ about $\bar s$. The linear
regression $r_i = \mu + J (\theta_i - \bar\theta) + K (s_i - \bar s) + e_i$ separates the effects of values and start from
chatter. The recording is one more such motion. Generalised least squares with the covariance $\sigma^2 + \mathrm{cov}(e)$ give
the next $\bar\theta$ and $\bar s$ and their covariance, from which the next motions are drawn, until both stay. The first
motions spread wider than any answer, so that the covariance shrinks to what chatter allows and not to a cell.

References:
    Evensen. Analysis of iterative ensemble smoothers for solving inverse problems. Computational Geosciences 22 (2018).
    Hartlap, Simon, Schneider. Why your model parameter confidences might be too optimistic. A&A 464 (2007).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjxgrad.identification.normal import at, solved, split
from mjxgrad.rollouts import DivergedError

# Root mean square of residuals over their covariance, at which chatter that is not normal still explains them.
MISFIT = 1.5
_MOTIONS, _PER_NUMBER = 192, 8  # motions of an ensemble at least, and for each unknown of a window
_MOST = 16  # ensembles
_MORE = 4  # times as many motions at most
_NARROWER, _WIDER = 0.25, 2.0  # widths that are kept from before; where the mean has missed
_CHATTER, _EXCESS = (
    (1.5, 3.0, 6.0, 12.0),
    1.0,
)  # of its variance; standard errors of a sum of squares beyond which it is more
_LONGEST = 3.0  # widths that a step goes at most
_SHORT, _SETTLED = 0.7, 1.5  # at the end: step of each number in widths; ratio of successive widths
_FEWEST, _AVERAGED = (
    3,
    3,
)  # ensembles at least, and those at the end of which the mean is the answer: each has its scatter

Box = tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]
Motions = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from values and starts, by motion, to residuals by motion, window and number."""


class Ensemble(NamedTuple):
    """Values and starts whose mean motion fits the recordings, and the motions that told."""

    values: Float[np.ndarray, " dim"]
    starts: Float[np.ndarray, "windows free"]
    factors: Float[np.ndarray, "windows columns columns"]  # at this point, weighed by noise and chatter
    squares: float
    drawn: Float[np.ndarray, "motions dim"]
    is_settled: bool


def size(columns: int) -> int:
    """Return the number of motions of an ensemble with so many unknowns of a window."""
    return max(_MOTIONS, _PER_NUMBER * columns)


def fit(
    motions: Motions, point: tuple[np.ndarray, np.ndarray], widths: tuple[np.ndarray, np.ndarray], box: Box,
    noise: float, count: int, say: Callable[[Ensemble], None],
) -> Ensemble:  # fmt: skip
    """Return the ensemble whose mean motion fits best.

    Args:
        motions: the simulation; motions that diverge have residuals that are not finite.
        point: values and starts at first.
        widths: standard deviations at first, of the values and of each start.
        box: least and greatest values.
        noise: size of the noise in units of the residuals.
        count: number of measured numbers.
        say: called with each ensemble.
    """
    (values, starts), rng, dim = point, np.random.default_rng(0), len(point[0])
    num = fewest = size(dim + starts.shape[1])
    root = np.diag(widths[0])
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    lowest = np.inf
    own, along = widths[1][:, :, None] * np.eye(starts.shape[1]), np.zeros((*starts.shape, dim))
    for index in range(1, _MOST + 1):
        drawn = np.clip(values + rng.normal(size=(num, dim)) @ root.T, *box)
        free = np.einsum("wij,mwj->mwi", own, rng.normal(size=(num, *starts.shape)))
        free += starts + np.einsum("wij,mj->mwi", along, drawn - values)
        residuals = motions(drawn, free)
        is_finite = np.isfinite(residuals).all(axis=(1, 2))
        drawn, free, residuals = drawn[is_finite], free[is_finite], residuals[is_finite]
        if len(drawn) < 2 * (dim + starts.shape[1]) + 2:
            raise DivergedError("most motions must stay finite about the best values, got few: give narrower bounds")
        middle, centres = drawn.mean(axis=0), free.mean(axis=0)
        model, most = Regression(drawn, free, residuals), count * noise**2 * (1.0 + _EXCESS * np.sqrt(2.0 / count))
        for (
            chatter
        ) in _CHATTER:  # its tails are longer than the normal's; the misfit tells where the recording has more
            factors, sureness = model.weighed(noise, chatter)
            step = solved(factors, dim, (box[0] - middle, box[1] - middle))
            if step.squares < most:
                break
        length = float(np.linalg.norm(np.linalg.lstsq(root, step.values, rcond=None)[0]))
        change = step.values * min(1.0, _LONGEST / max(length, 1e-300))
        by_start, mixed, slope, _ = split(factors, dim)
        inner = np.linalg.pinv(by_start)
        moved, misfit = at(factors, change)
        at_end = factors * sureness
        at_end[..., -1] = 0.0  # nothing is left to go
        growth = np.sqrt(max(misfit / (count * noise**2), 1.0)) * noise
        # A mean that explains less than that of a wider ensemble has missed: between two teeth all looks smooth.
        has_missed, lowest = misfit > max(most, lowest * most / (count * noise**2)), min(lowest, misfit)
        num = min(2 * num, _MORE * fewest) if has_missed else num  # few motions lack directions of chatter
        before, root = root, growth * np.linalg.pinv(slope, rcond=1e-9)
        wider = (_WIDER if has_missed else _NARROWER) * before
        root = np.linalg.cholesky(root @ root.T + wider @ wider.T + np.outer(change, change) + 1e-14 * np.eye(dim))
        own, along = growth * inner, -np.einsum("wij,wjk->wik", inner, mixed[..., :-1])
        values, starts = middle + change, centres + moved
        shrunk = np.sqrt(np.diag(before @ before.T) / np.diag(root @ root.T))
        is_short = (
            not has_missed and length < _SHORT * np.sqrt(dim) and bool((shrunk < _SETTLED).all()) and index >= _FEWEST
        )
        ends = [*ends, (values, starts)] if is_short or ends else []
        mean = [np.mean(part, axis=0) for part in zip(*(ends or [(values, starts)]), strict=True)]
        if len(ends) > 1:  # the mean of few has a scatter of its own
            scatter = np.var([one for one, _ in ends], axis=0, ddof=1) / np.diag(root @ root.T)
            at_end /= np.sqrt(1.0 + scatter.mean() / len(ends))
        found = Ensemble(*mean, at_end, misfit, drawn, len(ends) == _AVERAGED)
        say(found)
        if found.is_settled:
            break
    return found


class Regression:
    """The mean residual of each window and its derivatives, and the chatter that is left."""

    def __init__(
        self, drawn: Float[np.ndarray, "motions dim"], free: Float[np.ndarray, "motions windows free"],
        residuals: Float[np.ndarray, "motions windows numbers"],
    ):  # fmt: skip
        self._parts, self._count, self._width = [], len(drawn), 1 + drawn.shape[1] + free.shape[2]
        for starts, one in zip(free.swapaxes(0, 1), residuals.swapaxes(0, 1), strict=True):
            away = np.column_stack([starts - starts.mean(axis=0), drawn - drawn.mean(axis=0), np.ones(self._count)])
            columns = np.linalg.pinv(away) @ one
            left = one - away @ columns
            self._parts.append((columns @ columns.T, left @ columns.T, left @ left.T))

    def weighed(self, noise: float, chatter: float = 1.0) -> tuple[Float[np.ndarray, "windows columns columns"], float]:
        """Return factors of mean residual and derivatives over the root of the covariance, times the noise.

        The covariance is that of noise and chatter, the latter by a factor. Its inverse by few motions is too large (Hartlap et
        al.): the second result is the factor of derivatives for that.
        """
        found, told = [], []
        scale = max(self._count - self._width, 1) * noise**2 / chatter
        for plain, along, left in self._parts:
            # (σ² + e e'/n)⁻¹ = (1 - e (n σ² + e'e)⁻¹ e') / σ², in the space of motions, which are fewer than numbers.
            inverse = np.linalg.inv(max(scale, 1e-12 * np.trace(left)) * np.eye(self._count) + left)
            gram = plain - along.T @ inverse @ along
            told.append(self._count - scale * np.trace(inverse))
            sizes = np.sqrt(np.where(np.diag(gram) > 0, np.diag(gram), 1.0))
            values, axes = np.linalg.eigh(gram / np.outer(sizes, sizes))
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T * sizes
            found.append(np.linalg.qr(root, mode="r"))
        return np.stack(found), float(np.sqrt(max(1.0 - np.mean(told) / self._count, 0.1)))
