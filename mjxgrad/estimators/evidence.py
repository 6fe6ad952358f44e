r"""Evidence for rules: from the samples of one estimate, and on the bias from the last estimates of a descent.

In a descent the noise of the steps averages out, and the bias does not: the mean of $T$ mixtures is off by
$\alpha^2(V^1/T + b^2) + (1 - \alpha)^2 V^0/T$. So a bias counts $T$ times as much as in a single estimate. It is known
better, too: a bias of a fifth of the gradient, that no batch of 16 samples shows, shows after thirty.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.objective.base import Scalar, Vector

# Half of what is known is of the last 34 steps.
_STAYS = 0.98


class Evidence(eqx.Module):
    r"""The input of a rule, over all coordinates. Variances are traces of the covariance of one sample, or of one pair.

    Attributes:
        count: number of samples behind the means, or of pairs where starts are random.
        dim: number of coordinates.
        first_norm: norm of the mean derivative.
        difference_norm: norm of the difference between the two means.
        first_variance: variance of the derivative.
        zeroth_variance: variance of the unbiased term.
        difference_variance: variance of the difference; both parts share their rollouts.
        cost_variance: variance of the cost.
        scaled_first_variance: variance of derivatives by the noise in its standard deviations.
        scaled_first_norm: norm of the mean of these derivatives.
        squared_bias: unbiased estimate of the squared norm of the bias of the first order.
        squared_bias_error: its standard error where there is no bias.
        noise_dim: number of coordinates that its noise is worth, $(\mathrm{tr}\,\Sigma)^2/\mathrm{tr}\,\Sigma^2$.
        squared_bias_bound: bound on it by what derivatives miss.
        squared_jump_bound: the part of this bound that the scatter of derivatives does not explain.
        zeroth_noise: noise of the mean of the unbiased terms that the mean derivative does not share.
        first_noise: noise of the mean derivative that the other does not share.
        num_estimates: number of estimates over which noise averages and bias does not, 1 without a memory.
    """

    count: Float[Array, "*batch"]
    dim: Float[Array, "*batch"]
    first_norm: Float[Array, "*batch"]
    difference_norm: Float[Array, "*batch"]
    first_variance: Float[Array, "*batch"]
    zeroth_variance: Float[Array, "*batch"]
    difference_variance: Float[Array, "*batch"]
    cost_variance: Float[Array, "*batch"]
    scaled_first_variance: Float[Array, "*batch"]
    scaled_first_norm: Float[Array, "*batch"]
    squared_bias: Float[Array, "*batch"]
    squared_bias_error: Float[Array, "*batch"]
    noise_dim: Float[Array, "*batch"]
    squared_bias_bound: Float[Array, "*batch"]
    squared_jump_bound: Float[Array, "*batch"]
    zeroth_noise: Float[Array, "*batch"]
    first_noise: Float[Array, "*batch"]
    num_estimates: Float[Array, "*batch"]

    def least_variance(self) -> Float[Array, "*batch"]:
        """Return the weight V⁰/(V⁰ + V¹) of the first order; 1 where both are zero."""
        total = self.zeroth_variance + self.first_variance
        return jnp.where(total > 0, self.zeroth_variance / jnp.where(total > 0, total, 1), 1)

    def with_memory(self, memory: "Memory") -> "Evidence":
        """Return the evidence with what a memory, of this estimate too, knows of the bias; an empty one knows nothing."""
        pooled = dataclasses.replace(
            self,
            squared_bias=(memory.difference**2).sum() - memory.noise,
            squared_bias_error=jnp.sqrt(2.0) * memory.noise_square,
            noise_dim=noise_dim(memory.noise, memory.noise_square),
            squared_bias_bound=memory.bound,
            squared_jump_bound=memory.jump_bound,
            zeroth_noise=memory.zeroth_width**2,
            num_estimates=1 / memory.concentration,
        )
        return jax.tree.map(lambda own, other: jnp.where(memory.weight > 0, other, own), self, pooled)


class Memory(eqx.Module):
    """Evidence on the bias from all estimates of a descent: the mean difference of both parts, older ones counting less."""

    difference: Vector  # mean difference between both parts
    noise: Scalar  # its noise, the trace of its covariance matrix Σ
    noise_square: Scalar  # the norm of Σ, √tr Σ², at most: the sum of those of the estimates
    bound: Scalar  # mean bound on the squared bias
    jump_bound: Scalar  # mean part of it that scatter does not explain
    # Mean root of the noise of zeroth order. A step's own would give zeroth order less weight just where a rare sample shows
    # what derivatives miss.
    zeroth_width: Scalar
    weight: Scalar  # sum of the weights, 1 for the last estimate
    concentration: Scalar  # sum of their squares where they sum to one

    @classmethod
    def of(cls, difference: Vector, evidence: Evidence) -> "Memory":
        """Return the memory of one estimate."""
        noise, one = evidence.difference_variance / evidence.count, jnp.ones_like(evidence.count)
        square = evidence.squared_bias_error / jnp.sqrt(2.0)
        bounds = evidence.squared_bias_bound, evidence.squared_jump_bound
        return cls(difference, noise, square, *bounds, jnp.sqrt(evidence.zeroth_noise), one, one)

    def with_more(self, new: "Memory") -> "Memory":
        """Return the memory with that of a new estimate, which is left out where a number of it is not finite."""
        weight = _STAYS * self.weight + 1
        share = 1 / weight
        more = Memory(
            self.difference + share * (new.difference - self.difference),
            (1 - share) ** 2 * self.noise + share**2 * new.noise,
            (1 - share) ** 2 * self.noise_square + share**2 * new.noise_square,
            self.bound + share * (new.bound - self.bound),
            self.jump_bound + share * (new.jump_bound - self.jump_bound),
            self.zeroth_width + share * (new.zeroth_width - self.zeroth_width),
            weight,
            (1 - share) ** 2 * self.concentration + share**2,
        )
        is_sound = jnp.isfinite(new.difference).all() & jnp.isfinite(new.noise + new.noise_square + new.bound)
        return jax.tree.map(lambda old, x: jnp.where(is_sound, x, old), self, more)


def noise_dim(trace: Scalar, norm: Scalar) -> Scalar:
    """Return the effective dimension of noise, from the trace and the norm of its covariance matrix; at least 1."""
    return jnp.maximum(jnp.where(norm > 0, trace / jnp.where(norm > 0, norm, 1), 1) ** 2, 1)
