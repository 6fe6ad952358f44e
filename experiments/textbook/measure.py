"""From settings to numbers."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from scipy import stats

from experiments.failure import ExperimentError, suggest
from experiments.textbook.settings import EstimatorSettings, Settings
from experiments.workspace import Workspace
from mjxgrad import estimators as library
from mjxgrad.diagnostics import Comparison, EmpiricalBias, Rollouts, compare, empirical_bias, first_order_samples
from mjxgrad.estimators import rules
from mjxgrad.tasks import textbook
from mjxgrad.tasks.textbook import Textbook

_RULES = {"consistent": rules.Consistent, "inverse_variance": rules.InverseVariance, "concavity": rules.Concavity}


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    The sweeps are by `setting` and `estimator`: what `Comparison` has, intervals as `_low` and `_high`, and `exact_rmse`, the
    root-mean-square error in closed form, NaN where there is none.
    """

    settings: Settings
    gradient: float  # the truth at the shown stiffness
    by_samples: xr.Dataset
    by_stiffness: xr.Dataset | None
    problem: Textbook  # the shown one
    # For the soft step, by stiffness: the exact chance β of a sample to hit the slope, and what first-order samples tell of it.
    hits: list[tuple[float, EmpiricalBias]]

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
    named = {one.label: _estimator(one) for one in settings.estimators}
    shown = settings.shown_stiffness
    problem = _problem(settings, shown)
    samples_key, stiffness_key, hits_key = jax.random.split(jax.random.key(settings.seed), 3)

    def sweep(key: Array, cells: Sequence[tuple[float | None, int]], done: int) -> xr.Dataset:
        tables = []
        for i, (stiffness, rollouts) in enumerate(cells):
            problem = _problem(settings, stiffness)
            table = compare(
                named,
                problem.objective(settings.stddev),
                jnp.array([settings.point]),
                jax.random.fold_in(key, i),
                budget=Rollouts(rollouts),
                reference=np.asarray(problem.gradient(settings.point, settings.stddev)),
                num_repeats=settings.num_repeats,
                confidence=settings.confidence,
            )
            tables.append(table)
            advance_to(done + len(tables))
        return _dataset(settings, cells, tables)

    by_samples = [(shown, rollouts) for rollouts in settings.num_samples]
    by_stiffness = [(stiffness, settings.samples_at_stiffness) for stiffness in settings.stiffness]
    with workspace.stage("estimates", "settings", len(by_samples) + len(by_stiffness)) as advance_to:
        over_samples = sweep(samples_key, by_samples, 0)
        over_stiffness = sweep(stiffness_key, by_stiffness, len(by_samples)) if by_stiffness else None
    with workspace.stage("missed slopes", "stiffnesses", len(settings.stiffness)):
        hits = _hits(settings, hits_key) if settings.problem == "soft_heaviside" else []
    gradient = float(problem.gradient(settings.point, settings.stddev))
    return Outcome(settings, gradient, over_samples, over_stiffness, problem, hits)


def _dataset(settings: Settings, cells: Sequence[tuple[float | None, int]], tables: Sequence[Comparison]) -> xr.Dataset:
    dims, stiffness = ("setting", "estimator"), [np.nan if one is None else one for one, _ in cells]
    labels = [one.label for one in settings.estimators]
    data = xr.Dataset(coords={"estimator": labels, "stiffness": ("setting", stiffness)})
    one_each = ("num_samples", "num_rollouts", "num_gradient_rollouts", "num_finite", "claimed_variance")
    for name in (*one_each, "mean", "bias", "rmse", "variance"):
        data[name] = dims, np.stack([getattr(table, name).reshape(len(labels)) for table in tables])
    for name in ("bias", "rmse", "variance"):
        ends = np.stack([getattr(table, f"{name}_interval").reshape(2, len(labels)) for table in tables], axis=1)
        data[f"{name}_low"], data[f"{name}_high"] = (dims, ends[0]), (dims, ends[1])
    data["variance_method"] = dims, [table.variance_methods for table in tables]
    exact = [[_exact_error(one, settings, *cell) for one in settings.estimators] for cell in cells]
    return data.assign(exact_rmse=(dims, exact))


def _estimator(settings: EstimatorSettings) -> functools.partial:
    # Those that give one estimate of parameters with noise on them.
    others = ("first_and_zeroth_order", "per_step", "rules")
    names = [name for name in library.__all__ if name[0].islower() and name not in others]
    if settings.name not in names:
        raise ExperimentError(f'there is no estimator "{settings.name}"; {suggest(settings.name, names)}')
    options = settings.model_dump(exclude={"name"}, exclude_none=True)
    if settings.rule is not None:
        options["rule"] = _RULES[settings.rule]()
    return functools.partial(getattr(library, settings.name), **options)


def _problem(settings: Settings, stiffness: float | None) -> Textbook:
    if stiffness is None:
        return textbook.heaviside()
    if settings.problem == "soft_heaviside":
        return textbook.soft_heaviside(1 / stiffness)
    return textbook.quadratic_sine(settings.amplitude, stiffness)


def _exact_error(one: EstimatorSettings, settings: Settings, stiffness: float | None, rollouts: int) -> float:
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


def _hits(settings: Settings, key: Array) -> list[tuple[float, EmpiricalBias]]:
    """Estimate the chance to hit the slope from first-order samples."""
    found, point, stddev = [], settings.point, settings.stddev
    for i, stiffness in enumerate(settings.stiffness):
        problem, params = textbook.soft_heaviside(1 / stiffness), jnp.array([point])
        objective, count = problem.objective(stddev), settings.missed_samples
        samples = first_order_samples(objective, params, jax.random.fold_in(key, i), num_samples=count)
        truth = float(problem.gradient(point, stddev))
        told = empirical_bias(samples, reference=truth, confidence=settings.confidence)
        found.append((float(problem.slope_probability(point, stddev)), told))
    return found
