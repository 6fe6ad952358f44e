"""α for each step and each action, with noise on the actions of a policy."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.estimators.alpha import weigh
from mjxgrad.estimators.by_noise import plan_by_noise, sample_by_noise
from mjxgrad.estimators.estimate import GradientEstimate, Reason, assemble
from mjxgrad.estimators.moments import Moments, Summary, Total
from mjxgrad.estimators.parts import parts_and_terms
from mjxgrad.estimators.rules import Consistent, Rule
from mjxgrad.estimators.sampling import accumulate
from mjxgrad.objective import Objective


def per_step(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    num_samples: int,
    rule: Rule | None = None,
    control_variate: bool = True,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Mix derivatives and unbiased terms by step and action, then pull the mixture back through the policy, once.

    By the noise of step t and action a, a sample has a derivative $\lambda_{t,a}$ and an unbiased term $z_{t,a}$; the
    estimate is the mean of $P_j^\top(\alpha\odot\lambda_j + (1 - \alpha)\odot z_j)$. Derivatives far from the end of a
    long rollout may explode while those near it are exact, so that one weight for all would waste the latter.

    Args:
        objective: differentiated once per sample by its noise, under `jax.vmap`. With noise on the parameters the steps
            are the parameters.
        params: the point $\theta$.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2; where starts are random, even and at least 4, since pairs share one.
        rule: chooses each $\alpha_{t,a}$. None is `Consistent()`, whose first question is one for all steps;
            `InverseVariance()` is the published IVW-H.
        control_variate: whether the unbiased terms use derivatives.
        chunk_size: rollouts at a time, at least 4; $\alpha$ is chosen within a chunk.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit. Its `alpha` has one number for each
        step and action, flattened, the mean over chunks; its `reason` the most frequent. The bias is not
        bounded.

    Raises:
        ValueError: if `num_samples` or `chunk_size` do not fit, or the objective does not know its noise.

    References:
        Onoda et al., arXiv:2604.18161 (IVW-H).
    """
    params = jnp.asarray(params)
    objective = objective.sized_for(params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    num_actions = int(np.prod(objective.noise_shape))

    def one_chunk(units: Array) -> tuple[Summary, ...]:
        samples = sample_by_noise(objective, params, key, units, plan)
        parts, terms_by_noise, has_cost = parts_and_terms(
            samples, control_variate=control_variate, take=lambda by_noise: by_noise
        )
        weights = weigh(rule or Consistent(), parts, np.arange(num_actions), num_actions)
        alpha = weights.alpha
        group = samples.group
        mixed = alpha * group.derivatives + jnp.where(group.has_derivative[:, None], 1 - alpha, 1) * terms_by_noise
        values = Moments.of(samples.by_unit(samples.pull_back(mixed)), has_cost)
        reasons = jax.nn.one_hot(jax.tree.leaves(weights.reason)[0], len(Reason), axis=0)
        return values, parts.costs, Total((parts.num_costs * alpha, parts.num_costs * reasons, parts.num_costs))

    values, costs, sums = accumulate(plan, one_chunk)
    alpha, reasons, count = sums.value
    return assemble(
        values.mean,
        values.squared_error(),
        costs,
        plan,
        count=values.count,
        alpha=alpha / jnp.maximum(count, 1),
        reason=jax.tree.map(lambda _: reasons.argmax(axis=0), Reason.fixed),
        bias_bound=jnp.where((alpha > 0).any(), jnp.nan, 0),
    )
