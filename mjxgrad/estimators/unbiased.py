r"""Unbiased terms that use derivatives only as far as they explain the costs, and sums that tell how far they do.

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
from jaxtyping import Array, Bool, Float

from mjxgrad.estimators.samples import Group

_Pairs = Float[Array, "samples samples"]
# Costs are rounded: a residual below this many units in the last place of the largest cost counts as zero.
_ROUNDING = 32.0


def gram(samples: Group) -> _Pairs:
    """Return the slope of sample i along the noise of sample k, from which all comparisons follow."""
    return jnp.matmul(samples.derivatives, samples.noise.T, precision=jax.lax.Precision.HIGHEST)


def unbiased_terms(
    samples: Group, slopes: _Pairs, *, with_derivatives: bool
) -> tuple[Float[Array, "samples m"], Float[Array, " samples"]]:
    """Return the terms of a group, and the share β of each; without derivatives, the terms of the zeroth-order estimate.

    The mean of the terms after the pull-back is the estimate. Terms of samples without a cost are meaningless; the pull-back
    masks them.
    """
    costs, has_cost = samples.costs, samples.has_cost.astype(samples.costs.dtype)
    has_slope = samples.has_derivative.astype(costs.dtype)
    num_slopes = has_slope.sum()
    # Row j leaves sample j out.
    others = has_cost[None, :] * (1 - jnp.eye(len(costs), dtype=costs.dtype))
    num_others = jnp.maximum(others.sum(axis=1), 1)
    # (mean derivative without j) · w_k
    along = (slopes.sum(axis=0)[None, :] - slopes) / jnp.maximum(num_slopes - has_slope, 1)[:, None]
    beta = _fitted_share(samples, slopes, others) if with_derivatives else jnp.zeros_like(costs)
    rest = costs[None, :] - beta[:, None] * along
    baseline = (others * rest).sum(axis=1) / num_others
    if samples.per_unit == 2:
        baseline += _partner_prediction(samples, rest - baseline[:, None], others)
    residual = jnp.diagonal(rest) - baseline
    total = samples.derivatives.sum(axis=0)[None, :]
    without = (total - samples.derivatives) / jnp.maximum(num_slopes - has_slope, 1)[:, None]
    return residual[:, None] * samples.scores + beta[:, None] * without, beta


def _fitted_share(samples: Group, slopes: _Pairs, others: _Pairs) -> Float[Array, " samples"]:
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
    return jnp.where(has_any, jnp.clip(share, 0, 1), 0)


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


class SecantSums(eqx.Module):
    r"""Sums over pairs of samples, to be added over groups: how much of the costs their derivatives miss.

    For two samples that differ only in their noise, the trapezoidal rule along the line between them gives

    $$f_j - f_k = \tfrac12 (\nabla f_j + \nabla f_k)\cdot(w_j - w_k) + r_{jk}.$$

    The residual is zero for every quadratic, and of third order in the distance where $f$ is smooth. A jump between the two
    samples is wholly in it: two samples on different sides of a jump are enough.

    It bounds the bias. Let $J$ be the part of the cost that derivatives miss. The bias of the first-order estimate is
    $-\mathbb{E}[J s]$, and $\mathbb{E}[r^2] \approx 2\,\mathrm{Var}\,J$. For noise of one standard deviation on the
    parameters the components of $\sigma s$ are orthonormal, so that the norm is at most $\mathrm{sd}(J)/\sigma$ in any
    dimension (Bessel's inequality). In general $\sigma^{-2}$ is the largest eigenvalue of the scores' covariance; their
    mean eigenvalue, weighed by themselves, stands for it.
    """

    missed: Float[Array, ""]  # half the squared residuals: over the pairs, the variance of what derivatives miss
    pairs: Float[Array, ""]  # number of pairs


def secant_sums(samples: Group, slopes: _Pairs) -> SecantSums:
    """Compare all pairs of a group that differ only in their noise; every pair is in the sums twice."""
    own = jnp.diagonal(slopes)
    # The derivatives of both samples along the line from k to j.
    rise = (own[:, None] - slopes + slopes.T - own[None, :]) / 2
    residual = samples.costs[:, None] - samples.costs[None, :] - rise
    rounding = _ROUNDING * jnp.finfo(residual.dtype).eps * samples.rounding
    is_pair = samples.has_derivative[:, None] & samples.has_derivative[None, :] & ~jnp.eye(len(own), dtype=bool)
    if samples.per_unit == 2:  # other samples differ in their start, too
        unit = jnp.arange(len(own)) // 2
        is_pair &= unit[:, None] == unit[None, :]
    residual = jnp.where(is_pair & (jnp.abs(residual) > rounding), residual, 0)
    return SecantSums((residual**2).sum() / 2, is_pair.sum().astype(residual.dtype))


class Products(eqx.Module):
    """Sums of the squared products of two rows of a group, to be added over groups."""

    squares: Float[Array, ""]
    pairs: Float[Array, ""]

    @classmethod
    def of(cls, rows: Float[Array, "rows dim"], mask: Bool[Array, " rows"]) -> "Products":
        rows = jnp.where(mask[:, None], rows, 0)
        products = jnp.matmul(rows, rows.T, precision=jax.lax.Precision.HIGHEST)
        count = mask.sum().astype(rows.dtype)
        others = jnp.where(jnp.eye(len(rows), dtype=bool), 0, products)
        return cls((others**2).sum(), count * (count - 1))

    @property
    def mean(self) -> Float[Array, ""]:
        """The squared Frobenius norm of the rows' second moment, without bias; zero without pairs."""
        return self.squares / jnp.maximum(self.pairs, 1)
