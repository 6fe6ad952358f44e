"""The α-order estimate: first order where it can be trusted, an unbiased one where not; and the unbiased one alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mjxgrad.estimators.by_noise import SamplesByNoise, plan_by_noise, sample_by_noise
from mjxgrad.estimators.consistency import secant_sums
from mjxgrad.estimators.estimate import GradientEstimate, Reason, assemble
from mjxgrad.estimators.moments import Moments, Summary, Total, as_real
from mjxgrad.estimators.rules import Consistent, Evidence, Rule, Weights
from mjxgrad.estimators.sampling import Plan, accumulate
from mjxgrad.estimators.unbiased import gram, unbiased_terms
from mjxgrad.objective import Objective


def alpha_order(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    num_samples: int,
    rule: Rule | None = None,
    control_variate: bool = True,
    blocks: Int[np.ndarray, " dim"] | None = None,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Mix a first-order and an unbiased estimate of the gradient of a smoothed objective.

    $\alpha g^1 + (1 - \alpha) g^0$, both parts from the same rollouts. $g^1$ is the mean derivative; $g^0$ the
    control-variate estimate (see `control_variate`), which is never much worse than zeroth order and far better where
    derivatives explain the costs. The rule chooses $\alpha$ and says why. Choosing it from the same samples adds a
    dependence of the order of one over their number that the standard error does not count.

    Args:
        objective: differentiated once per sample by its noise, under `jax.vmap`.
        params: the point $\theta$.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2; where starts are random, even and at least 4, since pairs share one.
        rule: chooses $\alpha$; see `mjxgrad.estimators.rules`. None is `Consistent()`.
        control_variate: whether $g^0$ uses derivatives; without, it is zeroth order with the leave-one-out baseline.
        blocks: number of the block of each coordinate, from 0; $\alpha$ is then chosen for each block. None is one
            block, `np.arange(dim)` one for each coordinate.
        chunk_size: rollouts at a time, at least 2; memory grows with its square. Samples are compared, and leave each
            other out, within a chunk.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if `num_samples`, `chunk_size` or `blocks` do not fit, or the objective does not know its noise.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
        arXiv:2202.00817, section 4 (the mixture).
    """
    rule = Consistent() if rule is None else rule
    params = jnp.asarray(params)
    objective = objective.sized_for(params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    kept = _Kept(*_stream(objective, params, key, plan, control_variate))
    blocks, num_blocks = _checked_blocks(blocks, params.size)
    evidence = kept.evidence(blocks, num_blocks)
    weights = jax.vmap(lambda block: _weights(rule, block))(evidence)
    alpha, bias_bound = weights.alpha, jnp.sqrt((weights.bias_bound**2).sum())
    if num_blocks == 1:
        weights = jax.tree.map(lambda leaf: leaf[0], weights)
    value, squared_error = kept.mixture(alpha[blocks])
    return assemble(
        value,
        squared_error,
        kept.costs,
        count=kept.unbiased.count,
        rollouts_per_unit=plan.rollouts_per_unit,
        num_samples=plan.num_samples,
        num_rollouts=plan.num_rollouts,
        num_gradient_rollouts=plan.num_rollouts,
        alpha=weights.alpha,
        reason=weights.reason,
        bias_bound=bias_bound,
    )


def control_variate(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    num_samples: int,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Estimate the gradient without bias, using derivatives as far as they explain the costs.

    The mean of $(f_j - \beta\,\bar g\cdot w_j - b) s_j + \beta P_j^\top \bar g$, where the mean derivative $\bar g$, the
    baseline $b$ and the share $\beta \in [0, 1]$, fitted by least squares, all leave sample j out; see `unbiased`.
    Unbiased however wrong derivatives are; then $\beta$ is near zero and this is zeroth order. Where they explain the
    costs its error is smaller by the root of the share that they leave.

    Args:
        objective: differentiated once per sample by its noise, under `jax.vmap`.
        params: the point $\theta$.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2; where starts are random, even and at least 4, since pairs share one.
        chunk_size: rollouts at a time, at least 2; memory grows with its square. Samples leave each other out within a
            chunk.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if `num_samples` or `chunk_size` do not fit, or the objective does not know its noise.
    """
    params = jnp.asarray(params)
    objective = objective.sized_for(params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    kept = _Kept(*_stream(objective, params, key, plan, True))
    value, squared_error = kept.mixture(jnp.zeros_like(params))
    return assemble(
        value,
        squared_error,
        kept.costs,
        count=kept.unbiased.count,
        rollouts_per_unit=plan.rollouts_per_unit,
        num_samples=plan.num_samples,
        num_rollouts=plan.num_rollouts,
        num_gradient_rollouts=plan.num_rollouts,
    )


def _stream(
    objective: Objective, params: Float[Array, " dim"], key: PRNGKeyArray, plan: Plan, control_variate: bool
) -> tuple[Any, ...]:
    def one_chunk(units: Int[Array, " units"]) -> tuple[Summary, ...]:
        return _summary(sample_by_noise(objective, params, key, units, plan), control_variate)

    return accumulate(plan, one_chunk)


def _summary(samples: SamplesByNoise, control_variate: bool) -> tuple[Summary, ...]:
    """Keep of a chunk what `_Kept` lists."""
    slopes = gram(samples)
    terms = unbiased_terms(samples, slopes, with_derivatives=control_variate)
    # A cost without another to compare it with has no baseline.
    has_cost = samples.complete(samples.has_cost) & (samples.has_cost.sum() >= 2)
    has_both = has_cost & samples.complete(samples.has_derivative)
    unbiased = samples.by_unit(samples.pull_back(terms.by_noise))
    first = samples.by_unit(samples.pull_back(samples.derivatives))
    costs = samples.by_unit(samples.costs) + samples.mean_cost
    count = as_real(samples.has_cost.sum(), costs)
    return (
        Moments.of(first, has_both),
        Moments.of(unbiased, has_cost),
        Moments.of(unbiased - first, has_both),
        Moments.of(costs, has_cost),
        Moments.of(samples.derivatives * samples.stddev, samples.has_derivative),
        Total(secant_sums(samples, slopes)),
        Total((count * terms.linear_variance, (samples.has_cost * terms.beta).sum(), count)),
    )


class _Kept:
    """Sums over all chunks, and what follows from them."""

    def __init__(self, first, unbiased, difference, costs, scaled, secants, linear):
        self.first: Moments = first
        self.unbiased: Moments = unbiased
        self.difference: Moments = difference
        self.costs: Moments = costs
        self.scaled: Moments = scaled
        self.secants = secants.value
        self.linear = linear.value

    def evidence(self, blocks: Int[np.ndarray, " dim"], num_blocks: int) -> Evidence:
        """Give what a rule may look at, block by block."""

        def by_block(values: Float[Array, " dim"]) -> Float[Array, " blocks"]:
            return jax.ops.segment_sum(values, blocks, num_segments=num_blocks)

        def variance(moments: Moments) -> Float[Array, " dim"]:
            return moments.squares / as_real(jnp.maximum(moments.count - 1, 1), moments.squares)

        missed, linear = self.secants.missed_variance(), self.linear[0] / jnp.maximum(self.linear[2], 1)
        bound = jnp.sqrt(missed / jnp.where(linear > 0, linear, jnp.nan))

        def in_all(value: Array) -> Array:
            return jnp.broadcast_to(value, num_blocks)

        return Evidence(
            count=in_all(self.first.count),
            dim=by_block(jnp.ones_like(self.first.offset)),
            first_norm=jnp.sqrt(by_block(self.first.mean**2)),
            zeroth_norm=jnp.sqrt(by_block(self.unbiased.mean**2)),
            difference_norm=jnp.sqrt(by_block(self.difference.mean**2)),
            first_variance=by_block(variance(self.first)),
            zeroth_variance=by_block(variance(self.unbiased)),
            difference_variance=by_block(variance(self.difference)),
            inconsistency=in_all(self.secants.inconsistency()),
            relative_bias_bound=in_all(jnp.where(missed == 0, 0, bound)),
            cost_variance=in_all(variance(self.costs)),
            scaled_first_variance=in_all(variance(self.scaled).sum()),
            scaled_first_norm=in_all(jnp.sqrt((self.scaled.mean**2).sum())),
        )

    def mixture(self, alpha: Float[Array, " dim"]) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Give the weighted mean and its squared standard error, of each coordinate."""
        has_first = self.first.count >= 2
        first = jnp.where(has_first, self.first.mean, 0)
        value = alpha * first + (1 - alpha) * self.unbiased.mean
        unbiased_error = self._unbiased_squared_error(first)
        first_error = jnp.where(has_first, self.first.squared_error(), 0)
        difference_error = jnp.where(has_first, self.difference.squared_error(), 0)
        covariance = (unbiased_error + first_error - difference_error) / 2
        mixed = alpha**2 * first_error + (1 - alpha) ** 2 * unbiased_error + 2 * alpha * (1 - alpha) * covariance
        return value, jnp.where(has_first, mixed, unbiased_error)

    def _unbiased_squared_error(self, first: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Give the squared error of terms that share their baseline; the derivation is at `zeroth._leave_one_out`.

        There c is the covariance of cost and score; here that of the remaining cost and the score.
        """
        spread = self.unbiased.squared_error()
        others = as_real(jnp.maximum(self.unbiased.count - 1, 1), spread)
        share = self.linear[1] / jnp.maximum(self.linear[2], 1)
        return spread + ((self.unbiased.mean - share * first) ** 2 - spread) / (others**2 + 1)


def _weights(rule: Rule, evidence: Evidence) -> Weights:
    """Apply the rule where it has derivatives to judge."""
    weights = rule(evidence)
    has_first = evidence.count >= 2
    alpha = jnp.where(has_first, weights.alpha, 0)
    reason = Reason.where(has_first, weights.reason, Reason.not_finite)
    return Weights(alpha, reason, jnp.where(alpha > 0, weights.bias_bound, 0))


def _checked_blocks(blocks: Int[np.ndarray, " dim"] | None, dim: int) -> tuple[Int[np.ndarray, " dim"], int]:
    """Give the block of each coordinate, and how many blocks there are."""
    if blocks is None:
        return np.zeros(dim, int), 1
    blocks = np.asarray(blocks)
    if blocks.shape != (dim,):
        raise ValueError(f"blocks must have one number for each of the {dim} coordinates, got shape {blocks.shape}")
    num_blocks = int(blocks.max()) + 1
    if not np.issubdtype(blocks.dtype, np.integer) or set(np.unique(blocks)) != set(range(num_blocks)):
        raise ValueError("blocks must be integers from 0 without gaps; np.arange(dim) is one block for each coordinate")
    return blocks, num_blocks
