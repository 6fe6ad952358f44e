r"""Costs of one number whose smoothed gradient, and the errors of its estimates, are known.

With $w \sim N(0, \sigma^2)$ the smoothed cost is $F(\theta) = \mathbb{E} f(\theta + w)$. Each problem says what an
estimate of $F'$ should give and how far one sample of it is off: the yardstick for estimators, for diagnostics and for
whoever wants to see in a second what a contact does to a gradient. Points, widths and costs have no units.

Gradients are closed forms, all else is Gauss-Legendre quadrature to rounding. All methods are for one point and are
traceable: a sweep of points, noise or widths is a `jax.vmap`.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 3 and figure 2.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mjxgrad.objective import ParameterNoise, parameter_noise

# Beyond nine standard deviations a Gaussian is below 1e-17. Pieces of at most one standard deviation with 32 nodes are
# exact to rounding for all costs here (the square of a sine of three periods per standard deviation included).
_EDGES = np.arange(-9.0, 10.0)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)


def _number(value: ArrayLike) -> Float[Array, ""]:
    return jnp.asarray(value, float)


class Textbook(eqx.Module):
    """A cost of one number with what theory says about its gradient under Gaussian noise."""

    @abstractmethod
    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Return the cost."""

    @property
    @abstractmethod
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        """Where the cost has a kink or a jump."""

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the smoothed cost, F(θ)."""
        return self._mean(lambda x, _: jax.vmap(self)(x[:, None]), point, stddev)

    @abstractmethod
    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return what is to be estimated, F'(θ)."""

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return what the first-order estimate converges to, E f'(θ + w): the gradient, but for jumps of the cost."""
        return self._mean(lambda x, _: self._slope(x), point, stddev)

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the variance of one sample of the first-order estimate, Var f'(θ + w)."""
        square = self._mean(lambda x, _: self._slope(x) ** 2, point, stddev)
        return square - self.first_order_mean(point, stddev) ** 2

    def mean_square(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        """Return E (f(θ + w) − b)²."""
        return self._mean(lambda x, _: (jax.vmap(self)(x[:, None]) - baseline) ** 2, point, stddev)

    def zeroth_order_variance(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        r"""Return the variance of one sample of the zeroth-order estimate, $(f(\theta + w) - b)\,w/\sigma^2$.

        It is $\mathbb{E}[(f - b)^2 w^2]/\sigma^4 - F'^2$. The baseline $b$ does not depend on the sample: 0, the cost
        without noise, or any other number.
        """
        second = self._mean(lambda x, z: ((jax.vmap(self)(x[:, None]) - baseline) * z / stddev) ** 2, point, stddev)
        return second - self.gradient(point, stddev) ** 2

    def leave_one_out_variance(self, point: ArrayLike, stddev: ArrayLike, num_samples: int) -> Float[Array, ""]:
        r"""Return the variance of the whole zeroth-order estimate with its leave-one-out baseline.

        The estimate is the sample covariance of cost and score, whose variance is
        $\mathrm{Var}[(f - F)s]/N + (\mathrm{Var} f\,\mathrm{Var} s + F'^2)/(N(N - 1))$ for every number of samples
        $N \ge 2$. Times $N$ it tends to `zeroth_order_variance` with baseline $F$.
        """
        mean = self.smoothed(point, stddev)
        single = self.zeroth_order_variance(point, stddev, mean)
        both = self.mean_square(point, stddev, mean) / jnp.square(stddev) + self.gradient(point, stddev) ** 2
        return single / num_samples + both / (num_samples * (num_samples - 1))

    def objective(self, stddev: float | Float[Array, ""]) -> ParameterNoise:
        """Return the cost as estimators see it, with noise on its one parameter."""
        return parameter_noise(self, stddev, dim=1)

    def _slope(self, x: Float[Array, " points"]) -> Float[Array, " points"]:
        return jax.vmap(jax.grad(self))(x[:, None])[:, 0]

    def _mean(self, function: Callable[[Array, Array], Array], point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return E function(θ + σz, z), the line cut where the cost has a kink or a jump."""
        inner = jnp.clip((self.breakpoints - point) / stddev, _EDGES[0], _EDGES[-1])
        edges = jnp.sort(jnp.concatenate([jnp.asarray(_EDGES, inner.dtype), inner]))
        half = jnp.diff(edges)[:, None] / 2
        z = (edges[:-1, None] + half) + half * _NODES
        weights = half * _WEIGHTS * norm.pdf(z)
        return (weights.ravel() * function(jnp.asarray(point) + stddev * z.ravel(), z.ravel())).sum()


# Intervals shorter than this, in standard deviations, have their probability by series: a difference would cancel.
_SHORT = 0.02


class Heaviside(Textbook):
    r"""The step, 1 from zero on: $F' = \varphi(\theta/\sigma)/\sigma$, and no derivative that sees it."""

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        return jnp.where(x[0] >= 0, jnp.ones_like(x[0]), 0)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.zeros(1)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return norm.pdf(point, scale=stddev)


class SoftHeaviside(Textbook):
    r"""The ramp from −1 to 1 about zero, a step that has been softened.

    With $p$ the chance to fall on the slope, $F' = 2p/\nu$, and a first-order sample is $2/\nu$ with probability $p$,
    else 0: unbiased, with variance $(2/\nu)^2 p(1 - p)$, which grows as $1/\nu$.
    """

    width: Float[Array, ""] = eqx.field(converter=_number)  # $\nu > 0$ of the slope; $1/\nu$ is the stiffness

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        return jnp.clip(2 * x[0] / self.width, -1, 1)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.stack([-self.width, self.width]) / 2

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return 2 * _probability(-jnp.asarray(point) / stddev, self.width / stddev) / self.width


def _probability(middle: Float[Array, ""], length: Float[Array, ""]) -> Float[Array, ""]:
    """Return the chance of a standard normal variable to lie in an interval, to many digits."""
    series = length * norm.pdf(middle) * (1 + (middle**2 - 1) * length**2 / 24)
    # In the upper tail both distribution functions are near 1: mirrored they are small numbers.
    low = -jnp.abs(middle)
    difference = norm.cdf(low + length / 2) - norm.cdf(low - length / 2)
    return jnp.where(length < _SHORT, series, difference)


class QuadraticSine(Textbook):
    r"""The cost $x^2 + m \sin\omega x$: smooth, with a ripple whose slope $m\omega$ may be of any size.

    $F' = 2\theta + m\omega e^{-\omega^2\sigma^2/2}\cos\omega\theta$: the noise wipes the ripple out, while the
    variance of first order keeps $m^2\omega^2/2$.
    """

    amplitude: Float[Array, ""] = eqx.field(converter=_number)  # $m$
    frequency: Float[Array, ""] = eqx.field(converter=_number)  # $\omega$, in rad per unit of the parameter

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        return x[0] ** 2 + self.amplitude * jnp.sin(self.frequency * x[0])

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.zeros(0)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        # Of the ripple the noise leaves a share.
        slope = self.amplitude * self.frequency * jnp.exp(-((self.frequency * stddev) ** 2) / 2)
        return 2 * jnp.asarray(point) + slope * jnp.cos(self.frequency * point)
