"""From settings to numbers, and what a gradient is worth by them."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

import mjxgrad as mg
from experiments.policy_gradient.settings import Settings
from experiments.problems.push import push
from experiments.workspace import Workspace
from mjxgrad.estimators.mixture import both_parts, weigh
from mjxgrad.estimators.rules import LeastRisk
from mjxgrad.estimators.samples import plan_by_noise, stream

DISCRETE, ONSET = GRADIENTS = ("discrete", "onset")
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


class Estimated(eqx.Module):
    """Both parts of α-order estimates, first order and control variate, before they are mixed: of one, or many at one point.

    α is what the default rule gives the first, for a reason of `mg.estimators.Reason`; the cost is the mean over the rollouts.
    """

    first: Float[Any, "*estimates dim"]
    unbiased: Float[Any, "*estimates dim"]
    alpha: Float[Any, "*estimates"]
    reason: Int[Any, "*estimates"]
    cost: Float[Any, "*estimates"]


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
    estimates: Mapping[str, Estimated]  # by gradient
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

    def _judge(self, one: Estimated) -> Judged:
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
class Outcome:
    """All that was measured, by task and point."""

    settings: Settings
    cells: list[Cell]

    def of(self, *names: str) -> list[Cell]:
        """Give the cells of some tasks."""
        return [cell for cell in self.cells if cell.name in names]

    def rows(self) -> list[dict[str, Any]]:
        """One row per cell and gradient, for metrics.csv."""
        return [
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


# What MuJoCo gives a contact that says nothing: solref 0.02 1 and solimp 0.9 0.95 0.001.
DEFAULT_CONTACT = mg.Softness(stiffness=2500.0, damping_ratio=1.0, impedance=(0.9, 0.95), width=0.001)
WALL_STIFFNESS = 1e4  # 1/s², that of the README
_JUMPS = (0.62, 1.29)  # rad: throws between about 35 and 74 degrees clear the wall


@dataclass(frozen=True)
class Point:
    """Parameters at which gradients are compared, and whether the noise covers a jump of the cost there."""

    label: str
    params: Float[Array, " dim"]
    hits_and_misses: bool = False


@dataclass(frozen=True)
class Problem:
    """A task with its name in the settings and its title."""

    name: str
    title: str
    task: Any
    stddev: float  # of the noise at the points where gradients are compared
    points: Sequence[Point]
    num_samples: int  # rollouts of one estimate
    has_jump_of_force: bool  # whether its contacts set in with a force that is not zero

    def objective(self, gradient: str, stddev: float) -> mg.Objective:
        """Return the task's cost with contact that begins within the step, or with MuJoCo's motion and its derivative."""
        contact = mg.Onset() if gradient == ONSET else mg.Discrete()
        return self.task.with_contact(contact).objective(jnp.asarray(stddev))


def problem(name: str, settings: Settings) -> Problem:
    """Build one of the tasks that the settings name."""
    if name.startswith("push"):
        stiffness = {"push_soft": 10.0, "push_stiff": 1000.0}[name]
        task = push(stiffness)
        start = Point("start", task.initial_params())
        return Problem(name, f"Push, {stiffness:g} N/m", task, task.stddev, [start], 16, has_jump_of_force=False)
    return _hopper() if name == "hopper" else _throw(name, settings)


def _throw(name: str, settings: Settings) -> Problem:
    is_default = name == "ball_wall_default"
    softness = DEFAULT_CONTACT if is_default else mg.tasks.wall_softness(WALL_STIFFNESS)
    points = [
        Point(
            f"{angle:g} rad", jnp.array([angle]), any(abs(angle - jump) < 3 * settings.angle_stddev for jump in _JUMPS)
        )
        for angle in settings.angles
    ]
    title = "Throw, default contact" if is_default else "Throw, gentle contact"
    task = mg.tasks.ball_wall().with_softness(softness)
    return Problem(name, title, task, settings.angle_stddev, points, 50, has_jump_of_force=is_default)


def _hopper() -> Problem:
    task = mg.tasks.hopper()
    return Problem("hopper", "Hopper", task, 0.1, [Point("start", task.initial_params())], 32, has_jump_of_force=True)


@eqx.filter_jit
def estimated(objective: mg.Objective, params: Float[Array, " dim"], key: PRNGKeyArray, num_samples: int) -> Estimated:
    """Estimate once, by all estimators from the same rollouts.

    The public estimators give the same numbers one by one. To compile takes longer than all rollouts, so bias, reference and α
    share this one program.
    """
    objective = objective.sized_for(params)
    plan = plan_by_noise(objective, num_samples, None)
    parts = stream(objective, params, key, plan, functools.partial(both_parts, control_variate=True))
    weights = weigh(LeastRisk(), parts, plan)
    reason = jnp.asarray(weights.reason._value)  # pyright: ignore[reportAttributeAccessIssue]
    return Estimated(parts.first.mean, parts.unbiased.mean, weights.alpha, reason, parts.costs.mean)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Compare both gradients on all tasks."""
    cells = []
    with workspace.stage("estimates", "tasks", len(settings.tasks)) as advance_to:
        for number, name in enumerate(settings.tasks):
            key = jax.random.fold_in(jax.random.key(settings.seed), number)
            one = problem(name, settings)
            workspace.check(one.task.scene, name=one.title)
            for i, k in enumerate(jax.random.split(key, len(one.points))):
                cells.append(workspace.once(f"{name} {i}", functools.partial(_cell, one, i, k, settings)))
            advance_to(number + 1)
    return Outcome(settings, cells)


def _cell(one: Problem, index: int, key: PRNGKeyArray, settings: Settings) -> Cell:
    point = one.points[index]
    own, other = jax.random.split(key)
    keys = jax.random.split(own, settings.num_estimates)
    # The same rollouts for both: what differs is the derivative.
    estimates = {gradient: _estimates(one, gradient, point.params, keys) for gradient in GRADIENTS}
    # Unbiased by whatever derivative, so that with the less noise is taken; chosen by other rollouts than its own.
    best = min(GRADIENTS, key=lambda gradient: np.var(estimates[gradient].unbiased, axis=0).sum())
    reference = _estimates(one, best, point.params, jax.random.split(other, settings.num_references)).unbiased
    return Cell(one.name, one.title, point.label, point.hits_and_misses, one.has_jump_of_force, estimates, reference)


def _estimates(one: Problem, gradient: str, params: Float[Array, " dim"], keys: Key[Array, " count"]) -> Estimated:
    objective = one.objective(gradient, one.stddev)
    found = [estimated(objective, params, key, one.num_samples) for key in keys]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)
