r"""The minimiser over accelerations: Newton's method with an exact line search.

Minimise over a

    ½ (a - a_s)ᵀ M (a - a_s) + Σ_i s_i(J_i a - a_ref,i),

with the laws s_i of `constraint`. The problem is strictly convex, so the starting point affects the time taken and not the
answer. Along a search line the derivative of the cost is monotone and, but for elliptic rows and rows under noise, piecewise
linear: Newton's method on it, kept inside a bracket, ends at the exact minimiser after as many steps as it crosses pieces. (The
minimiser can also be read off the values at all breakpoints at once, without iterating; that takes rows² work and was
three times slower at 24 rows.) Elliptic cones need the loop: near the apex their curvature belongs to one side only, so that
the minimiser may lie at a thousandth of the step that it promises, and what is not known to lower the cost may raise it.

The solve ends by the Newton decrement, gᵀ H⁻¹ g: the step left to go, in the norm of kinetic energy. It does not depend on the
units of joints, nor on how light one body is beside another.

The same steps serve a batch, operation by operation, and one state in a GPU's program; what differs is a `Problem`.

The gradient is formed afresh in each iteration rather than updated along the line: in single precision an update keeps
the rounding errors of a poor start.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, Int, PyTree

from mjxgrad.batched import device, linear, on_gpu
from mjxgrad.bodies.kinematics import Inertia
from mjxgrad.solver import constraint, hessian
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.jacobian import JoinedRows, RowMap
from mjxgrad.solver.sparse import SparseRows, num_together

_Vector = Float[Array, "nv *batch"]
_OfRows = PyTree[Float[Array, "_ *batch"]]
_Scalar = Float[Array, "*batch"]
_Truth = Bool[Array, "*batch"]
_Result = tuple[_Vector, Int[Array, "*batch"]]

# Newton steps along the search line that all of a batch take: to ask whether they are needed takes as long as they do.
_LINE_STEPS = 4
# Bound of the steps after that, and of those for elliptic cones. Halving alone gets to 1e-12 of the bracket; 25 were seen.
_MAX_LINE_STEPS = 40
# A line search has converged where the slope has fallen to this part of its value at the start. On 512 stiff elliptic
# problems 0.1, 0.01 and 0.001 took the same number of outer iterations.
_LINE_TOLERANCE = 1e-2
# A look this near, as part of the bracket, to where the slope was seen to be too great is one back to there.
_LINE_MARGIN = 0.01
# A batch is iterated as a whole until this part of it is left: of 256 states of two bodies that slide about the slowest takes 5.0
# iterations in the mean over steps, the average one 1.3. It is a second loop to compile, which smaller batches are not worth: a
# fifth more for the gradient of a hopper, a third for that of elliptic cones.
_SHARE = 8
_LEAST_BATCH = 256
# Sums of a few terms are known to about this many units of rounding.
_ROUNDING = 4
# The estimate of rounding leaves out what cancels within M a and J a. On a humanoid in single precision the decrement goes from
# 10⁷ times it in one iteration to 5 to 70 times it, and then stays there, up and down, for as long as one lets it. From this
# multiple on the step is the last one: taken, what it leaves is rounding.
_LAST = 1e3
# A solve that rounding ends counts as none where it leaves this part of the acceleration unknown.
_RESOLVED = 1e-3


class Variant(eqx.Module):
    """In what a second solve of the same state may differ. For two solves arrays have a leading axis of two.

    Attributes:
        weight: of the rows.
        reference: a_ref of the rows; None for that of the system.
        parts: of J, where contacts may push from another side.
    """

    weight: Float[Array, "*two rows"]
    reference: Float[Array, "*two rows"] | None = None
    parts: tuple[RowMap | None, ...] | None = None

    def __getitem__(self, number: int) -> "Variant":
        """Return that of one solve."""
        return jax.tree.map(lambda x: x[number], self)


class System(eqx.Module):
    """What determines the acceleration of one state, as its derivative wants it.

    Attributes:
        inertia: M.
        force: f_smooth, all forces but those of constraints (N or N m).
        map: J, also of rows that are inactive.
        is_active: which rows are not.
        rows: parameters of the rows' laws.
    """

    inertia: Inertia
    force: _Vector
    map: JoinedRows
    is_active: Bool[Array, "rows *batch"]
    rows: Rows

    def rates(self, velocity: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Return J v, zero for inactive rows."""
        return jnp.where(self.is_active, self.map.rates(velocity), 0.0)

    def pull(self, force: Float[Array, " rows"]) -> Float[Array, " nv"]:
        """Return Jᵀ f."""
        return self.map.pull(jnp.where(self.is_active, force, 0.0))

    def row_force(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Return the constraint forces at an acceleration."""
        return constraint.force(layout, self.rows, self.rates(acceleration) - self.rows.reference)

    def gradient(self, layout: RowLayout, acceleration: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Return M a - f_smooth - Jᵀ f, zero at the solution."""
        pull = self.pull(self.row_force(layout, acceleration))
        return self.inertia.apply(acceleration) - self.force - pull

    def varied(self, variant: Variant) -> "System":
        """Return the same with what is different in one solve."""
        reference = self.rows.reference if variant.reference is None else variant.reference
        rows = eqx.tree_at(lambda rows: (rows.weight, rows.reference), self.rows, (variant.weight, reference))
        return dataclasses.replace(self, rows=rows, map=self.map.with_parts(variant.parts))

    def problem(self, layout: RowLayout) -> "Entries":
        """Return the same with entries; arrays may carry the batch as trailing axes here."""
        jacobian = SparseRows.of(self.map, self.is_active, len(self.force))
        return Entries(self.force, self.rows, self.inertia.matrix, jacobian, layout)  # pyright: ignore[reportCallIssue]


class Problem(eqx.Module):
    """What is minimised. Arrays may carry the batch as trailing axes, or belong to the one state of a GPU's program.

    What belongs to the rows is one array, or in such a program several.
    """

    force: _Vector
    reference: eqx.AbstractVar[_OfRows]
    weight: eqx.AbstractVar[_OfRows]

    @abc.abstractmethod
    def weigh(self, acceleration: _Vector) -> _Vector:
        """Return M a."""

    @abc.abstractmethod
    def rates(self, acceleration: _Vector) -> _OfRows:
        """Return J a."""

    @abc.abstractmethod
    def pull(self, force: _OfRows) -> _Vector:
        """Return Jᵀ f."""

    @abc.abstractmethod
    def push(self, x: _OfRows) -> _OfRows:
        """Return the forces of the rows."""

    @abc.abstractmethod
    def bent(self, x: _OfRows, along: _OfRows) -> _OfRows:
        """Return the second derivative of the cost by x, times a vector."""

    @abc.abstractmethod
    def newton(self, point: "Point") -> tuple[_Vector, _Vector]:
        """Return H⁻¹ times the gradient, not finite where H is not positive definite, and the diagonal of H."""

    @property
    @abc.abstractmethod
    def diagonal(self) -> _Vector:
        """The diagonal of M, positive."""

    @property
    @abc.abstractmethod
    def is_piecewise_quadratic(self) -> bool:
        """Whether the cost along a line is."""

    @abc.abstractmethod
    def is_finite(self, vector: _Vector) -> _Truth:
        """Return whether all of a vector is finite."""

    def at(self, acceleration: _Vector) -> "Point":
        """Evaluate the problem at an acceleration."""
        x = jax.tree.map(jnp.subtract, self.rates(acceleration), self.reference)
        row_force = self.push(x)
        inertia, pull = self.weigh(acceleration), self.pull(row_force)
        return Point(acceleration, x, row_force, inertia, pull, inertia - self.force - pull)

    def rounding(self, point: "Point") -> _Scalar:
        """Return the size that the decrement at a point has by rounding alone.

        In its norm rows may be as stiff as they like: an error of their x by e adds Jᵀ D e to the gradient, which is large,
        and at most e D e to the decrement.
        """

        def energy(x: Array, reference: Array, force: Array, weight: Array) -> Array:
            size = jnp.abs(x) + jnp.abs(reference)
            return linear.dot(jnp.where(force != 0, weight, 0.0) * size, size)

        rows = jax.tree.map(energy, point.x, self.reference, point.row_force, self.weight)
        terms = linear.add([linear.dot(point.acceleration, point.inertia), *jax.tree.leaves(rows)])
        return (_ROUNDING * jnp.finfo(terms.dtype).eps) ** 2 * terms

    def is_resolved(self, point: "Point") -> _Truth:
        """Return whether rounding leaves less than a thousandth of the acceleration unknown.

        In single precision it leaves more where rows weigh 10⁷ times the bodies: the edges of a pyramid do, as 1/μ², at little
        friction.
        """
        own, free = linear.dot(point.acceleration, point.inertia), linear.dot(self.force / self.diagonal, self.force)
        return self.rounding(point) <= _RESOLVED**2 * (own + free)


class Entries(Problem):
    """A problem whose M and J are entries."""

    rows: Rows
    mass: Float[Array, "nv nv *batch"]
    jacobian: SparseRows
    layout: RowLayout = eqx.field(static=True)

    def weigh(self, acceleration):
        return linear.matvec(self.mass, acceleration)

    def rates(self, acceleration):
        return self.jacobian.matvec(acceleration)

    def pull(self, force):
        return self.jacobian.rmatvec(force)

    def push(self, x):
        return constraint.force(self.layout, self.rows, x)

    def bent(self, x, along):
        return constraint.curvature_product(self.layout, self.rows, x, along[:, None])[:, 0]

    def newton(self, point):
        bend = constraint.bend(self.layout, self.rows, point.x)
        return hessian.solve(self.mass, self.jacobian, self.layout, bend, point.gradient)

    @property
    def reference(self):
        return self.rows.reference

    @property
    def weight(self):
        return self.rows.weight

    @property
    def diagonal(self):
        return jnp.maximum(linear.diagonal(self.mass), mujoco.mjMINVAL)

    @property
    def is_piecewise_quadratic(self):
        return self.layout.is_piecewise_quadratic

    def is_finite(self, vector):
        return jnp.all(jnp.isfinite(vector), axis=0)


_Parts = tuple[Float[Array, " height"], *tuple[Float[Array, " width"], ...]]


class _InRegisters(Problem):
    """A problem whose M and J a GPU's program keeps, and whose rows stand for themselves: their force is -D x between bounds.

    What belongs to the rows comes in parts: of those of J, and of limits and the like, which see one joint velocity each, by
    that joint velocity. They would double J, which has a power of two as number of rows.
    """

    reference: _Parts
    weight: _Parts
    mass: Float[Array, "width width"]
    jacobian: Float[Array, "height width"]
    signs: tuple[Float[Array, " width"], ...]  # of the rows that see one joint velocity
    bounds: tuple[_Parts, _Parts]
    on_diagonal: _Vector
    refs: tuple[Any, Any]  # M and J in memory
    size: int = eqx.field(static=True)

    def weigh(self, acceleration):
        return (self.mass * acceleration[:, None]).sum(axis=0)  # by symmetry; along a row it takes more registers

    def rates(self, acceleration):
        return (self.jacobian * acceleration[None]).sum(axis=1), *(sign * acceleration for sign in self.signs)

    def pull(self, force):
        first, *others = force
        own = (sign * other for sign, other in zip(self.signs, others, strict=True))
        return linear.add([(self.jacobian * first[:, None]).sum(axis=0), *own])

    def push(self, x):
        def push(x: Array, weight: Array, low: Array, high: Array) -> Array:
            force = -weight * x
            return jnp.where(force < low, low, jnp.where(force > high, high, force))

        return jax.tree.map(push, x, self.weight, *self.bounds)

    def curvature(self, x: _Parts) -> _Parts:
        """Return the second derivative of the cost by x."""

        def curvature(x: Array, weight: Array, low: Array, high: Array) -> Array:
            force = -weight * x
            return jnp.where((force > low) & (force < high), weight, 0.0)

        return jax.tree.map(curvature, x, self.weight, *self.bounds)

    def bent(self, x, along):
        return jax.tree.map(jnp.multiply, self.curvature(x), along)

    def newton(self, point):
        mass, jacobian = self.refs
        first, *others = self.curvature(point.x)
        matrix = on_gpu.add_rows(on_gpu.blocks(mass), jacobian, first, jacobian)
        if others:
            own = linear.add(sign**2 * other for sign, other in zip(self.signs, others, strict=True))
            matrix = on_gpu.add_to_diagonal(matrix, own)
        return on_gpu.solve_blocks(matrix, point.gradient, self.size), on_gpu.diagonal(matrix)

    @property
    def diagonal(self):
        return self.on_diagonal

    @property
    def is_piecewise_quadratic(self):
        return True

    def is_finite(self, vector):
        return on_gpu.is_finite(vector)


class Point(eqx.Module):
    """A problem evaluated at one acceleration a: x = J a - a_ref, f(x), M a, Jᵀ f, and M a - f_smooth - Jᵀ f."""

    acceleration: _Vector
    x: _OfRows
    row_force: _OfRows
    inertia: _Vector
    pull: _Vector
    gradient: _Vector

    def rounding(self) -> _Vector:
        """Return the size that the gradient has by rounding alone."""
        terms = jnp.abs(self.inertia) + jnp.abs(self.pull)
        return _ROUNDING * jnp.finfo(terms.dtype).eps * terms


class _Iterate(eqx.Module):
    """The loop's carry.

    The question whether it is done is asked of the carry: a carried array is computed once and stored, while XLA would write
    the sums that form it out again wherever they are used. (The Hessian needs no such help since its blocks are added in
    place; carried along, it was one more than the iterations use.)
    """

    point: Point
    is_near: _Truth
    num_iterations: Int[Array, "*batch"]


def minimise(layout: RowLayout, max_iterations: int, system: System, start: _Vector, tolerance: _Scalar) -> _Result:
    """Return the acceleration of least cost, NaN where the problem is not finite, and the number of iterations that it took.

    It goes on until every member of the batch is done; those that are do not move any more. Once an eighth of them are left,
    they are taken out and finished among themselves. A start that is not finite is replaced by zero.

    The tolerance is on the step that is left to go, in the norm of kinetic energy over the trace of the mass matrix: of a
    single body the root mean square error of its acceleration (m/s²). The search also ends where the step is rounding. The
    number is one more than `max_iterations` where these, or the digits of this precision, were too few.
    """
    start = jnp.where(jnp.all(jnp.isfinite(start), axis=0), start, jnp.zeros_like(start))
    if start.ndim == 2 and layout.is_piecewise_quadratic and on_gpu.holds(num_together(system.map), len(start)):
        ways = (functools.partial(way, layout, max_iterations) for way in (in_one_kernel, _in_turns))
        return device.by_platform(system, start, tolerance, gpu=next(ways), default=next(ways))
    return _in_turns(layout, max_iterations, system, start, tolerance)


def in_one_kernel(
    layout: RowLayout,
    max_iterations: int,
    system: System,
    start: Float[Array, "nv batch"],
    tolerance: Float[Array, " batch"],
    *,
    interpret: bool = False,
) -> _Result:
    """Do what `minimise` does for rows that stand for themselves; `interpret` runs on any device, slowly."""
    problem, size = system.problem(layout), len(start)
    jacobian, rows = problem.jacobian, problem.rows
    together = jacobian.together()
    apart = (jacobian.apart(x) for x in (rows.reference, rows.weight, *constraint.bounds(layout, rows)))
    by_row, structure = jax.tree.flatten((tuple(apart), jacobian.signs()))
    smallest = tolerance**2 * linear.add(problem.diagonal)

    def kernel(mass, jacobian, force, diagonal, start, smallest, *refs):
        *refs, acceleration, num_iterations = refs
        (reference, weight, *bounds), signs = jax.tree.unflatten(structure, [ref[...] for ref in refs])
        parts = (reference, weight, mass[...], jacobian[...], signs, tuple(bounds))
        problem = _InRegisters(force[...], *parts, diagonal[...], (mass, jacobian), size)
        solver = _Solver(problem, smallest[...], max_iterations)
        first = solver.measure(start[...], jnp.array(False), jnp.int32(0))
        acceleration[...], num_iterations[0] = solver.result(solver.run(first, 0))

    mass = on_gpu.filled(problem.mass)
    diagonal = jnp.maximum(linear.diagonal(mass), mujoco.mjMINVAL)
    width, height = on_gpu.padded(size), on_gpu.padded(len(together))
    found, count = on_gpu.run(
        kernel,
        (mass, together, problem.force, diagonal, start, smallest, *by_row),
        ((start.dtype, width), (jnp.int32, 1)),
        width * height,
        interpret=interpret,
    )
    return found[:size], count[0]


def _in_turns(layout: RowLayout, max_iterations: int, system: System, start: _Vector, tolerance: _Scalar) -> _Result:
    """Do what `minimise` does, each operation for the whole batch."""
    batch, problem = start.shape[1:], system.problem(layout)
    solver = _Solver(problem, tolerance**2 * linear.add(problem.diagonal), max_iterations)
    first = solver.measure(start, jnp.zeros(batch, bool), jnp.zeros(batch, jnp.int32))
    # On a CPU, where it was measured.
    splits = device.is_cpu() and bool(batch) and batch[0] >= _LEAST_BATCH
    num_last = batch[0] // _SHARE if splits else 0
    state = solver.run(first, num_last)
    result = solver.result(state)
    if not num_last:
        return result
    is_left = ~solver.is_done(state)
    return jax.lax.cond(jnp.any(is_left), lambda: _finish(solver, state, is_left, result, num_last), lambda: result)


def _finish(solver: "_Solver", state: _Iterate, is_left: Bool[Array, " batch"], result: _Result, count: int) -> _Result:
    """Finish the few that are left among themselves: else all wait for the slowest, and compute what nobody needs.

    There are places for `count`, no fewer than are left.
    """
    few = linear.Few(is_left, count)
    part = few.take(solver)
    # Evaluated anew: that takes less than it takes to gather it.
    began = part.measure(*few.take((state.point.acceleration, state.is_near, state.num_iterations)))
    return few.put(result, part.result(part.run(began, 0)))


class _Solver(eqx.Module):
    """The iteration for a batch of problems; `smallest` is the decrement at which a solve has converged."""

    problem: Problem
    smallest: _Scalar
    max_iterations: int = eqx.field(static=True)

    def measure(self, acceleration: _Vector, is_near: _Truth, num_iterations: Int[Array, "*batch"]) -> _Iterate:
        return _Iterate(self.problem.at(acceleration), is_near, num_iterations)

    def is_solved(self, state: _Iterate) -> _Truth:
        """Return who has converged."""
        # Known without the factor of H: as H exceeds M, no less than the decrement but for what M couples.
        diagonal = self.problem.diagonal
        energy, floor = (linear.dot(v / diagonal, v) for v in (state.point.gradient, state.point.rounding()))
        return state.is_near | (energy < self.smallest) | (energy <= floor)

    def is_done(self, state: _Iterate) -> _Truth:
        """Return who does not move any more."""
        is_broken = ~self.problem.is_finite(state.point.gradient)
        return self.is_solved(state) | is_broken | (state.num_iterations >= self.max_iterations)

    def run(self, state: _Iterate, num_left: int) -> _Iterate:
        """Iterate until no more than so many are left."""

        def goes_on(state: _Iterate) -> Bool[Array, ""]:
            goes = ~self.is_done(state)
            return jnp.sum(goes) > num_left if num_left else jnp.any(goes)

        if state.is_near.ndim:
            return jax.lax.while_loop(goes_on, lambda state: self.iterate(state, self.is_done(state)), state)

        # In a program the question takes registers if asked of the carry.
        def turn(carry: tuple[_Iterate, _Truth]) -> tuple[_Iterate, _Truth]:
            state = self.iterate(carry[0], ~carry[1])
            return state, ~self.is_done(state)

        return jax.lax.while_loop(lambda carry: carry[1], turn, (state, ~self.is_done(state)))[0]

    def iterate(self, state: _Iterate, stays: _Truth) -> _Iterate:
        """Take one step of Newton's method, those that stay excepted."""
        problem, point = self.problem, state.point
        solution, diagonal = problem.newton(point)
        newton = -solution
        # Where the factorisation fails in this precision, the gradient scaled by the diagonal.
        scaled = -point.gradient / diagonal
        direction = jnp.where(problem.is_finite(newton), newton, scaled)
        decrement, floor = -linear.dot(point.gradient, direction), problem.rounding(point)
        noise = jnp.sqrt(jnp.maximum(decrement, 0.0) * floor)
        length = _line_search(problem, point, direction, noise, stays)
        moved = jnp.where(stays, point.acceleration, point.acceleration + length * direction)
        is_near = state.is_near | ~stays & ((decrement < self.smallest) | (decrement <= _LAST * floor))
        return self.measure(moved, is_near, state.num_iterations + ~stays)

    def result(self, state: _Iterate) -> _Result:
        """Return what `minimise` does."""
        # Non-finite forces or rows have no minimiser: the start must not pass for one.
        is_sound = self.problem.is_finite(state.point.gradient)
        finished = self.is_solved(state) & self.problem.is_resolved(state.point)
        num_iterations = jnp.where(finished, state.num_iterations, self.max_iterations + 1)
        return jnp.where(is_sound, state.point.acceleration, jnp.nan), num_iterations


class _Search(eqx.Module):
    """Where the minimiser along a line is known to be: between `low`, up to which the cost has only fallen, and `high`.

    `length` is where to look next; once the slope is flat, as it was at the last look, it is the minimiser.
    """

    low: _Scalar
    high: _Scalar
    length: _Scalar
    is_flat: _Truth


def _line_search(problem: Problem, point: Point, direction: _Vector, noise: _Scalar, is_done: _Truth) -> _Scalar:
    """Return the minimiser of the cost along a descent direction from a point, or a shorter step that lowers it.

    `noise` is the size of the slope by rounding alone; for those who are done the answer does not matter.
    """
    along = problem.rates(direction)
    smooth_slope = linear.dot(direction, point.inertia - problem.force)
    smooth_curvature = linear.dot(direction, problem.weigh(direction))
    start = linear.dot(point.gradient, direction)
    flat = jnp.maximum(_LINE_TOLERANCE * jnp.abs(start), noise)

    def improve(search: _Search) -> _Search:
        length = search.length
        x = jax.tree.map(lambda x, rate: x + length * rate, point.x, along)
        value = smooth_slope + length * smooth_curvature - _dot(problem.push(x), along)
        curvature = smooth_curvature + _dot(problem.bent(x, along), along)
        low, high = jnp.where(value < 0, length, search.low), jnp.where(value < 0, search.high, length)
        newton = length - value / jnp.where(curvature > 0, curvature, 1.0)
        is_flat = jnp.abs(value) <= flat
        # From below it must not go back to where it came from, or it may go to and fro for ever between two pieces.
        reach = jnp.where((value < 0) & ~is_flat, high - _LINE_MARGIN * (high - low), high)
        inside = (newton >= low) & (newton <= reach)
        return _Search(low, high, jnp.where(inside, newton, 0.5 * (low + high)), is_flat)

    # The inertial part alone bounds the root from above, as the rows only add to the slope: twice that was not looked at.
    high = 2.0 * jnp.maximum(-start / jnp.where(smooth_curvature > 0, smooth_curvature, 1.0), 1.0)
    search = _Search(jnp.zeros_like(start), high, jnp.ones_like(start), is_done)
    search = (_until_exact if problem.is_piecewise_quadratic else _until_flat)(improve, search)
    return jnp.where(search.is_flat | (search.low == 0), search.length, search.low)


def _dot(one: PyTree, other: PyTree) -> _Scalar:
    return linear.add(jax.tree.leaves(jax.tree.map(linear.dot, one, other)))


def _until_exact(improve: Callable[[_Search], _Search], search: _Search) -> _Search:
    """Improve a few times, and on until every slope is flat, at which the next look is the minimiser.

    Without the second part the iteration may go around in a circle: where a step is a hundred times too long, as a foot that is
    pressed hard may make it, four looks are all beyond the minimiser, and the last of them raises the cost.
    """
    is_done, num_looks = search.is_flat, 0
    least = _LINE_STEPS if is_done.ndim else 0  # one state's own loop ends with its search
    if not device.is_cpu() and is_done.ndim:
        # A GPU spends more on starting the loop's turns than on the turns themselves. A CPU keeps the loop: unrolled, XLA
        # writes each step out again wherever the next one uses its length.
        num_looks = _LINE_STEPS
        for _ in range(num_looks):
            search = improve(search)

    def goes_on(state):
        search, count = state
        is_left = ~(search.is_flat | is_done)
        return (count < least) | ((jnp.any(is_left) if is_left.ndim else is_left) & (count < _MAX_LINE_STEPS))

    return jax.lax.while_loop(goes_on, lambda state: (improve(state[0]), state[1] + 1), (search, num_looks))[0]


def _until_flat(improve: Callable[[_Search], _Search], search: _Search) -> _Search:
    """Improve until every member of the batch has a flat slope; those that have one stay."""

    def turn(state):
        search, count = state
        moved = improve(search)
        stays = search.is_flat | moved.is_flat
        length = jnp.where(stays, search.length, moved.length)
        return _Search(moved.low, moved.high, length, stays), count + 1

    def goes_on(state):
        return ~jnp.all(state[0].is_flat) & (state[1] < _MAX_LINE_STEPS)

    return jax.lax.while_loop(goes_on, turn, (search, 0))[0]
