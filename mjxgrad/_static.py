"""What is known of a model while a program is traced: the numbers of a scene that is closed over, not those of an argument."""

from typing import Any

import jax
import numpy as np


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
