"""A step, and the ramp that it becomes when softened."""

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mjxgrad.tasks.textbook.problem import Textbook, positive

# Intervals shorter than this, in standard deviations, have their probability by series: a difference would cancel.
_SHORT = 0.02


class Heaviside(Textbook):
    """See `heaviside`."""

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give 1 from zero on, else 0."""
        return jnp.where(x[0] >= 0, jnp.ones_like(x[0]), 0)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.zeros(1)

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return norm.cdf(point, scale=stddev)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return norm.pdf(point, scale=stddev)

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return jnp.zeros_like(norm.pdf(point, scale=stddev))

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return jnp.zeros_like(norm.pdf(point, scale=stddev))

    def mean_square(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        above = self.smoothed(point, stddev)
        return jnp.square(1 - jnp.asarray(baseline)) * above + jnp.square(baseline) * (1 - above)

    def zeroth_order_variance(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        t = jnp.asarray(point) / stddev
        # E z² over z ≥ −t; over all z it is 1.
        above = norm.cdf(t) - t * norm.pdf(t)
        second = jnp.square(1 - jnp.asarray(baseline)) * above + jnp.square(baseline) * (1 - above)
        return second / jnp.square(stddev) - self.gradient(point, stddev) ** 2


class SoftHeaviside(Textbook):
    """See `soft_heaviside`."""

    width: Float[Array, ""]

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give the ramp."""
        return jnp.clip(2 * x[0] / self.width, -1, 1)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.stack([-self.width, self.width]) / 2

    def slope_probability(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give the chance p that a sample falls on the slope, the only place where the derivative is not zero."""
        return _probability(-jnp.asarray(point) / stddev, self.width / stddev)

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        # The closed form is a difference of terms of size σ/ν, so the narrow ramp would lose its digits.
        return self._mean(lambda x, _: jax.vmap(self)(x[:, None]), point, stddev)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return 2 * self.slope_probability(point, stddev) / self.width

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return self.gradient(point, stddev)

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        p = self.slope_probability(point, stddev)
        return (2 / self.width) ** 2 * p * (1 - p)


def heaviside() -> Heaviside:
    r"""Give the step, 1 from zero on: $F' = \varphi(\theta/\sigma)/\sigma$, and no derivative that sees it.

    Returns:
        The problem.
    """
    return Heaviside()


def soft_heaviside(width: ArrayLike) -> SoftHeaviside:
    r"""Give the ramp from −1 to 1 about zero, a step that has been softened.

    With $p$ the chance to fall on the slope, $F' = 2p/\nu$, and a first-order sample is $2/\nu$ with probability $p$,
    else 0: unbiased, with variance $(2/\nu)^2 p(1 - p)$, which grows as $1/\nu$.

    Args:
        width: $\nu > 0$ of the slope; $1/\nu$ is the stiffness.

    Returns:
        The problem.

    Raises:
        ValueError: if `width` is not positive.
    """
    return SoftHeaviside(positive(width, "width"))


def _probability(middle: Float[Array, ""], length: Float[Array, ""]) -> Float[Array, ""]:
    """Give the chance of a standard normal variable to lie in an interval, to many digits."""
    series = length * norm.pdf(middle) * (1 + (middle**2 - 1) * length**2 / 24)
    # In the upper tail both distribution functions are near 1: mirrored they are small numbers.
    low = -jnp.abs(middle)
    difference = norm.cdf(low + length / 2) - norm.cdf(low - length / 2)
    return jnp.where(length < _SHORT, series, difference)
