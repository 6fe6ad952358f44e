"""Mixtures of a first-order and an unbiased estimate from the same rollouts, and the evidence that weighs them."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators.consistency import SecantSums, secant_sums
from mjxgrad.estimators.estimate import GradientEstimate, Reason, assemble, is_nothing_felt
from mjxgrad.estimators.moments import Moments, Summary, Total, as_real
from mjxgrad.estimators.rules import Consistent, Evidence, Rule, Weights
from mjxgrad.estimators.samples import Group, Plan, Samples, plan_by_noise, stream
from mjxgrad.estimators.unbiased import UnbiasedTerms, gram, unbiased_terms
from mjxgrad.objective import Objective, as_vector

ByNoise = Float[Array, "samples m"]


def alpha_order(
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    rule: Rule | None = None,
    control_variate: bool = True,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Mix a first-order and an unbiased estimate of the gradient of a smoothed objective.

    The estimate is $\alpha g^1 + (1 - \alpha) g^0$, both parts from the same rollouts. $g^1$ is the mean derivative.
    $g^0$ is the control-variate estimate, see `control_variate`: never much worse than zeroth order, and far better where
    derivatives explain the costs. The rule chooses $\alpha$ and names the reason. It chooses from the same samples, which
    adds a dependence of order 1 / `num_samples` that the standard error does not count.

    Args:
        objective: differentiated once per sample by its noise, under `jax.vmap`.
        params: the point $\theta$, a vector or a pytree as in `first_order`.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2; with random starts even and at least 4, since pairs share a start.
        rule: the rule that chooses $\alpha$; see `mjxgrad.estimators.rules`. None is `Consistent()`.
        control_variate: whether $g^0$ uses derivatives; otherwise it is zeroth order with the leave-one-out baseline.
        chunk_size: rollouts at a time, at least 4; memory grows with it. Samples are compared, and leave each other out,
            within groups of at most 64 of a chunk.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if `num_samples` or `chunk_size` do not fit, or the objective does not know its noise.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
        arXiv:2202.00817, section 4 (the mixture).
    """
    objective, vector, restore = as_vector(objective, params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    (parts,) = stream(objective, vector, key, plan, functools.partial(both_parts, control_variate=control_variate))
    weights = weigh(rule or Consistent(), parts, plan)
    facts = {"alpha": weights.alpha, "reason": weights.reason, "bias_bound": weights.bias_bound}
    return _assembled(parts, plan, restore, jnp.full_like(vector, weights.alpha), **facts)


def control_variate(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int, chunk_size: int | None = None
) -> GradientEstimate:
    r"""Estimate the gradient without bias, using derivatives as far as they explain the costs.

    The estimate is the mean of $(f_j - \beta\,\bar g\cdot w_j - b) s_j + \beta P_j^\top \bar g$. The mean derivative
    $\bar g$, the baseline $b$ and the share $\beta \in [0, 1]$, fitted by least squares, all leave sample j out; see
    `unbiased`. It is unbiased even if derivatives are wrong: $\beta$ is then near zero, and this is zeroth order. Where
    derivatives explain the costs, the error falls by the root of the share that they leave unexplained.

    The standard error ignores that terms depend on each other through the mean derivative. In the tests it was up to 8 %
    too small at four samples, and less than 2 % from ten samples on.

    Arguments, units and errors are those of `alpha_order`.
    """
    objective, vector, restore = as_vector(objective, params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    (parts,) = stream(objective, vector, key, plan, functools.partial(both_parts, control_variate=True))
    return _assembled(parts, plan, restore, jnp.zeros_like(vector))


def per_step(
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    rule: Rule | None = None,
    control_variate: bool = True,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Mix derivatives and unbiased terms by step and action, then pull the mixture back through the policy, once.

    For the noise of step t and action a, a sample has a derivative $\lambda_{t,a}$ and an unbiased term $z_{t,a}$. The
    estimate is the mean of $P_j^\top(\alpha\odot\lambda_j + (1 - \alpha)\odot z_j)$. Early in a long rollout derivatives
    may explode while those near its end are exact. One weight for all steps would waste the exact ones.

    Arguments and errors are those of `alpha_order`. The rule chooses each $\alpha_{t,a}$ within a chunk. `Consistent()`,
    the default, asks its first question once for all steps; `InverseVariance()` is the published IVW-H.
    With noise on the parameters the steps are the parameters.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit. Its `alpha` has one number per step and
        action, flattened, the mean over chunks; its `reason` is the most frequent one. The bias is not bounded.

    References:
        Onoda et al., arXiv:2604.18161 (IVW-H).
    """
    objective, vector, restore = as_vector(objective, params)
    plan = plan_by_noise(objective, num_samples, chunk_size)

    def mixed_chunk(samples: Samples) -> tuple[Summary, ...]:
        chunk = Group.of(samples)
        parts, terms_by_noise, has_cost = parts_and_terms(
            samples, chunk, control_variate=control_variate, take=lambda by_noise: by_noise
        )
        weights = weigh(rule or Consistent(), parts, plan, by_coordinate=True)
        alpha = weights.alpha
        mixed = alpha * chunk.derivatives + jnp.where(chunk.has_derivative[:, None], 1 - alpha, 1) * terms_by_noise
        values = Moments.of(chunk.by_unit(chunk.pull_back(samples, mixed)), has_cost)
        reasons = jax.nn.one_hot(jax.tree.leaves(weights.reason)[0], len(Reason), axis=0)
        weighed = (parts.num_costs * alpha, parts.num_costs * reasons, parts.num_costs)
        return values, parts.costs, Total((*weighed, parts.num_felt))

    values, costs, sums = stream(objective, vector, key, plan, mixed_chunk)
    alpha, reasons, count, num_felt = sums.value
    return assemble(
        values.mean,
        values.squared_error(),
        costs,
        plan,
        count=values.count,
        num_felt=num_felt,
        restore=restore,
        alpha=alpha / jnp.maximum(count, 1),
        reason=jax.tree.map(lambda _: reasons.argmax(axis=0), Reason.fixed),
        bias_bound=jnp.where((alpha > 0).any(), jnp.nan, 0),
    )


class Parts(Summary):
    """Moments of both parts over all units: samples, or pairs where starts are random.

    Attributes:
        first: moments of the derivatives.
        unbiased: moments of the unbiased terms.
        difference: moments of the unbiased terms minus the derivatives.
        costs: moments of the costs.
        scaled: moments of the derivatives by the noise, in its standard deviations.
        secants: comparison of costs and derivatives over pairs.
        linear_variance: variance of the costs that the mean derivative explains, summed over samples.
        beta: sum of the shares of the linear part that were taken off.
        num_costs: number of samples in the last two sums.
        num_groups: number of groups of samples that share their baselines.
        num_felt: number of units whose noise made a difference.
    """

    first: Moments
    unbiased: Moments
    difference: Moments
    costs: Moments
    scaled: Moments
    secants: SecantSums
    linear_variance: Float[Array, ""]
    beta: Float[Array, ""]
    num_costs: Float[Array, ""]
    num_groups: Float[Array, ""]
    num_felt: Int[Array, ""]

    def merge(self, other: "Parts") -> "Parts":
        def both(mine: Any, theirs: Any) -> Any:
            return mine.merge(theirs) if isinstance(mine, Moments) else mine + theirs

        return jax.tree.map(both, self, other, is_leaf=lambda leaf: isinstance(leaf, Moments))

    def evidence(self, *, by_coordinate: bool) -> Evidence:
        """Return the evidence for a rule, with all coordinates as one block or each as a block of its own."""
        pool = jnp.asarray if by_coordinate else jnp.sum
        dim = pool(jnp.ones_like(self.first.offset))

        def in_all(value: Array) -> Array:
            return jnp.broadcast_to(value, dim.shape)

        missed, explained = self.secants.missed_variance(), self.linear_variance / jnp.maximum(self.num_costs, 1)
        bound = jnp.sqrt(missed / jnp.where(explained > 0, explained, jnp.nan))
        return Evidence(
            count=in_all(self.first.count),
            dim=dim,
            first_norm=jnp.sqrt(pool(self.first.mean**2)),
            zeroth_norm=jnp.sqrt(pool(self.unbiased.mean**2)),
            difference_norm=jnp.sqrt(pool(self.difference.mean**2)),
            first_variance=pool(self.first.variance()),
            zeroth_variance=pool(self.unbiased.variance()),
            difference_variance=pool(self.difference.variance()),
            inconsistency=in_all(self.secants.inconsistency()),
            relative_bias_bound=in_all(jnp.where(missed == 0, 0, bound)),
            cost_variance=in_all(self.costs.variance()),
            scaled_first_variance=in_all(self.scaled.variance().sum()),
            scaled_first_norm=in_all(jnp.sqrt((self.scaled.mean**2).sum())),
        )

    def mixture(self, alpha: Float[Array, " dim"]) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
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

    def _unbiased_squared_error(self, first: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Return the squared error of terms that share their baseline; derived at `first_and_zeroth._leave_one_out`.

        Its c, the covariance of cost and score, is here the covariance of the remaining cost and the score.
        """
        spread = self.unbiased.squared_error()
        num_groups = jnp.maximum(self.num_groups, 1)
        others = jnp.maximum(as_real(self.unbiased.count, spread) / num_groups - 1, 1)
        remaining = self.unbiased.mean - self.beta / jnp.maximum(self.num_costs, 1) * first
        return spread + (remaining**2 - spread) / (num_groups * others**2 + 1)


def both_parts(samples: Samples, *, control_variate: bool) -> tuple[Parts]:
    """Return the summary of a chunk with both parts pulled back to the parameters."""
    chunk = Group.of(samples)
    take = functools.partial(chunk.pull_back, samples)
    return (parts_and_terms(samples, chunk, control_variate=control_variate, take=take)[0],)


def parts_and_terms(
    samples: Samples, chunk: Group, *, control_variate: bool, take: Callable[[ByNoise], Array]
) -> tuple[Parts, ByNoise, Bool[Array, " units"]]:
    """Return the summary of a chunk, the unbiased terms by noise, and which units have both a cost and a baseline.

    `take` maps the noise to the space of the moments: the pull-back for parameters, the identity for noise.
    """
    groups = chunk.split()

    def compare(group: Group) -> tuple[UnbiasedTerms, SecantSums]:
        slopes = gram(group)
        return unbiased_terms(group, slopes, with_derivatives=control_variate), secant_sums(group, slopes)

    terms, secants = jax.vmap(compare)(groups)
    count = len(chunk.costs)
    terms_by_noise = terms.by_noise.reshape(-1, terms.by_noise.shape[-1])[:count]
    # A group with a single cost has no baseline.
    num_costs = groups.has_cost.sum(axis=1)
    is_compared = (groups.has_cost & (num_costs >= 2)[:, None]).ravel()[:count]
    has_cost = chunk.complete(is_compared)
    has_both = has_cost & chunk.complete(chunk.has_derivative)
    unbiased, first = chunk.by_unit(take(terms_by_noise)), chunk.by_unit(take(chunk.derivatives))
    real_counts = as_real(num_costs, chunk.costs)
    summary = Parts(
        first=Moments.of(first, has_both),
        unbiased=Moments.of(unbiased, has_cost),
        difference=Moments.of(unbiased - first, has_both),
        costs=Moments.of(chunk.by_unit(chunk.costs) + chunk.centre, has_cost),
        scaled=Moments.of(chunk.derivatives * chunk.stddev, chunk.has_derivative),
        secants=jax.tree.map(lambda sums: sums.sum(axis=0), secants),
        linear_variance=(real_counts * terms.linear_variance).sum(),
        beta=(groups.has_cost * terms.beta).sum(),
        num_costs=real_counts.sum(),
        num_groups=as_real((num_costs >= 2).sum(), chunk.costs),
        num_felt=samples.num_felt(),
    )
    return summary, terms_by_noise, has_cost


def weigh(rule: Rule, parts: Parts, plan: Plan, *, by_coordinate: bool = False) -> Weights:
    """Apply a rule to all coordinates or to each; α is zero without finite derivatives, or if nothing was felt."""
    if isinstance(rule, type) or not callable(rule):
        raise ValueError(f"rule must be one of mg.estimators.rules, such as rules.Consistent(), got {rule!r}")
    is_nothing = is_nothing_felt(plan, parts.costs, parts.num_felt)

    def one_block(evidence: Evidence) -> Weights:
        weights, has_first = rule(evidence), evidence.count >= 2
        alpha = jnp.where(has_first & ~is_nothing, weights.alpha, 0)
        reason = Reason.where(has_first, weights.reason, Reason.not_finite)
        return Weights(alpha, reason, jnp.where(alpha > 0, weights.bias_bound, 0))

    evidence = parts.evidence(by_coordinate=by_coordinate)
    return jax.vmap(one_block)(evidence) if by_coordinate else one_block(evidence)


def _assembled(
    parts: Parts, plan: Plan, restore: Callable, weights: Float[Array, " dim"], **facts: Any
) -> GradientEstimate:
    """Return one estimate from both parts; the facts are the arguments of `assemble` about α."""
    value, squared_error = parts.mixture(weights)
    count, num_felt = parts.unbiased.count, parts.num_felt
    return assemble(value, squared_error, parts.costs, plan, count=count, num_felt=num_felt, restore=restore, **facts)
