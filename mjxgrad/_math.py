"""Functions whose derivatives exist where the usual ones have none."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose derivative at zero is zero instead of infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm over the last axis, with derivative zero at the zero vector."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))
