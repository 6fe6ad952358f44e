r"""The minimiser over accelerations: Newton's method with an exact line search.

Minimise over a

    ½ (a - a_s)ᵀ M (a - a_s) + Σ_i s_i(J_i a - a_ref,i),

with the laws s_i of `constraint`. The problem is strictly convex, so the starting point affects the time taken and not the
answer. Along a search line the derivative of the cost is monotone and, but for elliptic rows, piecewise linear: Newton's
method on it, kept inside a bracket, ends at the exact minimiser after as many steps as it crosses pieces. It takes a
fixed number of steps, since under `vmap` a loop until convergence runs as long as its slowest member. (The
minimiser can also be read off the values at all breakpoints at once, without iterating; that takes rows² work and was
three times slower at 24 rows.)

The gradient is formed afresh in each iteration rather than updated along the line: in single precision an update keeps
the rounding errors of a poor start.
"""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.dynamics import constraint, linear
from mjxgrad.dynamics.constraint import RowLayout, Rows
from mjxgrad.dynamics.jacobian import SparseRows

# Newton steps along the search line. Near the solution the first, of length one, is already exact; far from it an inexact
# search costs an outer iteration and not the answer. On a box and a ball that slide on a plane, 2 to 12 steps needed the
# same number of outer iterations within two per cent.
_LINE_STEPS = 4
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

    mass: Float[Array, "nv nv *batch"]
    force: Float[Array, "nv *batch"]
    jacobian: SparseRows
    rows: Rows

    def at(self, layout: RowLayout, acceleration: Float[Array, "nv *batch"]) -> "Point":
        """Evaluate the problem at an acceleration."""
        x = self.jacobian.matvec(acceleration) - self.rows.reference
        row_force = constraint.force(layout, self.rows, x)
        inertia = linear.matvec(self.mass, acceleration)
        pull = self.jacobian.rmatvec(row_force)
        return Point(acceleration, x, inertia, pull, inertia - self.force - pull)

    def hessian(self, layout: RowLayout, x: Float[Array, "rows *batch"]) -> Float[Array, "nv nv *batch"]:
        """Return the second derivative of the cost, M + Jᵀ s'' J."""
        return self.jacobian.gram(self.mass, layout, constraint.bend(layout, self.rows, x))


class Point(eqx.Module):
    """A problem evaluated at one acceleration.

    Attributes:
        acceleration: a.
        x: J a - a_ref.
        inertia: M a.
        pull: Jᵀ f, the constraint forces in joint space.
        gradient: M a - f_smooth - Jᵀ f.
    """

    acceleration: Float[Array, "nv *batch"]
    x: Float[Array, "rows *batch"]
    inertia: Float[Array, "nv *batch"]
    pull: Float[Array, "nv *batch"]
    gradient: Float[Array, "nv *batch"]

    def rounding(self) -> Float[Array, "*batch"]:
        """Return the size that the gradient has by rounding alone."""
        terms = jnp.abs(self.inertia) + jnp.abs(self.pull)
        return 4 * jnp.finfo(terms.dtype).eps * jnp.sqrt(linear.dot(terms, terms))


class _Iterate(eqx.Module):
    """The loop's carry.

    It holds the Hessian of the next iteration, not for that iteration's sake: a carried array is computed once and stored,
    while XLA would write the sums that form an entry out again in each of the many places where the factorisation uses it.
    """

    point: Point
    hessian: Float[Array, "nv nv *batch"]
    is_done: Bool[Array, "*batch"]
    num_iterations: Int[Array, "*batch"]


def minimise(
    layout: RowLayout,
    problem: Problem,
    start: Float[Array, "nv *batch"],
    tolerance: Float[Array, "*batch"],
    max_iterations: int,
) -> tuple[Float[Array, "nv *batch"], Int[Array, "*batch"]]:
    """Return the acceleration of least cost and the number of iterations spent.

    It goes on until every member of the batch is done; those that are do not move any more.

    Args:
        layout: the laws of the rows.
        problem: the cost.
        start: where to begin, usually the last acceleration. A non-finite start is replaced by zero.
        tolerance: on the norm of the gradient, and on the decrease that the quadratic model still promises, both
            divided by the trace of the mass matrix, as MJX does. The search also ends where the gradient is rounding.
        max_iterations: upper bound.

    Returns:
        The acceleration, NaN where the problem is not finite, and the number of iterations.
    """
    trace = functools.reduce(operator.add, (problem.mass[i, i] for i in range(len(start))))
    scale = 1 / jnp.maximum(trace, mujoco.mjMINVAL)

    def measure(acceleration, promised, num_iterations):
        point = problem.at(layout, acceleration)
        norm = jnp.sqrt(linear.dot(point.gradient, point.gradient))
        is_small = (scale * norm < tolerance) | (scale * promised < tolerance)
        is_done = is_small | (norm <= point.rounding()) | ~jnp.isfinite(norm)
        is_done |= num_iterations >= max_iterations
        return _Iterate(point, problem.hessian(layout, point.x), is_done, num_iterations)

    def iterate(state: _Iterate) -> _Iterate:
        point = state.point
        direction = _descent(state.hessian, point.gradient)
        length = _line_search(layout, problem, point, direction)
        promised = -0.5 * linear.dot(point.gradient, direction)
        length = jnp.where(state.is_done, 0.0, length)
        moved = jnp.where(state.is_done, point.acceleration, point.acceleration + length * direction)
        return measure(moved, promised, state.num_iterations + ~state.is_done)

    start = jnp.where(jnp.all(jnp.isfinite(start), axis=0), start, jnp.zeros_like(start))
    none = jnp.zeros(start.shape[1:], jnp.int32)
    first = measure(start, jnp.full(start.shape[1:], jnp.inf, start.dtype), none)
    last = jax.lax.while_loop(lambda state: ~jnp.all(state.is_done), iterate, first)
    # Non-finite forces or rows have no minimiser: the start must not pass for one.
    is_sound = jnp.all(jnp.isfinite(last.point.gradient), axis=0)
    return jnp.where(is_sound, last.point.acceleration, jnp.nan), last.num_iterations


def _descent(hessian: Float[Array, "nv nv *batch"], gradient: Float[Array, "nv *batch"]) -> Float[Array, "nv *batch"]:
    """Return Newton's direction; where the factorisation fails in this precision, the gradient scaled by the diagonal."""
    newton = -linear.cholesky_solve(hessian, gradient)
    diagonal = jnp.stack([hessian[i, i] for i in range(len(gradient))])
    return jnp.where(jnp.all(jnp.isfinite(newton), axis=0), newton, -gradient / diagonal)


def _line_search(
    layout: RowLayout, problem: Problem, point: Point, direction: Float[Array, "nv *batch"]
) -> Float[Array, "*batch"]:
    """Return the minimiser of the cost along a descent direction, or a shorter step that lowers it."""
    along = problem.jacobian.matvec(direction)
    smooth_slope = linear.dot(direction, point.inertia - problem.force)
    smooth_curvature = linear.dot(direction, linear.matvec(problem.mass, direction))

    def slope(t: Float[Array, "*batch"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        x = point.x + t * along
        forces = constraint.force(layout, problem.rows, x)
        bend = constraint.curvature_product(layout, problem.rows, x, along[:, None])[:, 0]
        return (
            smooth_slope + t * smooth_curvature - linear.dot(forces, along),
            smooth_curvature + linear.dot(bend, along),
        )

    def improve(_, bracket):
        low, high, length, _ = bracket
        value, curvature = slope(length)
        low, high = jnp.where(value < 0, length, low), jnp.where(value < 0, high, length)
        newton = length - value / jnp.where(curvature > 0, curvature, 1.0)
        inside = (newton >= low) & (newton <= high)
        return low, high, jnp.where(inside, newton, 0.5 * (low + high)), value

    # The inertial part alone bounds the root from above: the rows only add to the slope's growth.
    start = linear.dot(point.gradient, direction)
    high = jnp.maximum(-start / jnp.where(smooth_curvature > 0, smooth_curvature, 1.0), 1.0)
    bracket = (jnp.zeros_like(start), high, jnp.ones_like(start), start)
    # A GPU spends more on starting the loop's turns than on the turns themselves. A CPU keeps the loop: unrolled, XLA writes
    # each step out again wherever the next one uses its length.
    unroll = jax.default_backend() != "cpu"
    low, _, length, value = jax.lax.fori_loop(0, _LINE_STEPS, improve, bracket, unroll=unroll)
    has_converged = jnp.abs(value) <= _LINE_TOLERANCE * jnp.abs(start)
    # Up to the lower end of the bracket the cost has only fallen.
    return jnp.where(has_converged | (low == 0), length, low)
