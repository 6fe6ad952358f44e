r"""The minimiser over accelerations: Newton's method with an exact line search.

Minimise over a

    ½ (a - a_s)ᵀ M (a - a_s) + Σ_i s_i(J_i a - a_ref,i),

with the laws s_i of `constraint`. The problem is strictly convex, so the starting point affects the time taken and not the
answer. Along a search line the derivative of the cost is monotone, and between the breakpoints of the laws it is linear
(elliptic rows: smooth). Evaluating it at all breakpoints at once brackets its root without a loop, which suits `vmap`: a
loop runs as long as its slowest member. One secant step in the bracket is then exact; elliptic rows take a few more.

The gradient is formed afresh in each iteration rather than updated along the line: in single precision an update keeps
the rounding errors of a poor start.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.dynamics import constraint, linear
from mjxgrad.dynamics.constraint import RowLayout, Rows

# Safeguarded Newton steps inside a bracket where the cost is smooth but not quadratic (elliptic rows only). Six leave a
# relative error far below what the outer iteration can use: each doubles the digits once it is close.
_CONE_STEPS = 6


class Problem(eqx.Module):
    """Everything that determines the acceleration of one state.

    Attributes:
        mass: M, joint-space inertia.
        force: f_smooth = M a_s, all forces but those of constraints (N or N m).
        jacobian: J, from joint velocities to constraint rows.
        rows: parameters of the rows' laws.
    """

    mass: Float[Array, "nv nv"]
    force: Float[Array, " nv"]
    jacobian: Float[Array, "rows nv"]
    rows: Rows

    def row_force(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Return the constraint forces at an acceleration."""
        return constraint.force(layout, self.rows, self._rows_at(acceleration))

    def gradient(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Return the gradient of the cost, M a - f_smooth - Jᵀ f(a)."""
        row_force = self.row_force(layout, acceleration)
        return self.mass @ acceleration - self.force - self.jacobian.T @ row_force

    def hessian(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, "nv nv"]:
        """Return the second derivative of the cost, M + Jᵀ s'' J."""
        x = self._rows_at(acceleration)
        curved = constraint.curvature_product(layout, self.rows, x, self.jacobian)
        return self.mass + linear.gram(self.jacobian, curved)

    def rounding(self, row_force: Float[Array, " rows"], acceleration: Float[Array, " nv"]) -> Float[Array, ""]:
        """Return the size that the gradient has by rounding alone."""
        terms = jnp.abs(self.mass @ acceleration) + jnp.abs(self.force)
        terms += jnp.abs(self.jacobian).T @ jnp.abs(row_force)
        return jnp.finfo(terms.dtype).eps * jnp.sqrt(jnp.sum(terms**2))

    def _rows_at(self, acceleration: Float[Array, " nv"]) -> Float[Array, " rows"]:
        return self.jacobian @ acceleration - self.rows.reference


class _Iterate(eqx.Module):
    acceleration: Float[Array, " nv"]
    gradient: Float[Array, " nv"]
    is_done: Bool[Array, ""]
    num_iterations: Int[Array, ""]


def minimise(
    layout: RowLayout,
    problem: Problem,
    start: Float[Array, " nv"],
    tolerance: Float[Array, ""],
    max_iterations: int,
) -> tuple[Float[Array, " nv"], Int[Array, ""]]:
    """Return the acceleration of least cost and the number of iterations spent.

    Args:
        layout: the laws of the rows.
        problem: the cost.
        start: where to begin, usually the last acceleration. A non-finite start is replaced by zero.
        tolerance: on the norm of the gradient, and on the decrease that the quadratic model still promises, both
            divided by the trace of the mass matrix, as MJX does. The search also ends where the gradient is rounding.
        max_iterations: upper bound.
    """
    scale = 1 / jnp.maximum(jnp.trace(problem.mass), 1e-15)

    def measure(acceleration, promised, num_iterations):
        row_force = problem.row_force(layout, acceleration)
        gradient = problem.mass @ acceleration - problem.force - problem.jacobian.T @ row_force
        norm = jnp.sqrt(jnp.sum(gradient**2))
        is_rounding = norm <= 2 * problem.rounding(row_force, acceleration)
        is_small = (scale * norm < tolerance) | (scale * promised < tolerance)
        return _Iterate(acceleration, gradient, is_rounding | is_small, num_iterations)

    def iterate(state: _Iterate) -> _Iterate:
        hessian = problem.hessian(layout, state.acceleration)
        direction = _descent(hessian, state.gradient)
        length = _line_search(layout, problem, state, direction)
        promised = -0.5 * jnp.dot(state.gradient, direction)
        moved = state.acceleration + length * direction
        return measure(moved, promised, state.num_iterations + 1)

    def goes_on(state: _Iterate) -> Bool[Array, ""]:
        is_finite = jnp.all(jnp.isfinite(state.gradient))
        return ~state.is_done & is_finite & (state.num_iterations < max_iterations)

    start = jnp.where(jnp.all(jnp.isfinite(start)), start, jnp.zeros_like(start))
    first = measure(start, jnp.asarray(jnp.inf, start.dtype), jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(goes_on, iterate, first)
    return last.acceleration, last.num_iterations


def _descent(
    hessian: Float[Array, "nv nv"], gradient: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """Return Newton's direction; where the factorisation fails in this precision, the gradient scaled by the diagonal."""
    newton = -linear.solve_positive_definite(hessian, gradient)
    return jnp.where(jnp.all(jnp.isfinite(newton)), newton, -gradient / jnp.diag(hessian))


def _line_search(
    layout: RowLayout, problem: Problem, state: _Iterate, direction: Float[Array, " nv"]
) -> Float[Array, ""]:
    """Return the exact minimiser of the cost along a descent direction."""
    x = problem._rows_at(state.acceleration)
    along = problem.jacobian @ direction
    smooth_slope = jnp.dot(direction, problem.mass @ state.acceleration - problem.force)
    smooth_curvature = jnp.dot(direction, problem.mass @ direction)

    def slope(t: Float[Array, "*points"]) -> Float[Array, "*points"]:
        forces = constraint.force(layout, problem.rows, x + t[..., None] * along)
        return smooth_slope + t * smooth_curvature - jnp.sum(forces * along, axis=-1)

    # The inertial part alone bounds the root from above: the rows only add to the slope's growth.
    origin = jnp.dot(state.gradient, direction)
    bound = jnp.maximum(-origin / jnp.where(smooth_curvature > 0, smooth_curvature, 1.0), 1.0)
    points = constraint.breakpoints(layout, problem.rows, x, along)
    points = jnp.clip(jnp.concatenate([points, jnp.ones(1, x.dtype)]), 0.0, bound)
    slopes = slope(points)
    low = jnp.max(jnp.where(slopes <= 0, points, 0.0), initial=0.0)
    high = jnp.min(jnp.where(slopes >= 0, points, bound))
    ends = slope(jnp.stack([low, high]))
    root = low - ends[0] * _divide(high - low, ends[1] - ends[0])
    for _ in range(_CONE_STEPS if layout.cones else 0):
        value, curvature = jax.jvp(slope, (root,), (jnp.ones_like(root),))
        low, high = jnp.where(value < 0, root, low), jnp.where(value < 0, high, root)
        newton = root - _divide(value, curvature)
        root = jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    return root


def _divide(numerator: Float[Array, ""], denominator: Float[Array, ""]) -> Float[Array, ""]:
    """Return the quotient, or zero where the denominator vanishes (the bracket is a point)."""
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1.0), 0.0)
