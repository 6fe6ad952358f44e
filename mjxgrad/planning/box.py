"""Small quadratic programs with bounds, as the controls of one step are."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

# Newton steps of the projected method. Each settles bounds that are active for good, or shortens the way by backtracking; two or
# three suffice for a few controls, and the rest cost nothing beside a step of the dynamics.
_STEPS = 12
_SHORTENING = 0.5 ** np.arange(8)


class BoxMinimum(eqx.Module):
    """The minimiser of a quadratic function in a box.

    Attributes:
        value: where.
        is_free: which coordinates are not held by a bound.
        is_sound: whether it is finite and stationary: the gradient of the free coordinates vanishes, up to rounding.
    """

    value: Float[Array, " m"]
    is_free: Bool[Array, " m"]
    is_sound: Bool[Array, ""]


def minimise_in_box(
    hessian: Float[Array, "m m"],
    gradient: Float[Array, " m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
) -> BoxMinimum:
    """Minimise ½ xᵀ H x + gᵀ x between bounds, by projected Newton steps.

    Args:
        hessian: H, positive definite.
        gradient: g.
        lower: bounds from below, at most `upper`.
        upper: bounds from above.

    Returns:
        The minimiser.

    References:
        Tassa, Mansard, Todorov. Control-Limited Differential Dynamic Programming. ICRA 2014, section III.
    """

    def value(x: Float[Array, " m"]) -> Float[Array, ""]:
        return 0.5 * x @ hessian @ x + gradient @ x

    def free(x: Float[Array, " m"]) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
        slope = hessian @ x + gradient
        return slope, ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))

    def improve(_: ArrayLike, x: Float[Array, " m"]) -> Float[Array, " m"]:
        slope, is_free = free(x)
        direction = -solve_free(hessian, slope[:, None], is_free)[:, 0]
        tried = jnp.clip(x + _SHORTENING[:, None].astype(x.dtype) * direction, lower, upper)
        values = jax.vmap(value)(tried)
        best = jnp.argmin(values)
        return jnp.where(values[best] < value(x), tried[best], x)

    x = jax.lax.fori_loop(0, _STEPS, improve, jnp.clip(jnp.zeros_like(gradient), lower, upper))
    slope, is_free = free(x)
    rounding = 1e3 * jnp.finfo(x.dtype).eps * (jnp.abs(hessian) @ jnp.abs(x) + jnp.abs(gradient))
    is_sound = jnp.all(jnp.isfinite(x)) & jnp.all(~is_free | (jnp.abs(slope) <= rounding))
    return BoxMinimum(x, is_free, is_sound)


def solve_free(
    hessian: Float[Array, "m m"], right: Float[Array, "m columns"], is_free: Bool[Array, " m"]
) -> Float[Array, "m columns"]:
    """Solve H y = b for the free coordinates, the others held at zero."""
    both = is_free[:, None] & is_free
    held = jnp.where(both, hessian, jnp.eye(len(hessian), dtype=hessian.dtype))
    return jnp.linalg.solve(held, jnp.where(is_free[:, None], right, 0.0))
