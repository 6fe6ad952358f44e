"""From settings to the numbers."""

import jax
import jax.numpy as jnp
import numpy as np

import mjxgrad as mg
from experiments.optimisation.methods import estimator, problem, runner, scene
from experiments.optimisation.outcome import Outcome, Run
from experiments.optimisation.published import Published
from experiments.optimisation.settings import MethodSettings, Settings
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Comparison, Rollouts, compare
from mjxgrad.estimators import Reason


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
    found = {
        name: np.asarray(history.reason == getattr(Reason, name)) & was_done
        for name in (
            "fixed",
            "inverse_variance",
            "bias_limit",
            "uncertain",
            "inconsistent",
            "not_finite",
            "nothing_felt",
        )
    }
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
