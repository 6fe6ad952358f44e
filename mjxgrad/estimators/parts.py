"""A first-order and an unbiased estimate from the same rollouts, and all that is needed to weigh them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.estimators.by_noise import Group, SamplesByNoise
from mjxgrad.estimators.consistency import SecantSums, secant_sums
from mjxgrad.estimators.moments import Moments, Summary, as_real
from mjxgrad.estimators.rules import Evidence
from mjxgrad.estimators.unbiased import UnbiasedTerms, gram, unbiased_terms

ByNoise = Float[Array, "samples m"]


class Parts(Summary):
    """Moments of both parts over all samples; of pairs of them where starts are random.

    Attributes:
        first: of the derivatives.
        unbiased: of the unbiased terms.
        difference: of the terms less the derivatives.
        costs: of the costs.
        scaled: of the derivatives by noise, in its standard deviations.
        secants: how far the derivatives explain the costs.
        linear_variance: of the costs that the mean derivative explains, summed over samples.
        beta: sum of the shares that were taken off.
        num_costs: samples in these sums.
        num_groups: groups of samples that share their baselines.
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

    def merge(self, other: "Parts") -> "Parts":
        """Give the summary of both sets of samples."""

        def both(mine: Any, theirs: Any) -> Any:
            return mine.merge(theirs) if isinstance(mine, Moments) else mine + theirs

        return jax.tree.map(both, self, other, is_leaf=lambda leaf: isinstance(leaf, Moments))

    def evidence(self, blocks: Int[np.ndarray, " dim"], num_blocks: int) -> Evidence:
        """Give what a rule may look at, block by block.

        Args:
            blocks: number of the block of each coordinate.
            num_blocks: how many there are.

        Returns:
            The evidence, with an axis of blocks.
        """

        def by_block(values: Float[Array, " dim"]) -> Float[Array, " blocks"]:
            return jax.ops.segment_sum(values, blocks, num_segments=num_blocks)

        def in_all(value: Array) -> Array:
            return jnp.broadcast_to(value, num_blocks)

        missed, explained = self.secants.missed_variance(), self.linear_variance / jnp.maximum(self.num_costs, 1)
        bound = jnp.sqrt(missed / jnp.where(explained > 0, explained, jnp.nan))
        return Evidence(
            count=in_all(self.first.count),
            dim=by_block(jnp.ones_like(self.first.offset)),
            first_norm=jnp.sqrt(by_block(self.first.mean**2)),
            zeroth_norm=jnp.sqrt(by_block(self.unbiased.mean**2)),
            difference_norm=jnp.sqrt(by_block(self.difference.mean**2)),
            first_variance=by_block(self.first.variance()),
            zeroth_variance=by_block(self.unbiased.variance()),
            difference_variance=by_block(self.difference.variance()),
            inconsistency=in_all(self.secants.inconsistency()),
            relative_bias_bound=in_all(jnp.where(missed == 0, 0, bound)),
            cost_variance=in_all(self.costs.variance()),
            scaled_first_variance=in_all(self.scaled.variance().sum()),
            scaled_first_norm=in_all(jnp.sqrt((self.scaled.mean**2).sum())),
        )

    def mixture(self, alpha: Float[Array, " dim"]) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Give the weighted mean and its squared standard error, coordinate by coordinate.

        Args:
            alpha: weight of the first-order part.

        Returns:
            Both; where no derivative was finite, those of the unbiased part.
        """
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
        num_groups = jnp.maximum(self.num_groups, 1)
        others = jnp.maximum(as_real(self.unbiased.count, spread) / num_groups - 1, 1)
        remaining = self.unbiased.mean - self.beta / jnp.maximum(self.num_costs, 1) * first
        return spread + (remaining**2 - spread) / (num_groups * others**2 + 1)


def parts_and_terms(
    samples: SamplesByNoise, *, control_variate: bool, take: Callable[[ByNoise], Array]
) -> tuple[Parts, ByNoise, Bool[Array, " units"]]:
    """Summarise a chunk.

    Args:
        samples: of the chunk.
        control_variate: whether the unbiased part uses derivatives.
        take: where the moments are wanted: `samples.pull_back` for parameters, the identity for noise.

    Returns:
        The summary, the unbiased terms by noise, and which units have both cost and baseline.
    """
    groups = samples.groups()

    def compare(group: Group) -> tuple[UnbiasedTerms, SecantSums]:
        slopes = gram(group)
        return unbiased_terms(group, slopes, with_derivatives=control_variate), secant_sums(group, slopes)

    terms, secants = jax.vmap(compare)(groups)
    whole, count = samples.group, len(samples.group.costs)
    terms_by_noise = terms.by_noise.reshape(-1, terms.by_noise.shape[-1])[:count]
    # A cost without another to compare it with has no baseline.
    num_costs = groups.has_cost.sum(axis=1)
    is_compared = (groups.has_cost & (num_costs >= 2)[:, None]).ravel()[:count]
    has_cost = samples.complete(is_compared)
    has_both = has_cost & samples.complete(whole.has_derivative)
    unbiased, first = samples.by_unit(take(terms_by_noise)), samples.by_unit(take(whole.derivatives))
    real_counts = as_real(num_costs, whole.costs)
    summary = Parts(
        first=Moments.of(first, has_both),
        unbiased=Moments.of(unbiased, has_cost),
        difference=Moments.of(unbiased - first, has_both),
        costs=Moments.of(samples.by_unit(whole.costs) + samples.mean_cost, has_cost),
        scaled=Moments.of(whole.derivatives * whole.stddev, whole.has_derivative),
        secants=jax.tree.map(lambda sums: sums.sum(axis=0), secants),
        linear_variance=(real_counts * terms.linear_variance).sum(),
        beta=(groups.has_cost * terms.beta).sum(),
        num_costs=real_counts.sum(),
        num_groups=as_real((num_costs >= 2).sum(), whole.costs),
    )
    return summary, terms_by_noise, has_cost
