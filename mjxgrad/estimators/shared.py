"""First- and zeroth-order estimates from the same rollouts."""

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.estimators.estimate import GradientEstimate
from mjxgrad.estimators.first import first_order_result, first_order_summary
from mjxgrad.estimators.sampling import Plan, Samples, check_baseline, stream
from mjxgrad.estimators.zeroth import noise_free_rollouts, zeroth_order_result, zeroth_order_summary
from mjxgrad.objective import Objective


def first_and_zeroth_order(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    num_samples: int,
    baseline: str = "leave_one_out",
    antithetic: bool = False,
    chunk_size: int | None = None,
) -> tuple[GradientEstimate, GradientEstimate]:
    """Estimate the gradient both ways, with one differentiated rollout per sample for both.

    Each is what `first_order` and `zeroth_order` give from the same key. They are dependent,
    and each reports what was spent on both: do not add the two.

    Args:
        objective: differentiated once per sample, under `jax.vmap`.
        params: the point.
        key: consumed here; do not use it again.
        num_samples: as in `zeroth_order`.
        baseline: as in `zeroth_order`.
        antithetic: as in `zeroth_order`; the first-order estimate then uses pairs, too.
        chunk_size: as in `zeroth_order`.

    Returns:
        The first-order and the zeroth-order estimate. A sample with a finite cost whose
        derivative is not finite counts in the second only.

    Raises:
        ValueError: as in `zeroth_order`.
    """
    check_baseline(baseline)
    plan = both_plan(num_samples, chunk_size, antithetic, **noise_free_rollouts(objective, baseline))
    params = jnp.asarray(params)
    kept = stream(objective.sized_for(params), params, key, plan, both_summary)
    return both_results(kept, plan, baseline)


def both_plan(
    num_samples: int,
    chunk_size: int | None,
    antithetic: bool = False,
    *,
    with_zero_noise: bool,
    with_silence: bool = False,
) -> Plan:
    """Plan rollouts that serve both estimates."""
    return Plan(
        num_samples,
        chunk_size,
        antithetic,
        with_gradient=True,
        with_score=True,
        with_zero_noise=with_zero_noise,
        with_silence=with_silence,
    )


def both_summary(samples: Samples) -> tuple:
    """Keep of samples what both estimates need."""
    return *first_order_summary(samples), *zeroth_order_summary(samples)


def both_results(kept: tuple, plan: Plan, baseline: str) -> tuple[GradientEstimate, GradientEstimate]:
    """Turn what was kept into both estimates."""
    return first_order_result(kept[:2], plan), zeroth_order_result(kept[2:], plan, baseline)
