"""From settings to numbers."""

import functools
import itertools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

import mjxgrad as mg
from experiments.policy_gradient.outcome import GRADIENTS, Cell, Course, Estimates, Outcome
from experiments.policy_gradient.problems import Descent, Problem, problem
from experiments.policy_gradient.settings import Settings
from experiments.workspace import Workspace
from mjxgrad.estimators.mixture import both_parts, weigh
from mjxgrad.estimators.rules import Consistent
from mjxgrad.estimators.samples import plan_by_noise, stream


class Estimated(eqx.Module):
    """Both parts of one α-order estimate, first order and control variate, before they are mixed.

    α is what the default rule gives the first, for a reason of `mg.estimators.Reason`; the cost is the mean over the rollouts.
    """

    first: Float[Array, " dim"]
    unbiased: Float[Array, " dim"]
    alpha: Float[Array, ""]
    reason: Int[Array, ""]
    cost: Float[Array, ""]

    def weight(self, estimator: str) -> Float[Array, ""]:
        """Give α of "first" order, which is 1, or of "alpha"-order."""
        return jnp.ones_like(self.alpha) if estimator == "first" else self.alpha

    def value(self, estimator: str) -> Float[Array, " dim"]:
        """Give the estimate of "first" order or of "alpha"-order."""
        alpha = self.weight(estimator)
        return alpha * self.first + (1 - alpha) * self.unbiased


@eqx.filter_jit
def estimated(objective: mg.Objective, params: Float[Array, " dim"], key: PRNGKeyArray, num_samples: int) -> Estimated:
    """Estimate once, by all estimators from the same rollouts.

    The public estimators give the same numbers one by one. To compile takes longer than all rollouts, so bias, reference, α
    and descents share this one program.
    """
    objective = objective.sized_for(params)
    plan = plan_by_noise(objective, num_samples, None)
    (parts,) = stream(objective, params, key, plan, functools.partial(both_parts, control_variate=True))
    weights = weigh(Consistent(), parts, plan)
    reason = jnp.asarray(weights.reason._value)  # pyright: ignore[reportAttributeAccessIssue]
    return Estimated(parts.first.mean, parts.unbiased.mean, weights.alpha, reason, parts.costs.mean)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Compare both gradients on all tasks."""
    cells, courses = [], []
    with workspace.stage("estimates", "tasks", len(settings.tasks)) as advance_to:
        for number, name in enumerate(settings.tasks):
            key, descent_key = jax.random.split(jax.random.fold_in(jax.random.key(settings.seed), number))
            one = problem(name, settings)
            workspace.check(one.task.scene)
            cells += [_cell(one, i, k, settings) for i, k in enumerate(jax.random.split(key, len(one.points)))]
            courses += _courses(one, descent_key, settings.num_seeds)
            advance_to(number + 1)
    return Outcome(settings, cells, courses)


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


def _estimates(one: Problem, gradient: str, params: Float[Array, " dim"], keys: Key[Array, " count"]) -> Estimates:
    objective = one.objective(gradient, one.stddev)
    found = [estimated(objective, params, key, one.num_samples) for key in keys]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *found)
    return Estimates(stacked.first, stacked.unbiased, stacked.alpha, stacked.reason)


def _courses(one: Problem, key: PRNGKeyArray, num_seeds: int) -> list[Course]:
    descent, seeds, courses = one.descent, jax.random.split(key, num_seeds), []
    if descent is None or not descent.num_steps:
        return []
    for estimator, gradient in itertools.product(descent.estimators, GRADIENTS):
        started = time.perf_counter()
        histories = [_descend(one, descent, gradient, estimator, seed) for seed in seeds]
        seconds = time.perf_counter() - started
        costs = np.array([[step.cost for step in history] for history in histories])
        alphas = np.array([[step.weight(estimator) for step in history] for history in histories])
        courses.append(Course(one.name, one.title, estimator, gradient, costs, alphas, seconds))
    return courses


def _descend(one: Problem, descent: Descent, gradient: str, estimator: str, seed: PRNGKeyArray) -> list[Estimated]:
    """Descend by Adam; the last of what is given back is at the final parameters."""
    objective, optimiser = one.objective(gradient, descent.stddev), optax.adam(descent.learning_rate)
    params, state, history = descent.start, optimiser.init(descent.start), []
    *steps, end = jax.random.split(seed, descent.num_steps + 1)
    for key in steps:
        history.append(estimated(objective, params, key, one.num_samples))
        change, state = optimiser.update(history[-1].value(estimator), state)
        params = jnp.asarray(optax.apply_updates(params, change))
    return [*history, estimated(objective, params, end, one.num_samples)]
