"""A parabola with a ripple."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mjxgrad.tasks.textbook.problem import Textbook, number


class QuadraticSine(Textbook):
    """See `quadratic_sine`."""

    amplitude: Float[Array, ""]
    frequency: Float[Array, ""]

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give the rippled parabola."""
        return x[0] ** 2 + self.amplitude * jnp.sin(self.frequency * x[0])

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.zeros(0)

    def damping(self, stddev: ArrayLike) -> Float[Array, ""]:
        """Give the share exp(−ω²σ²/2) of the ripple that the noise leaves."""
        return jnp.exp(-((self.frequency * stddev) ** 2) / 2)

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        ripple = self.amplitude * self.damping(stddev) * jnp.sin(self.frequency * point)
        return jnp.square(point) + jnp.square(stddev) + ripple

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        slope = self.amplitude * self.frequency * self.damping(stddev)
        return 2 * jnp.asarray(point) + slope * jnp.cos(self.frequency * point)

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return self.gradient(point, stddev)

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        slope, left, angle = self.amplitude * self.frequency, self.damping(stddev), self.frequency * point
        cosine = (1 + left**4 * jnp.cos(2 * angle)) / 2 - (left * jnp.cos(angle)) ** 2
        # Stein: Cov(x, cos ωx) = σ² E[−ω sin ωx].
        together = -jnp.square(stddev) * self.frequency * left * jnp.sin(angle)
        return 4 * jnp.square(stddev) + slope**2 * cosine + 4 * slope * together

    def mean_square(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        x, v, left, angle = jnp.asarray(point), jnp.square(stddev), self.damping(stddev), self.frequency * point
        square, fourth = x**2 + v, x**4 + 6 * x**2 * v + 3 * v**2
        sine_square = (1 - left**4 * jnp.cos(2 * angle)) / 2
        # E x² sin ωx = −d²/dω² E sin ωx.
        shifted = (square - (self.frequency * v) ** 2 - baseline) * jnp.sin(angle)
        mixed = left * (shifted + 2 * x * self.frequency * v * jnp.cos(angle))
        parabola = fourth - 2 * jnp.asarray(baseline) * square + jnp.square(baseline)
        return parabola + self.amplitude**2 * sine_square + 2 * self.amplitude * mixed

    def zeroth_order_variance(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        point = jnp.asarray(point, jnp.result_type(point, float))
        # Stein twice: E g z² = G + σ² G'' with G = E g.
        curvature = jax.grad(jax.grad(self.mean_square))(point, stddev, baseline)
        second = self.mean_square(point, stddev, baseline) / jnp.square(stddev) + curvature
        return second - self.gradient(point, stddev) ** 2


def quadratic_sine(amplitude: ArrayLike, frequency: ArrayLike) -> QuadraticSine:
    r"""Give $x^2 + m \sin\omega x$: smooth, with a ripple whose slope $m\omega$ may be of any size.

    $F' = 2\theta + m\omega e^{-\omega^2\sigma^2/2}\cos\omega\theta$: the noise wipes the ripple out, while the
    variance of first order keeps $m^2\omega^2/2$.

    Args:
        amplitude: $m$.
        frequency: $\omega$, in rad per unit of the parameter.

    Returns:
        The problem.
    """
    return QuadraticSine(number(amplitude), number(frequency))
