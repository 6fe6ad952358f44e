"""Any function of a vector, with noise on the vector."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.objective.base import Differentiated, Objective, as_scalar, unchanged
from mjxgrad.objective.derivative import value_and_gradient
from mjxgrad.objective.gaussian import gaussian, positive
from mjxgrad.task import as_pytree


class ParameterNoise(Objective):
    r"""$f(\theta + w)$ with $w \sim N(0, \mathrm{stddev}^2)$ on the parameters; see `parameter_noise`."""

    function: Callable[[Float[Array, " dim"]], Float[Array, ""]]
    stddev: Float[Array, " *dim"]
    dim: int | None = eqx.field(static=True)

    def sample_noise(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        """Draw noise for the parameters."""
        if self.dim is None:
            raise ValueError("dim is not known: pass dim=... to parameter_noise")
        return gaussian(key, self.stddev, (self.dim,))

    def value(self, params: Float[Array, " dim"], noise: Float[Array, " dim"]) -> Float[Array, ""]:
        """Evaluate the function at the noisy parameters."""
        return as_scalar(self.function(params + noise.astype(params.dtype)), "function")

    def score(self, params: Float[Array, " dim"], noise: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Give w/σ²."""
        return (noise / self.stddev**2).astype(params.dtype)

    def differentiate(self, params: Float[Array, " dim"], noise: Float[Array, " dim"]) -> Differentiated:
        """Differentiate by the parameters, which is by the noise: the pull-back is the identity."""
        cost, _, gradient = value_and_gradient(lambda at: (self.value(at, noise), None), params)
        stddev = jnp.broadcast_to(self.stddev, params.shape).astype(params.dtype)
        return Differentiated(cost, gradient, self.score(params, noise), stddev, Partial(unchanged))

    def with_stddev(self, stddev: Float[Array, "..."] | float) -> "ParameterNoise":
        """Give the same function under other noise; see `Objective.with_stddev`."""
        stddev, dim = _fitting(stddev, self.dim)
        return dataclasses.replace(self, stddev=stddev, dim=dim)


def parameter_noise(
    function: Callable[[Float[Array, " dim"]], Float[Array, ""]],
    stddev: float | Float[Array, ""] | Float[Array, " dim"],
    dim: int | None = None,
) -> ParameterNoise:
    r"""Smooth any function of a vector by Gaussian noise on the vector.

    $F(\theta) = \mathbb{E}[f(\theta + w)]$, $w \sim N(0, \sigma^2 I)$, with score $w/\sigma^2$.

    Args:
        function: takes a vector, gives a scalar; traceable by JAX.
        stddev: $\sigma > 0$, in the parameters' units; one number, or one per parameter.
        dim: number of parameters. Needed only to draw noise by hand: an estimator takes it from
            the parameters it is given.

    Returns:
        The objective.

    Raises:
        ValueError: if `stddev` is not positive, or neither one number nor `dim` of them.
    """
    stddev, dim = _fitting(stddev, dim)
    return ParameterNoise(function=as_pytree(function), stddev=stddev, dim=dim)


def _fitting(stddev: float | Float[Array, "..."], dim: int | None) -> tuple[Float[Array, "*dim"], int | None]:
    """Give the standard deviation as an array, and the number of parameters if it tells."""
    stddev = positive(stddev)
    if stddev.ndim > 1 or (stddev.ndim == 1 and dim not in (None, stddev.shape[0])):
        raise ValueError(f"stddev must be one number or {dim or 'dim'}, got shape {stddev.shape}")
    return stddev, stddev.shape[0] if stddev.ndim == 1 else dim
