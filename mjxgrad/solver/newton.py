r"""The minimiser over accelerations: Newton's method with an exact line search.

Minimise over a

    ½ (a - a_s)ᵀ M (a - a_s) + Σ_i s_i(J_i a - a_ref,i),

with the laws s_i of `constraint`. The problem is strictly convex: the start affects the time taken, not the solution.

Along a line the derivative of the cost is monotone and, without elliptic rows and noise, piecewise linear. Newton's method inside
a bracket then ends at the exact minimiser, after as many steps as it crosses pieces. Near the apex of an elliptic cone the
curvature holds on one side only, so its loop checks every step.

The solve ends by the Newton decrement gᵀ H⁻¹ g, the remaining step in the norm of kinetic energy, which does not depend on units
or ratios of masses. In single precision an update of the gradient along the line would keep rounding errors: it is formed anew.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, Int, PyTree

from mjxgrad.batched import device, linear, on_gpu
from mjxgrad.bodies.kinematics import Inertia
from mjxgrad.solver import constraint, hessian
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.hessian import SparseRows, num_dense_rows
from mjxgrad.solver.jacobian import JoinedRows, RowMap

_Vector = Float[Array, "nv *batch"]
_OfRows = PyTree[Float[Array, "_ *batch"]]
_Scalar = Float[Array, "*batch"]
_Truth = Bool[Array, "*batch"]
_Result = tuple[_Vector, Int[Array, "*batch"]]

# Newton steps along the search line for the whole batch: testing whether they are needed takes as long as the steps.
_LINE_STEPS = 4
_MAX_LINE_STEPS = 40  # bound on all steps; halving alone reaches 1e-12 of the bracket
_LINE_TOLERANCE = 1e-2  # a line search has converged where the slope has fallen to this part of its value
# Next lengths keep this share of the bracket as distance from its upper end, where the slope is known to be positive.
_LINE_MARGIN = 0.01
# A batch is iterated as a whole until one part in so many is left: the slowest of 256 states takes four times the average. The
# second loop takes too long to compile for smaller batches.
_SHARE = 8
_LEAST_BATCH = 256
_ROUNDING = 4  # rounding error of a sum of a few terms, in units of rounding
# The estimate of rounding omits cancellation within M a and J a. Below this multiple of it only rounding is left after a step.
_LAST = 1e3
_RESOLVED = 1e-3  # a solve has failed where rounding leaves this share of the acceleration unknown


class Variant(eqx.Module):
    """The differences between two solves of one state. For two solves arrays have a leading axis of two."""

    weight: Float[Array, "*two rows"]  # weights D of the rows
    reference: Float[Array, "*two rows"] | None = None  # a_ref of the rows; None keeps the system's
    parts: tuple[RowMap | None, ...] | None = None  # parts of J to replace, where contacts may act from another side

    def __getitem__(self, number: int) -> "Variant":
        return jax.tree.map(lambda x: x[number], self)


class System(eqx.Module):
    """The equations of motion of one state, in a form that can be differentiated."""

    inertia: Inertia  # M
    force: _Vector  # f_smooth, all forces except those of constraints (N or N m)
    map: JoinedRows  # J, inactive rows included
    is_active: Bool[Array, "rows *batch"]
    rows: Rows

    def mv(self, velocity: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Return J v, zero for inactive rows."""
        return jnp.where(self.is_active, self.map.mv(velocity), 0.0)

    def rmv(self, force: Float[Array, " rows"]) -> Float[Array, " nv"]:
        """Return Jᵀ f."""
        return self.map.rmv(jnp.where(self.is_active, force, 0.0))

    def row_force(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Return the constraint forces at an acceleration."""
        return constraint.force(layout, self.rows, self.mv(acceleration) - self.rows.reference)

    def gradient(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Return M a - f_smooth - Jᵀ f, zero at the solution."""
        constraint_force = self.rmv(self.row_force(layout, acceleration))
        return self.inertia.apply(acceleration) - self.force - constraint_force

    def with_variant(self, variant: Variant) -> "System":
        """Return the system of one solve."""
        reference = self.rows.reference if variant.reference is None else variant.reference
        rows = eqx.tree_at(lambda rows: (rows.weight, rows.reference), self.rows, (variant.weight, reference))
        return dataclasses.replace(self, rows=rows, map=self.map.with_parts(variant.parts))

    def problem(self, layout: RowLayout) -> "Problem":
        """Return the problem with the entries of M and J; arrays may carry the batch as trailing axes."""
        jacobian = SparseRows.of(self.map, self.is_active, len(self.force))
        diagonal = jnp.maximum(linear.diagonal(self.inertia.matrix), mujoco.mjMINVAL)
        return Problem(self.force, self.rows, self.inertia.matrix, diagonal, jacobian, layout)


class Problem(eqx.Module):
    """The minimisation problem, with the entries of M and J as arrays that may carry the batch as trailing axes.

    `_KernelProblem` replaces the operations within a GPU's program. Quantities of the rows are one array, or several there.
    """

    force: _Vector
    rows: Any  # `Rows`
    mass: Float[Array, "nv nv *batch"]
    diagonal: _Vector  # of M, positive
    jacobian: Any  # `SparseRows`
    layout: RowLayout = eqx.field(static=True)

    def mass_mv(self, acceleration: _Vector) -> _Vector:
        return linear.matvec(self.mass, acceleration)

    def mv(self, acceleration: _Vector) -> _OfRows:
        return self.jacobian.matvec(acceleration)

    def rmv(self, force: _OfRows) -> _Vector:
        return self.jacobian.rmatvec(force)

    def row_force(self, x: _OfRows) -> _OfRows:
        return constraint.force(self.layout, self.rows, x)

    def hessian_product(self, x: _OfRows, along: _OfRows) -> _OfRows:
        """Return the second derivative of the cost by x, times a vector."""
        return constraint.curvature_product(self.layout, self.rows, x, along[:, None])[:, 0]

    def newton(self, point: "Point") -> tuple[_Vector, _Vector]:
        """Return H⁻¹ times the gradient, not finite where H is not positive definite, and the diagonal of H."""
        row_hessian = constraint.hessian(self.layout, self.rows, point.x)
        return hessian.solve(self.mass, self.jacobian, self.layout, row_hessian, point.gradient)

    def is_finite(self, vector: _Vector) -> _Truth:
        return jnp.all(jnp.isfinite(vector), axis=0)

    def at(self, acceleration: _Vector) -> "Point":
        """Evaluate the problem at an acceleration."""
        x = jax.tree.map(jnp.subtract, self.mv(acceleration), self.rows.reference)
        row_force = self.row_force(x)
        inertia, constraint_force = self.mass_mv(acceleration), self.rmv(row_force)
        return Point(acceleration, x, row_force, inertia, constraint_force, inertia - self.force - constraint_force)

    def rounding(self, point: "Point") -> _Scalar:
        """Return the rounding error of the decrement at a point."""
        # An error e of a row's x adds Jᵀ D e to the gradient, which is large for stiff rows, but at most e D e to the decrement.

        def energy(x: Array, reference: Array, force: Array, weight: Array) -> Array:
            size = jnp.abs(x) + jnp.abs(reference)
            return linear.dot(jnp.where(force != 0, weight, 0.0) * size, size)

        rows = jax.tree.map(energy, point.x, self.rows.reference, point.row_force, self.rows.weight)
        terms = linear.add([linear.dot(point.acceleration, point.inertia), *jax.tree.leaves(rows)])
        return (_ROUNDING * jnp.finfo(terms.dtype).eps) ** 2 * terms

    def is_resolved(self, point: "Point") -> _Truth:
        """Return whether rounding leaves less than a thousandth of the acceleration unknown."""
        # In single precision it leaves more where rows weigh 10⁷ times the bodies. The edges of a pyramid, with
        # weights of 1/μ², do so at low friction.
        own, free = linear.dot(point.acceleration, point.inertia), linear.dot(self.force / self.diagonal, self.force)
        return self.rounding(point) <= _RESOLVED**2 * (own + free)


_Parts = tuple[Float[Array, " height"], *tuple[Float[Array, " width"], ...]]


class _KernelRows(NamedTuple):
    """Parameters of uncoupled rows, whose forces are -D x between bounds."""

    reference: _Parts
    weight: _Parts
    low: _Parts
    high: _Parts


class _KernelProblem(Problem):
    """A problem of uncoupled rows whose M and J a GPU's program keeps in registers."""

    # Quantities of the rows come in parts: one for the rows of J, and one by joint velocity for each group of rows that
    # act on a single one, such as limits. As rows of J, whose number is a power of two, they would double it.
    signs: tuple[Float[Array, " width"], ...]  # entries of the rows that act on one joint velocity
    refs: tuple[Any, Any]  # M and J in memory
    size: int = eqx.field(static=True)

    def mass_mv(self, acceleration):
        return (self.mass * acceleration[:, None]).sum(axis=0)  # M is symmetric; a sum along rows takes more registers

    def mv(self, acceleration):
        return (self.jacobian * acceleration[None]).sum(axis=1), *(sign * acceleration for sign in self.signs)

    def rmv(self, force):
        first, *others = force
        own = (sign * other for sign, other in zip(self.signs, others, strict=True))
        return linear.add([(self.jacobian * first[:, None]).sum(axis=0), *own])

    def row_force(self, x):
        def clipped(x: Array, weight: Array, low: Array, high: Array) -> Array:
            force = -weight * x
            return jnp.where(force < low, low, jnp.where(force > high, high, force))

        return jax.tree.map(clipped, x, *self.rows[1:])

    def curvature(self, x: _Parts) -> _Parts:
        def curvature(x: Array, weight: Array, low: Array, high: Array) -> Array:
            force = -weight * x
            return jnp.where((force > low) & (force < high), weight, 0.0)

        return jax.tree.map(curvature, x, *self.rows[1:])

    def hessian_product(self, x, along):
        return jax.tree.map(jnp.multiply, self.curvature(x), along)

    def newton(self, point):
        mass, jacobian = self.refs
        first, *others = self.curvature(point.x)
        matrix = on_gpu.add_rows(on_gpu.blocks(mass), jacobian, first, jacobian)
        if others:
            own = linear.add(sign**2 * other for sign, other in zip(self.signs, others, strict=True))
            matrix = on_gpu.add_to_diagonal(matrix, own)
        return on_gpu.solve_blocks(matrix, point.gradient, self.size), on_gpu.diagonal(matrix)

    def is_finite(self, vector):
        return on_gpu.is_finite(vector)


class Point(eqx.Module):
    """A problem evaluated at one acceleration a: x = J a - a_ref, f(x), M a, Jᵀ f, and M a - f_smooth - Jᵀ f."""

    acceleration: _Vector
    x: _OfRows
    row_force: _OfRows
    inertia: _Vector
    constraint_force: _Vector
    gradient: _Vector

    def rounding(self) -> _Vector:
        """Return the rounding error of the gradient."""
        terms = jnp.abs(self.inertia) + jnp.abs(self.constraint_force)
        return _ROUNDING * jnp.finfo(terms.dtype).eps * terms


class _Iterate(eqx.Module):
    """The loop's carry."""

    # Convergence is tested on the carry: a carried array is computed once and stored, while XLA would repeat the sums that form
    # it wherever they are used. (The Hessian is not carried: its blocks are added in place, and the last one is not needed.)
    point: Point
    is_near: _Truth
    num_iterations: Int[Array, "*batch"]


def minimise(layout: RowLayout, max_iterations: int, system: System, start: _Vector, tolerance: _Scalar) -> _Result:
    """Return the acceleration of least cost, NaN where the problem is not finite, and the number of iterations."""
    # The loop runs until every member of the batch is done; members that are done stay where they are. The tolerance bounds the
    # remaining step, in the norm of kinetic energy over the trace of the mass matrix; for a single body this is the root mean
    # square error of its acceleration (m/s²). The search also ends where the step is rounding. The number is `max_iterations` + 1
    # where the iterations, or the digits of the precision, did not suffice.
    start = jnp.where(jnp.all(jnp.isfinite(start), axis=0), start, jnp.zeros_like(start))
    if start.ndim == 2 and layout.is_piecewise_quadratic and on_gpu.holds(num_dense_rows(system.map), len(start)):
        solvers = (functools.partial(solver, layout, max_iterations) for solver in (in_one_kernel, _over_batch))
        return device.by_platform(system, start, tolerance, gpu=next(solvers), default=next(solvers))
    return _over_batch(layout, max_iterations, system, start, tolerance)


def in_one_kernel(
    layout: RowLayout,
    max_iterations: int,
    system: System,
    start: _Vector,
    tolerance: _Scalar,
    *,
    interpret: bool = False,
) -> _Result:
    """Compute `minimise` for uncoupled rows in one kernel; `interpret` runs on any device, slowly."""
    problem, size = system.problem(layout), len(start)
    jacobian, rows = problem.jacobian, problem.rows
    dense_rows = jacobian.dense_rows()
    split = (jacobian.split(x) for x in (rows.reference, rows.weight, *constraint.bounds(layout, rows)))
    by_row, structure = jax.tree.flatten((_KernelRows(*split), jacobian.signs()))
    smallest = tolerance**2 * linear.add(problem.diagonal)

    def kernel(mass, jacobian, force, diagonal, start, smallest, *refs):
        *refs, acceleration, num_iterations = refs
        rows, signs = jax.tree.unflatten(structure, [ref[...] for ref in refs])
        parts = (force[...], rows, mass[...], diagonal[...], jacobian[...], layout, signs)
        problem = _KernelProblem(*parts, (mass, jacobian), size)
        solver = _Solver(problem, smallest[...], max_iterations)
        first = solver.measure(start[...], jnp.array(False), jnp.int32(0))
        acceleration[...], num_iterations[0] = solver.result(solver.run(first, 0))

    mass = on_gpu.filled(problem.mass)
    diagonal = jnp.maximum(linear.diagonal(mass), mujoco.mjMINVAL)
    width, height = on_gpu.padded(size), on_gpu.padded(len(dense_rows))
    inputs = mass, dense_rows, problem.force, diagonal, start, smallest, *by_row
    outputs = (start.dtype, width), (jnp.int32, 1)
    found, count = on_gpu.run(kernel, inputs, outputs, width * height, interpret=interpret)
    return found[:size], count[0]


def _over_batch(layout: RowLayout, max_iterations: int, system: System, start: _Vector, tolerance: _Scalar) -> _Result:
    """Compute `minimise` with operations on the whole batch."""
    batch, problem = start.shape[1:], system.problem(layout)
    solver = _Solver(problem, tolerance**2 * linear.add(problem.diagonal), max_iterations)
    first = solver.measure(start, jnp.zeros(batch, bool), jnp.zeros(batch, jnp.int32))
    # Measured on a CPU only.
    splits = device.is_cpu() and bool(batch) and batch[0] >= _LEAST_BATCH
    num_last = batch[0] // _SHARE if splits else 0
    state = solver.run(first, num_last)
    result = solver.result(state)
    if not num_last:
        return result
    is_left = ~solver.is_done(state)
    return jax.lax.cond(jnp.any(is_left), lambda: _finish(solver, state, is_left, result, num_last), lambda: result)


def _finish(solver: "_Solver", state: _Iterate, is_left: Bool[Array, " batch"], result: _Result, count: int) -> _Result:
    """Finish the remaining members on their own, so that the others need not wait for the slowest."""
    # The subset has `count` places, at least as many as members are left.
    index, place = jnp.flatnonzero(is_left, size=count, fill_value=0), jnp.cumsum(is_left) - 1

    def take(whole: PyTree) -> PyTree:  # an axis of length one stays, as all members share it
        return jax.tree.map(lambda x: x if x.shape[-1] == 1 else jnp.take(x, index, axis=-1, mode="clip"), whole)

    def put(one: Array, own: Array) -> Array:
        return jnp.where(is_left, jnp.take(own, place, axis=-1, mode="clip"), one)

    part = take(solver)
    # Evaluated anew, which is faster than gathering it.
    began = part.measure(*take((state.point.acceleration, state.is_near, state.num_iterations)))
    return jax.tree.map(put, result, part.result(part.run(began, 0)))


class _Solver(eqx.Module):
    """The iteration for a batch of problems; `smallest` is the decrement at which a solve has converged."""

    problem: Problem
    smallest: _Scalar
    max_iterations: int = eqx.field(static=True)

    def measure(self, acceleration: _Vector, is_near: _Truth, num_iterations: Int[Array, "*batch"]) -> _Iterate:
        return _Iterate(self.problem.at(acceleration), is_near, num_iterations)

    def is_solved(self, state: _Iterate) -> _Truth:
        """Return which members have converged."""
        # An estimate without the factor of H: H exceeds M, so this bounds the decrement up to the couplings in M.
        diagonal = self.problem.diagonal
        energy, floor = (linear.dot(v / diagonal, v) for v in (state.point.gradient, state.point.rounding()))
        return state.is_near | (energy < self.smallest) | (energy <= floor)

    def is_done(self, state: _Iterate) -> _Truth:
        """Return which members are done: converged, broken or out of iterations."""
        is_broken = ~self.problem.is_finite(state.point.gradient)
        return self.is_solved(state) | is_broken | (state.num_iterations >= self.max_iterations)

    def run(self, state: _Iterate, num_left: int) -> _Iterate:
        """Iterate until no more than `num_left` members are left."""

        def goes_on(state: _Iterate) -> Bool[Array, ""]:
            goes = ~self.is_done(state)
            return jnp.sum(goes) > num_left if num_left else jnp.any(goes)

        if state.is_near.ndim:
            return jax.lax.while_loop(goes_on, lambda state: self.iterate(state, self.is_done(state)), state)

        # In a GPU's program a test on the carry would take registers.
        def turn(carry: tuple[_Iterate, _Truth]) -> tuple[_Iterate, _Truth]:
            state = self.iterate(carry[0], ~carry[1])
            return state, ~self.is_done(state)

        return jax.lax.while_loop(lambda carry: carry[1], turn, (state, ~self.is_done(state)))[0]

    def iterate(self, state: _Iterate, stays: _Truth) -> _Iterate:
        """Take one step of Newton's method, except for members that stay."""
        problem, point = self.problem, state.point
        solution, diagonal = problem.newton(point)
        newton = -solution
        # The diagonally scaled gradient where the factorisation fails in this precision.
        scaled = -point.gradient / diagonal
        direction = jnp.where(problem.is_finite(newton), newton, scaled)
        decrement, floor = -linear.dot(point.gradient, direction), problem.rounding(point)
        noise = jnp.sqrt(jnp.maximum(decrement, 0.0) * floor)
        length = _line_search(problem, point, direction, noise, stays)
        moved = jnp.where(stays, point.acceleration, point.acceleration + length * direction)
        is_near = state.is_near | ~stays & ((decrement < self.smallest) | (decrement <= _LAST * floor))
        return self.measure(moved, is_near, state.num_iterations + ~stays)

    def result(self, state: _Iterate) -> _Result:
        """Return the acceleration and the number of iterations, as `minimise` does."""
        # Non-finite forces or rows have no minimiser: the start must not be returned as one.
        is_sound = self.problem.is_finite(state.point.gradient)
        finished = self.is_solved(state) & self.problem.is_resolved(state.point)
        num_iterations = jnp.where(finished, state.num_iterations, self.max_iterations + 1)
        return jnp.where(is_sound, state.point.acceleration, jnp.nan), num_iterations


class _Search(eqx.Module):
    """A bracket of the minimiser along a line: the cost falls up to `low`, and rises from `high` on."""

    # `length` is the next length to evaluate, and the minimiser once the slope was flat at the last one.
    low: _Scalar
    high: _Scalar
    length: _Scalar
    is_flat: _Truth


def _line_search(problem: Problem, point: Point, direction: _Vector, noise: _Scalar, is_done: _Truth) -> _Scalar:
    """Return the minimiser of the cost along a descent direction from a point, or a shorter step that lowers the cost."""
    # `noise` is the rounding error of the slope. The result is not used for members that are done.
    along = problem.mv(direction)
    smooth_slope = linear.dot(direction, point.inertia - problem.force)
    smooth_curvature = linear.dot(direction, problem.mass_mv(direction))
    start = linear.dot(point.gradient, direction)
    flat = jnp.maximum(_LINE_TOLERANCE * jnp.abs(start), noise)

    def improve(search: _Search) -> _Search:
        length = search.length
        x = jax.tree.map(lambda x, rate: x + length * rate, point.x, along)
        value = smooth_slope + length * smooth_curvature - _dot(problem.row_force(x), along)
        curvature = smooth_curvature + _dot(problem.hessian_product(x, along), along)
        low, high = jnp.where(value < 0, length, search.low), jnp.where(value < 0, search.high, length)
        newton = length - value / jnp.where(curvature > 0, curvature, 1.0)
        is_flat = jnp.abs(value) <= flat
        # A step from below must stay clear of the bracket's upper end, or it may alternate between two pieces for ever.
        reach = jnp.where((value < 0) & ~is_flat, high - _LINE_MARGIN * (high - low), high)
        inside = (newton >= low) & (newton <= reach)
        return _Search(low, high, jnp.where(inside, newton, 0.5 * (low + high)), is_flat)

    # The rows only add to the slope, so the inertial part alone bounds the root from above; twice that is outside.
    high = 2.0 * jnp.maximum(-start / jnp.where(smooth_curvature > 0, smooth_curvature, 1.0), 1.0)
    search = _Search(jnp.zeros_like(start), high, jnp.ones_like(start), is_done)
    search = (_until_exact if problem.layout.is_piecewise_quadratic else _until_flat)(improve, search)
    return jnp.where(search.is_flat | (search.low == 0), search.length, search.low)


def _dot(one: PyTree, other: PyTree) -> _Scalar:
    return linear.add(jax.tree.leaves(jax.tree.map(linear.dot, one, other)))


def _until_exact(improve: Callable[[_Search], _Search], search: _Search) -> _Search:
    """Improve a fixed number of times, then until every slope is flat, where the next length is the minimiser."""
    # A fixed number alone may fail: under a foot that is pressed hard a step can be a hundred times too long. Then four
    # lengths all lie beyond the minimiser, the last one raises the cost, and the iteration cycles.
    is_done, num_looks = search.is_flat, 0
    least = _LINE_STEPS if is_done.ndim else 0  # one state's own loop ends with its search
    if not device.is_cpu() and is_done.ndim:
        # A GPU spends more on starting a loop's turns than on the turns. A CPU keeps the loop: XLA would repeat each
        # unrolled step wherever the next one uses its length.
        num_looks = _LINE_STEPS
        for _ in range(num_looks):
            search = improve(search)

    def goes_on(state):
        search, count = state
        is_left = ~(search.is_flat | is_done)
        return (count < least) | ((jnp.any(is_left) if is_left.ndim else is_left) & (count < _MAX_LINE_STEPS))

    return jax.lax.while_loop(goes_on, lambda state: (improve(state[0]), state[1] + 1), (search, num_looks))[0]


def _until_flat(improve: Callable[[_Search], _Search], search: _Search) -> _Search:
    """Improve until every member of the batch has a flat slope; members with a flat slope stay."""

    def turn(state):
        search, count = state
        moved = improve(search)
        stays = search.is_flat | moved.is_flat
        length = jnp.where(stays, search.length, moved.length)
        return _Search(moved.low, moved.high, length, stays), count + 1

    def goes_on(state):
        return ~jnp.all(state[0].is_flat) & (state[1] < _MAX_LINE_STEPS)

    return jax.lax.while_loop(goes_on, turn, (search, 0))[0]
