"""From settings to numbers, and what follows from them."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any
from warnings import catch_warnings, simplefilter

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key
from scipy import stats

import mjxgrad as mg
from experiments.config import ExperimentError
from experiments.motion import own_task
from experiments.optimisation import searches
from experiments.optimisation.published import TASKS, Published
from experiments.optimisation.settings import MethodSettings, Settings
from experiments.problems.comparison import affordable
from experiments.workspace import Workspace
from mjxgrad.checking.motions import half_range
from mjxgrad.diagnostics import mean_interval
from mjxgrad.estimators import Reason, rules

REASONS = (
    "inverse_variance", "bias_limit", "uncertain", "inconsistent", "not_finite", "nothing_felt", "fixed", "inside"
)  # fmt: skip
# Costs are sums over hundreds of steps; seeds that agree to this share differ by rounding alone.
ROUNDING = 1e-6


@dataclass(frozen=True)
class Run:
    """All seeds of one method."""

    method: MethodSettings  # its settings
    final_cost: Float[np.ndarray, " seeds"]  # without noise, after the last step; infinite for a run that was lost
    # Without noise, by seed and evaluation, the last one after the last step.
    cost: Float[np.ndarray, "seeds evaluations"]
    rollouts: Int[np.ndarray, " evaluations"]  # spent before each evaluation, of the seed that spent most
    seconds: Float[np.ndarray, " evaluations"]  # likewise, of all seeds together, without compilation
    alpha: Float[np.ndarray, "seeds steps"]  # weight of the first-order part, by seed and step
    # For each sentence, at which steps of which seeds it was why; empty for a method without a choice.
    reasons: dict[str, Bool[np.ndarray, "seeds steps"]] = field(repr=False)
    num_skipped: Int[np.ndarray, " seeds"]  # steps not taken, because the estimate was not finite, by seed
    finite_share: float  # of all rollouts
    rollouts_per_step: int  # most of all steps
    compile_seconds: float  # spent on compilation

    @property
    def is_lost(self) -> Bool[np.ndarray, " seeds"]:
        """Say which runs ended without a finite cost."""
        return ~np.isfinite(self.final_cost)

    @property
    def kept(self) -> Float[np.ndarray, " kept"]:
        """Give the final costs of the others."""
        return self.final_cost[~self.is_lost]

    @property
    def mean(self) -> float:
        """Give their mean, NaN if all runs were lost."""
        return float(self.kept.mean()) if self.kept.size else np.nan

    @property
    def spread(self) -> float:
        """Give their standard deviation, NaN for fewer than two."""
        return float(self.kept.std(ddof=1)) if self.kept.size > 1 else np.nan

    @property
    def seconds_per_step(self) -> float:
        """Give the time of one step of one seed."""
        return float(self.seconds[-1]) / self.alpha.size

    @property
    def rank(self) -> tuple[int, float]:
        """Give what runs are ordered by: fewer lost ones first, then a lower mean."""
        return int(self.is_lost.sum()), self.mean if self.kept.size else np.inf

    def interval(self, confidence: float) -> Float[np.ndarray, " 2"]:
        """Give the interval of the mean over seeds."""
        count = self.kept.size
        return mean_interval(self.mean, self.spread / np.sqrt(max(count, 1)), count, confidence)


@dataclass(frozen=True)
class Difference:
    """One method less another, in final cost: the difference of the means with Welch's interval.

    Beside it stands the p-value of Mann and Whitney's two-sided rank test, a lost run ranking last; it counts below what is left
    of the confidence.
    """

    ours: Run
    other: Run
    value: float
    low: float
    high: float
    p_value: float
    confidence: float

    @classmethod
    def of(cls, ours: Run, other: Run, confidence: float) -> "Difference":
        """Compare two methods."""
        with catch_warnings():
            simplefilter("ignore")  # seeds that agree, or too few of them
            low, high = stats.ttest_ind(ours.kept, other.kept, equal_var=False).confidence_interval(confidence)
        # Rounded, so that runs that are the same but for rounding tie.
        size = max(ROUNDING * abs(other.mean), 1e-300) if other.kept.size else 1.0
        first, second = (np.where(run.is_lost, np.inf, np.round(run.final_cost / size)) for run in (ours, other))
        p_value = float(stats.mannwhitneyu(first, second).pvalue)
        return cls(ours, other, ours.mean - other.mean, float(low), float(high), p_value, confidence)

    @property
    def is_above(self) -> bool:
        """Say whether the one ends higher beyond seed noise, by the means, by the ranks, or by lost runs."""
        return int(self.ours.is_lost.sum()) > int(self.other.is_lost.sum()) or self._is_beyond(1)

    @property
    def is_below(self) -> bool:
        """Say whether it ends lower beyond seed noise, by the ranks, too: three seeds have means that far apart by chance."""
        return not self.is_above and self._is_beyond(-1) and self.is_ranked

    @property
    def is_ranked(self) -> bool:
        """Say whether the ranks of the seeds tell the two apart."""
        return self.p_value < 1 - self.confidence

    def _is_beyond(self, sign: int) -> bool:
        noise = ROUNDING * abs(self.other.mean)
        # To say which way the ranks point.
        shift = float(np.median(self.ours.final_cost) - np.median(self.other.final_cost))
        return (self.low if sign > 0 else -self.high) > noise or (self.is_ranked and sign * shift > noise)


@dataclass(frozen=True)
class Outcome:
    """All methods on one task."""

    settings: Settings  # of the experiment
    num_samples: int  # rollouts per step
    num_steps: int  # of each run
    dim: int  # number of parameters
    start_cost: float  # without noise, before the first step
    # Published mean and standard deviation of the final cost, by what they belong to.
    reference: dict[str, tuple[float, float]]
    runs: list[Run]  # in the order of the settings

    @functools.cached_property
    def verdicts(self) -> list[Difference]:
        """Compare α-order as it comes with the better of first and zeroth order; empty if one of them is missing."""
        ours = [run for run in self.runs if run.method.is_default_alpha]
        pure = [run for run in self.runs if run.method.name in ("first_order", "zeroth_order")]
        if not ours or not pure:
            return []
        return [Difference.of(ours[0], min(pure, key=lambda run: run.rank), self.settings.confidence)]

    @property
    def best(self) -> Run:
        """Give the method that ends lowest."""
        return min(self.runs, key=lambda run: run.rank)

    def published(self, run: Run) -> tuple[float, float] | None:
        """Give the published result of a method."""
        method = run.method
        if method.name == "first_order":
            return self.reference.get("first")
        if method.name == "zeroth_order" and method.baseline == "zero_noise" and not method.antithetic:
            return self.reference.get("zeroth")
        if method.name != "alpha_order" or method.control_variate is not False:
            return None
        return self.reference.get({"bias_constrained": "alpha", "concavity": "ddcg"}.get(method.rule or "", ""))

    def rows(self) -> list[dict[str, Any]]:
        """One row per method, seed and evaluation, for metrics.csv."""
        return [
            {
                "task": self.settings.scene or self.settings.task,
                "method": run.method.label,
                "seed": seed,
                "rollouts": int(run.rollouts[i]),
                "seconds": float(run.seconds[i]),
                "cost": float(run.cost[seed, i]),
                "is_final": i == run.cost.shape[1] - 1,
                "steps_skipped": int(run.num_skipped[seed]),
                "mean_alpha": float(run.alpha[seed].mean()),
            }
            for run in self.runs
            for seed, i in np.ndindex(run.cost.shape)
        ]


_OWN = {"num_samples": 16, "learning_rate": 1.0, "num_steps": 100, "gamma": 1.0, "bound": 1.0}
_ELITE = 0.2  # share of the candidates that cross-entropy fits to


def problem(settings: Settings) -> Published:
    """Set up the task, with the run's own settings in place of the published ones, which alone have reference results."""
    if settings.scene is not None:
        task = own_task(settings, seed=settings.seed)
        if not task.num_controls:
            raise ExperimentError(f"{settings.scene} has no actuators, so there are no controls to optimise")
        objective = mg.open_loop(task, settings.stddev * jnp.asarray(half_range(task.scene)))
        start = jnp.tile(task.scene.data.ctrl, task.horizon)
        found = Published(objective, start, reference={}, **_OWN)
    else:
        found = TASKS[str(settings.task)]()
    chosen = settings.model_dump(include={"num_steps", "num_samples", "learning_rate"}, exclude_none=True)
    return replace(found, **chosen, reference={}) if chosen else found


_RULES = {
    "least_risk": rules.LeastRisk,
    "inverse_variance": rules.InverseVariance,
    "concavity": rules.Concavity,
    "trust_region": rules.TrustRegion,
}


def estimator(method: MethodSettings, gamma: float = 0.0, bound: float = 0.0) -> functools.partial:
    """Return an estimator, its options bound; the rule "bias_constrained" takes the published constants of a task."""
    options = method.options
    if method.rule is not None:
        is_published = method.rule == "bias_constrained"
        options["rule"] = rules.BiasConstrained(gamma, bound) if is_published else _RULES[method.rule]()
    return functools.partial(getattr(mg.estimators, method.name), **options)


def runner(method: MethodSettings, task: Published, key: Key[Array, ""]) -> Callable[..., mg.Optimisation]:
    """Give the function that runs a method, of keys, one per seed, and of the options of `mg.optimise`.

    A baseline without noise is a rollout, too: an estimator gets as many samples as the rollouts of a step allow.
    """
    if method.is_search:
        return _search(method, task)
    function = estimator(method, task.gamma, task.bound)
    afforded = affordable(function, task.objective, task.params, key, task.num_samples)

    def run(keys: Key[Array, " seeds"], **options: Any) -> mg.Optimisation:
        return mg.optimise(
            task.objective,
            task.params,
            keys,
            estimator=functools.partial(function, num_samples=afforded),
            # The schedules of tasks are optax's, but for the arrays that optax allows and they do not need.
            optimiser=optax.sgd(task.learning_rate),  # pyright: ignore[reportArgumentType]
            num_steps=task.num_steps,
            **options,
        )

    return run


def _search(method: MethodSettings, task: Published) -> Callable[..., mg.Optimisation]:
    objective, width = task.objective, method.stddev
    if width is None and isinstance(objective, mg.objective.OpenLoop):
        # The controls are the parameters, so noise on the ones is noise on the others.
        width = jax.numpy.broadcast_to(objective.stddev, objective.noise_shape).ravel()
    own = {"num_elite": max(2, round(_ELITE * task.num_samples))} if method.name == "cross_entropy" else {}
    search = getattr(searches, method.name)
    sizes = {"num_samples": task.num_samples, "num_steps": task.num_steps}
    return functools.partial(search, objective, task.params, stddev=width, **sizes, **own)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Run every method from every seed."""
    task = problem(settings)
    if settings.scene is not None:
        workspace.check(own_task(settings).scene)
    key = jax.random.key(settings.seed)
    # Other noise for every method: the tests of their differences take runs to be independent.
    parts = {
        f"{i}": functools.partial(_run, method, task, settings, jax.random.fold_in(key, i))
        for i, method in enumerate(settings.methods)
    }
    return Outcome(
        settings=settings,
        num_samples=task.num_samples,
        num_steps=task.num_steps,
        dim=task.params.size,
        start_cost=float(jax.jit(task.final_cost)(task.params)),
        reference=dict(task.reference),
        runs=workspace.each("optimisation", "methods", parts),
    )


def _run(method: MethodSettings, task: Published, settings: Settings, key: jax.Array) -> Run:
    every = -(-task.num_steps // settings.evaluations)
    keys = jax.random.split(key, settings.seeds)
    result = runner(method, task, key)(keys, evaluate=task.final_cost, evaluate_every=every)
    # The last point is measured in any case, so a run of NaNs alone is told by its cost.
    final = np.asarray(result.final_cost, float)
    final = np.where(np.isfinite(final), final, np.inf)
    history = result.history
    steps = np.arange(0, history.alpha.shape[-1], every)
    has_choice = method.name == "alpha_order"
    return Run(
        method=method,
        final_cost=final,
        cost=np.concatenate([np.asarray(history.noise_free_cost, float)[:, steps], final[:, None]], axis=1),
        rollouts=_before(np.asarray(history.num_rollouts).max(axis=0), steps),
        seconds=_before(np.asarray(history.seconds, float), steps),
        alpha=np.asarray(history.alpha, float),
        reasons=_reasons(history) if has_choice else {},
        num_skipped=np.asarray(result.num_skipped),
        finite_share=float(np.nanmean(history.finite_fraction)),
        rollouts_per_step=int(np.diff(history.num_rollouts, axis=-1, prepend=0).max()),
        compile_seconds=result.compile_seconds,
    )


def _before(totals: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Give what was spent before some steps, and in the end."""
    return np.append(np.append(0, totals)[steps], totals[-1]).astype(totals.dtype)


def _reasons(history: mg.History) -> dict[str, np.ndarray]:
    # Steps that a run did not do have no α.
    was_done = ~np.isnan(history.alpha)
    found = {name: np.asarray(history.reason == getattr(Reason, name)) & was_done for name in REASONS}
    return {name: where for name, where in found.items() if where.any()}
