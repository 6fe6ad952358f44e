"""Gaussian noise, and what its standard deviation must be."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def gaussian(key: PRNGKeyArray, stddev: Float[Array, "..."], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Draw noise of a shape that `stddev` broadcasts to."""
    return stddev * jax.random.normal(key, shape, stddev.dtype)


def positive(stddev: float | Float[Array, "..."]) -> Float[Array, "..."]:
    """Give the standard deviation as an array.

    Raises:
        ValueError: if it is known and not positive.
    """
    stddev = jnp.asarray(stddev, jnp.result_type(stddev, float))
    # A traced value (a noise schedule, a sweep) cannot be looked at here.
    if not isinstance(stddev, jax.core.Tracer) and not bool((stddev > 0).all()):
        raise ValueError(f"stddev must be positive, got {stddev}")
    return stddev
