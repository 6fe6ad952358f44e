"""First order (mean derivative of the samples), zeroth order (covariance of cost and score), and both at once."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray, PyTree

from mjxgrad._arrays import one_of
from mjxgrad._programs import compiled
from mjxgrad.estimators.estimate import GradientEstimate, assemble
from mjxgrad.estimators.moments import Moments, ScoreMoments, as_real
from mjxgrad.estimators.samples import Plan, Samples, all_finite, stream
from mjxgrad.objective import Objective, as_vector
from mjxgrad.objective.base import Vector


@compiled
def first_order(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int, chunk_size: int | None = None
) -> GradientEstimate:
    r"""Estimate the gradient of a smoothed objective by differentiating each sample.

    $\hat g = \mathrm{mean}_i \nabla_\theta f(\theta, w_i)$. It is unbiased where $f$ is continuous.
    Where $f$ jumps the derivative misses the jump; where $f$ is stiff the variance is huge.

    Args:
        objective: differentiated once per sample, under `jax.vmap`.
        params: the point $\theta$: a vector, or a pytree such as a dict or an equinox module. The floating-point
            arrays of a pytree are the parameters, and the estimate has its form.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2.
        chunk_size: rollouts at a time. Memory grows with it; the result depends on it only by rounding.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if `num_samples` is below 2, `chunk_size` below 1, or `params` is not a
            vector of the objective's dimension.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy
        Gradients? ICML 2022, arXiv:2202.00817, definition 2.2.
    """
    objective, vector, restore = as_vector(objective, params)
    plan = Plan(num_samples, chunk_size, with_gradient=True)
    return first_order_result(stream(objective, vector, key, plan, first_order_summary), plan, restore)


@compiled
def zeroth_order(
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    baseline: str = "leave_one_out",
    antithetic: bool = False,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Estimate the gradient of a smoothed objective without differentiating it.

    With noise $w \sim p(w \mid \theta)$ the gradient of $F(\theta) = \mathbb{E}[f]$ is
    $\mathbb{E}[(f_i - b_i)\, s_i]$ with the score $s_i$. None of the three baselines $b_i$ depends on sample $i$,
    so the estimate is unbiased even where $f$ jumps.

    The other arguments, and the units, are those of `first_order`.

    - `num_samples`: rollouts with noise to spend. At least 2; even and at least 4 with antithetic pairs.
    - `baseline`: "leave_one_out", the mean cost of the other samples or pairs; "zero_noise", the cost without noise; or
      "none". Zero noise costs one more rollout; with random starts, one per sample or pair, from its start.
    - `antithetic`: whether every noise is used together with its mirror image. The standard error is then over pairs.
      Where the score is odd in the noise (parameter noise, open loop) all baselines cancel within a pair.

    Raises:
        ValueError: as `first_order`; also if `num_samples` is odd, or `baseline` unknown.

    References:
        Definition 2.3 in the reference of `first_order` (there with the zero-noise baseline). Kool, van Hoof, Welling. Buy 4
        REINFORCE samples, get a baseline for free! ICLR 2019 workshop, equation 8 (leave-one-out).
    """
    objective, vector, restore = as_vector(objective, params)
    one_of("baseline", baseline, ("leave_one_out", "zero_noise", "none"))
    is_needed, has_own = baseline == "zero_noise", objective.has_circumstances
    plan = Plan(
        num_samples,
        chunk_size,
        antithetic,
        with_score=True,
        with_zero_noise=is_needed and not has_own,
        zero_noise_per_unit=is_needed and has_own,
    )
    return zeroth_order_result(stream(objective, vector, key, plan, zeroth_order_summary), plan, baseline, restore)


@compiled
def first_and_zeroth_order(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int, chunk_size: int | None = None
) -> tuple[GradientEstimate, GradientEstimate]:
    """Estimate the gradient in first and in zeroth order from the same differentiated rollouts.

    Arguments, errors and estimates are those of `first_order`, and of `zeroth_order` with its default baseline. The two are
    dependent, and each reports the rollouts spent on both: do not add them. A sample with a finite cost but no finite
    derivative counts in the second only.
    """
    objective, vector, restore = as_vector(objective, params)
    plan = Plan(num_samples, chunk_size, with_gradient=True, with_score=True)
    return both_results(stream(objective, vector, key, plan, both_summary), plan, restore)


def first_order_summary(samples: Samples) -> tuple[Moments, Moments, Array]:
    """Return the moments of gradients and of costs, and the number of units that felt their noise."""
    rollouts = samples.rollouts
    mask = samples.is_noisy & all_finite(rollouts.cost) & all_finite(rollouts.gradient_by_noise)
    gradients = Moments.of(rollouts.gradient_by_noise.mean(axis=1), mask)
    return gradients, Moments.of(rollouts.cost.mean(axis=1), mask), samples.num_felt()


def first_order_result(summary: tuple[Any, ...], plan: Plan, restore: Callable) -> GradientEstimate:
    """Return the estimate from the summary of `first_order_summary`."""
    gradients, costs, num_felt = summary
    return assemble(
        gradients.mean,
        gradients.squared_error(),
        costs,
        plan,
        count=gradients.count,
        num_felt=num_felt,
        restore=restore,
        alpha=1.0,
        bias_bound=jnp.nan,
    )


def zeroth_order_summary(samples: Samples) -> tuple[ScoreMoments, Moments, Array, Array]:
    """Return joint moments of costs and scores, moments of the costs, the cost without noise, and units that felt it."""
    mask = samples.zeroth_order_mask()
    costs, scores = samples.rollouts.cost, samples.rollouts.noise_score
    moments = ScoreMoments.of(costs - samples.zero_noise_costs[:, None], scores, mask)
    return moments, Moments.of(costs.mean(axis=1), mask), samples.noise_free_cost(), samples.num_felt()


def zeroth_order_result(summary: tuple[Any, ...], plan: Plan, baseline: str, restore: Callable) -> GradientEstimate:
    """Return the estimate from the summary of `zeroth_order_summary`."""
    moments, costs, noise_free_cost, num_felt = summary
    if baseline == "leave_one_out":
        value, squared_error = _leave_one_out(moments)
    else:
        # Costs from their own starts are already taken off.
        centre = noise_free_cost if plan.with_zero_noise else jnp.zeros_like(noise_free_cost)
        first, second = moments.moved(moments.costs.above(centre))
        value, squared_error = _mean_and_squared_error(first[0], second[0, 0], moments.costs.count)
    return assemble(
        value,
        squared_error,
        costs,
        plan,
        count=moments.costs.count,
        num_felt=num_felt,
        restore=restore,
        has_baseline=jnp.isfinite(noise_free_cost),
    )


def both_summary(samples: Samples) -> tuple:
    """Return the summaries of both estimates."""
    return first_order_summary(samples), zeroth_order_summary(samples)


def both_results(summary: tuple, plan: Plan, restore: Callable) -> tuple[GradientEstimate, GradientEstimate]:
    """Return both estimates from the summary of `both_summary`, the second with the leave-one-out baseline."""
    first, zeroth = summary
    return first_order_result(first, plan, restore), zeroth_order_result(zeroth, plan, "leave_one_out", restore)


def _leave_one_out(moments: ScoreMoments) -> tuple[Vector, Vector]:
    r"""Return the mean of $g_i = u_i - b_i \bar s_i$ and its squared error; $b_i$ is the mean cost of the other units.

    About the mean cost, $g_i = u_i + p_i/(n-1)$ with the features of `ScoreMoments`. Without pairs $u = p$, and this is
    $\frac{n}{n-1}(f_i - \bar f)s_i$, whose mean is the sample covariance of cost and score.

    The $g_i$ share the mean, so their spread over $n$ is not quite the variance $V$ of their
    mean. With $\mathbb{E}[s] = 0$ and $c = \mathbb{E}[\bar f \bar s]$,

    $$V = \frac{\mathrm{Var}\,u}{n} + \frac{\mathrm{Var}\bar f\,\mathrm{Var}\bar s + c^2}{n(n-1)},
      \qquad \mathbb{E}[\text{spread}/n] = V - \frac{c^2}{(n-1)^2}.$$

    The same holds for the sample covariance $k$ of $\bar f, \bar s$ with its own spread, and
    $\mathbb{E}[k^2] = c^2 + V_k$. Together they give an estimate of $V$ that is unbiased for every $n \ge 2$. Without
    pairs it is never negative.
    """
    first, second, count = moments.first, moments.second, moments.costs.count
    others = as_real(jnp.maximum(count - 1, 1), first)
    total = first[0] + first[1] / others
    total_square = second[0, 0] + 2 * second[0, 1] / others + second[1, 1] / others**2
    value, spread = _mean_and_squared_error(total, total_square, count)
    # Written as n/(n-1) p, whose mean is k.
    scale = 1 + 1 / others
    covariance, covariance_spread = _mean_and_squared_error(scale * first[1], scale**2 * second[1, 1], count)
    return value, spread + (covariance**2 - covariance_spread) / (others**2 + 1)


def _mean_and_squared_error(total: Vector, total_square: Vector, count: Array) -> tuple[Vector, Vector]:
    count = as_real(count, total)
    mean = total / jnp.maximum(count, 1)
    return mean, (total_square - count * mean**2) / jnp.maximum(count * (count - 1), 1)
