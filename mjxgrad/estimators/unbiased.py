r"""Unbiased terms that use derivatives only as far as they explain the costs.

With noise $w_j$, score $s_j$, cost $f_j$ and a vector $a$ that does not depend on $w_j$,

$$\mathbb{E}[(f_j - \beta\, a\cdot w_j - b)\, s_j + \beta\, P_j^\top a] = \nabla F$$

for every $\beta$ and $b$ that do not depend on $w_j$ either, whatever $a$ is: $(a\cdot w_j)s_j$ has the mean of
$P_j^\top a$, where $P_j^\top$ is the pull-back from the noise to the parameters. With $a$ the mean derivative of the other
samples the linear part of the cost, which makes most of the noise of a zeroth-order estimate, is gone; where derivatives
are wrong $\beta$ is near zero and what remains is the zeroth-order estimate itself. All of $a$, $\beta$ and $b$ leave
sample j out, so nothing is lost to splitting.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.estimators.samples import Group


class UnbiasedTerms(eqx.Module):
    r"""One term per sample, before the pull-back, whose mean is the estimate; the share $\beta$ of each.

    The variance is that of the linear part $a\cdot w$ over the samples.
    """

    by_noise: Float[Array, "samples m"]
    beta: Float[Array, " samples"]
    linear_variance: Float[Array, ""]


def gram(samples: Group) -> Float[Array, "samples samples"]:
    """Give the slope of sample i along the noise of sample k, from which all comparisons follow."""
    return jnp.matmul(samples.derivatives, samples.noise.T, precision=jax.lax.Precision.HIGHEST)


def unbiased_terms(samples: Group, slopes: Float[Array, "samples samples"], *, with_derivatives: bool) -> UnbiasedTerms:
    """Give the terms of a group, without derivatives those of the zeroth-order estimate.

    Those of samples without a cost are zero or meaningless, and masked by their pull-back.
    """
    costs, has_cost = samples.costs, samples.has_cost.astype(samples.costs.dtype)
    has_slope = samples.has_derivative.astype(costs.dtype)
    num_slopes = has_slope.sum()
    # Row j leaves sample j out.
    others = has_cost[None, :] * (1 - jnp.eye(len(costs), dtype=costs.dtype))
    num_others = jnp.maximum(others.sum(axis=1), 1)
    # (mean derivative without j) · w_k
    along = (slopes.sum(axis=0)[None, :] - slopes) / jnp.maximum(num_slopes - has_slope, 1)[:, None]
    if with_derivatives:
        beta, linear_variance = _fitted_share(samples, slopes, others)
    else:
        beta, linear_variance = jnp.zeros_like(costs), jnp.zeros_like(num_slopes)
    rest = costs[None, :] - beta[:, None] * along
    baseline = (others * rest).sum(axis=1) / num_others
    if samples.per_unit == 2:
        baseline += _partners_surplus(samples, rest - baseline[:, None], others)
    residual = jnp.diagonal(rest) - baseline
    total = samples.derivatives.sum(axis=0)[None, :]
    without = (total - samples.derivatives) / jnp.maximum(num_slopes - has_slope, 1)[:, None]
    by_noise = residual[:, None] * samples.scores + beta[:, None] * without
    return UnbiasedTerms(by_noise, beta, linear_variance)


def _fitted_share(
    samples: Group, slopes: Float[Array, "samples samples"], others: Float[Array, "samples samples"]
) -> tuple[Float[Array, " samples"], Float[Array, ""]]:
    """Regress the costs of the other samples on the linear part, both samples left out of the mean derivative.

    The share that minimises the variance of the remaining costs also minimises, up to their fourth moments, that of the
    estimate: its variance is that of the costs times that of the score.
    """
    has_slope = samples.has_derivative.astype(slopes.dtype)
    count = has_slope.sum() - has_slope[:, None] - has_slope[None, :]
    along = (slopes.sum(axis=0)[None, :] - slopes - jnp.diagonal(slopes)[None, :]) / jnp.maximum(count, 1)
    weights = others * (count >= 1)

    def centred(values: Float[Array, "samples samples"]) -> Float[Array, "samples samples"]:
        if samples.per_unit == 2:  # what the start does to the costs is not the noise's doing
            return pairs * (values - _partner(values)) / jnp.sqrt(2.0)
        mean = (weights * values).sum(axis=1) / jnp.maximum(weights.sum(axis=1), 1)
        return weights * (values - mean[:, None])

    weights = weights * samples.has_cost[:, None]
    pairs = weights * _partner(weights) if samples.per_unit == 2 else weights
    explaining, explained = centred(along), centred(jnp.broadcast_to(samples.costs, along.shape))
    squares = (explaining**2).sum(axis=1)
    has_any = squares > 0
    share = (explaining * explained).sum(axis=1) / jnp.where(has_any, squares, 1)
    variance = squares.sum() / jnp.maximum(pairs.sum(), 1)
    return jnp.where(has_any, jnp.clip(share, 0, 1), 0), variance


def _partners_surplus(
    samples: Group, rest: Float[Array, "samples samples"], others: Float[Array, "samples samples"]
) -> Float[Array, " samples"]:
    """Give what the cost of the other sample from the same start tells about this one's, beyond the mean of all.

    The best linear guess: its distance from the mean times the correlation within pairs, which is taken from the other
    pairs. Where starts make most of the spread it is near one, and the baseline is the partner's cost.
    """
    both = others * _partner(others)
    together = (both * rest * _partner(rest)).sum(axis=1)
    alone = (both * rest**2).sum(axis=1)
    correlation = jnp.where(alone > 0, jnp.clip(together / jnp.where(alone > 0, alone, 1), 0, 1), 0)
    index = jnp.arange(len(rest))
    partner = index + 1 - 2 * (index % 2)
    has_partner = samples.has_cost[partner]
    return jnp.where(has_partner, correlation * rest[index, partner], 0)


def _partner(rows: Float[Array, "samples samples"]) -> Float[Array, "samples samples"]:
    """Swap the two samples of each start in every row."""
    return rows.reshape(len(rows), -1, 2)[:, :, ::-1].reshape(rows.shape)
