r"""The derivative of the acceleration, by the implicit function theorem.

At the minimum g(a, p) = M a - f_smooth - Jᵀ f(J a - a_ref) = 0 for all parameters p (inertias, forces, rows), so

    da = -H⁻¹ (∂g/∂p) dp,        H = ∂g/∂a = M + Jᵀ s'' J.

This is the exact derivative of the converged solve. The rule is linear in dp, so it serves forward mode and, transposed, reverse
mode. It calls the solve itself, so derivatives of any order nest. (Of one more Newton step with fixed H the second derivative is
wrong.) The residual g is evaluated without forming M and J, so that reverse mode passes through a few vectors per body and
contact. The acceleration has a name for `jax.checkpoint`, see `cholesky.SOLUTION`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.batched import device, linear
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.batched.sparse import sparsely
from mjxgrad.solver import constraint, hessian, newton
from mjxgrad.solver.constraint import RowHessian, RowLayout
from mjxgrad.solver.newton import System, Variant

_Truth = Bool[Array, ""]
_Scalar = Float[Array, ""]
_Vector = Float[Array, " nv"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve(
    layout: RowLayout, max_iterations: int, system: System, start: _Vector, tolerance: _Scalar
) -> tuple[_Vector, Int[Array, ""]]:
    """Return the result of `newton.minimise`, differentiable with respect to the system."""
    return linear.batch_last(functools.partial(newton.minimise, layout, max_iterations))(system, start, tolerance)


@solve.defjvp
def _solve_jvp(layout, max_iterations, primals, tangents):
    system, start, tolerance = primals
    # Named here, where reverse mode reads it: `jax.checkpoint` does not see names inside the call.
    acceleration, num_iterations = solve(layout, max_iterations, system, start, tolerance)
    acceleration = checkpoint_name(acceleration, SOLUTION)
    _, change = jax.jvp(lambda s: s.gradient(layout, acceleration), (system,), (tangents[0],))
    row_hessian = constraint.hessian(layout, system.rows, system.mv(acceleration) - system.rows.reference)
    no_change = np.zeros(num_iterations.shape, jax.dtypes.float0)  # JAX's tangent of an integer
    return (acceleration, num_iterations), (-solve_linearised(layout, system, row_hessian, change), no_change)


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
    """Solve two variants of a system; a CPU solves the second only where it differs from the first."""
    # Elsewhere the second solution is the first, and its derivative, which is zero, must not be used. The larger
    # number of iterations is returned.
    of_batch = linear.batch_last(functools.partial(newton.minimise, layout, max_iterations))
    if not device.is_cpu():  # a GPU solves all of them sooner than those that need it
        both, counts = jax.vmap(lambda v: of_batch(system.with_variant(v), start, tolerance))(variants)
        return both, jnp.max(counts)
    found, count = of_batch(system.with_variant(variants[0]), start, tolerance)
    given = system.with_variant(variants[1]), found, tolerance
    (other,), (more,) = sparsely(lambda _, given: of_batch(*given), differ[None], differ[None], given)
    return jnp.stack([found, jnp.where(differ, other, found)]), jnp.maximum(count, more)


@solve_both.defjvp
def _solve_both_jvp(layout, max_iterations, primals, tangents):
    system, variants, differ, start, tolerance = primals
    both, count = solve_both(layout, max_iterations, system, variants, differ, start, tolerance)
    both = checkpoint_name(both, SOLUTION)

    def residual(system: System, variants: Variant) -> Array:
        return jax.vmap(lambda variant, a: system.with_variant(variant).gradient(layout, a))(variants, both)

    def response(variant: Variant, acceleration: Array, force: Array, is_needed: Array | None = None) -> Array:
        varied = system.with_variant(variant)
        row_hessian = constraint.hessian(layout, varied.rows, varied.mv(acceleration) - varied.rows.reference)
        return solve_linearised(layout, varied, row_hessian, force, is_needed)

    _, change = jax.jvp(residual, (system, variants), (tangents[0], tangents[1]))
    if device.is_cpu():
        moved = jnp.stack([response(variants[k], both[k], change[k], one) for k, one in enumerate((None, differ))])
    else:
        moved = jax.vmap(response)(variants, both, change)
    no_change = np.zeros(count.shape, jax.dtypes.float0)
    return (both, count), (-moved, no_change)


def solve_linearised(
    layout: RowLayout, system: System, row_hessian: RowHessian, force: _Vector, is_needed: _Truth | None = None
) -> _Vector:
    """Return (M + Jᵀ S J)⁻¹ force for a curvature S of the rows; differentiable, and linear in the force."""
    # The result is zero where it is not needed.

    def apply(x: _Vector) -> _Vector:
        return system.inertia.apply(x) + system.rmv(constraint.hessian_product(layout, row_hessian, system.mv(x)))

    def run(system, row_hessian, force):
        problem = system.problem(layout)
        return hessian.solve(problem.mass, problem.jacobian, layout, row_hessian, force, hessian.MAX_SHIFT)[0]

    def invert(_, force):
        given = system, row_hessian, force
        if is_needed is None:
            return linear.batch_last(run)(*given)
        return sparsely(lambda _, given: linear.batch_last(run)(*given), is_needed[None], is_needed[None], given)[0]

    return jax.lax.custom_linear_solve(apply, force, invert, symmetric=True)
