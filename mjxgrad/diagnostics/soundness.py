"""Checks that a gradient is usable: finite, from a rollout that did not diverge, and not exploding.

`Trajectory.diverged` concerns the motion only. A derivative can overflow although the motion is fine. It is zero or stale
where a rollout diverged and its state was held. Estimators leave out and count such samples; direct users of `jax.grad`
on a rollout can check here.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree


class UnsoundGradientError(FloatingPointError):
    """A gradient that must not be used."""


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


def check_soundness(found: Soundness) -> None:
    """Raise if any gradient that `soundness` checked, batched or not, is unsound. Call it on the host.

    Raises:
        UnsoundGradientError: with the number of unsound gradients and the reasons.
    """
    unsound = ~np.atleast_1d(found.is_sound)
    if not unsound.any():
        return
    counts = (
        (np.atleast_1d(found.diverged), "belong to rollouts that diverged"),
        (np.atleast_1d(found.num_nonfinite) > 0, "are not finite"),
        (np.atleast_1d(found.explodes), f"exceed the bound, up to {np.max(found.largest):.3g}"),
    )
    reasons = ", ".join(f"{is_so.sum()} {what}" for is_so, what in counts if is_so.any())
    raise UnsoundGradientError(
        f"{unsound.sum()} of {unsound.size} gradients must not be used: {reasons}; shorten the time step, soften the "
        "contact, shorten the horizon, or leave these samples out"
    )
