r"""Values by the mean of many motions, for scenes whose contacts chatter, so that no single motion tells.

Each switch of a chattering contact makes the later motion jump, and the sum of squares of one motion has a minimum in every
cell between two jumps. The mean of motions whose values and starts differ a little is smooth. Let $r_i$ be the residuals of a
window, in units of the noise, of motions with values $\theta_i$ about $\bar\theta$ and starts $s_i$ about $\bar s$. The linear
regression $r_i = \mu + J (\theta_i - \bar\theta) + K (s_i - \bar s) + e_i$ separates the effects of values and start from
chatter. The recording is one more such motion. Generalised least squares with the covariance $\sigma^2 + \mathrm{cov}(e)$ give
the next $\bar\theta$ and $\bar s$ and their covariance. From twice its width the next motions are drawn, until both stay: among
motions that differ by less, fewer switches differ, and the covariance would shrink to a cell. In the end further motions stand
for recordings of known values. Their errors widen the intervals until 95 % of them hold.

References:
    Evensen. Analysis of iterative ensemble smoothers for solving inverse problems. Computational Geosciences 22 (2018).
"""

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjxgrad.identification.normal import Step, at, distinct, solved, split
from mjxgrad.rollouts import DivergedError

# Root mean square of residuals over their covariance, at which chatter that is not normal still explains them.
MISFIT = 1.5
_MOTIONS, _PER_NUMBER = 192, 8  # motions of an ensemble at least, and for each unknown of a window
_MORE = 4  # times as many motions at most
EXPECTED, MOST = 15, 16  # ensembles of the first size that a fit takes, about; ensembles of any size
LARGEST = (MOST + 1) * _MORE  # what a fit takes at most, in ensembles of the first size; one more tries the intervals
_NARROWER, _WIDER = 0.25, 2.0  # widths that are kept from before; where the mean has missed
_APART = 2.0  # standard errors by which the next motions differ: chatter grows with it, so one would shrink to a cell
# Factors of its variance; standard errors of a sum of squares beyond which it is more.
_CHATTER, _EXCESS = (1.5, 3.0, 6.0, 12.0), 1.0
_LONGEST = 3.0  # widths that a step goes at most
_SHORT, _SETTLED = 0.7, 1.5  # at the end: step of each number in widths; ratio of successive widths
_SURE = 0.003  # width of a coordinate: where all but noise is explained, narrower intervals are not worth the time
# Ensembles at least, and those at the end of which the mean is the answer: each has its scatter.
_FEWEST, _AVERAGED = 3, 3
# Standard deviations of the squares of a derivative's errors, beyond which it is none: chatter has long tails.
_BY_CHANCE = 5.0
_HALF_WIDTH = 1.96  # of an interval that holds at 95 %, in standard errors

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


_Product = Callable[[np.ndarray], np.ndarray]
Say = Callable[[Ensemble, float, int, tuple[float, float]], None]
"""Function of the best ensemble so far, and of the last one's sum of squares, motions, and motions ahead, about and at most."""


def size(columns: int) -> int:
    """Return the number of motions of an ensemble with so many unknowns of a window."""
    return max(_MOTIONS, _PER_NUMBER * columns)


def algebra(dim: int, free: int, numbers: int) -> float:
    """Return the seconds of an ensemble's regression of one window, measured on random numbers."""
    rng, num, began = np.random.default_rng(0), size(dim + free), time.monotonic()
    drawn, starts, residuals = rng.normal(size=(num, dim)), rng.normal(size=(num, 1, free)), np.ones((num, 1, numbers))
    residuals *= rng.normal(size=(num, 1, 1))
    Regression(drawn, starts, residuals).weighed(1.0)
    return time.monotonic() - began


def fit(
    motions: Motions, point: tuple[np.ndarray, np.ndarray], widths: tuple[np.ndarray, np.ndarray], box: Box,
    noise: float, count: int, say: Say,
) -> Ensemble:  # fmt: skip
    """Return the ensemble whose mean motion fits best: the first that settles, else the one with the least left.

    Args:
        motions: the simulation; motions that diverge have residuals that are not finite.
        point: values and starts at first.
        widths: standard deviations at first, of the values and of each start.
        box: least and greatest values.
        noise: size of the noise in units of the residuals.
        count: number of measured numbers.
        say: called after each ensemble.
    """
    rng, dim, lowest, wide = np.random.default_rng(0), len(point[0]), np.inf, np.inf
    free = widths[1].shape[1]
    law = _first(point, widths)
    num = fewest = size(dim + free)
    most = count * noise**2 * (1.0 + _EXCESS * np.sqrt(2.0 / count))
    ends: list[_Law] = []
    index, spent, best = 0, 0, None
    while True:
        index, spent, used = index + 1, spent + num, num
        model, drawn, starts = _regression(motions, *law.draw(num, rng, box))
        middle, centres = drawn.mean(axis=0), starts.mean(axis=0)
        factors, chatter, step = _explained(model, noise, (box[0] - middle, box[1] - middle), dim, most)
        length = float(np.linalg.norm(np.linalg.lstsq(law.root, step.values, rcond=None)[0]))
        change = step.values * min(1.0, _LONGEST / max(length, 1e-300))
        moved, misfit = at(factors, change)
        # A mean that explains less than that of a wider ensemble has missed: between two teeth all looks smooth.
        is_worse, width = misfit > max(most, lowest * most / (count * noise**2)), float(np.log(law.variances).mean())
        has_missed = is_worse and width <= wide
        lowest, wide = (lowest, wide) if misfit >= lowest else (misfit, width)
        num = min(2 * num, _MORE * fewest) if is_worse else num  # few motions lack directions of chatter
        growth = float(np.sqrt(max(misfit / (count * noise**2), 1.0))) * noise
        before, kept = law, (_WIDER if has_missed else _NARROWER) * law.root
        *_, slope, _ = split(factors, dim)
        # What cannot be told keeps its width: among motions that hardly differ it never could be.
        if not has_missed:
            narrowed = law.root - kept
            kept = kept + narrowed - np.linalg.pinv(slope, rcond=1e-9) @ (slope @ narrowed)
        law = _law(factors, middle + change, centres + moved, growth, kept, change)
        is_narrow = bool((before.variances < _SETTLED**2 * law.variances).all())
        # Where all but noise is explained, more ensembles would only narrow the intervals.
        is_late = misfit <= most and spent >= EXPECTED * fewest
        is_enough = is_late or (misfit <= most and bool((law.variances < _SURE**2).all()))
        stays = length < _SHORT * np.sqrt(dim) and (is_narrow or is_enough)
        is_short = stays and not is_worse and index >= _FEWEST
        ends = [*ends, law] if is_short or ends else []
        found = _mean_of(ends or [law], factors, misfit, drawn)
        # Of those that explain all but noise the last has the narrowest intervals.
        if best is None or found.is_settled or found.squares <= max(best.squares, most):
            best = found
        is_settled = found.is_settled or (is_short and is_late)
        is_last = is_settled or index == MOST
        if is_last:
            best = best._replace(is_settled=is_settled)
            errors = _tried(model, motions, before.draw(used, rng, box), noise, chatter)
            best = best._replace(factors=best.factors / max(1.0, float(np.quantile(errors, 0.95)) / _HALF_WIDTH))
        ahead = num + max((_AVERAGED - len(ends)) * num, 0 if ends else EXPECTED * fewest - spent)
        most_ahead = 0 if is_last else (MOST - index + 1) * _MORE * fewest
        say(best, misfit, used, (float(min(ahead, most_ahead)), float(most_ahead)))
        if is_last:
            return best


def outlook(
    motions: Motions,
    point: tuple[np.ndarray, np.ndarray],
    widths: tuple[np.ndarray, np.ndarray],
    box: Box,
    noise: float,
) -> Float[np.ndarray, "windows columns columns"]:
    """Return the factors of a first ensemble, of the arguments of `fit`: what the mean of motions tells of a point."""
    law = _first(point, widths)
    drawn = law.draw(size(len(point[0]) + widths[1].shape[1]), np.random.default_rng(0), box)
    return _regression(motions, *drawn)[0].weighed(noise)


def _first(point: tuple[np.ndarray, np.ndarray], widths: tuple[np.ndarray, np.ndarray]) -> "_Law":
    """Return the law of the first motions, whose values and starts are independent."""
    own = widths[1][:, :, None] * np.eye(widths[1].shape[1])
    return _Law(*point, np.diag(widths[0]), own, np.zeros((*point[1].shape, len(point[0]))))


def _regression(motions: Motions, drawn: np.ndarray, starts: np.ndarray) -> tuple["Regression", np.ndarray, np.ndarray]:
    """Return the regression of motions, and the values and starts of those that stay finite."""
    residuals = motions(drawn, starts)
    is_finite = np.isfinite(residuals).all(axis=(1, 2))
    drawn, starts = drawn[is_finite], starts[is_finite]
    if len(drawn) < 2 * (drawn.shape[1] + starts.shape[2]) + 2:
        raise DivergedError("most motions must stay finite about the best values, got few: give narrower bounds")
    return Regression(drawn, starts, residuals[is_finite]), drawn, starts


class _Law(NamedTuple):
    """The law of motions: means, a root of the covariance of values, and starts by noise of their own and along values."""

    values: Float[np.ndarray, " dim"]
    starts: Float[np.ndarray, "windows free"]
    root: Float[np.ndarray, "dim dim"]
    own: Float[np.ndarray, "windows free free"]
    along: Float[np.ndarray, "windows free dim"]

    @property
    def variances(self) -> Float[np.ndarray, " dim"]:
        """Return the variances of the values."""
        return np.sum(self.root**2, axis=1)

    def draw(self, num: int, rng: np.random.Generator, box: Box) -> tuple[np.ndarray, np.ndarray]:
        """Return values and starts of so many motions."""
        drawn = np.clip(self.values + rng.normal(size=(num, len(self.values))) @ self.root.T, *box)
        noise = np.einsum("wij,mwj->mwi", self.own, rng.normal(size=(num, *self.starts.shape)))
        return drawn, self.starts + noise + np.einsum("wij,mj->mwi", self.along, drawn - self.values)


def _law(
    factors: np.ndarray, values: np.ndarray, starts: np.ndarray, growth: float, kept: np.ndarray, change: np.ndarray
) -> _Law:
    """Return what the next motions are drawn from: what factors leave open, a share of the former law, and the last change."""
    by_start, mixed, slope, _ = split(factors, len(values))
    inner, root = np.linalg.pinv(by_start), _APART * growth * np.linalg.pinv(slope, rcond=1e-9)
    covariance = root @ root.T + kept @ kept.T + np.outer(change, change) + 1e-14 * np.eye(len(values))
    along = -np.einsum("wij,wjk->wik", inner, mixed[..., :-1])
    return _Law(values, starts, np.linalg.cholesky(covariance), growth * inner, along)


def _explained(model: "Regression", noise: float, room: Box, dim: int, most: float) -> tuple[np.ndarray, float, Step]:
    """Return factors, how much chatter they count, and the step: as much as explains what recordings have more than noise."""
    for chatter in _CHATTER:  # its tails are longer than the normal's
        factors = model.weighed(noise, chatter)
        step = solved(factors, dim, room)
        if step.squares < most or chatter == _CHATTER[-1]:
            return factors, chatter, step
    raise AssertionError("there is a last one")


def _tried(
    model: "Regression", motions: Motions, drawn: tuple[np.ndarray, np.ndarray], noise: float, chatter: float
) -> Float[np.ndarray, "motions dim"]:
    """Return by how many standard errors the values of further motions are missed."""
    residuals = motions(*drawn)
    is_finite = np.isfinite(residuals).all(axis=(1, 2))
    return np.abs(model.errors(drawn[0][is_finite], residuals[is_finite], noise, chatter))


def _mean_of(ends: list[_Law], factors: np.ndarray, misfit: float, drawn: np.ndarray) -> Ensemble:
    """Return the mean of the last ensembles, whose scatter widens the intervals."""
    values, starts = np.mean([one.values for one in ends], axis=0), np.mean([one.starts for one in ends], axis=0)
    factors[..., -1] = 0.0  # nothing is left to go
    if len(ends) > 1:
        scatter = np.var([one.values for one in ends], axis=0, ddof=1) / (ends[-1].variances / _APART**2)
        factors /= np.sqrt(1.0 + scatter.mean() / len(ends))
    return Ensemble(values, starts, factors, misfit, drawn, len(ends) == _AVERAGED)


class _Part(NamedTuple):
    """The regression of a window: columns by starts and values with the mean, what is left, and its products."""

    columns: Float[np.ndarray, "columns numbers"]
    left: Float[np.ndarray, "motions numbers"]
    gram: Float[np.ndarray, "motions motions"]
    inverse: Float[np.ndarray, "columns columns"]  # of the products of what was drawn: errors of columns go by it


class Regression:
    """The mean residual of each window and its derivatives, and the chatter that is left.

    The derivatives have errors of chatter, too, by which alone two numbers of one effect would be told apart: see `distinct`.
    """

    def __init__(
        self, drawn: Float[np.ndarray, "motions dim"], free: Float[np.ndarray, "motions windows free"],
        residuals: Float[np.ndarray, "motions windows numbers"],
    ):  # fmt: skip
        self._middle, self._count, self._width = drawn.mean(axis=0), len(drawn), 1 + drawn.shape[1] + free.shape[2]
        self._parts: list[_Part] = []
        self._apart: np.ndarray | None = None
        for starts, one in zip(free.swapaxes(0, 1), residuals.swapaxes(0, 1), strict=True):
            away = np.column_stack([starts - starts.mean(axis=0), drawn - self._middle, np.ones(self._count)])
            inverse = np.linalg.pinv(away)
            columns = inverse @ one
            left = one - away @ columns
            self._parts.append(_Part(columns, left, left @ left.T, inverse @ inverse.T))

    def _weighed(self, noise: float, chatter: float) -> Iterator[_Product]:
        """Yield, by window, the product of all columns with others, weighed by the covariance of noise and chatter."""
        scale = self._scale(noise, chatter)
        for columns, left, gram, _ in self._parts:
            # (σ² + e e'/n)⁻¹ = (1 - e (n σ² + e'e)⁻¹ e') / σ², in the space of motions, which are fewer than numbers.
            least = max(scale, 1e-12 * np.trace(gram))
            kept = np.linalg.solve(least * np.eye(self._count) + gram, left @ columns.T)
            yield lambda others, columns=columns, left=left, kept=kept: columns @ others - kept.T @ (left @ others)

    def _scale(self, noise: float, chatter: float) -> float:
        return max(self._count - self._width, 1) * noise**2 / chatter

    def _told(self, noise: float, chatter: float) -> Float[np.ndarray, "dim dim"]:
        """Return what derivatives are multiplied with so that their own errors tell no numbers apart.

        It depends little on the factor of chatter, and is found once.
        """
        dim = len(self._middle)
        if self._apart is None and dim < 2:
            self._apart = np.eye(dim)
        if self._apart is None:
            slope, error = np.zeros((dim, dim)), np.zeros((dim, dim))
            for (columns, left, gram, inverse), product in zip(self._parts, self._weighed(noise, chatter), strict=True):
                weighed, free = product(columns.T), len(columns) - dim - 1
                # What the starts explain tells nothing of values; by these shares of theirs, errors of starts count, too.
                shares = -np.linalg.pinv(weighed[:free, :free], hermitian=True) @ weighed[:free, free:-1]
                shares = np.vstack([shares, np.eye(dim)])
                slope += shares.T @ weighed[:-1, :-1] @ shares
                expected, directions = _sum_of_others(
                    left, gram, max(self._scale(noise, chatter), 1e-12 * np.trace(gram))
                )
                # Squares of as many errors are rarely more than what is expected of them by more than this.
                most = 1.0 + _BY_CHANCE * np.sqrt(2.0 / directions)
                error += noise**2 / chatter * expected * most * shares.T @ inverse[:-1, :-1] @ shares
            self._apart = distinct(slope, error)
        return self._apart

    def weighed(self, noise: float, chatter: float = 1.0) -> Float[np.ndarray, "windows columns columns"]:
        """Return factors of mean residual and derivatives over the root of the covariance, times the noise.

        The covariance is that of noise and chatter, the latter by a factor.
        """
        apart, found = self._told(noise, chatter), []
        for (columns, *_), product in zip(self._parts, self._weighed(noise, chatter), strict=True):
            gram = product(columns.T)
            sizes = np.sqrt(np.where(np.diag(gram) > 0, np.diag(gram), 1.0))
            values, axes = np.linalg.eigh(gram / np.outer(sizes, sizes))
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T * sizes
            found.append(np.linalg.qr(root, mode="r"))
        factors = np.stack(found)
        by_value = slice(-1 - len(apart), -1)
        factors[..., by_value] = factors[..., by_value] @ apart
        return factors

    def errors(
        self, drawn: Float[np.ndarray, "motions dim"], residuals: Float[np.ndarray, "motions windows numbers"],
        noise: float, chatter: float,
    ) -> Float[np.ndarray, "motions dim"]:  # fmt: skip
        """Return errors of the values that other motions would be given if they were recorded, in standard errors."""
        rng, dim = np.random.default_rng(1), drawn.shape[1]
        slope, seen = np.zeros((dim, dim)), np.zeros((dim, len(drawn)))
        apart = self._told(noise, chatter)
        for (columns, *_), product, one in zip(
            self._parts, self._weighed(noise, chatter), residuals.swapaxes(0, 1), strict=True
        ):
            free = len(columns) - dim - 1
            gram, told = product(columns.T), product((one + noise * rng.normal(size=one.shape) - columns[-1]).T)
            inner = gram[:-1, :free] @ np.linalg.pinv(gram[:free, :free], hermitian=True)
            slope += gram[free:-1, free:-1] - inner[free:] @ gram[:free, free:-1]
            seen += told[free:-1] - inner[free:] @ told[:free]
        inverse = np.linalg.pinv(apart.T @ slope @ apart, rcond=1e-12, hermitian=True)
        # A number that cannot be told has no error.
        is_told = (apart == np.eye(dim)).all(axis=1)
        sizes = np.sqrt(np.where(is_told, np.diag(inverse), 0.0))
        return ((inverse @ apart.T @ seen).T - (drawn - self._middle)) / np.where(sizes > 0, noise * sizes, np.inf)


def _sum_of_others(left: np.ndarray, gram: np.ndarray, least: float) -> tuple[float, float]:
    """Return the sum of squares of motions' chatter, each over the covariance of noise and the others', and its directions.

    The errors of derivatives are of chatter that is another than what is left: by its own covariance it would seem smaller.
    """
    if left.shape[1] < len(left):
        inner = np.linalg.solve(least * np.eye(left.shape[1]) + left.T @ left, left.T)
        part, own = inner @ left, np.sum(left * inner.T, axis=1)
    else:
        part = np.eye(len(left)) - least * np.linalg.inv(least * np.eye(len(left)) + gram)
        own = np.diag(part)
    # e_i' (n σ² + e'e - e_i e_i')⁻¹ e_i = h / (1 - h), where h is the same with e_i.
    own = np.clip(own, 0.0, 1.0 - 1e-12)
    squares = float(np.sum(part * part.T))
    return float(np.sum(own / (1.0 - own))), max(float(np.trace(part)) ** 2 / max(squares, 1e-300), 1.0)
