"""Linear solves of Newton's method, (M + Jᵀ s'' J) x = v, assembled and factored per device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU assembles the matrix and factors it, each operation along the
batch. A GPU would move the matrices of many states to memory and back many times, so it uses a single kernel.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.batched import cholesky, device, linear, on_gpu
from mjxgrad.solver.constraint import RowHessian, RowLayout
from mjxgrad.solver.sparse import SparseRows

_Vector = Float[Array, "nv *batch"]
_Matrix = Float[Array, "nv nv *batch"]
# Upper bound on the regularisation of an indefinite matrix, as a share of its diagonal.
_MAX_SHIFT = 0.01


def solve(
    mass: _Matrix, jacobian: SparseRows, layout: RowLayout, row_hessian: RowHessian, vector: _Vector
) -> tuple[_Vector, _Vector]:
    """Return (M + Jᵀ s'' J)⁻¹ vector, non-finite where the matrix is not positive definite, and the matrix's diagonal."""

    def step_by_step(mass, jacobian, row_hessian, vector):
        hessian = jacobian.gram(mass, layout, row_hessian)
        return cholesky.cholesky_solve(hessian, vector), linear.diagonal(hessian)

    return _on_device(in_one_kernel, step_by_step, layout, mass, jacobian, row_hessian, vector)


def solve_regularised(
    mass: _Matrix, jacobian: SparseRows, layout: RowLayout, row_hessian: RowHessian, vector: _Vector
) -> _Vector:
    """Return (M + Jᵀ s'' J)⁻¹ vector, regularised where rounding has made the matrix indefinite.

    At an impedance near 1, s'' may exceed M so far that M is lost in single precision. Then the smallest share of the
    diagonal that suffices is added, tried in powers of four from rounding on, which makes the step shorter.
    """
    unit = jnp.eye(len(vector), dtype=vector.dtype).reshape(len(vector), -1, *(1,) * (vector.ndim - 1))

    def step_by_step(mass, jacobian, row_hessian, vector):
        hessian = jacobian.gram(mass, layout, row_hessian)
        diagonal = linear.diagonal(hessian)
        can_be = jnp.isfinite(jnp.stack([diagonal, vector])).all(axis=(0, 1))

        def attempt(state):
            known, is_known, share = state
            found = cholesky.cholesky_solve(hessian + unit * (share * diagonal), vector)
            is_lost = can_be & ~jnp.isfinite(found).all(axis=0)
            return jnp.where(is_known, known, found), is_known | ~is_lost, on_gpu.next_share(share)

        first = jnp.zeros_like(vector), jnp.zeros(vector.shape[1:], bool), jnp.zeros((), vector.dtype)
        return jax.lax.while_loop(lambda s: ~s[1].all() & (s[2] < _MAX_SHIFT), attempt, first)[0]

    def at_once(*args):
        return in_one_kernel(*args, max_shift=_MAX_SHIFT)[0]

    return _on_device(at_once, step_by_step, layout, mass, jacobian, row_hessian, vector)


def _on_device(at_once: Callable, step_by_step: Callable, layout: RowLayout, *system):
    """Solve by one kernel where kernels are available, else operation by operation."""
    vector = system[-1]
    if vector.ndim == 2 and on_gpu.solves(layout.num_rows, len(vector)):
        return device.by_platform(*system, gpu=functools.partial(at_once, layout), default=step_by_step)
    return step_by_step(*system)


def in_one_kernel(
    layout: RowLayout,
    mass: Float[Array, "nv nv batch"],
    jacobian: SparseRows,
    row_hessian: RowHessian,
    vector: Float[Array, "nv batch"],
    *,
    max_shift: float = 0.0,
    interpret: bool = False,
) -> tuple[Float[Array, "nv batch"], Float[Array, "nv batch"]]:
    """Compute `solve`, or `solve_regularised` up to `max_shift`, in one kernel; `interpret` runs on any device, slowly."""
    rows = jacobian.dense_rows()
    factors, right, diagonal = jacobian.hessian_factors(rows, layout, row_hessian)
    mass = mass + jnp.eye(len(vector), dtype=mass.dtype)[:, :, None] * diagonal
    return on_gpu.solve(mass, vector, rows, factors, right, max_shift=max_shift, interpret=interpret)
