"""The numbers of an experiment on policy gradients."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from experiments.policy_gradient.settings import Settings

DISCRETE, ONSET = GRADIENTS = ("discrete", "onset")
ESTIMATORS = {"first": "first order", "alpha": "α-order"}
Vectors = Float[np.ndarray, "estimates dim"]


def squared_norm(vectors: Vectors) -> float:
    r"""Give the squared norm of the mean without bias.

    That of the average holds the noise, too: with 200 coordinates more noise than signal. The mean of $x_i \cdot x_j$ over
    different $i$ and $j$ does not.
    It is below zero if noise is all there is.
    """
    count = len(vectors)
    return float((np.sum(vectors.sum(axis=0) ** 2) - np.sum(vectors**2)) / (count * (count - 1)))


def squared_distance(first: Vectors, reference: Vectors) -> float:
    """Give the squared distance of two means, of independent estimates, without bias."""
    return squared_norm(first) + squared_norm(reference) - 2 * float(first.mean(axis=0) @ reference.mean(axis=0))


def share_along(first: Vectors, reference: Vectors) -> float:
    """Give the component of a mean along another, as a share of that one's length; NaN where that is not known from zero."""
    square = squared_norm(reference)
    return float(first.mean(axis=0) @ reference.mean(axis=0)) / square if square > 0 else np.nan


def cosine(first: Vectors, reference: Vectors) -> float:
    """Give the cosine of the angle between two means; NaN where one of them is not known from zero."""
    squares = squared_norm(first) * squared_norm(reference)
    inner = float(first.mean(axis=0) @ reference.mean(axis=0))
    return inner / np.sqrt(squares) if squares > 0 else np.nan


def relative_squared_distance(first: Vectors, reference: Vectors) -> float:
    """Give the squared distance of two means over the squared norm of the second; NaN where that is not known from zero."""
    square = squared_norm(reference)
    return squared_distance(first, reference) / square if square > 0 else np.nan


def jackknife_error(function: Callable[..., float], *sets: Vectors) -> float:
    """Give the standard error of a function of several sets of independent estimates: each is left out once.

    References:
        Efron, Tibshirani. An Introduction to the Bootstrap. Chapman & Hall 1993, section 11.5.
    """
    variance = 0.0
    for i, vectors in enumerate(sets):
        count = len(vectors)
        without = [function(*sets[:i], np.delete(vectors, j, axis=0), *sets[i + 1 :]) for j in range(count)]
        variance += (count - 1) * float(np.var(without))
    return variance**0.5


@dataclass(frozen=True)
class Estimates:
    """Independent estimates at one point.

    Attributes:
        first: of first order.
        unbiased: by control variate.
        alpha: what the default rule gives the first.
        reason: numbers of items of `mg.estimators.Reason`.
    """

    first: Vectors
    unbiased: Vectors
    alpha: Float[np.ndarray, " estimates"]
    reason: Int[np.ndarray, " estimates"]

    @property
    def mixed(self) -> Vectors:
        """The α-order estimates."""
        return self.alpha[:, None] * self.first + (1 - self.alpha[:, None]) * self.unbiased


@dataclass(frozen=True)
class Cell:
    """Both gradients at one point of one task.

    Attributes:
        name: of the task.
        title: of the task.
        point: its label.
        hits_and_misses: whether the noise covers a jump of the cost.
        has_jump_of_force: whether contacts set in with a force that is not zero.
        estimates: by gradient.
        reference: unbiased estimates from rollouts of their own.
    """

    name: str
    title: str
    point: str
    hits_and_misses: bool
    has_jump_of_force: bool
    estimates: Mapping[str, Estimates]
    reference: Vectors

    @property
    def label(self) -> str:
        """Task and point."""
        return self.title if self.point == "start" else f"{self.title}, {self.point}"

    @functools.cached_property
    def norm(self) -> float:
        """Norm of the reference; NaN where it is not known from zero, as everything measured by it."""
        square = squared_norm(self.reference)
        return square**0.5 if square > 0 else np.nan

    def first_mean(self, gradient: str) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
        """Mean of the first-order estimates, with its standard error."""
        return _mean(self.estimates[gradient].first)

    def reference_mean(self) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
        """The reference, with its standard error."""
        return _mean(self.reference)

    def bias(self, gradient: str) -> tuple[float, float, float]:
        """Norm of the bias of the first order over that of the gradient, with the ends of two standard errors.

        The errors are of the square, in which the noise has been taken off; the square root of what is below zero is zero.
        """
        sets = self.estimates[gradient].first, self.reference
        square, error = relative_squared_distance(*sets), jackknife_error(relative_squared_distance, *sets)
        return _root(square), _root(square - 2 * error), _root(square + 2 * error)

    def along(self, gradient: str) -> tuple[float, float]:
        """Component of the first-order mean along the reference, as a share of it, with its standard error."""
        sets = self.estimates[gradient].first, self.reference
        return share_along(*sets), jackknife_error(share_along, *sets)

    def error(self, gradient: str, kind: str) -> float:
        """Root-mean-square error of one estimate ("first", "unbiased" or "mixed") over the gradient's norm."""
        estimates, (reference, noise) = getattr(self.estimates[gradient], kind), self.reference_mean()
        return _root(float(np.mean(np.sum((estimates - reference) ** 2, axis=1)) - np.sum(noise**2))) / self.norm

    def alpha(self, gradient: str) -> tuple[float, float]:
        """Mean weight of the first order, with its standard error."""
        alpha = self.estimates[gradient].alpha
        return float(alpha.mean()), float(alpha.std(ddof=1) / len(alpha) ** 0.5)


@dataclass(frozen=True)
class Course:
    """Descents of one kind, one per seed.

    Attributes:
        name: of the task.
        title: of the task.
        estimator: "first" or "alpha".
        gradient: "discrete" or "onset".
        costs: mean costs under noise, before each step and at the end.
        alphas: weights of the first order, likewise.
        seconds: of all seeds, with compilation if there was any.
    """

    name: str
    title: str
    estimator: str
    gradient: str
    costs: Float[np.ndarray, "seeds steps"]
    alphas: Float[np.ndarray, "seeds steps"]
    seconds: float

    @property
    def final(self) -> tuple[float, float | None]:
        """Mean final cost, with its standard deviation over seeds (none of one)."""
        final = self.costs[:, -1]
        return float(final.mean()), float(final.std(ddof=1)) if len(final) > 1 else None


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        cells: by task and point.
        courses: of the descents.
    """

    settings: Settings
    cells: list[Cell]
    courses: list[Course]

    def of(self, *names: str) -> list[Cell]:
        """Give the cells of some tasks."""
        return [cell for cell in self.cells if cell.name in names]

    def rows(self) -> list[dict[str, Any]]:
        """One row per cell and gradient, and per course, for metrics.csv."""
        rows = []
        for cell in self.cells:
            for gradient in GRADIENTS:
                (bias, low, high), (along, along_error) = cell.bias(gradient), cell.along(gradient)
                rows.append(
                    {
                        "task": cell.name,
                        "point": cell.point,
                        "gradient": gradient,
                        "gradient_norm": cell.norm,
                        "relative_bias": bias,
                        "relative_bias_low": low,
                        "relative_bias_high": high,
                        "along": along,
                        "along_error": along_error,
                        "cosine": cosine(cell.estimates[gradient].first, cell.reference),
                        "alpha": cell.alpha(gradient)[0],
                        **{f"error_{kind}": cell.error(gradient, kind) for kind in ("first", "unbiased", "mixed")},
                    }
                )
        for course in self.courses:
            final, spread = course.final
            rows.append(
                {
                    "task": course.name,
                    "point": f"descent by {course.estimator}",
                    "gradient": course.gradient,
                    "final_cost": final,
                    "final_cost_stddev": "" if spread is None else spread,
                    "alpha": float(course.alphas.mean()),
                }
            )
        return rows


def _mean(vectors: Vectors) -> tuple[np.ndarray, np.ndarray]:
    return vectors.mean(axis=0), vectors.std(axis=0, ddof=1) / len(vectors) ** 0.5


def _root(square: float) -> float:
    return max(square, 0.0) ** 0.5
