"""Mixtures of a first-order and an unbiased estimate from the same rollouts, and the evidence that weighs them."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad._arrays import instance
from mjxgrad._programs import compiled
from mjxgrad.estimators.estimate import GradientEstimate, Reason, assemble, is_nothing_felt
from mjxgrad.estimators.evidence import Evidence, Memory, noise_dim
from mjxgrad.estimators.moments import Moments, as_real
from mjxgrad.estimators.rules import FixedAlpha, LeastRisk, Rule, Weights
from mjxgrad.estimators.samples import Group, Plan, Samples, in_groups, plan_by_noise, stream
from mjxgrad.estimators.unbiased import Products, SecantSums, gram, secant_sums, unbiased_terms
from mjxgrad.objective import Objective, as_vector
from mjxgrad.objective.base import Scalar, Vector

# Right derivatives leave this share of their variance by the noise unexplained in a quartic cost, 0.83 in a cubic one.
_SCATTER = 1.25


@compiled
def alpha_order(
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    rule: Rule | None = None,
    control_variate: bool = True,
    memory: Memory | None = None,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Mix a first-order and an unbiased estimate of the gradient of a smoothed objective.

    The estimate is $\alpha g^1 + (1 - \alpha) g^0$, both parts from the same rollouts: $g^1$ is the mean derivative,
    $g^0$ the estimate of `control_variate`. The rule chooses $\alpha$ and names the reason. It chooses from the same
    samples, which adds a dependence of order 1 / `num_samples` that the standard error does not count.

    The other arguments, and the units, are those of `first_order`.

    - `num_samples`: rollouts to spend. At least 2; with random starts even and at least 4, since pairs share a start.
    - `rule`: the rule that chooses $\alpha$; see `mjxgrad.estimators.rules`. None is `LeastRisk()`.
    - `control_variate`: whether $g^0$ uses derivatives; otherwise it is zeroth order with the leave-one-out baseline.
    - `memory`: the `memory` of the estimate before in a descent, for evidence of all its steps; `optimise` sees to it.
    - `chunk_size`: rollouts at a time, at least 4; memory grows with it. Samples are compared, and leave each other out,
      within groups of at most 64 of a chunk.

    Raises:
        ValueError: if `num_samples` or `chunk_size` do not fit, or the objective does not know its noise.

    References:
        Suh, Simchowitz, Zhang, Tedrake. ICML 2022, arXiv:2202.00817, section 4 (the mixture); see `first_order`.
    """
    objective, vector, restore = as_vector(objective, params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    parts = stream(objective, vector, key, plan, functools.partial(both_parts, control_variate=control_variate))
    evidence = parts.evidence()
    known = Memory.of(parts.difference.mean, evidence)
    instance("memory", memory, Memory | None, "the memory of an estimate")
    if memory is not None:
        known = memory.with_more(known)
        evidence = evidence.with_memory(known)
    weights = weigh(rule or LeastRisk(), parts, plan, evidence)
    value, squared_error = parts.mixture(weights.alpha)
    return assemble(
        value,
        squared_error,
        parts.costs,
        plan,
        count=parts.unbiased.count,
        num_felt=parts.num_felt,
        restore=restore,
        alpha=weights.alpha,
        reason=weights.reason,
        bias_bound=weights.bias_bound,
        memory=known,
    )


@compiled
def control_variate(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int, chunk_size: int | None = None
) -> GradientEstimate:
    r"""Estimate the gradient without bias, using derivatives as far as they explain the costs.

    It is `alpha_order` with a fixed α of zero, whose arguments, units and errors it has; `unbiased` has the terms. Where
    derivatives are wrong it is zeroth order. Where they explain the costs, the error falls by the root of the share that
    they leave unexplained.

    The standard error ignores that terms depend on each other through the mean derivative. In the tests it was up to 8 %
    too small at four samples, and less than 2 % from ten samples on.
    """
    rule = FixedAlpha(0.0)
    return alpha_order(objective, params, key, num_samples=num_samples, rule=rule, chunk_size=chunk_size)


class Parts(eqx.Module):
    """Moments of both parts over all units: samples, or pairs where starts are random."""

    first: Moments
    unbiased: Moments
    difference: Moments  # unbiased terms minus derivatives
    costs: Moments
    scaled: Moments  # derivatives by the noise, in its standard deviations
    secants: SecantSums
    differences: Products  # unbiased terms minus derivatives, by pairs of units
    scores: Products
    score_variance: Scalar  # squared norms of the scores, summed over samples
    beta: Scalar  # sum of the shares of the linear part that were taken off
    num_costs: Scalar  # number of samples in the last two sums
    num_groups: Scalar  # number of groups of samples that share their baselines
    num_felt: Int[Array, ""]  # see `Samples`

    def evidence(self) -> Evidence:
        """Return the evidence for a rule."""
        missed = self.secants.missed / self.secants.pairs  # NaN without pairs
        spread = self.score_variance / jnp.maximum(self.num_costs, 1)
        width = self.scores.mean / jnp.where(spread > 0, spread, 1)
        count, has_pairs = as_real(self.first.count, self.first.offset), self.secants.pairs > 0
        scaled = self.scaled.variance().sum()
        first, zeroth, noise = (x.variance().sum() for x in (self.first, self.unbiased, self.difference))
        unshared = [
            jnp.clip(noise + x - y, 0, 2 * noise) / (2 * jnp.maximum(count, 1))
            for x, y in ((zeroth, first), (first, zeroth))
        ]
        # The mean product of two samples' differences, and its variance where they have no mean (Chen, Qin 2010).
        excess = (self.difference.mean**2).sum() - noise / jnp.maximum(count, 1)
        error = jnp.sqrt(2 * self.differences.mean / jnp.maximum(count * (count - 1), 1))
        return Evidence(
            count=count,
            dim=jnp.asarray(self.first.offset.size, count.dtype),
            first_norm=jnp.linalg.norm(self.first.mean),
            difference_norm=jnp.linalg.norm(self.difference.mean),
            first_variance=first,
            zeroth_variance=zeroth,
            difference_variance=noise,
            cost_variance=self.costs.variance(),
            scaled_first_variance=scaled,
            scaled_first_norm=jnp.linalg.norm(self.scaled.mean),
            squared_bias=excess,
            squared_bias_error=error,
            noise_dim=noise_dim(noise / jnp.maximum(count, 1), error / jnp.sqrt(2.0)),
            squared_bias_bound=jnp.where(has_pairs, missed * width, jnp.inf),
            squared_jump_bound=jnp.where(has_pairs, jnp.maximum(missed - _SCATTER * scaled, 0) * width, jnp.inf),
            zeroth_noise=unshared[0],
            first_noise=unshared[1],
            num_estimates=jnp.ones_like(count),
        )

    def mixture(self, alpha: Float[Array, "..."]) -> tuple[Vector, Vector]:
        """Return the weighted mean and its squared error; without finite derivatives, those of the unbiased part."""
        has_first = self.first.count >= 2
        first = jnp.where(has_first, self.first.mean, 0)
        value = alpha * first + (1 - alpha) * self.unbiased.mean
        unbiased_error = self._unbiased_squared_error(first)
        first_error = jnp.where(has_first, self.first.squared_error(), 0)
        difference_error = jnp.where(has_first, self.difference.squared_error(), 0)
        covariance = (unbiased_error + first_error - difference_error) / 2
        mixed = alpha**2 * first_error + (1 - alpha) ** 2 * unbiased_error + 2 * alpha * (1 - alpha) * covariance
        return value, jnp.where(has_first, mixed, unbiased_error)

    def _unbiased_squared_error(self, first: Vector) -> Vector:
        """Return the squared error of terms that share their baseline; derived at `first_and_zeroth._leave_one_out`.

        Its c, the covariance of cost and score, is here the covariance of the remaining cost and the score.
        """
        spread = self.unbiased.squared_error()
        num_groups = jnp.maximum(self.num_groups, 1)
        others = jnp.maximum(as_real(self.unbiased.count, spread) / num_groups - 1, 1)
        remaining = self.unbiased.mean - self.beta / jnp.maximum(self.num_costs, 1) * first
        return spread + (remaining**2 - spread) / (num_groups * others**2 + 1)


def both_parts(samples: Samples, *, control_variate: bool) -> Parts:
    """Return the summary of a chunk with both parts pulled back to the parameters."""
    chunk = Group.of(samples)
    groups = chunk.split()

    def compare(group: Group) -> tuple[Array, Array, SecantSums]:
        slopes = gram(group)
        return *unbiased_terms(group, slopes, with_derivatives=control_variate), secant_sums(group, slopes)

    terms, beta, secants = jax.vmap(compare)(groups)
    count = len(chunk.costs)
    terms_by_noise = terms.reshape(-1, terms.shape[-1])[:count]
    # A group with a single cost has no baseline.
    num_costs = groups.has_cost.sum(axis=1)
    has_cost = chunk.complete((groups.has_cost & (num_costs >= 2)[:, None]).ravel()[:count])
    has_both = has_cost & chunk.complete(chunk.has_derivative)
    pulled = [chunk.pull_back(samples, x) for x in (terms_by_noise, chunk.derivatives, chunk.scores)]
    unbiased, first = (chunk.by_unit(x) for x in pulled[:2])

    def products(rows: Float[Array, "rows dim"], mask: Bool[Array, " rows"], per_group: int) -> Products:
        rows, mask = (in_groups(x, len(num_costs), per_group) for x in (rows, mask))
        return jax.tree.map(lambda sums: sums.sum(axis=0), jax.vmap(Products.of)(rows, mask))

    size, real_counts = groups.costs.shape[1], as_real(num_costs, chunk.costs)
    return Parts(
        first=Moments.of(first, has_both),
        unbiased=Moments.of(unbiased, has_cost),
        difference=Moments.of(unbiased - first, has_both),
        costs=Moments.of(chunk.by_unit(chunk.costs) + chunk.centre, has_cost),
        scaled=Moments.of(chunk.derivatives * chunk.stddev, chunk.has_derivative),
        secants=jax.tree.map(lambda sums: sums.sum(axis=0), secants),
        differences=products(unbiased - first, has_both, size // chunk.per_unit),
        scores=products(pulled[2], chunk.has_cost, size),
        score_variance=(pulled[2] ** 2).sum(),
        beta=(groups.has_cost * beta).sum(),
        num_costs=real_counts.sum(),
        num_groups=as_real((num_costs >= 2).sum(), chunk.costs),
        num_felt=samples.num_felt(),
    )


def weigh(rule: Rule, parts: Parts, plan: Plan, evidence: Evidence | None = None) -> Weights:
    """Apply a rule, to the parts' evidence if no other is given; α is zero without finite derivatives, or if nothing was felt."""
    if isinstance(rule, type) or not callable(rule):
        raise ValueError(f"rule must be one of mg.estimators.rules, such as rules.LeastRisk(), got {rule!r}")
    weights, has_first = rule(parts.evidence() if evidence is None else evidence), parts.first.count >= 2
    alpha = jnp.where(has_first & ~is_nothing_felt(plan, parts.costs, parts.num_felt), weights.alpha, 0)
    reason = Reason.where(has_first, weights.reason, Reason.not_finite)
    return Weights(alpha, reason, jnp.where(alpha > 0, weights.bias_bound, 0))
