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

The acceleration is named for `jax.checkpoint`, see `cholesky.SOLUTION`: a rollout that recomputes its steps keeps this vector and
spares itself the iterations.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.batched import device, linear
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.solver import constraint, hessian, newton
from mjxgrad.solver.constraint import Bend, RowLayout
from mjxgrad.solver.newton import System, Variant

_Truth = Bool[Array, ""]
_Scalar = Float[Array, ""]
_Vector = Float[Array, " nv"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve(
    layout: RowLayout, max_iterations: int, system: System, start: _Vector, tolerance: _Scalar
) -> tuple[_Vector, Int[Array, ""]]:
    """Return what `newton.minimise` does, differentiable with respect to the system."""
    return linear.batch_last(functools.partial(newton.minimise, layout, max_iterations))(system, start, tolerance)


@solve.defjvp
def _solve_jvp(layout, max_iterations, primals, tangents):
    system, start, tolerance = primals
    # Named here, where reverse mode reads it: a name inside the call is not seen from outside.
    acceleration, num_iterations = solve(layout, max_iterations, system, start, tolerance)
    acceleration = checkpoint_name(acceleration, SOLUTION)
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
    differ: _Truth,
    start: _Vector,
    tolerance: _Scalar,
) -> tuple[Float[Array, "2 nv"], Int[Array, ""]]:
    """Solve in two variants, on CPUs the second time only where they differ.

    Where they do not, the second solution is the first one, and its derivative must not count, for it is zero. The number of
    iterations is the larger one.
    """
    minimise = functools.partial(newton.minimise, layout, max_iterations)

    def second(system, differ, start, tolerance):
        none = jnp.zeros(differ.shape, jnp.int32)
        return linear.on_few(minimise, differ, (start, none), system, start, tolerance)

    if not _takes_few():
        both, counts = jax.vmap(lambda v: linear.batch_last(minimise)(system.varied(v), start, tolerance))(variants)
        return both, jnp.max(counts)
    found, count = linear.batch_last(minimise)(system.varied(variants[0]), start, tolerance)
    other, more = linear.batch_last(second)(system.varied(variants[1]), differ, found, tolerance)
    return jnp.stack([found, other]), jnp.maximum(count, more)


@solve_both.defjvp
def _solve_both_jvp(layout, max_iterations, primals, tangents):
    system, variants, differ, start, tolerance = primals
    both, count = solve_both(layout, max_iterations, system, variants, differ, start, tolerance)
    both = checkpoint_name(both, SOLUTION)

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
    return device.is_cpu()


def respond(layout: RowLayout, system: System, bend: Bend, force: _Vector, is_needed: _Truth | None = None) -> _Vector:
    """Return (M + Jᵀ S J)⁻¹ force for some curvature S of the rows; differentiable, and linear in the force.

    Where it is not needed it is zero.
    """

    def apply(x: _Vector) -> _Vector:
        return system.inertia.apply(x) + system.pull(constraint.bend_product(layout, bend, system.rates(x)))

    def run(system, bend, force):
        problem = system.problem(layout)
        return hessian.solve_mended(problem.mass, problem.jacobian, layout, bend, force)

    def run_where(system, bend, force, is_needed):
        return linear.on_few(run, is_needed, jnp.zeros_like(force), system, bend, force)

    def invert(_, force):
        if is_needed is None:
            return linear.batch_last(run)(system, bend, force)
        return linear.batch_last(run_where)(system, bend, force, is_needed)

    return jax.lax.custom_linear_solve(apply, force, invert, symmetric=True)
