r"""The derivative of the acceleration, by the implicit function theorem.

At the minimum g(a, p) = M a - f_smooth - Jᵀ f(J a - a_ref) = 0 for all parameters p (inertias, forces, rows), so

    da = -H⁻¹ (∂g/∂p) dp,        H = ∂g/∂a = M + Jᵀ s'' J.

This is the exact derivative of the converged solve: the iterations are not differentiated, and the warm start has no part in
it. The rule is linear in dp, so the same line serves forward mode and, transposed, reverse mode. It calls the solve itself
again, so derivatives of any order nest; one more Newton step with H held fixed would be shorter, but its second derivative is
wrong, finite and silent, since there H and a do not move with p.

The residual g is evaluated without M and J: M a is the force that accelerates the bodies, J a the acceleration of one body
against another. So reverse mode passes through some vectors per body and contact, where the derivative of a Jacobian would be a
Jacobian. Only the solve and the factor of H need entries, and both are formed with the batch as trailing axis.

The acceleration is named "acceleration" for `jax.checkpoint`: a rollout that recomputes its steps keeps this vector and
spares itself the iterations.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.dynamics import cholesky, constraint, linear, newton
from mjxgrad.dynamics.constraint import Bend, RowLayout, Rows
from mjxgrad.dynamics.inertia import Inertia
from mjxgrad.dynamics.jacobian import JoinedRows, RowMap
from mjxgrad.dynamics.newton import Problem
from mjxgrad.dynamics.sparse import SparseRows

CHECKPOINT_NAME = "acceleration"


class Variant(eqx.Module):
    """In what a second solve of the same state may differ. For two solves arrays have a leading axis of two.

    Attributes:
        weight: of the rows.
        reference: a_ref of the rows; None for that of the system.
        parts: of J, where contacts may push from another side; None where they never do.
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
    force: Float[Array, "nv *batch"]
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

    def problem(self) -> Problem:
        """Return the same with entries; arrays may carry the batch as trailing axes here."""
        jacobian = SparseRows.of(self.map, self.is_active, len(self.force))
        return Problem(self.inertia.matrix, self.force, jacobian, self.rows)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve(
    layout: RowLayout,
    max_iterations: int,
    system: System,
    start: Float[Array, " nv"],
    tolerance: Float[Array, ""],
) -> tuple[Float[Array, " nv"], Int[Array, ""]]:
    """Return the acceleration at which the forces of a system are in balance, differentiable with respect to it.

    Returns:
        The acceleration, and the number of iterations that it took: one more than `max_iterations` where these, or
        the digits of this precision, were too few.
    """

    def run(system, start, tolerance):
        return newton.minimise(layout, system.problem(), start, tolerance, max_iterations)

    return linear.batch_last(run)(system, start, tolerance)


@solve.defjvp
def _solve_jvp(layout, max_iterations, primals, tangents):
    system, start, tolerance = primals
    # Named here, where reverse mode reads it: a name inside the call is not seen from outside.
    acceleration, num_iterations = solve(layout, max_iterations, system, start, tolerance)
    acceleration = checkpoint_name(acceleration, CHECKPOINT_NAME)
    _, change = jax.jvp(lambda s: s.gradient(layout, acceleration), (system,), (tangents[0],))
    bend = constraint.bend(layout, system.rows, system.rates(acceleration) - system.rows.reference)
    no_change = np.zeros(num_iterations.shape, jax.dtypes.float0)  # what JAX takes for the tangent of an integer
    return (acceleration, num_iterations), (-respond(layout, system, bend, change), no_change)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve_both(
    layout: RowLayout,
    max_iterations: int,
    system: System,
    variants: Variant,
    differ: Bool[Array, ""],
    start: Float[Array, " nv"],
    tolerance: Float[Array, ""],
) -> tuple[Float[Array, "2 nv"], Int[Array, ""]]:
    """Solve in two variants, on CPUs the second time only where they differ.

    Where they do not, the second solution is the first one, and its derivative must not count, for it is zero.

    Returns:
        Both accelerations, and the larger number of iterations, as `solve` has it.
    """

    def first(system, variant, start, tolerance):
        return newton.minimise(layout, system.varied(variant).problem(), start, tolerance, max_iterations)

    def second(system, variant, differ, start, tolerance):
        none = jnp.zeros(differ.shape, jnp.int32)
        return linear.on_few(first, differ, (start, none), system, variant, start, tolerance)

    if not _takes_few():
        both, counts = jax.vmap(lambda variant: linear.batch_last(first)(system, variant, start, tolerance))(variants)
        return both, jnp.max(counts)
    found, count = linear.batch_last(first)(system, variants[0], start, tolerance)
    other, more = linear.batch_last(second)(system, variants[1], differ, found, tolerance)
    return jnp.stack([found, other]), jnp.maximum(count, more)


@solve_both.defjvp
def _solve_both_jvp(layout, max_iterations, primals, tangents):
    system, variants, differ, start, tolerance = primals
    both, count = solve_both(layout, max_iterations, system, variants, differ, start, tolerance)
    both = checkpoint_name(both, CHECKPOINT_NAME)

    def residual(system: System, variants: Variant) -> Array:
        return jax.vmap(lambda variant, a: system.varied(variant).gradient(layout, a))(variants, both)

    def response(variant: Variant, acceleration: Array, force: Array, is_needed: Array | None = None) -> Array:
        varied = system.varied(variant)
        bend = constraint.bend(layout, varied.rows, varied.rates(acceleration) - varied.rows.reference)
        return respond(layout, varied, bend, force, is_needed)

    _, change = jax.jvp(residual, (system, variants), (tangents[0], tangents[1]))
    if _takes_few():
        moved = [response(variants[k], both[k], change[k], needed) for k, needed in enumerate((None, differ))]
        moved = -jnp.stack(moved)
    else:
        moved = -jax.vmap(response)(variants, both, change)
    no_change = np.zeros(count.shape, jax.dtypes.float0)
    return (both, count), (moved, no_change)


def _takes_few() -> bool:
    """Whether it pays to solve again for those few of a batch that need it: a GPU is done sooner with all of them at once."""
    return jax.default_backend() == "cpu"


def respond(
    layout: RowLayout,
    system: System,
    bend: Bend,
    force: Float[Array, " nv"],
    is_needed: Bool[Array, ""] | None = None,
) -> Float[Array, " nv"]:
    """Return (M + Jᵀ S J)⁻¹ force for some curvature S of the rows; differentiable, and linear in the force.

    Where it is not needed it is zero.
    """

    def apply(x: Float[Array, " nv"]) -> Float[Array, " nv"]:
        return system.inertia.apply(x) + system.pull(constraint.bend_product(layout, bend, system.rates(x)))

    def run(system, bend, force):
        problem = system.problem()
        return cholesky.cholesky_solve(problem.jacobian.gram(problem.mass, layout, bend), force)

    def run_where(system, bend, force, is_needed):
        return linear.on_few(run, is_needed, jnp.zeros_like(force), system, bend, force)

    def invert(_, force):
        if is_needed is None:
            return linear.batch_last(run)(system, bend, force)
        return linear.batch_last(run_where)(system, bend, force, is_needed)

    return jax.lax.custom_linear_solve(apply, force, invert, symmetric=True)
