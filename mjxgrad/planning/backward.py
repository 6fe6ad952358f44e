"""The backward pass: from linear models and quadratic costs to a feedback law, within control limits."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad.planning.box import minimise_in_box, solve_free
from mjxgrad.planning.cost import Quadratic


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
        k, K = minimum.value, -solve_free(held, q_ux, minimum.is_free)
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
