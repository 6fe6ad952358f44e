"""From settings to numbers."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.failure import ExperimentError, suggest
from experiments.textbook.outcome import Curves, Missing, Outcome
from experiments.textbook.settings import EstimatorSettings, Settings
from experiments.workspace import Workspace
from mjxgrad import estimators as library
from mjxgrad.diagnostics import Comparison, Rollouts, compare, empirical_bias, first_order_samples
from mjxgrad.estimators import rules
from mjxgrad.tasks import textbook
from mjxgrad.tasks.textbook import Textbook

_RULES = {
    "consistent": rules.Consistent,
    "inverse_variance": rules.InverseVariance,
    "concavity": rules.Concavity,
}

# Simulated sets of samples, of which is counted how many miss the slope.
_SETS = 4000


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Repeat every estimator at every number of rollouts and every stiffness.

    Raises:
        ExperimentError: if there is no estimator of some name.
    """
    named = {one.label: _estimator(one) for one in settings.estimators}
    problem = _problem(settings, settings.shown_stiffness)
    samples_key, stiffness_key, missing_key = jax.random.split(jax.random.key(settings.seed), 3)

    def run(problem: Textbook, key: Array, rollouts: int) -> Comparison:
        return compare(
            named,
            problem.objective(settings.stddev),
            jnp.array([settings.point]),
            key,
            budget=Rollouts(rollouts),
            reference=np.asarray(problem.gradient(settings.point, settings.stddev)),
            num_repeats=settings.num_repeats,
            confidence=settings.confidence,
        )

    cells = len(settings.num_samples) + len(settings.stiffness)
    by_samples, by_stiffness = [], []
    with workspace.stage("estimates", "settings", cells) as advance_to:
        for i, rollouts in enumerate(settings.num_samples):
            by_samples.append(run(problem, jax.random.fold_in(samples_key, i), rollouts))
            advance_to(len(by_samples))
        for i, stiffness in enumerate(settings.stiffness):
            key = jax.random.fold_in(stiffness_key, i)
            by_stiffness.append(run(_problem(settings, stiffness), key, settings.samples_at_stiffness))
            advance_to(len(by_samples) + len(by_stiffness))
    missing = None
    if settings.problem == "soft_heaviside":
        with workspace.stage("missed slopes", "stiffnesses", len(settings.stiffness)):
            missing = _missing(settings, missing_key)
    return Outcome(
        settings=settings,
        gradient=float(problem.gradient(settings.point, settings.stddev)),
        by_samples=by_samples,
        by_stiffness=by_stiffness,
        exact_by_samples=_exact(settings, [problem] * len(settings.num_samples), settings.num_samples),
        exact_by_stiffness=_exact(
            settings,
            [_problem(settings, stiffness) for stiffness in settings.stiffness],
            [settings.samples_at_stiffness] * len(settings.stiffness),
        ),
        curves=_curves(problem, settings),
        missing=missing,
    )


def _estimator(settings: EstimatorSettings) -> functools.partial:
    # Those that give one estimate of parameters with noise on them.
    others = ("first_and_zeroth_order", "per_step", "rules")
    names = [name for name in library.__all__ if name[0].islower() and name not in others]
    if settings.name not in names:
        raise ExperimentError(f'there is no estimator "{settings.name}"; {suggest(settings.name, names)}')
    options = settings.options
    if settings.rule is not None:
        options["rule"] = _RULES[settings.rule]()
    return functools.partial(getattr(library, settings.name), **options)


def _problem(settings: Settings, stiffness: float | None) -> Textbook:
    if stiffness is None:
        return textbook.heaviside()
    if settings.problem == "soft_heaviside":
        return textbook.soft_heaviside(1 / stiffness)
    return textbook.quadratic_sine(settings.amplitude, stiffness)


def _exact(
    settings: Settings, problems: list[Textbook], rollouts: list[int] | tuple[int, ...]
) -> dict[str, Float[np.ndarray, " settings"]]:
    """Give the root-mean-square error of each estimator that has a closed form, at each setting."""
    found = {}
    for one in settings.estimators:
        errors = [
            _exact_error(one, problem, settings, count) for problem, count in zip(problems, rollouts, strict=True)
        ]
        if errors and not np.isnan(errors).any():
            found[one.label] = np.array(errors)
    return found


def _exact_error(one: EstimatorSettings, problem: Textbook, settings: Settings, rollouts: int) -> float:
    point, stddev = settings.point, settings.stddev
    if one.antithetic:
        return np.nan
    if one.name == "first_order":
        bias = problem.first_order_mean(point, stddev) - problem.gradient(point, stddev)
        return float(jnp.sqrt(bias**2 + problem.first_order_variance(point, stddev) / rollouts))
    if one.name != "zeroth_order":
        return np.nan
    if one.baseline in (None, "leave_one_out"):
        return float(jnp.sqrt(problem.leave_one_out_variance(point, stddev, rollouts)))
    # The baseline without noise is one rollout that is no sample.
    is_paid = one.baseline == "zero_noise"
    baseline = problem(jnp.array([point])) if is_paid else 0.0
    return float(jnp.sqrt(problem.zeroth_order_variance(point, stddev, baseline) / (rollouts - is_paid)))


def _curves(problem: Textbook, settings: Settings) -> Curves:
    reach = max(4 * settings.stddev, 1.5 * abs(settings.point))
    grid = jnp.linspace(-reach, reach, 801)

    @eqx.filter_jit
    def along(problem: Textbook, grid: Array) -> tuple[Array, ...]:
        stddev = settings.stddev
        return (
            jax.vmap(lambda x: problem(x[None]))(grid),
            jax.vmap(lambda x: problem.smoothed(x, stddev))(grid),
            jax.vmap(lambda x: problem.gradient(x, stddev))(grid),
            jax.vmap(lambda x: problem.first_order_mean(x, stddev))(grid),
        )

    return Curves(np.asarray(grid), *(np.asarray(values) for values in along(problem, grid)))


def _missing(settings: Settings, key: Array) -> Missing:
    """Estimate the chance to miss the slope from first-order samples, and count how often it is missed."""
    counts = np.unique(np.geomspace(2, 1000, 25).astype(int))
    exact, found, frequency = [], [], []
    for i, stiffness in enumerate(settings.stiffness):
        problem = textbook.soft_heaviside(1 / stiffness)
        samples_key, sets_key = jax.random.split(jax.random.fold_in(key, i))
        samples = first_order_samples(
            problem.objective(settings.stddev),
            jnp.array([settings.point]),
            samples_key,
            num_samples=settings.missed_samples,
        )
        truth = float(problem.gradient(settings.point, settings.stddev))
        found.append(empirical_bias(samples, reference=truth, confidence=settings.confidence))
        exact.append(float(problem.slope_probability(settings.point, settings.stddev)))
        noise = settings.stddev * np.asarray(jax.random.normal(sets_key, (_SETS, int(counts[-1])), jnp.float32))
        is_hit = np.abs(settings.point + noise) < 0.5 / stiffness
        # A set of N misses if its first hit comes later than N.
        first_hit = np.where(is_hit.any(axis=1), is_hit.argmax(axis=1), np.iinfo(int).max)
        frequency.append([(first_hit >= count).mean() for count in counts])
    return Missing(counts, np.array(exact), np.array(frequency), found)
