r"""The weight of first order with which a mixture of both gradients has the least error.

Let $g$ be the gradient of the return by the parameters. Zeroth order estimates it as $z$, right in the mean, with much noise;
first order as $d$, with little noise, wrong in the mean where contacts jump. Of all $a\,d + b\,z$ the one with the least
expected squared error has
$$\begin{pmatrix} |\bar d|^2 + V^1 & \bar d \cdot g \\ \bar d \cdot g & |g|^2 + V^0 \end{pmatrix}
\begin{pmatrix} a \\ b \end{pmatrix} = \begin{pmatrix} \bar d \cdot g \\ |g|^2 \end{pmatrix},$$
with the noises' traces $V^1$ and $V^0$. Its direction is $\alpha d + (1 - \alpha) z$ with $\alpha = a/(a + b)$, and the
optimiser takes care of its length. Where $\bar d = g$ this weighs by inverse variance. Where $d$ points at no good,
$\bar d \cdot g \le 0$, $\alpha$ is 0; so no bias holds a policy where the return still rises.

All products are known without bias from the gradients of two halves of the environments: products across halves have no
noise, and half the difference of halves has the mean's. A batch knows them roughly, the last twenty updates well.

References:
    Green, Strawderman. A James-Stein type estimator for combining unbiased and possibly biased estimators. Journal of the
    American Statistical Association 86, 1991, for weights from such products that sum to one.
"""

import equinox as eqx
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

_MEMORY = 0.95  # share of what was known before that stays
Halves = tuple[PyTree, PyTree]
"""The parts of a mean gradient that come from either half of the environments."""


class Products(eqx.Module):
    r"""Running means of the products of both gradients by the parameters, each update's over its squared norms.

    Attributes:
        first: $|\bar d|^2$.
        first_noise: $V^1$, the trace of the covariance of first order.
        zeroth: $|g|^2$.
        zeroth_noise: $V^0$, that of zeroth order.
        across: $\bar d \cdot g$.
    """

    first: Float[Array, ""]
    first_noise: Float[Array, ""]
    zeroth: Float[Array, ""]
    zeroth_noise: Float[Array, ""]
    across: Float[Array, ""]

    @classmethod
    def none(cls) -> "Products":
        """Return the products of no update."""
        return cls(*jnp.zeros(5))

    def with_more(self, first: Halves, zeroth: Halves) -> "Products":
        """Return the products with those of one more update; one that is not finite is left out."""
        dot = optax.tree.vdot
        total = jnp.asarray(sum(dot(half, half) for half in (*first, *zeroth)))
        is_sound = jnp.isfinite(total) & (total > 0)
        new = (
            4 * dot(*first),
            optax.tree.norm(optax.tree.sub(*first), squared=True),
            4 * dot(*zeroth),
            optax.tree.norm(optax.tree.sub(*zeroth), squared=True),
            2 * (dot(first[0], zeroth[1]) + dot(first[1], zeroth[0])),
        )
        old = (self.first, self.first_noise, self.zeroth, self.zeroth_noise, self.across)
        share = (1 - _MEMORY) / jnp.where(is_sound, total, 1.0)
        return Products(*(jnp.where(is_sound, _MEMORY * x + share * y, x) for x, y in zip(old, new, strict=True)))

    @property
    def cosine(self) -> Float[Array, ""]:
        """Cosine between the means of both gradients; NaN where the noise hides one of them."""
        return self.across / jnp.sqrt(self.first * self.zeroth)

    def weight(self) -> Float[Array, ""]:
        """Return the weight of first order, from 0 to 1; 1 where zeroth order shows nothing but agrees."""
        a = jnp.maximum(self.across * self.zeroth_noise, 0)
        both = (jnp.maximum(self.first, 0) + self.first_noise) * jnp.maximum(self.zeroth, 0)
        b = jnp.maximum(both - self.across**2, 0)
        is_known = a + b > 0
        alpha = jnp.where(is_known, a / jnp.where(is_known, a + b, 1.0), 1.0)
        return jnp.where(self.across > 0, alpha, 0.0)
