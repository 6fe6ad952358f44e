"""Functions of parameters with noise on them, and pytrees of parameters as the vector that estimators use."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import function as check_function
from mjxgrad.objective.base import (
    Differentiated,
    Objective,
    Scalar,
    Vector,
    as_objective,
    as_scalar,
    gaussian,
    positive,
    unchanged,
    value_and_gradient,
)
from mjxgrad.objective.task import as_pytree


class ParameterNoise(Objective):
    r"""$f(\theta + w)$ with $w \sim N(0, \mathrm{stddev}^2)$ on the parameters; see `parameter_noise`."""

    function: Callable[[Any], Scalar]
    stddev: Float[Array, " *dim"]
    dim: int | None = eqx.field(static=True)

    def sample_noise(self, key: PRNGKeyArray) -> Vector:
        if self.dim is None:
            raise ValueError("dim is not known: pass dim=... to parameter_noise")
        return gaussian(key, self.stddev, (self.dim,))

    def value(self, params: Vector, noise: Vector) -> Scalar:
        return as_scalar(self.function(params + noise.astype(params.dtype)), "function")

    def score(self, params: Vector, noise: Vector) -> Vector:
        return (noise / self.stddev**2).astype(params.dtype)

    def differentiate(self, params: Vector, noise: Vector) -> Differentiated:
        cost, gradient = value_and_gradient(self.function, params + noise.astype(params.dtype))
        stddev = jnp.broadcast_to(self.stddev, params.shape).astype(params.dtype)
        return Differentiated(cost, gradient, self.score(params, noise), stddev, Partial(unchanged))

    def with_stddev(self, stddev: Float[Array, "..."] | float) -> "ParameterNoise":
        return parameter_noise(self.function, stddev, self.dim)


def parameter_noise(
    function: Callable[[Any], Scalar], stddev: float | Float[Array, "*dim"], dim: int | None = None
) -> ParameterNoise:
    r"""Smooth any function of parameters by Gaussian noise on them.

    $F(\theta) = \mathbb{E}[f(\theta + w)]$, $w \sim N(0, \sigma^2 I)$, with score $w/\sigma^2$.

    Args:
        function: function from a vector, or from the pytree of parameters, to a scalar; traceable by JAX.
        stddev: $\sigma > 0$, in the parameters' units; one number, or one per parameter.
        dim: number of parameters, needed only to draw noise by hand: an estimator takes it from its parameters.

    Returns:
        The objective.

    Raises:
        ValueError: if `stddev` is not positive, or neither one number nor `dim` of them.
    """
    width = positive(stddev)
    if width.ndim > 1 or (width.ndim == 1 and dim not in (None, width.shape[0])):
        raise ValueError(f"stddev must be one number or {dim or 'dim'}, got shape {width.shape}")
    dim = width.shape[0] if width.ndim == 1 else dim
    check_function("function", function, "params")
    return ParameterNoise(function=as_pytree(function), stddev=width, dim=dim)


class Restored(eqx.Module):
    """A function of a pytree of parameters, as a function of their vector."""

    function: Callable[[PyTree], Any]
    restore: Callable[[Vector], PyTree] = eqx.field(static=True)

    def __call__(self, vector: Vector) -> Any:
        return self.function(self.restore(vector))


def flattened(
    params: PyTree, num_axes: int = 1
) -> tuple[Float[Array, "..."], Callable[[Float[Array, "..."]], PyTree] | None]:
    """Return the floating-point arrays of a pytree as a vector, with its inverse, also for one per seed; or a vector, None.

    An array with more axes than a vector, or than one vector per seed, is a pytree, too: controls by step and actuator.
    """
    if eqx.is_array_like(params) and jnp.ndim(params) <= num_axes:
        return jnp.asarray(params), None
    # `is_inexact_array_like` calls a tracer's `__jax_array__`, which is None (jax 0.10.2, equinox 0.13.8).
    is_parameter = lambda x: eqx.is_inexact_array(x) if eqx.is_array(x) else eqx.is_inexact_array_like(x)  # noqa: E731
    arrays, others = eqx.partition(params, is_parameter)
    vector, unravel = ravel_pytree(arrays)
    if vector.size == 0:
        raise ValueError(f"params must have floating-point arrays, got none in {params}; write 1.0 in place of 1")

    def restore(vector: Float[Array, "..."]) -> PyTree:
        return eqx.combine(jax.vmap(unravel)(vector) if vector.ndim == 2 else unravel(vector), others)

    return vector, restore


def of_vector(objective: Any, restore: Callable[[Vector], PyTree] | None) -> Any:
    """Return an objective, or a function from a scale to one, that takes the vector of `flattened`.

    An objective with noise on actions is unchanged: it takes a vector already, and restores its policy's parameters itself.
    """
    if restore is None or not (callable(objective) or isinstance(objective, ParameterNoise)):
        return objective
    if isinstance(objective, ParameterNoise):
        return dataclasses.replace(objective, function=Restored(objective.function, restore))
    return lambda scale: of_vector(objective(scale), restore)


def as_vector(objective: Objective, params: PyTree) -> tuple[Objective, Vector, Callable[[Vector], PyTree]]:
    """Return an objective of a vector, sized for it, the vector, and the map from a gradient to the parameters' form."""
    vector, restore = flattened(params)
    objective = of_vector(as_objective(objective), restore).sized_for(vector)
    if restore is None:
        return objective, vector, unchanged
    return objective, vector, lambda gradient: eqx.filter(restore(gradient), eqx.is_inexact_array)
