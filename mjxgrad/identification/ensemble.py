r"""Values by the mean of many motions, for scenes whose contacts chatter, so that no single motion tells.

Each switch of a chattering contact makes the later motion jump, and the sum of squares of one motion has a minimum in every
cell between two jumps. The mean of motions whose values and starts differ a little is smooth. Let $r_i$ be the residuals, in
units of the noise, of motions with values $\theta_i$ about $\bar\theta$ and with starts as noisy as they were measured. The
linear regression $r_i = \mu + J (\theta_i - \bar\theta) + e_i$ separates the effect of the values from that of chatter. The
recording is one more such motion. Generalised least squares with the covariance $\sigma^2 + \mathrm{cov}(e)$ thus give the next
$\bar\theta$ and its covariance, chatter included, from which the next motions are drawn. The first motions are drawn between
the bounds, and then about those that fit best (the cross-entropy method).

References:
    Evensen. Analysis of iterative ensemble smoothers for solving inverse problems. Computational Geosciences 22 (2018).
    Rubinstein, Kroese. The Cross-Entropy Method. Springer 2004.
    Hartlap, Simon, Schneider. Why your model parameter confidences might be too optimistic. A&A 464 (2007).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjxgrad.rollouts import DivergedError

# Motions of an ensemble at first and at most, at least for each parameter, and numbers at most, for memory.
_NUM_MOTIONS, _PER_NUMBER, _MOST_NUMBERS = (512, 2048), 20, 1e8
_NUM_ALONE, _MOST_ALONE = 4096, 32  # motions, of which some alone nearly fit, and those kept
_MOST_ENSEMBLES, _PATIENCE = 20, 8  # ensembles at most, and since the misfit last fell
# Root mean square of residuals over their covariance, at which chatter that is not normal still explains them.
MISFIT = 1.5
# Share of the motions that fit best; factor of their median loss by which it goes on.
_ELITE, _STILL_FALLS = 0.0625, 0.98
# Scale of the first loss, which grows with logarithms beyond it: after some jumps two motions have nothing in common, and their
# squares would drown what still tells. It is a share of the noise, or of the nominal motion's residuals.
_SCALE, _SCALE_OF_FIRST = 0.3, 0.03
# Widths of an ensemble over the standard error: wider ones add what is not linear, and the last one shows the derivative.
_WIDER, _LAST = 1.0, 2.0
_LONGEST = 3.0  # widths that a step goes at most
# At the end: step in widths; misfit of the covariance, by fewer motions than at most and by most; ratio of successive widths.
_SHORT, _FITS, _SETTLED = 1.0, (1.3, MISFIT**2), 1.5
_CLEAR = 1e-10  # of the largest variance
_SIZES = np.geomspace(1e-6, 1.0, 81)  # of the noise, where it is not known, over the residuals of the nominal motion

_Box = tuple[np.ndarray, np.ndarray]
_Log = Callable[[float], None]
Motions = Callable[[Float[np.ndarray, "motions dim"], Float[np.ndarray, "motions windows start"]], np.ndarray]
"""Function from points and changes of the starts, in units of their noise, to residuals by motion, window and number."""


class Ensemble(NamedTuple):
    """The last motions, and the point whose mean motion fits the recordings."""

    point: Float[np.ndarray, " dim"]
    points: Float[np.ndarray, "motions dim"]
    alone: list[tuple[np.ndarray, np.ndarray]]  # points and changes of the starts of single motions, best first
    noise: float  # its size, 1 where it is known
    is_settled: bool
    residual: Float[np.ndarray, " numbers"]  # at the point, over the root of the covariance, times the noise
    slope: Float[np.ndarray, "numbers dim"]  # likewise, by the point

    def judged(self, residuals: Float[np.ndarray, "motions windows rows"]) -> Float[np.ndarray, " numbers"]:
        """Return the residual at the point in the same way, from those of the motions for these or other recordings."""
        is_finite = np.isfinite(residuals).all(axis=(1, 2))
        if is_finite.sum() < 2 * self.points.shape[1] + 2:
            return np.full(residuals[0].size, np.inf)
        model = _Regression(self.points[is_finite], residuals[is_finite])
        return model.over_root(self.noise) @ np.append(1.0, self.point - model.middle) * self.noise


def fit(motions: Motions, box: _Box, starts: tuple[int, int], count: int, noise: float | None, log: _Log) -> Ensemble:
    """Return the ensemble whose mean motion fits best.

    Args:
        motions: the simulation; motions that diverge have residuals that are not finite.
        box: least and greatest coordinates of a point; zero is the nominal one.
        starts: numbers of windows, and of coordinates of a start.
        count: number of measured numbers.
        noise: size of the noise in units of the residuals, None for unknown.
        log: called with the root mean square misfit of each ensemble.
    """
    draw = _Draw(motions, box, starts, count, noise or 0.0)
    first, middle, covariance = _narrowed(draw, count, noise, log)
    prior = np.diag(12.0 / (box[1] - box[0]) ** 2)  # the variance of a point between the bounds
    is_last, misfits = False, []
    while True:
        points, _, residuals = draw(middle, covariance)
        model = _Regression(points, residuals)
        sizes = [noise] if noise else first * _SIZES
        draw.noise = size = min(sizes, key=lambda one: model.deviance(one, count, prior))
        step, inverse, misfit = model.solved(size, prior)
        log(size * np.sqrt(misfit / count))
        misfits.append(misfit)
        length = np.sqrt(step @ np.linalg.pinv(covariance, hermitian=True) @ step)
        step *= _LONGEST / max(length, _LONGEST)
        middle, fits = np.clip(model.middle + step, *box), misfit < _FITS[draw.size == draw.most] * count
        if (is_last and fits) or min(misfits) < min(misfits[-_PATIENCE:]) or len(misfits) == _MOST_ENSEMBLES:
            break
        before, covariance = covariance, _WIDER**2 * max(misfit / count, 1.0) * inverse + np.outer(step, step)
        if not fits:  # the covariance of few motions lacks directions
            draw.size = min(2 * draw.size, draw.most)
        is_last = length < _SHORT and fits and (np.diag(before) < _SETTLED**2 * np.diag(covariance)).all()
        covariance *= _LAST**2 if is_last else 1.0
    both, alone = model.over_root(size) * size, draw.alone(middle, covariance)
    residual = both @ np.append(1.0, middle - model.middle)
    return Ensemble(middle, points, alone, size, bool(is_last and fits), residual, both[:, 1:] * model.sureness(size))


class _Draw:
    """Motions of points about a middle, or between the bounds, with starts off by their noise."""

    def __init__(self, motions: Motions, box: _Box, starts: tuple[int, int], count: int, noise: float):
        self._motions, self._box, self._starts, self.noise = motions, box, starts, noise
        fewest = _PER_NUMBER * len(box[0])
        self.size, self.most = (max(fewest, min(number, int(_MOST_NUMBERS / count))) for number in _NUM_MOTIONS)
        self._rng = np.random.default_rng(0)

    def __call__(
        self, middle: np.ndarray | None = None, covariance: np.ndarray | None = None
    ) -> tuple[np.ndarray, ...]:
        """Return points, changes of the starts, and residuals of the motions that stay finite."""
        if middle is None or covariance is None:
            points = self._rng.uniform(*self._box, (self.size, len(self._box[0])))
            points[0] = 0.0  # the nominal values, at which no motion diverges
        else:
            points = np.clip(self._rng.multivariate_normal(middle, covariance, self.size, method="eigh"), *self._box)
        starts = self.noise * self._rng.normal(size=(len(points), *self._starts))
        residuals = self._motions(points, starts)
        is_finite = np.isfinite(residuals).all(axis=(1, 2))
        if is_finite.sum() < 2 * points.shape[1] + 2:
            raise DivergedError("most motions must stay finite between the bounds, got few: give narrower ones")
        return points[is_finite], starts[is_finite], residuals[is_finite]

    def alone(self, middle: np.ndarray, covariance: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return points and changes of the starts of the single motions that fit best, each window's start by itself."""
        found = []
        for _ in range(max(_NUM_ALONE // self.size, 1)):
            points, starts, residuals = self(middle, covariance)
            found.append((points, starts, (residuals**2).sum(axis=2)))
        points, starts, squares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.argsort(squares, axis=0)[:_MOST_ALONE]
        return [(points[best].mean(axis=0), starts[best, np.arange(len(best))]) for best in order]


def _narrowed(draw: _Draw, count: int, noise: float | None, log: _Log) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the nominal root mean square, and mean and covariance of points that fit best, by the cross-entropy method."""
    points, _, residuals = draw()
    first, medians = float(np.sqrt((residuals[0] ** 2).sum() / count)), [np.inf]
    scale = _SCALE * noise if noise else _SCALE_OF_FIRST * first
    while True:
        losses = np.log1p((residuals / scale) ** 2).sum(axis=(1, 2))
        best = np.argsort(losses)[: max(int(_ELITE * len(points)), 2 * points.shape[1])]
        middle, covariance = points[best].mean(axis=0), 2.0 * np.atleast_2d(np.cov(points[best].T))
        medians.append(float(np.median(losses[best])))
        log(float(np.sqrt((residuals[best] ** 2).sum(axis=(1, 2)).min() / count)))
        if medians[-1] > _STILL_FALLS * medians[-2] or len(medians) > _MOST_ENSEMBLES:
            return first, middle, covariance
        points, _, residuals = draw(middle, covariance)


class _Regression:
    """Residuals of many motions by their points: the mean and its derivative, and the covariance of what is left."""

    def __init__(self, points: np.ndarray, residuals: np.ndarray):
        self.middle, self._count = points.mean(axis=0), len(points)
        away = np.column_stack([np.ones(len(points)), points - self.middle])
        self._columns = np.einsum("dm,mwn->wnd", np.linalg.pinv(away), residuals)
        left = residuals - np.einsum("md,wnd->mwn", away, self._columns)
        # The covariance of each window in terms of its eigenvectors, fewer than motions.
        self._axes, self._variances = [], []
        for one in left.swapaxes(0, 1):
            is_wide = one.shape[0] < one.shape[1]
            sizes, axes = np.linalg.eigh(one @ one.T if is_wide else one.T @ one)
            is_clear = sizes > _CLEAR * max(sizes.max(), np.finfo(float).tiny)
            sizes, axes = sizes[is_clear], axes[:, is_clear]
            self._axes.append(one.T @ (axes / np.sqrt(sizes)) if is_wide else axes)
            self._variances.append(sizes / (len(points) - away.shape[1]))
        self._along = [axes.T @ columns for axes, columns in zip(self._axes, self._columns, strict=True)]
        across = self._columns - np.stack([a @ b for a, b in zip(self._axes, self._along, strict=True)])
        self._across = np.einsum("wni,wnj->ij", across, across)

    def _gram(self, size: float) -> np.ndarray:
        """Return the products of residual and derivative over the covariance with a noise of this size."""
        parts = zip(self._along, self._variances, strict=True)
        return self._across / size**2 + sum(along.T @ (along / (size**2 + v)[:, None]) for along, v in parts)

    def solved(self, size: float, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the step to the best point, its covariance, and the misfit that remains: a sum of squares."""
        gram = self._gram(size)
        inverse = np.linalg.inv(gram[1:, 1:] + prior)
        step = -inverse @ gram[1:, 0]
        end = np.append(1.0, step)
        return step, inverse, float(end @ gram @ end)

    def deviance(self, size: float, count: int, prior: np.ndarray) -> float:
        """Return twice the negative logarithm of the likelihood of a noise of this size, up to a constant."""
        determinant = sum(np.log1p(variances / size**2).sum() for variances in self._variances)
        return 2 * count * np.log(size) + determinant + self.solved(size, prior)[2]

    def sureness(self, size: float) -> float:
        """Return the factor of derivatives for a covariance of few motions, whose inverse is too large (Hartlap et al.)."""
        directions = np.mean([(variances / (size**2 + variances)).sum() for variances in self._variances])
        return float(np.sqrt(max(1.0 - directions / self._count, 0.1)))

    def over_root(self, size: float) -> Float[np.ndarray, "numbers dim"]:
        """Return the residual at the middle and its derivative, over the root of the covariance."""
        parts = []
        for columns, axes, along, v in zip(self._columns, self._axes, self._along, self._variances, strict=True):
            parts.append((columns - axes @ ((1 - size / np.sqrt(size**2 + v))[:, None] * along)) / size)
        return np.concatenate(parts)
