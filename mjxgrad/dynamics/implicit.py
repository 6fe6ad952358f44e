r"""The derivative of the acceleration, by the implicit function theorem.

At the minimum g(a, p) = M a - f_smooth - Jᵀ f(J a - a_ref) = 0 for all parameters p (mass, forces, Jacobian, rows), so

    da = -H⁻¹ (∂g/∂p) dp,        H = ∂g/∂a = M + Jᵀ s'' J.

This is the exact derivative of the converged solve: the iterations are not differentiated, and the warm start has no part in
it. The rule is linear in dp, so the same line serves forward mode and, transposed, reverse mode. It calls the solve itself
again, so derivatives of any order nest; one more Newton step with H held fixed would be shorter, but its second derivative is
wrong, finite and silent, since there H and a do not move with p.

The acceleration is named "acceleration" for `jax.checkpoint`: a rollout that recomputes its steps keeps this vector and
spares itself the iterations.
"""

import functools

import jax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from mjxgrad.dynamics import linear, newton
from mjxgrad.dynamics.constraint import RowLayout
from mjxgrad.dynamics.newton import Problem

CHECKPOINT_NAME = "acceleration"


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve(
    layout: RowLayout,
    max_iterations: int,
    problem: Problem,
    start: Float[Array, " nv"],
    tolerance: Float[Array, ""],
) -> Float[Array, " nv"]:
    """Return the acceleration that minimises `problem`, differentiable with respect to it."""
    acceleration, _ = newton.minimise(layout, problem, start, tolerance, max_iterations)
    return acceleration


@solve.defjvp
def _solve_jvp(layout, max_iterations, primals, tangents):
    problem, start, tolerance = primals
    # Named here, where reverse mode reads it: the name inside the call is not seen from outside.
    acceleration = checkpoint_name(solve(layout, max_iterations, problem, start, tolerance), CHECKPOINT_NAME)
    _, change = jax.jvp(lambda p: p.at(layout, acceleration).gradient, (problem,), (tangents[0],))
    hessian = problem.hessian(layout, problem.at(layout, acceleration).x)
    return acceleration, -linear.solve_positive_definite(hessian, change)
