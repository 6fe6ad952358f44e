r"""Do the derivatives of samples explain the differences of their costs?

For two samples that differ in their noise alone, the trapezoidal rule along the line between them gives

$$f_j - f_k = \tfrac12 (\nabla f_j + \nabla f_k)\cdot(w_j - w_k) + r_{jk}.$$

The residual vanishes for every quadratic and is of third order in the distance where $f$ is smooth. A jump between the
two is in $r_{jk}$ whole, and a stiff slope that one of them met and the other did not makes it large. No bound, no rate
and no number of samples is needed to read it, and two samples on different sides of a jump are enough.

The test is on secants: residuals and differences are divided by the distance, so that near pairs, where smooth functions
are flat and jumps are not, count most. In many dimensions all distances are alike.

What the residual says about bias: let $J$ be the part of the cost that derivatives miss. The bias of the first-order
estimate is $-\mathbb{E}[J s]$, and because the components of $\sigma s$ are orthonormal its norm is at most
$\mathrm{sd}(J)/\sigma$ in any dimension (Bessel's inequality); $\mathbb{E}[r^2] \approx 2\,\mathrm{Var}\,J$.

References:
    Compare Onoda et al., arXiv:2604.18161 (DDCG), who test the Poincaré inequality between the variances of costs and
    derivatives: a necessary condition for smoothness, where this one looks at each pair.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.estimators.samples import Group

# Differences of costs are rounded; what is within this many units in the last place of the largest cost is no residual.
_ROUNDING = 32.0


class SecantSums(eqx.Module):
    """Sums over pairs of samples, to be added over groups.

    Of squared residuals, and differences of costs, over squared distances in standard deviations of the noise; of half the
    squared residuals, missed; and the number of pairs.
    """

    residual: Float[Array, ""]
    difference: Float[Array, ""]
    missed: Float[Array, ""]
    pairs: Float[Array, ""]

    def inconsistency(self) -> Float[Array, ""]:
        """Give the share of the secants' squares that derivatives do not explain: zero where they explain all."""
        return jnp.where(self.residual > 0, self.residual / jnp.maximum(self.difference, self.residual * 1e-6), 0)

    def missed_variance(self) -> Float[Array, ""]:
        """Give the variance of the part of the cost that derivatives miss; NaN without pairs."""
        return self.missed / self.pairs


def secant_sums(samples: Group, slopes: Float[Array, "samples samples"]) -> SecantSums:
    """Compare all pairs of a group that differ in their noise alone; every pair is in the sums twice."""
    own = jnp.diagonal(slopes)
    difference = samples.costs[:, None] - samples.costs[None, :]
    # The derivatives of both along the way from k to j.
    rise = (own[:, None] - slopes + slopes.T - own[None, :]) / 2
    residual = difference - rise
    rounding = _ROUNDING * jnp.finfo(residual.dtype).eps * samples.rounding
    scaled = samples.noise / samples.stddev
    squares = (scaled**2).sum(axis=1)
    distance = squares[:, None] + squares[None, :] - 2 * jnp.matmul(scaled, scaled.T, precision="highest")
    is_pair = samples.same_start() & samples.has_derivative[:, None] & samples.has_derivative[None, :]
    is_pair &= ~jnp.eye(len(own), dtype=bool)
    # Samples that fall together have no secant; the floor is rounding's in the line above.
    floor = 16 * jnp.finfo(distance.dtype).eps * jnp.maximum(squares.max(), 1e-30)
    is_pair &= distance > floor
    inverse = jnp.where(is_pair, 1 / jnp.where(is_pair, distance, 1), 0)
    residual = jnp.where(is_pair & (jnp.abs(residual) > rounding), residual, 0)
    return SecantSums(
        residual=(residual**2 * inverse).sum(),
        difference=(difference**2 * inverse).sum(),
        missed=(residual**2).sum() / 2,
        pairs=is_pair.sum().astype(residual.dtype),
    )
