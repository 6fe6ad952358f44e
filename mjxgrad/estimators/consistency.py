r"""A test whether the derivatives of samples explain the differences between their costs.

For two samples that differ only in their noise, the trapezoidal rule along the line between them gives

$$f_j - f_k = \tfrac12 (\nabla f_j + \nabla f_k)\cdot(w_j - w_k) + r_{jk}.$$

The residual is zero for every quadratic, and of third order in the distance where $f$ is smooth. A jump between the two
samples is wholly in it: two samples on different sides of a jump are enough.

The test divides residuals and differences by the distance. Near pairs therefore count most, where smooth functions are flat
and jumps are not. In many dimensions all distances are alike.

The residual also bounds the bias. Let $J$ be the part of the cost that derivatives miss. The bias of the first-order
estimate is $-\mathbb{E}[J s]$. The components of $\sigma s$ are orthonormal, so its norm is at most
$\mathrm{sd}(J)/\sigma$ in any dimension (Bessel's inequality), and $\mathbb{E}[r^2] \approx 2\,\mathrm{Var}\,J$.

References:
    Compare Onoda et al., arXiv:2604.18161 (DDCG). They test the Poincaré inequality between the variances of costs and
    derivatives, a necessary condition for smoothness; this test looks at each pair.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.estimators.samples import Group

# Costs are rounded: a residual below this many units in the last place of the largest cost counts as zero.
_ROUNDING = 32.0


class SecantSums(eqx.Module):
    """Sums over pairs of samples, to be added over groups.

    Attributes:
        residual: squared residuals over squared distances, in standard deviations of the noise.
        difference: squared differences of costs over the same squared distances.
        missed: half the squared residuals.
        pairs: number of pairs.
    """

    residual: Float[Array, ""]
    difference: Float[Array, ""]
    missed: Float[Array, ""]
    pairs: Float[Array, ""]

    def inconsistency(self) -> Float[Array, ""]:
        """Return the share of the squared secants that derivatives do not explain; zero where they explain all."""
        return jnp.where(self.residual > 0, self.residual / jnp.maximum(self.difference, self.residual * 1e-6), 0)

    def missed_variance(self) -> Float[Array, ""]:
        """Return the variance of the part of the cost that derivatives miss; NaN without pairs."""
        return self.missed / self.pairs


def secant_sums(samples: Group, slopes: Float[Array, "samples samples"]) -> SecantSums:
    """Compare all pairs of a group that differ only in their noise; every pair is in the sums twice."""
    own = jnp.diagonal(slopes)
    difference = samples.costs[:, None] - samples.costs[None, :]
    # The derivatives of both samples along the line from k to j.
    rise = (own[:, None] - slopes + slopes.T - own[None, :]) / 2
    residual = difference - rise
    rounding = _ROUNDING * jnp.finfo(residual.dtype).eps * samples.rounding
    scaled = samples.noise / samples.stddev
    squares = (scaled**2).sum(axis=1)
    distance = squares[:, None] + squares[None, :] - 2 * jnp.matmul(scaled, scaled.T, precision="highest")
    is_pair = samples.same_start() & samples.has_derivative[:, None] & samples.has_derivative[None, :]
    is_pair &= ~jnp.eye(len(own), dtype=bool)
    # Coinciding samples have no secant; the floor is the rounding error of `distance`.
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
