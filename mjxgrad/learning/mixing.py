r"""The weight of first order with which a mixture of both gradients has the least error.

Let $g$ be the gradient of the return by the parameters. Zeroth order estimates it as $z$, right in the mean, with much noise;
first order as $d$, with little noise, wrong in the mean where contacts jump. Of all $a\,d + b\,z$ the one with the least
expected squared error has
$$\begin{pmatrix} |\bar d|^2 + V^1 & \bar d \cdot g \\ \bar d \cdot g & |g|^2 + V^0 \end{pmatrix}
\begin{pmatrix} a \\ b \end{pmatrix} = \begin{pmatrix} \bar d \cdot g \\ |g|^2 \end{pmatrix},$$
with the noises' traces $V^1$ and $V^0$, and $\alpha = a/(a + b)$; the optimiser takes care of the length. Where
$\bar d = g$ this weighs by inverse variance. Where $d$ points at no good, $\bar d \cdot g \le 0$, $\alpha$ is 0; so no bias
holds a policy where the return still rises.

All products are known without bias from the gradients of two halves of the environments: products across halves have no
noise, and half the difference of halves has the mean's. A batch knows them roughly, the last fifty updates better. What
they leave open is taken in favour of first order: $|g|^2$ is less a standard error, $\bar d \cdot g$ more one. In a few
environments, where zeroth order is noise, no bias can then be seen, and $\alpha$ is 1.

**Over many updates.** A policy moves along many gradients, over which noise averages out and bias does not. So what counts is
the error of the mean of $K$ updates, with $V^1/K$ and $V^0/K$ in place of $V^1$ and $V^0$. $K$ is 40, over which a policy's
direction stays much the same. With $K = 1$ a cosine of 0.6 between both gradients counts as good.

References:
    Green, Strawderman. A James-Stein type estimator for combining unbiased and possibly biased estimators. Journal of the
    American Statistical Association 86, 1991, for weights from such products that sum to one.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

_MEMORY = 0.98  # share of what was known before that stays
# A standard error of such a mean, over the deviation of one update.
_ERROR = ((1 - _MEMORY) / (1 + _MEMORY)) ** 0.5
_UPDATES = 40  # over which noise averages out and bias does not
Halves = tuple[PyTree, PyTree]
"""The parts of a mean gradient that come from either half of the environments."""


class Products(eqx.Module):
    """Running means of the products of both gradients by the parameters, each update's over its squared norms."""

    first: Float[Array, ""]  # |d̄|²
    first_noise: Float[Array, ""]  # V¹, the trace of the covariance of first order
    zeroth: Float[Array, ""]  # |g|²
    zeroth_noise: Float[Array, ""]  # V⁰, that of zeroth order
    across: Float[Array, ""]  # d̄ · g
    zeroth_spread: Float[Array, ""]  # variance of an update's `zeroth`, half the squared change from the update before
    across_spread: Float[Array, ""]  # variance of an update's `across`
    last: Float[Array, "2"]  # the last update's `zeroth` and `across`

    @classmethod
    def none(cls) -> "Products":
        """Return the products of no update."""
        return cls(*jnp.zeros(7), last=jnp.zeros(2))

    def with_more(self, first: Halves, zeroth: Halves) -> "Products":
        """Return the products with those of one more update; one that is not finite is left out."""
        dot = optax.tree.vdot
        total = jnp.asarray(sum(dot(half, half) for half in (*first, *zeroth)))
        is_sound = jnp.isfinite(total) & (total > 0)
        share = 1 / jnp.where(is_sound, total, 1.0)
        own, shared = 4 * share * dot(*zeroth), 2 * share * (dot(first[0], zeroth[1]) + dot(first[1], zeroth[0]))
        noises = (share * optax.tree.norm(optax.tree.sub(*halves), squared=True) for halves in (first, zeroth))
        first_noise, zeroth_noise = noises
        last = jnp.stack([own, shared])
        # By changes between updates, for what drifts over many is no error.
        spread = (last - self.last) ** 2 / 2
        new = Products(4 * share * dot(*first), first_noise, own, zeroth_noise, shared, spread[0], spread[1], last)
        means = jax.tree.map(lambda x, y: _MEMORY * x + (1 - _MEMORY) * y, self, new)
        following = dataclasses.replace(means, last=last)
        return jax.tree.map(lambda old, new: jnp.where(is_sound, new, old), self, following)

    @property
    def cosine(self) -> Float[Array, ""]:
        """Cosine between the means of both gradients; NaN where the noise hides one of them."""
        return self.across / jnp.sqrt(self.first * self.zeroth)

    def weights(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return $a$ and $b$ over the larger of the two; 1 and 0 where zeroth order shows nothing against first order."""
        zeroth = jnp.maximum(self.zeroth - _ERROR * jnp.sqrt(self.zeroth_spread), 0)
        across = jnp.maximum(self.across + _ERROR * jnp.sqrt(self.across_spread), 0)
        first = jnp.maximum(self.first, 0) + self.first_noise / _UPDATES
        a, b = across * self.zeroth_noise / _UPDATES, jnp.maximum(first * zeroth - across**2, 0)
        most = jnp.maximum(a, b)
        return jnp.where(b > 0, a / jnp.where(b > 0, most, 1.0), 1.0), b / jnp.where(most > 0, most, 1.0)
