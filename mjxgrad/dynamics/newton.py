r"""The minimiser over accelerations: Newton's method with an exact line search.

Minimise over a

    ½ (a - a_s)ᵀ M (a - a_s) + Σ_i s_i(J_i a - a_ref,i),

with the laws s_i of `constraint`. The problem is strictly convex, so the starting point affects the time taken and not the
answer. Along a search line the derivative of the cost is monotone and, but for elliptic rows, piecewise linear: Newton's
method on it, kept inside a bracket, ends at the exact minimiser after as many steps as it crosses pieces. A fixed number
of steps is unrolled, since under `vmap` a loop runs as long as its slowest member, and tests for it all the while. (The
minimiser can also be read off the values at all breakpoints at once, without iterating; that takes rows² work and was
three times slower at 24 rows.)

The gradient is formed afresh in each iteration rather than updated along the line: in single precision an update keeps
the rounding errors of a poor start.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.dynamics import constraint, linear
from mjxgrad.dynamics.constraint import RowLayout, Rows

# Newton steps along the search line. Near the solution the first, of length one, is already exact; far from it an inexact
# search costs an outer iteration and not the answer.
_LINE_STEPS = 8
# A line search has converged where the slope has fallen to this part of its value at the start.
_LINE_TOLERANCE = 1e-3


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

    def at(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> "Point":
        """Evaluate the problem at an acceleration."""
        x = self.jacobian @ acceleration - self.rows.reference
        row_force = constraint.force(layout, self.rows, x)
        inertia = self.mass @ acceleration
        pull = self.jacobian.T @ row_force
        return Point(acceleration, x, row_force, inertia, pull, inertia - self.force - pull)

    def hessian(self, layout: RowLayout, x: Float[Array, " rows"]) -> Float[Array, "nv nv"]:
        """Return the second derivative of the cost, M + Jᵀ s'' J."""
        curved = constraint.curvature_product(layout, self.rows, x, self.jacobian)
        return self.mass + linear.gram(self.jacobian, curved)


class Point(eqx.Module):
    """A problem evaluated at one acceleration.

    Attributes:
        acceleration: a.
        x: J a - a_ref.
        row_force: constraint forces f(x).
        inertia: M a.
        pull: Jᵀ f, the constraint forces in joint space.
        gradient: M a - f_smooth - Jᵀ f.
    """

    acceleration: Float[Array, " nv"]
    x: Float[Array, " rows"]
    row_force: Float[Array, " rows"]
    inertia: Float[Array, " nv"]
    pull: Float[Array, " nv"]
    gradient: Float[Array, " nv"]

    def rounding(self) -> Float[Array, ""]:
        """Return the size that the gradient has by rounding alone."""
        terms = jnp.abs(self.inertia) + jnp.abs(self.pull)
        return 4 * jnp.finfo(terms.dtype).eps * jnp.sqrt(jnp.sum(terms**2))


class _Iterate(eqx.Module):
    point: Point
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
        point = problem.at(layout, acceleration)
        norm = jnp.sqrt(jnp.sum(point.gradient**2))
        is_small = (scale * norm < tolerance) | (scale * promised < tolerance)
        return _Iterate(point, is_small | (norm <= point.rounding()), num_iterations)

    def iterate(state: _Iterate) -> _Iterate:
        point = state.point
        direction = _descent(problem.hessian(layout, point.x), point.gradient)
        length = _line_search(layout, problem, point, direction)
        promised = -0.5 * jnp.sum(point.gradient * direction)
        moved = point.acceleration + length * direction
        return measure(moved, promised, state.num_iterations + 1)

    def goes_on(state: _Iterate) -> Bool[Array, ""]:
        is_finite = jnp.isfinite(jnp.sum(state.point.gradient))
        return ~state.is_done & is_finite & (state.num_iterations < max_iterations)

    start = jnp.where(jnp.all(jnp.isfinite(start)), start, jnp.zeros_like(start))
    first = measure(start, jnp.asarray(jnp.inf, start.dtype), jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(goes_on, iterate, first)
    return last.point.acceleration, last.num_iterations


def _descent(
    hessian: Float[Array, "nv nv"], gradient: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """Return Newton's direction; where the factorisation fails in this precision, the gradient scaled by the diagonal."""
    newton = -linear.solve_positive_definite(hessian, gradient)
    return jnp.where(jnp.all(jnp.isfinite(newton)), newton, -gradient / jnp.diag(hessian))


def _line_search(
    layout: RowLayout, problem: Problem, point: Point, direction: Float[Array, " nv"]
) -> Float[Array, ""]:
    """Return the minimiser of the cost along a descent direction, or a shorter step that lowers it."""
    along = problem.jacobian @ direction
    smooth_slope = jnp.sum(direction * (point.inertia - problem.force))
    smooth_curvature = jnp.sum(direction * (problem.mass @ direction))

    def slope(t: Float[Array, ""]) -> Float[Array, ""]:
        forces = constraint.force(layout, problem.rows, point.x + t * along)
        return smooth_slope + t * smooth_curvature - jnp.sum(forces * along)

    # The inertial part alone bounds the root from above: the rows only add to the slope's growth.
    start = jnp.sum(point.gradient * direction)
    low, length = jnp.zeros_like(start), jnp.ones_like(start)
    high = jnp.maximum(-start / jnp.where(smooth_curvature > 0, smooth_curvature, 1.0), 1.0)
    for _ in range(_LINE_STEPS):
        value, curvature = jax.jvp(slope, (length,), (jnp.ones_like(length),))
        low, high = jnp.where(value < 0, length, low), jnp.where(value < 0, high, length)
        newton = length - value / jnp.where(curvature > 0, curvature, 1.0)
        length = jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    has_converged = jnp.abs(value) <= _LINE_TOLERANCE * jnp.abs(start)
    # Up to the lower end of the bracket the cost has only fallen.
    return jnp.where(has_converged | (low == 0), length, low)
