"""Estimators that look at single steps: REINFORCE with reward-to-go, and inverse variance step by step."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from mjxgrad._arrays import one_of
from mjxgrad._programs import compiled
from mjxgrad.estimators.estimate import GradientEstimate, Reason, assemble
from mjxgrad.estimators.moments import Moments, as_real
from mjxgrad.estimators.samples import Group, Plan, plan_by_noise, sample
from mjxgrad.estimators.unbiased import gram, unbiased_terms
from mjxgrad.objective import ActionNoise, Objective, as_vector


@compiled
def reinforce(
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    baseline: str = "leave_one_out",
) -> GradientEstimate:
    r"""Estimate the gradient by the policy gradient theorem.

    With the cost $c_{it}$ charged at step $t$ of rollout $i$ and the noise $w_{it}$ of its action,

    $$\hat g = \mathrm{mean}_i \sum_t \Big(\frac{\partial \pi_\theta(x_{it})}{\partial\theta}\Big)^{\!\top}
      \frac{w_{it}}{\sigma^2} \Big(\sum_{t' \ge t} c_{it'} - b_{it}\Big).$$

    Costs charged before step $t$ do not depend on $w_{it}$ and add only variance: `zeroth_order` keeps them, this
    estimator leaves them out. The leave-one-out baseline $b_{it}$ is the mean cost to go of the other rollouts at the
    same step. It is independent of rollout $i$, so the estimate is unbiased with it and without. All rollouts are in
    memory at once, because the baseline of every step needs them all.

    The standard error is from the spread of the samples. It ignores their dependence through the baseline, a share of
    order 1 / `num_samples` of the variance.

    Args:
        objective: an objective from `open_loop` or `closed_loop`, on a task that gives `step_costs`.
        params: the point $\theta$, a vector or a pytree as in `first_order`.
        key: consumed here.
        num_samples: rollouts to spend. At least 2.
        baseline: "leave_one_out" or "none".

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit. A sample counts as finite if its
        costs and its score are.

    Raises:
        ValueError: if the objective's noise is not on actions, the task gives no `step_costs`, `num_samples` is below
            2 or `baseline` unknown.

    References:
        Williams. Simple statistical gradient-following algorithms for connectionist reinforcement learning. Machine
        Learning 8, 1992, theorem 1. Sutton, McAllester, Singh, Mansour. Policy gradient methods for reinforcement
        learning with function approximation. NIPS 1999, theorem 1 (cost to go). Kool, van Hoof, Welling. Buy 4
        REINFORCE samples, get a baseline for free! ICLR 2019 workshop, equation 8 (leave-one-out).
    """
    objective, vector, restore = as_vector(objective, params)
    if not isinstance(objective, ActionNoise):
        raise ValueError(
            f"objective must have noise on actions, from open_loop or closed_loop, got {type(objective).__name__}; "
            "use zeroth_order where there are no steps"
        )
    one_of("baseline", baseline, ("leave_one_out", "none"))
    plan = Plan(num_samples, with_score=True)
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(num_samples))
    noises = jax.vmap(objective.sample_noise)(keys)
    outcomes = jax.vmap(lambda noise: objective.outcome(vector, noise))(noises)
    if outcomes.step_costs is None:
        raise ValueError(
            f"reinforce must be given a task with step_costs, got {type(objective.task).__name__}, which knows only "
            "the total; use zeroth_order, or let its cost be one number per step"
        )
    # Costs after the last action are in all of them.
    to_go = jnp.cumsum(outcomes.step_costs[:, ::-1], axis=1)[:, ::-1][:, : objective.task.horizon]
    actions = jax.vmap(lambda noise: objective.split(noise)[0])(noises)
    is_used = jnp.isfinite(outcomes.cost) & jnp.isfinite(to_go).all(axis=1)
    count = is_used.sum()
    if baseline == "leave_one_out":
        # n/(n-1) (C - mean of all) is C minus the mean of the others.
        mean = jnp.where(is_used[:, None], to_go, 0).sum(axis=0) / jnp.maximum(count, 1)
        to_go = (to_go - mean) * (as_real(count, to_go) / as_real(jnp.maximum(count - 1, 1), to_go))
    weighted = actions / objective.stddev**2 * to_go[:, :, None]
    samples = jax.vmap(lambda states, weights: objective.pull_back_at(vector, states)(jnp.ravel(weights)))(
        outcomes.states, jnp.where(is_used[:, None, None], weighted, 0).astype(vector.dtype)
    )
    is_used &= jnp.isfinite(samples).all(axis=1)
    gradients = Moments.of(samples, is_used)
    return assemble(
        gradients.mean,
        gradients.squared_error(),
        Moments.of(outcomes.cost, is_used),
        plan,
        count=gradients.count,
        # Zero noise has no finite score, so every sample that is used was moved by its noise.
        num_felt=(~is_used).sum(),
        restore=restore,
    )


@compiled
def per_step_inverse_variance(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int
) -> GradientEstimate:
    r"""Mix first and zeroth order component by component of the noise, each by its own variances (IVW-H).

    With the derivative $g^1_{t,a}$ by the noise of action $a$ at step $t$ and the zeroth-order term $g^0_{t,a}$, the weight
    is $\alpha_{t,a} = V^0_{t,a}/(V^0_{t,a} + V^1_{t,a})$; the mixture is pulled back through the policy once. Early steps,
    whose derivatives pass through all contacts, may so be left to zeroth order and late ones to first. Like
    `rules.InverseVariance` it is blind to bias. All rollouts are in memory at once.

    Arguments, errors and units are those of `alpha_order`. `alpha` is the mean weight. The standard error is the samples'
    own spread; it ignores that weights and baselines come from the same samples.

    References:
        Onoda et al., arXiv:2604.18161 (IVW-H).
    """
    objective, vector, restore = as_vector(objective, params)
    plan = plan_by_noise(objective, num_samples, None)
    samples = sample(objective, vector, key, plan, jnp.arange(plan.num_units))
    chunk = Group.of(samples)
    terms, _ = jax.vmap(lambda group: unbiased_terms(group, gram(group), with_derivatives=False))(chunk.split())
    zeroth = terms.reshape(-1, terms.shape[-1])[: len(chunk.costs)]
    is_used = chunk.complete(chunk.has_derivative)
    variances = [Moments.of(chunk.by_unit(x), is_used).variance() for x in (chunk.derivatives, zeroth)]
    total = variances[0] + variances[1]
    alpha = jnp.where(total > 0, variances[1] / jnp.where(total > 0, total, 1), 1)
    mixed = chunk.by_unit(chunk.pull_back(samples, alpha * chunk.derivatives + (1 - alpha) * zeroth))
    gradients = Moments.of(mixed, is_used)
    return assemble(
        gradients.mean,
        gradients.squared_error(),
        Moments.of(chunk.by_unit(chunk.costs) + chunk.centre, is_used),
        plan,
        count=gradients.count,
        num_felt=samples.num_felt(),
        restore=restore,
        alpha=alpha.mean(),
        reason=Reason.inverse_variance,
        bias_bound=jnp.nan,
    )
