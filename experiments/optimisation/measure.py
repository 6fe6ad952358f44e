"""From settings to the numbers: every method is run, and one estimate of each is judged."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key

import mjxgrad as mg
from experiments.optimisation.outcome import Outcome, Run
from experiments.optimisation.published import TASKS, Published
from experiments.optimisation.settings import MethodSettings, Settings
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Comparison, Rollouts, compare
from mjxgrad.diagnostics.comparison import affordable
from mjxgrad.estimators import GradientEstimate, Reason, rules

_SCENES = {
    "push_soft": lambda: mg.tasks.push(10.0),
    "push_stiff": lambda: mg.tasks.push(1000.0),
    "friction": mg.tasks.friction,
    "motion_planning": mg.tasks.motion_planning,
    "tennis": mg.tasks.tennis,
}
_ELITE = 0.2  # share of the candidates that cross-entropy fits to
# How to optimise the scenes; found by trying, so that few steps show what each is about.
_PUSH = {"num_samples": 10, "learning_rate": 1e-3, "num_steps": 200, "gamma": 1e8, "bound": 100.0}
_SCENE_SETTINGS = {
    "push_soft": _PUSH,
    "push_stiff": _PUSH,
    "friction": {"num_samples": 10, "learning_rate": 1e-4, "num_steps": 100, "gamma": 2e4, "bound": 100.0},
    "motion_planning": {"num_samples": 50, "learning_rate": 0.03, "num_steps": 100, "gamma": 150.0, "bound": 10.0},
    "tennis": {
        "num_samples": 100, "learning_rate": 1e-6, "num_steps": 60, "gamma": 1000.0, "bound": 1000.0, "num_starts": 500
    },
}  # fmt: skip


def problem(settings: Settings) -> Published:
    """Set up the task, with the run's own settings in place of the published ones, which alone have reference results."""
    if settings.dynamics == "published":
        found = TASKS[settings.task]()
    else:
        task = _SCENES[settings.task]()
        # What is published of the equations does not hold for the scene.
        found = Published(task.objective(), task.initial_params(), reference={}, **_SCENE_SETTINGS[settings.task])
    chosen = settings.model_dump(include={"num_steps", "num_samples", "learning_rate"}, exclude_none=True)
    return dataclasses.replace(found, **chosen, reference={}) if chosen else found


def scene(settings: Settings) -> mg.Scene | None:
    """Give the scene of the task; None under the published equations, which have none."""
    return None if settings.dynamics == "published" else _SCENES[settings.task]().scene


def estimator(method: MethodSettings, task: Published) -> Callable[..., GradientEstimate]:
    """Give a function of `mjxgrad.estimators`, its options bound; its rule may take the published constants of the task."""
    options = method.options
    if method.rule is not None:
        options["rule"] = {
            "consistent": rules.Consistent,
            "inverse_variance": rules.InverseVariance,
            "concavity": rules.Concavity,
            "bias_constrained": lambda: rules.BiasConstrained(task.gamma, task.bound),
        }[method.rule]()
    return functools.partial(getattr(mg.estimators, method.name), **options)


def runner(method: MethodSettings, task: Published, key: Key[Array, ""]) -> Callable[..., mg.Optimisation]:
    """Give the function that runs a method, of keys, one per seed, and of the options of `mg.optimise`.

    A baseline without noise is a rollout, too: an estimator gets as many samples as the rollouts of a step allow.
    """
    if method.is_search:
        return _search(method, task)
    function = estimator(method, task)
    afforded = affordable(function, task.objective, task.params, key, Rollouts(task.num_samples)).num_samples

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
    search = getattr(mg.baselines, method.name)
    sizes = {"num_samples": task.num_samples, "num_steps": task.num_steps}
    return functools.partial(search, objective, task.params, stddev=width, **sizes, **own)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Run every method from every seed, and estimate the gradient at the start many times."""
    task = problem(settings)
    if (simulated := scene(settings)) is not None:
        workspace.check(simulated)
    run_key, error_key = jax.random.split(jax.random.key(settings.seed))
    runs = []
    with workspace.stage("optimisation", "methods", len(settings.methods)) as advance_to:
        for i, method in enumerate(settings.methods):
            # Other noise for every method: the tests of their differences take runs to be independent.
            runs.append(_run(method, task, settings, jax.random.fold_in(run_key, i)))
            advance_to(len(runs))
    errors = _errors(task, settings, error_key, workspace) if settings.error_repeats > 1 else None
    return Outcome(
        settings=settings,
        num_samples=task.num_samples,
        num_steps=task.num_steps,
        dim=task.params.size,
        start_cost=float(jax.jit(task.final_cost)(task.params)),
        reference=dict(task.reference),
        runs=runs,
        errors=errors,
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
    has_choice = method.name in ("alpha_order", "per_step")
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
    names = ["fixed", "inverse_variance", "bias_limit", "uncertain", "inconsistent", "not_finite", "nothing_felt"]
    found = {name: np.asarray(history.reason == getattr(Reason, name)) & was_done for name in names}
    return {name: where for name, where in found.items() if where.any()}


def _errors(task: Published, settings: Settings, key: jax.Array, workspace: Workspace) -> Comparison | None:
    named = {one.label: estimator(one, task) for one in settings.methods if not one.is_search}
    if not named:
        return None
    reference_key, repeats_key = jax.random.split(key)
    with workspace.stage("errors of one estimate", "estimators", 1 + len(named)) as advance_to:
        # Unbiased, and never much worse than zeroth order.
        reference = jax.jit(
            lambda at: mg.estimators.control_variate(
                task.objective, at, reference_key, num_samples=settings.reference_samples
            )
        )(task.params)
        advance_to(1)
        return compare(
            named,
            task.objective,
            jnp.asarray(task.params),
            repeats_key,
            budget=Rollouts(task.num_samples),
            reference=(np.asarray(reference.value), np.asarray(reference.standard_error)),
            num_repeats=settings.error_repeats,
            confidence=settings.confidence,
            progress=lambda done, _: advance_to(1 + done),
        )
