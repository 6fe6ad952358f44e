r"""Unbiased terms that use derivatives only as far as they explain the costs.

With noise $w_j$, score $s_j$, cost $f_j$ and a vector $a$ that does not depend on $w_j$,

$$\mathbb{E}[(f_j - \beta\, a\cdot w_j - b)\, s_j + \beta\, P_j^\top a] = \nabla F$$

for all $a$, $\beta$ and $b$ that do not depend on $w_j$. The reason: $(a\cdot w_j)s_j$ and $P_j^\top a$ have the same mean,
where $P_j^\top$ is the pull-back from the noise to the parameters. Here $a$ is the mean derivative of the other samples. It
removes the linear part of the cost, the source of most of the noise of a zeroth-order estimate. The share $\beta$, from 0 to
1, is fitted by least squares: near zero where derivatives are wrong. $a$, $\beta$ and $b$ all leave sample j out.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.estimators.samples import Group

_Pairs = Float[Array, "samples samples"]


class UnbiasedTerms(eqx.Module):
    r"""The terms of a group, whose mean after the pull-back is the estimate.

    Attributes:
        by_noise: term of each sample before the pull-back.
        beta: share $\beta$ of each sample.
        linear_variance: variance of the linear part $a\cdot w$ over the samples.
    """

    by_noise: Float[Array, "samples m"]
    beta: Float[Array, " samples"]
    linear_variance: Float[Array, ""]


def gram(samples: Group) -> _Pairs:
    """Return the slope of sample i along the noise of sample k, from which all comparisons follow."""
    return jnp.matmul(samples.derivatives, samples.noise.T, precision=jax.lax.Precision.HIGHEST)


def unbiased_terms(samples: Group, slopes: _Pairs, *, with_derivatives: bool) -> UnbiasedTerms:
    """Return the terms of a group; without derivatives, the terms of the zeroth-order estimate.

    Terms of samples without a cost are meaningless; the pull-back masks them.
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
        baseline += _partner_prediction(samples, rest - baseline[:, None], others)
    residual = jnp.diagonal(rest) - baseline
    total = samples.derivatives.sum(axis=0)[None, :]
    without = (total - samples.derivatives) / jnp.maximum(num_slopes - has_slope, 1)[:, None]
    by_noise = residual[:, None] * samples.scores + beta[:, None] * without
    return UnbiasedTerms(by_noise, beta, linear_variance)


def _fitted_share(samples: Group, slopes: _Pairs, others: _Pairs) -> tuple[Float[Array, " samples"], Float[Array, ""]]:
    """Regress the costs of the other samples on the linear part, both samples left out of the mean derivative.

    Up to fourth moments, the share that minimises the variance of the remaining costs minimises that of the estimate.
    """
    has_slope = samples.has_derivative.astype(slopes.dtype)
    count = has_slope.sum() - has_slope[:, None] - has_slope[None, :]
    along = (slopes.sum(axis=0)[None, :] - slopes - jnp.diagonal(slopes)[None, :]) / jnp.maximum(count, 1)
    weights = others * (count >= 1)

    def centred(values: _Pairs) -> _Pairs:
        if samples.per_unit == 2:  # the difference within a pair is free of the effect of the start
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


def _partner_prediction(samples: Group, rest: _Pairs, others: _Pairs) -> Float[Array, " samples"]:
    """Return the best linear prediction of each remaining cost from that of its partner, relative to the mean.

    The partner is the other sample from the same start. The prediction is its distance from the mean times the
    correlation within the other pairs, near one where starts cause most of the spread.
    """
    both = others * _partner(others)
    covariance = (both * rest * _partner(rest)).sum(axis=1)
    variance = (both * rest**2).sum(axis=1)
    correlation = jnp.where(variance > 0, jnp.clip(covariance / jnp.where(variance > 0, variance, 1), 0, 1), 0)
    index = jnp.arange(len(rest))
    partner = index + 1 - 2 * (index % 2)
    has_partner = samples.has_cost[partner]
    return jnp.where(has_partner, correlation * rest[index, partner], 0)


def _partner(rows: _Pairs) -> _Pairs:
    """Return the rows with the two samples of each start swapped."""
    return rows.reshape(len(rows), -1, 2)[:, :, ::-1].reshape(rows.shape)
