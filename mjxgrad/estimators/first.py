"""The first-order estimate: the mean of the derivatives of the samples."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.estimators.estimate import GradientEstimate, assemble
from mjxgrad.estimators.moments import Moments
from mjxgrad.estimators.sampling import Plan, Samples, stream
from mjxgrad.objective import Objective


def first_order(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    num_samples: int,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Estimate the gradient of a smoothed objective by differentiating each sample.

    $\hat g = \mathrm{mean}_i \nabla_\theta f(\theta, w_i)$. Unbiased where $f$ is continuous;
    where it jumps the derivative misses the jump, and where it is stiff the variance is huge.

    Args:
        objective: differentiated once per sample, under `jax.vmap`.
        params: the point $\theta$.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2.
        chunk_size: rollouts at a time; memory grows with it, the result depends on it only by
            rounding.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if `num_samples` is below 2, `chunk_size` below 1, or `params` is not a
            vector of the objective's dimension.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy
        Gradients? ICML 2022, arXiv:2202.00817, definition 2.2.
    """
    plan = Plan(num_samples, chunk_size, with_gradient=True)
    params = jnp.asarray(params)
    summary = stream(objective.sized_for(params), params, key, plan, first_order_summary)
    return first_order_result(summary, plan)


def first_order_summary(samples: Samples) -> tuple[Moments, Moments]:
    """Keep of samples what the estimate needs: moments of gradients and of costs."""
    mask = samples.first_order_mask()
    gradients = Moments.of(samples.gradients.mean(axis=1), mask)
    return gradients, Moments.of(samples.costs.mean(axis=1), mask)


def first_order_result(summary: tuple[Any, ...], plan: Plan) -> GradientEstimate:
    """Turn what `first_order_summary` kept into the estimate."""
    gradients, costs = summary
    return assemble(
        gradients.mean,
        gradients.squared_error(),
        costs,
        plan,
        count=gradients.count,
        alpha=1.0,
        bias_bound=jnp.nan,
    )
