"""The backward pass: from linear models and quadratic costs to a feedback law, within control limits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad.planning.cost import Quadratic

# Newton steps of the projected method. Each settles bounds that are active for good, or shortens the way by backtracking; two or
# three suffice for a few controls, and the rest cost nothing beside a step of the dynamics.
_STEPS = 12
_SHORTENING = 0.5 ** np.arange(8)


class Feedback(eqx.Module):
    """The law du = step k + K dx around a trajectory.

    Attributes:
        change: k, of the controls.
        gain: K; rows of controls that a limit holds are zero.
        slope: derivative of the cost by the step at 0, which is below 0.
        curvature: its second derivative.
        is_sound: whether every step's program was solved.
    """

    change: Float[Array, "horizon m"]
    gain: Float[Array, "horizon m n"]
    slope: Float[Array, ""]
    curvature: Float[Array, ""]
    is_sound: Bool[Array, ""]

    def promised(self, step: ArrayLike = 1.0) -> Float[Array, ""]:
        """Return by how much the model says that the cost falls."""
        return -jnp.asarray(step) * (self.slope + 0.5 * jnp.asarray(step) * self.curvature)


def backward_pass(
    A: Float[Array, "horizon n n"],
    B: Float[Array, "horizon n m"],
    stages: Quadratic,
    terminal: Quadratic,
    lower: Float[Array, "horizon m"],
    upper: Float[Array, "horizon m"],
    regularisation: Float[Array, ""],
) -> Feedback:
    """Minimise the quadratic model of the cost-to-go step by step, the last first.

    Args:
        A: derivative of each next state by the state.
        B: and by the control.
        stages: costs of the steps, with a leading axis.
        terminal: cost of the last state.
        lower: how far each control may fall, at most 0.
        upper: how far it may rise.
        regularisation: added to the curvature by the controls, in units of its largest entry; it shortens the steps.

    Returns:
        The feedback law.

    References:
        Li, Todorov. Iterative Linear Quadratic Regulator Design for Nonlinear Biological Movement Systems. ICINCO 2004.
        Tassa, Mansard, Todorov. Control-Limited Differential Dynamic Programming. ICRA 2014 (limits).
    """
    n = A.shape[-1]

    def back(carry, inputs):
        value, slope_sum, curvature_sum, sound = carry
        A, B, stage, low, high = inputs
        both = jnp.concatenate([A, B], axis=1)
        gradient = stage.gradient + both.T @ value.gradient
        hessian = stage.hessian + both.T @ value.hessian @ both
        q_u, q_uu, q_ux = gradient[n:], hessian[n:, n:], hessian[n:, :n]
        held = q_uu + regularisation * jnp.max(jnp.diag(q_uu)) * jnp.eye(len(q_u), dtype=q_u.dtype)
        minimum = minimise_in_box(held, q_u, low, high)
        k, K = minimum.value, -_solve_free(held, q_ux, minimum.is_free)
        # The exact cost-to-go of this law: the shorter forms of it hold without regularisation and limits only.
        closed = jnp.concatenate([jnp.eye(n, dtype=K.dtype), K])
        affine = jnp.concatenate([jnp.zeros(n, k.dtype), k])
        value_hessian = closed.T @ hessian @ closed
        value = Quadratic(closed.T @ (gradient + hessian @ affine), 0.5 * (value_hessian + value_hessian.T))
        carry = (value, slope_sum + q_u @ k, curvature_sum + k @ q_uu @ k, sound & minimum.is_sound)
        return carry, (k, K)

    zero = jnp.zeros((), A.dtype)
    start = (terminal, zero, zero, jnp.asarray(True))
    (_, slope, curvature, sound), (k, K) = jax.lax.scan(back, start, (A, B, stages, lower, upper), reverse=True)
    sound &= jnp.all(jnp.isfinite(k)) & jnp.all(jnp.isfinite(K))
    return Feedback(k, K, slope, curvature, sound)


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
        direction = -_solve_free(hessian, slope[:, None], is_free)[:, 0]
        tried = jnp.clip(x + _SHORTENING[:, None].astype(x.dtype) * direction, lower, upper)
        values = jax.vmap(value)(tried)
        best = jnp.argmin(values)
        return jnp.where(values[best] < value(x), tried[best], x)

    x = jax.lax.fori_loop(0, _STEPS, improve, jnp.clip(jnp.zeros_like(gradient), lower, upper))
    slope, is_free = free(x)
    rounding = 1e3 * jnp.finfo(x.dtype).eps * (jnp.abs(hessian) @ jnp.abs(x) + jnp.abs(gradient))
    is_sound = jnp.all(jnp.isfinite(x)) & jnp.all(~is_free | (jnp.abs(slope) <= rounding))
    return BoxMinimum(x, is_free, is_sound)


def _solve_free(
    hessian: Float[Array, "m m"], right: Float[Array, "m columns"], is_free: Bool[Array, " m"]
) -> Float[Array, "m columns"]:
    """Solve H y = b for the free coordinates, the others held at zero."""
    both = is_free[:, None] & is_free
    held = jnp.where(both, hessian, jnp.eye(len(hessian), dtype=hessian.dtype))
    return jnp.linalg.solve(held, jnp.where(is_free[:, None], right, 0.0))
