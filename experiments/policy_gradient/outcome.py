"""The numbers of an experiment on policy gradients."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from experiments.policy_gradient.settings import Settings

DISCRETE, ONSET = GRADIENTS = ("discrete", "onset")
ESTIMATORS = {"first": "first order", "alpha": "α-order"}
Vectors = Float[np.ndarray, "estimates dim"]


def squared_norm(vectors: Vectors) -> float:
    r"""Give the squared norm of the mean without bias; below zero if noise is all there is.

    That of the average holds the noise, too: with 200 coordinates more noise than signal. The mean of $x_i \cdot x_j$ over
    different $i$ and $j$ does not.
    """
    count = len(vectors)
    return float((np.sum(vectors.sum(axis=0) ** 2) - np.sum(vectors**2)) / (count * (count - 1)))


def share_along(first: Vectors, reference: Vectors) -> float:
    """Give the component of a mean along another, as a share of that one's length; NaN where that is not known from zero."""
    square = squared_norm(reference)
    return float(first.mean(axis=0) @ reference.mean(axis=0)) / square if square > 0 else np.nan


def squared_distance(first: Vectors, reference: Vectors) -> float:
    """Give the squared distance of two means over the squared norm of the second, likewise, without bias."""
    square = squared_norm(reference)
    return squared_norm(first) / square + 1 - 2 * share_along(first, reference) if square > 0 else np.nan


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


class Estimates(NamedTuple):
    """Independent estimates at one point, with α of the default rule and the numbers of its `mg.estimators.Reason`."""

    first: Vectors
    unbiased: Vectors
    alpha: Float[np.ndarray, " estimates"]
    reason: Int[np.ndarray, " estimates"]


class Judged(NamedTuple):
    """What one gradient is worth at one point; all but α over the norm of the gradient."""

    bias: float  # norm of that of the first order, noise taken off
    low: float  # two standard errors below; they are of the square, and the square root of what is below zero is zero
    high: float  # two standard errors above
    along: float  # component of the first-order mean along the reference
    along_error: float  # its standard error
    alpha: float  # mean weight of the first order
    alpha_error: float  # its standard error
    error_first: float  # root-mean-square error of one estimate of first order
    error_unbiased: float  # of one unbiased estimate
    error_mixed: float  # of one α-order estimate


@dataclass(frozen=True)
class Cell:
    """Both gradients at one point of one task."""

    name: str  # of the task
    title: str  # of the task
    point: str  # its label
    hits_and_misses: bool  # whether the noise covers a jump of the cost
    has_jump_of_force: bool  # whether contacts set in with a force that is not zero
    estimates: Mapping[str, Estimates]  # by gradient
    reference: Vectors  # unbiased estimates from rollouts of their own

    @property
    def label(self) -> str:
        """Task and point."""
        return self.title if self.point == "start" else f"{self.title}, {self.point}"

    @functools.cached_property
    def norm(self) -> float:
        """Norm of the reference; NaN where it is not known from zero, as everything measured by it."""
        square = squared_norm(self.reference)
        return square**0.5 if square > 0 else np.nan

    @functools.cached_property
    def judged(self) -> dict[str, Judged]:
        """What each gradient is worth."""
        return {gradient: self._judge(self.estimates[gradient]) for gradient in GRADIENTS}

    def _judge(self, one: Estimates) -> Judged:
        sets, alpha = (one.first, self.reference), one.alpha[:, None]
        square, error = squared_distance(*sets), jackknife_error(squared_distance, *sets)
        reference, noise = mean_and_error(self.reference)
        kinds = (one.first, one.unbiased, alpha * one.first + (1 - alpha) * one.unbiased)
        squares = [float(np.mean(np.sum((kind - reference) ** 2, axis=1)) - np.sum(noise**2)) for kind in kinds]
        return Judged(
            bias=_root(square),
            low=_root(square - 2 * error),
            high=_root(square + 2 * error),
            along=share_along(*sets),
            along_error=jackknife_error(share_along, *sets),
            alpha=float(one.alpha.mean()),
            alpha_error=float(mean_and_error(alpha)[1][0]),
            error_first=_root(squares[0]) / self.norm,
            error_unbiased=_root(squares[1]) / self.norm,
            error_mixed=_root(squares[2]) / self.norm,
        )


def mean_and_error(vectors: Vectors) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
    """Give the mean and its standard error."""
    return vectors.mean(axis=0), vectors.std(axis=0, ddof=1) / len(vectors) ** 0.5


def _root(square: float) -> float:
    return max(square, 0.0) ** 0.5


@dataclass(frozen=True)
class Course:
    """Descents of one kind on a task, one per seed."""

    name: str  # of the task
    title: str  # of the task
    estimator: str  # of `ESTIMATORS`
    gradient: str  # of `GRADIENTS`
    costs: Float[np.ndarray, "seeds steps"]  # mean costs under noise, before each step and at the end
    alphas: Float[np.ndarray, "seeds steps"]  # weights of the first order, likewise
    seconds: float  # of all seeds, with compilation if there was any

    @property
    def final(self) -> tuple[float, float | None]:
        """Mean final cost, with its standard deviation over seeds (none of one)."""
        final = self.costs[:, -1]
        return float(final.mean()), float(final.std(ddof=1)) if len(final) > 1 else None


@dataclass(frozen=True)
class Outcome:
    """All that was measured: by task and point, and the descents."""

    settings: Settings
    cells: list[Cell]
    courses: list[Course]

    def of(self, *names: str) -> list[Cell]:
        """Give the cells of some tasks."""
        return [cell for cell in self.cells if cell.name in names]

    def rows(self) -> list[dict[str, Any]]:
        """One row per cell and gradient, and per course, for metrics.csv."""
        rows: list[dict[str, Any]] = [
            {
                "task": cell.name,
                "point": cell.point,
                "gradient": gradient,
                "gradient_norm": cell.norm,
                **cell.judged[gradient]._asdict(),
            }
            for cell in self.cells
            for gradient in GRADIENTS
        ]
        for course in self.courses:
            final, spread = course.final
            rows.append(
                {
                    "task": course.name,
                    "point": f"descent by {course.estimator}",
                    "gradient": course.gradient,
                    "alpha": float(course.alphas.mean()),
                    "final_cost": final,
                    "final_cost_stddev": "" if spread is None else spread,
                }
            )
        return rows
