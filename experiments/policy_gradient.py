"""Policy gradients: which derivative gives first order without bias, and what α-order makes of it."""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray
from matplotlib.ticker import LogLocator
from pydantic import Field

import mjxgrad as mg
from experiments.problems.push import push
from experiments.report import Bold, Table, tabulated
from experiments.settings import Positive, RunSettings
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, legend_below, logarithmic, subplots
from experiments.words import joined, percent, quantity
from experiments.workspace import Workspace
from mjxgrad.estimators import Reason
from mjxgrad.estimators.mixture import both_parts, weigh
from mjxgrad.estimators.rules import LeastRisk
from mjxgrad.estimators.samples import plan_by_noise, stream

TaskName = Literal["ball_wall", "ball_wall_default", "push_soft", "push_stiff", "hopper"]
Angle = Annotated[float, Field(gt=0, lt=1.5)]


class Settings(RunSettings):
    """Both gradients of each task against an unbiased reference, and what α-order makes of them."""

    tasks: Annotated[tuple[TaskName, ...], Field(min_length=1)]
    """Which tasks; `ball_wall_default` has MuJoCo's default contact in place of the scene's own."""
    angles: Annotated[tuple[Angle, ...], Field(min_length=1)]
    """Of the throws at which gradients are compared, in rad."""
    angle_stddev: Positive
    """Noise on the angle there, in rad."""
    num_estimates: Annotated[int, Field(ge=8)]
    """Independent estimates of each kind at each point, from which means and errors are taken."""
    num_references: Annotated[int, Field(ge=8)]
    """Further estimates, all unbiased, behind the reference."""


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
            {"task": cell.name, "point": cell.point, "gradient": gradient, "gradient_norm": cell.norm}
            | cell.judged[gradient]._asdict()
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


def problem(name: str, settings: Settings) -> Problem:
    """Build one of the tasks that the settings name."""
    if name.startswith("push"):
        stiffness = {"push_soft": 10.0, "push_stiff": 1000.0}[name]
        task = push(stiffness)
        start = Point("start", task.initial_params())
        return Problem(name, f"Push, {stiffness:g} N/m", task, task.stddev, [start], 16, has_jump_of_force=False)
    if name == "hopper":
        task = mg.tasks.hopper()
        start = Point("start", task.initial_params())
        return Problem(name, "Hopper", task, 0.1, [start], 32, has_jump_of_force=True)
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
    problems = [problem(name, settings) for name in settings.tasks]
    for one in problems:
        workspace.check(one.task.scene, name=one.title)
    points = [(one, point) for one in problems for point in one.points]
    keys = jax.random.split(jax.random.key(settings.seed), len(points))
    parts = {f"{i}": functools.partial(_cell, *each, keys[i], settings) for i, each in enumerate(points)}
    return Outcome(settings, workspace.each("estimates", "points", parts))


def _cell(one: Problem, point: Point, key: PRNGKeyArray, settings: Settings) -> Cell:
    own, other = jax.random.split(key)
    keys = jax.random.split(own, settings.num_estimates)
    # The same rollouts for both: what differs is the derivative.
    estimates = {gradient: _estimates(one, gradient, point.params, keys) for gradient in GRADIENTS}
    # Unbiased by whatever derivative, so that with the less noise is taken; chosen by other rollouts than its own.
    best = min(GRADIENTS, key=lambda gradient: np.var(estimates[gradient].unbiased, axis=0).sum())
    reference = _estimates(one, best, point.params, jax.random.split(other, settings.num_references)).unbiased
    return Cell(one.name, one.title, point.label, point.hits_and_misses, one.has_jump_of_force, estimates, reference)


def _estimates(one: Problem, gradient: str, params: Float[Array, " dim"], keys: Key[Array, " count"]) -> Estimated:
    contact = mg.Onset() if gradient == ONSET else mg.Discrete()
    objective = one.task.with_contact(contact).objective(jnp.asarray(one.stddev))
    found = [estimated(objective, params, key, one.num_samples) for key in keys]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


NEGLIGIBLE = 0.05
"""Of the gradient's norm: a bias below it matters to no descent."""


def answer(outcome: Outcome) -> str:
    """Count where either first-order gradient is biased, among points without a jump of the cost if there are any."""
    smooth = [cell for cell in outcome.cells if not cell.hits_and_misses]
    if not smooth:
        biased = sum(_is_biased(cell, ONSET) for cell in outcome.cells)
        return f"It does not see hits and misses: biased at {biased} of {len(outcome.cells)} points."
    discrete, onset = (sum(_is_biased(cell, gradient) for cell in smooth) for gradient in (DISCRETE, ONSET))
    if not discrete and not onset:
        return f"First order is right with and without it, at all {len(smooth)} points."
    if onset < discrete:
        return f"It cuts the points with a biased gradient from {discrete} to {onset} of {len(smooth)}."
    return f"It does not help: {onset} of {len(smooth)} points are biased, {discrete} without it."


def verdict(outcome: Outcome) -> str:
    """Say where which first-order estimate is right."""
    smooth = [cell for cell in outcome.cells if not cell.hits_and_misses]
    repaired = [cell for cell in smooth if _is_biased(cell, DISCRETE) and _is_beyond(cell, DISCRETE, ONSET)]
    sentences = []
    if repaired:
        discrete, onset = ([cell.judged[gradient].bias for cell in repaired] for gradient in GRADIENTS)
        sentences.append(
            f"The discrete first-order gradient is biased at {len(repaired)} of {len(smooth)} points without a jump of the cost, "
            f"by {_span(discrete)} of the gradient's norm, where contact that begins within the step leaves {_span(onset)}."
        )
    worse = [cell for cell in smooth if _is_biased(cell, ONSET) and _is_beyond(cell, ONSET, DISCRETE)]
    sentences.append(
        f"Contact that begins within the step is worse in {joined([cell.label for cell in worse])}."
        if worse
        else "Nowhere is contact that begins within the step the worse of both beyond chance."
    )
    jumps = [cell for cell in outcome.cells if cell.hits_and_misses]
    missed = [cell for cell in jumps if _is_biased(cell, ONSET)]
    if missed:
        biases, alphas = zip(*((cell.judged[ONSET].bias, cell.judged[ONSET].alpha) for cell in missed), strict=True)
        sentences.append(
            f"Hit or miss it does not see: at {len(missed)} of {len(jumps)} points where the noise covers a jump it is biased by "
            f"{_span(biases)}, and α-order gives it a weight of {_span(alphas, '{:.2f}'.format)}."
        )
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say whether an onset does harm where contact sets in gently."""
    gentle = [cell for cell in outcome.cells if not cell.has_jump_of_force]
    if not gentle:
        return []
    cell = max(gentle, key=_change)
    return [
        f"Where contact sets in gently it changes the first-order mean by at most {percent(_change(cell))} of the "
        f"gradient ({cell.label})."
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate both gradients at every point."""
    rows = []
    for cell, gradient in itertools.product(outcome.cells, GRADIENTS):
        one, is_first = cell.judged[gradient], gradient == DISCRETE
        bias = f"{one.bias:.1%} ({one.low:.1%} to {one.high:.1%})"
        rows.append(
            {
                "task": cell.label if is_first else "",
                "norm of the gradient": f"{cell.norm:.3g}" if is_first else "",
                "derivative": gradient,
                "bias, first order": Bold(bias) if _is_biased(cell, gradient) else bias,
                "component along": quantity(one.along, one.along_error),
                "α": quantity(one.alpha, one.alpha_error),
                "why (share of estimates)": _reasons(cell, gradient),
                "error, first order": f"{one.error_first:.1%}",
                "error, unbiased": f"{one.error_unbiased:.1%}",
                "error, α-order": f"{one.error_mixed:.1%}",
            }
        )
    caption = (
        "Bias and errors over the norm of the gradient. Bias: of the mean, noise taken off, in brackets two standard errors "
        "to either side; bold where it is not chance and above five per cent. Component along the reference: 1 is right. Errors: "
        "root mean square of one estimate."
    )
    return [tabulated(rows, caption)]


def _is_biased(cell: Cell, gradient: str) -> bool:
    """Say whether a bias is beyond chance, and worth speaking of."""
    return cell.judged[gradient].low > 0 and cell.judged[gradient].bias > NEGLIGIBLE


def _is_beyond(cell: Cell, larger: str, smaller: str) -> bool:
    return cell.judged[larger].low > cell.judged[smaller].high


def _change(cell: Cell) -> float:
    """How far apart both first-order means are, over the norm of the gradient; from the same rollouts."""
    onset, discrete = (cell.estimates[gradient].first.mean(axis=0) for gradient in (ONSET, DISCRETE))
    return float(np.linalg.norm(onset - discrete)) / cell.norm


def _reasons(cell: Cell, gradient: str) -> str:
    """Name the rule's reasons in a word each, with their shares."""
    words = {"inconsistent": "contradictory", "inverse_variance": "trusted", "bias_limit": "biased"}
    words["uncertain"] = "uncertain"
    reasons = cell.estimates[gradient].reason
    shares = {word: float(np.mean(reasons == getattr(Reason, name)._value)) for name, word in words.items()}
    return ", ".join(f"{word} {share:.0%}" for word, share in shares.items() if share > 0)


def _span(values: Sequence[float], write: Callable[[float], str] = percent) -> str:
    return " to ".join(dict.fromkeys(map(write, (min(values), max(values)))))


_COLOURS = {DISCRETE: FIRST, ONSET: ZEROTH}
_MARKERS = {DISCRETE: "o", ONSET: "s"}
_SMALLEST = 1e-3
_THROWS = ("ball_wall", "ball_wall_default")


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"summary": summarised} | ({"throw": throw} if outcome.of(*_THROWS) else {})


def summarised(outcome: Outcome):
    """Three panels with one row per point: bias of the first order, α, error of one α-order estimate."""
    cells = outcome.cells
    figure, axes = subplots(1, 3, height=1.4 + 0.27 * len(cells), sharey=True)
    rows = np.arange(len(cells))
    for gradient, shift in ((DISCRETE, -0.14), (ONSET, 0.14)):
        look = {"color": _COLOURS[gradient], "marker": _MARKERS[gradient], "ls": "", "ms": 5}
        judged = [cell.judged[gradient] for cell in cells]
        bias, low, high = np.maximum(np.array([one[:3] for one in judged]).T, _SMALLEST)
        spread = np.abs(np.stack([bias - low, high - bias]))
        axes[0, 0].errorbar(bias, rows + shift, xerr=spread, label=f"{gradient} gradient", elinewidth=1, **look)
        alpha, alpha_error = np.array([(one.alpha, one.alpha_error) for one in judged]).T
        axes[0, 1].errorbar(alpha, rows + shift, xerr=2 * alpha_error, elinewidth=1, **look)
        axes[0, 2].plot([one.error_mixed for one in judged], rows + shift, **look)
    for axis in axes[0]:
        for row in rows[[cell.hits_and_misses for cell in cells]]:
            axis.axhspan(row - 0.5, row + 0.5, color=MUTED, alpha=0.18, lw=0)
        axis.grid(axis="y", visible=False)
    for axis in axes[0, ::2]:
        logarithmic(axis.xaxis)
        axis.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g}%")
    axes[0, 0].set_xlim(left=_SMALLEST)
    axes[0, 1].set_xlim(-0.04, 1.04)
    axes[0, 0].set_yticks(rows, [cell.label for cell in cells])
    axes[0, 0].set_ylim(len(cells) - 0.5, -0.5)
    axes[0, 2].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes[0, 0].set(title="Bias of the first order", xlabel="share of the gradient")
    axes[0, 1].set(title="Weight of the first order", xlabel="α")
    axes[0, 2].set(title="Error of one α-order estimate", xlabel="share of the gradient")
    legend_below(figure, axes[0, 0], 2)
    caption = (
        "Left, norm of the bias over the norm of the gradient, noise taken off, with two standard errors; where the interval "
        "reaches the edge no bias was found. Middle, mean weight of the first order. Right, root-mean-square error of one "
        "estimate, over the norm of the gradient: the smaller, the fewer rollouts are needed. Shaded: the noise covers a jump "
        "of the cost."
    )
    return figure, "Bias, trust and error", caption


def throw(outcome: Outcome):
    """A row per contact: gradients against the angle, and α."""
    cells = outcome.of(*_THROWS)
    names = list(dict.fromkeys(cell.name for cell in cells))
    figure, axes = subplots(len(names), 2, height=0.6 + 2.7 * len(names), sharex=True, width_ratios=[1.6, 1])
    for (left, right), name in zip(axes, names, strict=True):
        shown = [cell for cell in cells if cell.name == name]
        angle = np.array([float(cell.point.split()[0]) for cell in shown])
        reference = np.array([mean_and_error(cell.reference) for cell in shown])[:, :, 0]
        left.errorbar(
            angle, reference[:, 0], 2 * reference[:, 1], color=REFERENCE, lw=2.2, capsize=3, label="unbiased reference"
        )
        for gradient, shift in ((DISCRETE, -0.006), (ONSET, 0.006)):
            look = {"color": _COLOURS[gradient], "marker": _MARKERS[gradient], "ms": 5, "lw": 1, "ls": (0, (4, 2))}
            first = np.array([mean_and_error(cell.estimates[gradient].first) for cell in shown])[:, :, 0]
            left.errorbar(
                angle + shift, first[:, 0], 2 * first[:, 1], label=f"first order, {gradient} gradient", **look
            )
            judged = [cell.judged[gradient] for cell in shown]
            spread = [2 * one.alpha_error for one in judged]
            right.errorbar(angle + shift, [one.alpha for one in judged], spread, **look)
        for axis in (left, right):
            for cell, place in zip(shown, angle, strict=True):
                if cell.hits_and_misses:
                    axis.axvspan(place - 0.05, place + 0.05, color=MUTED, alpha=0.18, lw=0)
        left.set_yscale("symlog", linthresh=0.01)
        left.yaxis.set_major_formatter("{x:g}")
        left.set(title=shown[0].title, ylabel="gradient, m²/rad")
        right.set(title="Weight of the first order", ylabel="α", ylim=(-0.05, 1.05))
    for axis in axes[-1]:
        axis.set_xlabel("angle, rad")
    legend_below(figure, axes[0, 0], 3)
    caption = (
        f"Left, gradient of the cost under noise of {outcome.settings.angle_stddev:g} rad; error bars are two standard errors. "
        "Right, weight of the first order in the α-order estimate. Shaded: between the first throws that clear the wall and the "
        "last that do not; there neither derivative sees the jump."
    )
    return figure, "Throws over the wall", caption
