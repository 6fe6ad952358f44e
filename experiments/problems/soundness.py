"""Checks that a gradient is usable: finite, from a rollout that did not diverge, and not exploding.

`Trajectory.diverged` concerns the motion only. A derivative can overflow although the motion is fine. It is zero or stale
where a rollout diverged and its state was held.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree


class Soundness(eqx.Module):
    """The state of a gradient; under `jax.vmap` every field gains leading axes.

    Attributes:
        is_sound: whether the gradient can be used: no fault below occurs.
        num_nonfinite: number of entries that are not finite.
        largest: largest finite magnitude in it.
        explodes: whether the largest magnitude exceeds the bound.
        diverged: whether the rollout diverged.
    """

    is_sound: Bool[Array, ""]
    num_nonfinite: Int[Array, ""]
    largest: Float[Array, ""]
    explodes: Bool[Array, ""]
    diverged: Bool[Array, ""]


def soundness(gradient: PyTree, diverged: Bool[ArrayLike, ""] = False, *, bound: float | None = None) -> Soundness:
    """Check a gradient of a rollout, inside or outside of `jax.jit`.

    Args:
        gradient: any pytree of floating-point arrays, as `jax.grad` returns it.
        diverged: the flag `diverged` of its trajectory.
        bound: largest magnitude that does not count as exploding; None asks for finite numbers only.

    Returns:
        The state of the gradient.

    Raises:
        ValueError: if the gradient has no floating-point numbers.
    """
    leaves = [leaf for leaf in map(jnp.asarray, jax.tree.leaves(gradient)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    if not leaves:
        raise ValueError("gradient must hold floating-point arrays, got none")
    numbers = jnp.concatenate([leaf.reshape(-1) for leaf in leaves])
    is_finite = jnp.isfinite(numbers)
    largest = jnp.max(jnp.where(is_finite, jnp.abs(numbers), 0.0), initial=0.0)
    num_nonfinite = jnp.sum(~is_finite)
    explodes = largest > (jnp.inf if bound is None else bound)
    diverged = jnp.asarray(diverged, bool)
    return Soundness(~diverged & (num_nonfinite == 0) & ~explodes, num_nonfinite, largest, explodes, diverged)
