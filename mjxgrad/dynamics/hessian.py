"""The system of one Newton step, (M + Jᵀ s'' J) x = v: assembled and solved in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU assembles the matrix and factors it, operation by operation along
the batch. On a GPU the matrix of many states would go to memory and back many times; there one kernel does it all.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.dynamics import cholesky, linear, on_gpu
from mjxgrad.dynamics.constraint import Bend, RowLayout
from mjxgrad.dynamics.sparse import SparseRows

_Vector = Float[Array, "nv *batch"]
_Matrix = Float[Array, "nv nv *batch"]


def solve(
    mass: _Matrix, jacobian: SparseRows, layout: RowLayout, bend: Bend, vector: _Vector
) -> tuple[_Vector, _Vector]:
    """Return (M + Jᵀ s'' J)⁻¹ vector, non-finite where that is not positive definite, and the diagonal of the matrix."""

    def step_by_step(mass, jacobian, bend, vector):
        hessian = jacobian.gram(mass, layout, bend)
        return cholesky.cholesky_solve(hessian, vector), linear.diagonal(hessian)

    def at_once(mass, jacobian, bend, vector):
        return in_one_kernel(mass, jacobian, layout, bend, vector)

    if vector.ndim == 2 and on_gpu.solves(layout.num_rows, len(vector)):
        # The program may yet be compiled for the CPU beside the GPU.
        return jax.lax.platform_dependent(mass, jacobian, bend, vector, cuda=at_once, default=step_by_step)
    return step_by_step(mass, jacobian, bend, vector)


def in_one_kernel(
    mass: Float[Array, "nv nv batch"],
    jacobian: SparseRows,
    layout: RowLayout,
    bend: Bend,
    vector: Float[Array, "nv batch"],
    *,
    interpret: bool = False,
) -> tuple[Float[Array, "nv batch"], Float[Array, "nv batch"]]:
    """Do what `solve` does; `interpret` runs on any device, slowly."""
    together = jacobian.together()
    factors, bent, diagonal = jacobian.bent(together, layout, bend)
    mass = mass + jnp.eye(len(vector), dtype=mass.dtype)[:, :, None] * diagonal
    return on_gpu.solve(mass, vector, together, factors, bent, interpret=interpret)
