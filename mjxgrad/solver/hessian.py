"""The system of one Newton step, (M + Jᵀ s'' J) x = v: assembled and solved in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU assembles the matrix and factors it, operation by operation along
the batch. On a GPU the matrix of many states would go to memory and back many times; there one kernel does it all.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.batched import cholesky, device, linear, on_gpu
from mjxgrad.solver.constraint import Bend, RowLayout
from mjxgrad.solver.sparse import SparseRows

_Vector = Float[Array, "nv *batch"]
_Matrix = Float[Array, "nv nv *batch"]


# Of the diagonal of a matrix: what is added where rounding has made it indefinite stays below.
_MOST_MENDED = 0.01


def solve(
    mass: _Matrix, jacobian: SparseRows, layout: RowLayout, bend: Bend, vector: _Vector
) -> tuple[_Vector, _Vector]:
    """Return (M + Jᵀ s'' J)⁻¹ vector, non-finite where that is not positive definite, and the diagonal of the matrix."""

    def step_by_step(mass, jacobian, bend, vector):
        hessian = jacobian.gram(mass, layout, bend)
        return cholesky.cholesky_solve(hessian, vector), linear.diagonal(hessian)

    return _on_device(in_one_kernel, step_by_step, mass, jacobian, layout, bend, vector)


def solve_mended(mass: _Matrix, jacobian: SparseRows, layout: RowLayout, bend: Bend, vector: _Vector) -> _Vector:
    """Return (M + Jᵀ s'' J)⁻¹ vector, also where rounding has made that indefinite.

    In single precision s'' may exceed M so far (impedance near 1) that M is lost. Then the least share of its diagonal that mends
    it, by powers of four from rounding on, is added: there less moves.
    """
    unit = jnp.eye(len(vector), dtype=vector.dtype).reshape(len(vector), -1, *(1,) * (vector.ndim - 1))

    def step_by_step(mass, jacobian, bend, vector):
        hessian = jacobian.gram(mass, layout, bend)
        diagonal = linear.diagonal(hessian)
        can_be = jnp.isfinite(jnp.stack([diagonal, vector])).all(axis=(0, 1))

        def attempt(state):
            known, is_known, share = state
            found = cholesky.cholesky_solve(hessian + unit * (share * diagonal), vector)
            is_lost = can_be & ~jnp.isfinite(found).all(axis=0)
            return jnp.where(is_known, known, found), is_known | ~is_lost, on_gpu.next_share(share)

        first = jnp.zeros_like(vector), jnp.zeros(vector.shape[1:], bool), jnp.zeros((), vector.dtype)
        return jax.lax.while_loop(lambda s: ~s[1].all() & (s[2] < _MOST_MENDED), attempt, first)[0]

    def at_once(*args):
        return in_one_kernel(*args, most_mended=_MOST_MENDED)[0]

    return _on_device(at_once, step_by_step, mass, jacobian, layout, bend, vector)


def _on_device(at_once: Callable, step_by_step: Callable, mass, jacobian, layout: RowLayout, bend, vector):
    """Solve by one kernel where there are some, else by operations."""
    if vector.ndim == 2 and on_gpu.solves(layout.num_rows, len(vector)):
        return device.by_platform(
            *(mass, jacobian, bend, vector),
            gpu=lambda mass, jacobian, bend, vector: at_once(mass, jacobian, layout, bend, vector),
            default=step_by_step,
        )
    return step_by_step(mass, jacobian, bend, vector)


def in_one_kernel(
    mass: Float[Array, "nv nv batch"],
    jacobian: SparseRows,
    layout: RowLayout,
    bend: Bend,
    vector: Float[Array, "nv batch"],
    *,
    most_mended: float = 0.0,
    interpret: bool = False,
) -> tuple[Float[Array, "nv batch"], Float[Array, "nv batch"]]:
    """Do what `solve` does, or `solve_mended` with at most so much; `interpret` runs on any device, slowly."""
    together = jacobian.together()
    factors, bent, diagonal = jacobian.bent(together, layout, bend)
    mass = mass + jnp.eye(len(vector), dtype=mass.dtype)[:, :, None] * diagonal
    return on_gpu.solve(mass, vector, together, factors, bent, most_mended=most_mended, interpret=interpret)
