"""What every textbook problem can say of itself."""

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

# Beyond nine standard deviations a Gaussian is below 1e-17. Pieces of at most one standard deviation with 16 nodes are
# exact to rounding for all costs here (a sine of two periods per standard deviation included).
_EDGES = np.arange(-9.0, 10.0)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


class Textbook(eqx.Module):
    """A cost of one number with what theory says about its gradient under Gaussian noise."""

    @abstractmethod
    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give the cost."""

    @property
    @abstractmethod
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        """Where the cost has a kink or a jump."""

    @abstractmethod
    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give the smoothed cost, F(θ)."""

    @abstractmethod
    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give what is to be estimated, F'(θ)."""

    @abstractmethod
    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give what the first-order estimate converges to, E f'(θ + w): without the jumps."""

    @abstractmethod
    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give the variance of one sample of the first-order estimate, Var f'(θ + w)."""

    def mean_square(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        """Give E (f(θ + w) − b)², by quadrature where there is no closed form."""
        return self._mean(lambda x, _: (jax.vmap(self)(x[:, None]) - baseline) ** 2, point, stddev)

    def zeroth_order_variance(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        r"""Give the variance of one sample of the zeroth-order estimate, $(f(\theta + w) - b)\,w/\sigma^2$.

        Args:
            point: $\theta$.
            stddev: $\sigma$.
            baseline: $b$, a number that does not depend on the sample: 0, the cost without noise, or any other.

        Returns:
            $\mathbb{E}[(f - b)^2 w^2]/\sigma^4 - F'^2$, by quadrature where there is no closed form.
        """
        second = self._mean(lambda x, z: ((jax.vmap(self)(x[:, None]) - baseline) * z / stddev) ** 2, point, stddev)
        return second - self.gradient(point, stddev) ** 2

    def leave_one_out_variance(self, point: ArrayLike, stddev: ArrayLike, num_samples: int) -> Float[Array, ""]:
        r"""Give the variance of the whole zeroth-order estimate with its leave-one-out baseline.

        The estimate is the sample covariance of cost and score, whose variance is
        $\mathrm{Var}[(f - F)s]/N + (\mathrm{Var} f\,\mathrm{Var} s + F'^2)/(N(N - 1))$ for every $N \ge 2$.

        Args:
            point: $\theta$.
            stddev: $\sigma$.
            num_samples: $N$.

        Returns:
            The variance; times $N$ it tends to `zeroth_order_variance` with baseline $F$.
        """
        mean = self.smoothed(point, stddev)
        single = self.zeroth_order_variance(point, stddev, mean)
        both = self.mean_square(point, stddev, mean) / jnp.square(stddev) + self.gradient(point, stddev) ** 2
        return single / num_samples + both / (num_samples * (num_samples - 1))

    def objective(self, stddev: float | Float[Array, ""]) -> ParameterNoise:
        """Give the cost as estimators see it, with noise on its one parameter."""
        return parameter_noise(self, stddev, dim=1)

    def _mean(self, function: Callable[[Array, Array], Array], point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give E function(θ + σz, z), the line cut where the cost has a kink or a jump."""
        inner = jnp.clip((self.breakpoints - point) / stddev, _EDGES[0], _EDGES[-1])
        edges = jnp.sort(jnp.concatenate([jnp.asarray(_EDGES, inner.dtype), inner]))
        half = jnp.diff(edges)[:, None] / 2
        z = (edges[:-1, None] + half) + half * _NODES
        weights = half * _WEIGHTS * norm.pdf(z)
        return (weights.ravel() * function(jnp.asarray(point) + stddev * z.ravel(), z.ravel())).sum()


def number(value: ArrayLike) -> Float[Array, ""]:
    """Give a number as an array of floating point."""
    return jnp.asarray(value, jnp.result_type(value, float))


def positive(value: ArrayLike, name: str) -> Float[Array, ""]:
    """Give a number as an array of floating point, refusing one that is not positive."""
    array = number(value)
    # A traced value (a sweep) cannot be looked at here.
    if not isinstance(array, jax.core.Tracer) and not bool((array > 0).all()):
        raise ValueError(f"{name} must be positive, got {value}")
    return array
