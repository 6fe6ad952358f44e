"""What is known of arrays while a program is traced, and roots whose derivatives exist where the usual ones have none."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def as_float(value: Any) -> Any:
    """Return numbers, integers too (10000 is a natural way to write a stiffness), as an array; None as it is."""
    return None if value is None else jnp.asarray(value, dtype=jnp.result_type(float))


def known(values: Any) -> np.ndarray | None:
    """Return numbers as they are; None for those that only the running program, or a derivative, knows."""
    return None if isinstance(values, jax.core.Tracer) else np.asarray(values)


def is_known(value: Any) -> bool:
    """Return whether this is an array that can be looked at.

    Trees of other things than numbers (axes of vmap, shapes) go through the same constructors.
    """
    return isinstance(value, jax.Array | np.ndarray) and not isinstance(value, jax.core.Tracer)


def is_known_to_be(number: float, values: Any, *, column: int | None = None) -> bool:
    """Return whether all numbers of an array, or of one of its columns, are known, and are this one."""
    found = known(values)
    return found is not None and bool(np.all((found if column is None else found[..., column]) == number))


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose derivative at zero is zero instead of infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm over the last axis, with derivative zero at the zero vector."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))
