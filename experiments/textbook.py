"""Textbook problems: every estimator against gradients that are known in closed form."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator
from pydantic import Field, model_validator
from scipy import stats

from experiments import theme
from experiments.optimisation.measure import estimator
from experiments.optimisation.settings import MethodSettings
from experiments.problems import textbook
from experiments.problems.comparison import compare
from experiments.problems.textbook import Textbook
from experiments.report import Bold, Table, tabulated
from experiments.settings import Confidence, Finite, Positive, RunSettings, Several
from experiments.theme import FIRST, MUTED, REFERENCE, Drawings, power, subplots
from experiments.words import capitalised, counted, named, quantity
from experiments.workspace import Workspace


class Settings(RunSettings):
    """Error, bias and variance of estimators against samples and stiffness, with closed forms drawn in."""

    # The cost, a function of `experiments/problems/textbook.py`.
    problem: Literal["heaviside", "soft_heaviside", "quadratic_sine"]
    point: Finite  # where the gradient is estimated
    stddev: Positive  # of the noise
    # In the order of the legend.
    estimators: Annotated[tuple[MethodSettings, ...], Field(min_length=1, max_length=10)]
    # Rollouts per estimate, all that an estimator spends included, for error against rollouts.
    num_samples: Annotated[tuple[Several, ...], Field(min_length=2)]
    num_repeats: Several = 400  # estimates of each estimator at each setting
    stiffness: tuple[Positive, ...] = ()  # to sweep: 1/width of the soft step, or the frequency of the sine
    shown_stiffness: Positive | None = None  # at which error against rollouts is measured
    samples_at_stiffness: Several = 100  # rollouts per estimate in the sweep of stiffness
    amplitude: Positive = 0.1  # of the sine
    confidence: Confidence = 0.95  # of every interval

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.problem == "heaviside" and (self.stiffness or self.shown_stiffness):
            raise ValueError("stiffness and shown_stiffness must not be set: a step has none; take soft_heaviside")
        if self.problem != "heaviside" and (len(self.stiffness) < 2 or self.shown_stiffness is None):
            raise ValueError(f"{self.problem} needs at least two values of stiffness, and shown_stiffness")
        if other := [one.label for one in self.estimators if one.is_baseline]:
            raise ValueError(f"estimators must be of one gradient with noise on the parameters, got {other[0]}")
        if any(one.rule == "bias_constrained" for one in self.estimators):
            raise ValueError("estimators must have rules that need no number, got bias_constrained")
        return self


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    The sweeps are by `setting` and `estimator`: what `compare` gives, and `exact_rmse`, the root-mean-square error in closed
    form, NaN where there is none.
    """

    settings: Settings
    gradient: float  # the truth at the shown stiffness
    by_samples: xr.Dataset
    by_stiffness: xr.Dataset | None
    problem: Textbook  # the shown one

    @property
    def sweeps(self) -> list[xr.Dataset]:
        """Those that there are."""
        return [self.by_samples, *([] if self.by_stiffness is None else [self.by_stiffness])]

    @property
    def is_biased(self) -> xr.DataArray:
        """Where the bias differs from zero, beyond chance over all numbers of rollouts and estimators (Bonferroni)."""
        table = self.by_samples
        quantile = stats.t.isf((1 - self.settings.confidence) / 2 / table.bias.size, table.num_finite - 1)
        # Where nothing varies, a difference of rounding alone is none.
        return abs(table.bias) > quantile * np.sqrt(table.variance / table.num_finite) + 1e-9 * abs(self.gradient)

    def rows(self) -> list[dict[str, Any]]:
        """One row per setting and estimator, for metrics.csv."""
        return [row for sweep in self.sweeps for row in sweep.to_dataframe().reset_index().to_dict("records")]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Repeat every estimator at every number of rollouts and every stiffness."""
    named = {one.label: estimator(one) for one in settings.estimators}
    shown = settings.shown_stiffness
    problem = _problem(settings, shown)
    by_samples = [(shown, rollouts) for rollouts in settings.num_samples]
    by_stiffness = [(stiffness, settings.samples_at_stiffness) for stiffness in settings.stiffness]

    def cell(key: Array, stiffness: float | None, rollouts: int) -> xr.Dataset:
        one = _problem(settings, stiffness)
        found = compare(
            named,
            one.objective(settings.stddev),
            jnp.array([settings.point]),
            key,
            budget=rollouts,
            reference=float(one.gradient(settings.point, settings.stddev)),
            num_repeats=settings.num_repeats,
            confidence=settings.confidence,
        )
        exact = [_exact_error(method, settings, stiffness, rollouts) for method in settings.estimators]
        found = found.assign_coords(stiffness=np.nan if stiffness is None else stiffness)
        return found.assign(exact_rmse=("estimator", exact))

    keys = jax.random.split(jax.random.key(settings.seed), len(by_samples) + len(by_stiffness))
    given = zip(keys, [*by_samples, *by_stiffness], strict=True)
    parts = {f"{i}": functools.partial(cell, key, *one) for i, (key, one) in enumerate(given)}
    found = workspace.each("estimates", "settings", parts)
    swept: list[list[xr.Dataset]] = [found[: len(by_samples)], found[len(by_samples) :]]
    over_samples, *over_stiffness = (xr.concat(one, "setting", coords=["stiffness"]) for one in swept if one)
    gradient = float(problem.gradient(settings.point, settings.stddev))
    return Outcome(settings, gradient, over_samples, next(iter(over_stiffness), None), problem)


def _problem(settings: Settings, stiffness: float | None) -> Textbook:
    if stiffness is None:
        return textbook.Heaviside()
    if settings.problem == "soft_heaviside":
        return textbook.SoftHeaviside(1 / stiffness)
    return textbook.QuadraticSine(settings.amplitude, stiffness)


def _exact_error(one: MethodSettings, settings: Settings, stiffness: float | None, rollouts: int) -> float:
    """Give the root-mean-square error of an estimator in closed form; NaN where there is none."""
    point, stddev, problem = settings.point, settings.stddev, _problem(settings, stiffness)
    if one.antithetic or one.name not in ("first_order", "zeroth_order"):
        return np.nan
    if one.name == "first_order":
        bias = problem.first_order_mean(point, stddev) - problem.gradient(point, stddev)
        return float(jnp.sqrt(bias**2 + problem.first_order_variance(point, stddev) / rollouts))
    if one.baseline in (None, "leave_one_out"):
        return float(jnp.sqrt(problem.leave_one_out_variance(point, stddev, rollouts)))
    # The baseline without noise is one rollout that is no sample.
    is_paid = one.baseline == "zero_noise"
    baseline = problem(jnp.array([point])) if is_paid else 0.0
    return float(jnp.sqrt(problem.zeroth_order_variance(point, stddev, baseline) / (rollouts - is_paid)))


def answer(outcome: Outcome) -> str:
    """Say which estimators see a jump; what a stiffness, what a ripple does to both orders."""
    if outcome.by_stiffness is None:
        labels, is_blind = outcome.is_biased.estimator.values, outcome.is_biased[-1].values
        seeing, blind = list(labels[~is_blind]), list(labels[is_blind])
        if not blind:
            return "All of them see it."
        if len(blind) <= len(seeing):
            return f"All but {named(blind, len(labels), words=10)} see it."
        return capitalised(f"{named(seeing, len(labels), words=10)} {'sees' if len(seeing) == 1 else 'see'} it.")
    if not {"first order", "zeroth order"} <= set(outcome.by_stiffness.estimator.values):
        return _closest(outcome)
    errors = outcome.by_stiffness.rmse
    first, zeroth = (
        f"{float(e[-1] / e[0]):.2g}" for e in (errors.sel(estimator=f"{n} order") for n in ("first", "zeroth"))
    )
    if outcome.settings.problem == "quadratic_sine":
        return f"It multiplies first order's error by {first}, zeroth order's by {zeroth}."
    return f"First order's error grows {first}×, zeroth order's {zeroth}×."


def verdict(outcome: Outcome) -> str:
    """Say which estimator is closest, and which are biased."""
    return " ".join(sentence for sentence in (_closest(outcome), _bias(outcome), _crossing(outcome)) if sentence)


def findings(outcome: Outcome) -> list[str]:
    """Say what no table shows: agreement with closed forms, and what was left out."""
    hits = total = lost = 0
    for table in outcome.sweeps:
        exact = table.exact_rmse
        inside = (table.rmse_low <= exact * (1 + 1e-9)) & (exact <= table.rmse_high * (1 + 1e-9))
        hits, total = hits + int(inside.sum()), total + int(exact.notnull().sum())
        lost += int((outcome.settings.num_repeats - table.num_finite).max("estimator").sum())
    confidence = f"{outcome.settings.confidence:.0%}"
    agreement = f"{hits} of {total} intervals of the error contain the closed form, at {confidence} each."
    left_out = f"{lost} estimates were not finite and were left out." if lost else ""
    return [sentence for sentence in (agreement, left_out) if sentence]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all estimators at the largest number of rollouts."""
    last, rows = outcome.by_samples.isel(setting=-1), []
    for label in last.estimator.values:
        one = {name: value.item() for name, value in last.sel(estimator=label).data_vars.items()}
        half = {name: (one[f"{name}_high"] - one[f"{name}_low"]) / 2 for name in ("bias", "rmse")}
        bias = quantity(one["bias"], half["bias"])
        rows.append(
            {
                "estimator": label,
                "samples": str(one["num_samples"]),
                "mean": quantity(one["mean"], half["bias"]),
                "bias": Bold(bias) if outcome.is_biased[-1].sel(estimator=label) else bias,
                "error": quantity(one["rmse"], half["rmse"]),
                "error, closed form": "" if np.isnan(one["exact_rmse"]) else quantity(one["exact_rmse"]),
                "error it claims": quantity(one["claimed_variance"] ** 0.5),
            }
        )
    caption = (
        f"At {outcome.settings.num_samples[-1]} rollouts per estimate; the gradient is {quantity(outcome.gradient)}. "
        f"Half widths are of {outcome.settings.confidence:.0%} intervals. A bias in bold differs from zero beyond chance "
        "over all numbers of rollouts. The last column is the root of the mean squared standard error of the estimates: "
        "an estimator that claims less than its error hides something."
    )
    return [tabulated(rows, caption)]


def _closest(outcome: Outcome) -> str:
    few, many = (_best(outcome.by_samples.isel(setting=i)) for i in (0, -1))
    low, high = outcome.settings.num_samples[0], outcome.settings.num_samples[-1]
    shown = outcome.settings.shown_stiffness
    where = "" if shown is None else f" at {stiffness_name(outcome)} = {shown:g}"
    if few == many:
        return f"From {low} to {high} rollouts{where} the smallest error is that of {few}."
    return f"With {low} rollouts{where} the smallest error is that of {few}; with {high} that of {many}."


def _best(table: xr.Dataset) -> str:
    """Name the estimator of least error, and count those whose intervals overlap its own."""
    table = table.sortby("rmse")
    ties = table.estimator.values[table.rmse_low.values <= table.rmse_high.values[0]]
    return f"{ties[0]}, in a tie with {counted(len(ties) - 1, 'other', 'others')}" if len(ties) > 1 else str(ties[0])


def _bias(outcome: Outcome) -> str:
    biased = outcome.is_biased
    if not biased.any():
        return "No estimator shows a bias."
    share, parts = (outcome.by_samples.bias / abs(outcome.gradient)).where(biased), []
    for label in biased.estimator.values[biased.any("setting")]:
        worst = int(np.nanargmax(abs(share.sel(estimator=label).values)))
        size = f"{share.sel(estimator=label).values[worst]:+.2g}".replace("-", "−")
        parts.append(f"{label} (by {size} of the gradient with {outcome.settings.num_samples[worst]} rollouts)")
    others = "" if len(parts) == biased.estimator.size else "; the others show no bias"
    return f"Biased beyond chance: {', '.join(parts)}{others}."


def _crossing(outcome: Outcome) -> str | None:
    """Say from which stiffness on zeroth order is closer than first order."""
    table = outcome.by_stiffness
    if table is None or not {"first order", "zeroth order"} <= set(table.estimator.values):
        return None
    first, zeroth = table.sel(estimator="first order"), table.sel(estimator="zeroth order")
    x = table.stiffness.values
    ahead = (zeroth.rmse_high < first.rmse_low).values
    behind = (zeroth.rmse_low > first.rmse_high).values
    name, count = stiffness_name(outcome), outcome.settings.samples_at_stiffness
    if ahead.any() and behind.any() and x[ahead].min() > x[behind].max():
        return (
            f"With {count} rollouts first order is closer up to {name} = {power(x[behind].max())}, zeroth order from "
            f"{power(x[ahead].min())} on."
        )
    return (
        f"With {count} rollouts zeroth order is closer at {ahead.sum()} and first order at {behind.sum()} of {len(x)} values of "
        f"{name}."
    )


def drawings(outcome: Outcome) -> Drawings:
    """Draw the figures in order of reading."""
    found = {} if outcome.by_stiffness is None else {"stiffness": stiffness(outcome)}
    return found | {"samples": samples(outcome), "problem": problem(outcome)}


def stiffness_name(outcome: Outcome) -> str:
    """Name the axis of stiffness."""
    return "frequency ω" if outcome.settings.problem == "quadratic_sine" else "stiffness 1/ν"


def problem(outcome: Outcome):
    """The cost with and without noise, and both gradients that estimates can converge to."""
    figure, axes = subplots(1, 2, height=3.3)
    settings, one = outcome.settings, outcome.problem
    left, right = axes[0]
    point, stddev = settings.point, settings.stddev
    grid = jnp.linspace(-1, 1, 801) * max(4 * stddev, 1.5 * abs(point))

    def draw(axis: Axes, function: Callable[[Array], Array], **look: Any) -> None:
        axis.plot(grid, jax.jit(jax.vmap(function))(grid), **look)

    draw(left, lambda x: one(x[None]), color=MUTED, lw=1.2, label="without noise")
    draw(left, lambda x: one.smoothed(x, stddev), color=REFERENCE, label=f"mean under noise of {stddev:g}")
    draw(right, lambda x: one.gradient(x, stddev), color=REFERENCE, label="gradient of the mean")
    look = {"color": FIRST, "ls": (0, (4, 2)), "zorder": 3}
    draw(right, lambda x: one.first_order_mean(x, stddev), label="mean of first order", **look)
    for axis, title in ((left, "Cost"), (right, "Gradient")):
        axis.axvline(point, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        low, high = axis.get_ylim()
        axis.set(title=title, xlabel="parameter", xlim=(grid[0], grid[-1]), ylim=(low, high + 0.22 * (high - low)))
        axis.legend(loc="upper left", ncols=2)
    shown = "" if settings.shown_stiffness is None else f" at stiffness {settings.shown_stiffness:g}"
    caption = (
        f"Left, the cost{shown}; right, the gradient that is to be estimated, and what first order converges to. Where the "
        "two part, first order is biased. The dotted line marks the point of the estimates."
    )
    return figure, "The cost and its gradient", caption


def samples(outcome: Outcome):
    """Root-mean-square error and bias against rollouts."""
    figure, axes = subplots(1, 2, height=4.2)
    x, size, table = np.asarray(outcome.settings.num_samples, float), abs(outcome.gradient), outcome.by_samples
    left, right = axes[0]
    _errors(left, x, table)
    left.set_xlabel("rollouts per estimate")
    right.axhline(0, color=MUTED, lw=0.8)
    right.axhline(-1, color=MUTED, lw=0.8, ls=(0, (2, 3)))
    _marks(right, x, table, "bias", 1 / size)
    # One wild interval of few samples is not to flatten all others.
    reach = max(0.15, 1.6 * float(abs(table.bias[1:]).max()) / size)
    right.set(title="Bias, as a share of the gradient", xlabel="rollouts per estimate", ylim=(-reach, reach))
    theme.legend_below(figure, left, 4)
    caption = (
        f"{_repeats(outcome)}. Left, distance to the true gradient; thin lines are closed forms, dotted ones join marks that "
        "have none. Right, mean less truth; at −1 (dotted) an estimate is zero throughout. A budget counts every rollout, that "
        "without noise included. Intervals that leave the panel are cut."
    )
    return figure, "Error against rollouts", caption


def stiffness(outcome: Outcome):
    """Root-mean-square error against stiffness."""
    assert outcome.by_stiffness is not None
    (figure, axis), settings = theme.panel(4.2), outcome.settings
    _errors(axis, np.asarray(settings.stiffness), outcome.by_stiffness)
    axis.set_xlabel(stiffness_name(outcome))
    theme.legend_below(figure, axis, 4)
    caption = (
        f"{_repeats(outcome)}, {settings.samples_at_stiffness} rollouts each: distance to the true gradient. Thin lines are "
        "closed forms, dotted ones join marks that have none."
    )
    return figure, "Error against stiffness", caption


def _repeats(outcome: Outcome) -> str:
    settings = outcome.settings
    return f"Each mark is from {settings.num_repeats} estimates, with its {settings.confidence:.0%} interval"


def _errors(axis: Axes, x: np.ndarray, table: xr.Dataset) -> None:
    """Draw measured errors with intervals and, thin, the closed forms."""
    _marks(axis, x, table, "rmse", ls=(0, (1, 2)))
    axis.set(title="Root-mean-square error", ylabel="error of the gradient", yscale="log")
    # Errors often span a single decade, where powers of ten alone would leave one label.
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_minor_locator(NullLocator())
    theme.plain(axis.yaxis)


def _marks(axis: Axes, x: np.ndarray, table: xr.Dataset, name: str, scale: float = 1.0, ls: Any = "") -> None:
    """Draw a number of each estimator with its interval; closed forms of the error are lines in place of dotted ones."""
    for row, look in enumerate(theme.looks(table.estimator.values)):
        one = table.isel(estimator=row)
        at = x * 1.035 ** (row - (table.estimator.size - 1) / 2)
        has_exact = name == "rmse" and bool(one.exact_rmse.notnull().all())
        ends = scale * one[[f"{name}_low", f"{name}_high"]].to_array().values
        look |= {"ls": "" if has_exact else ls, "ms": 4.5, "label": str(one.estimator.values)}
        theme.errorbar(axis, at, scale * one[name].values, ends, **look)
        if has_exact:
            axis.plot(at, one.exact_rmse, color=look["color"], lw=1.0)
    axis.set_xscale("log")
    shown = x[:: -(-len(x) // 8)]
    axis.set_xticks(shown, [power(value) for value in shown])
    axis.minorticks_off()
