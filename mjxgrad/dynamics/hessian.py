"""The system of one Newton step, (M + Jᵀ s'' J) x = v: assembled and solved in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU assembles the matrix and factors it, operation by operation along
the batch. On a GPU the matrix of many states would go to memory and back many times; there one kernel does it all, that of
`cholesky`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.dynamics import cholesky, linear
from mjxgrad.dynamics.constraint import Bend, RowLayout
from mjxgrad.dynamics.jacobian import Group
from mjxgrad.dynamics.sparse import SparseRows

_Vector = Float[Array, "nv *batch"]
_Matrix = Float[Array, "nv nv *batch"]
# More rows are left to cuBLAS, and larger matrices to cuSOLVER: on a humanoid, 23 by 23 and 242 rows, the kernel takes 540 µs,
# 160 of them for the elimination, and all else of an iteration 300.
_MOST_ROWS = 128


def solve(
    mass: _Matrix, jacobian: SparseRows, layout: RowLayout, bend: Bend, vector: _Vector
) -> tuple[_Vector, _Vector]:
    """Return (M + Jᵀ s'' J)⁻¹ vector, non-finite where that is not positive definite, and the diagonal of the matrix."""

    def step_by_step(mass, jacobian, bend, vector):
        hessian = jacobian.gram(mass, layout, bend)
        return cholesky.cholesky_solve(hessian, vector), linear.diagonal(hessian)

    def at_once(mass, jacobian, bend, vector):
        return in_one_kernel(mass, jacobian, layout, bend, vector)

    num_rows = sum(group.num * group.dim for group in jacobian.groups)
    is_small = len(vector) <= cholesky.LARGEST and num_rows <= _MOST_ROWS
    if vector.ndim == 2 and is_small and cholesky.has_kernels():
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
    groups = jacobian.groups

    def add(matrix, refs, i, j, state):
        places, refs = refs[0], refs[1:]
        for number, group in enumerate(groups):
            entries, curvature = refs[number], refs[len(groups) + number]
            matrix = _with_group(matrix, group, entries, curvature, places[number, i], places[number, j], state)
        return matrix

    arrays = _places(groups, len(vector)), *jacobian.pieces, *jacobian.curvatures(layout, bend)
    return cholesky.in_one_kernel(mass, vector, arrays, add, interpret=interpret)


def _places(groups: tuple[Group, ...], size: int) -> Array:
    """Return where each joint velocity is among those of each group; -1 if it is not, and beyond the matrix."""
    places = np.full((len(groups), cholesky.padded(size)), -1, np.int32)
    for row, group in zip(places, groups, strict=True):
        row[list(group.dofs)] = np.arange(len(group.dofs))
    return jnp.asarray(places)


def _with_group(matrix: Array, group: Group, entries, curvature, down: Array, across: Array, state: Array) -> Array:
    """Return the matrix with what the items of a group add to it; `down` and `across` are places of its joint velocities."""
    is_here, below, right = (down >= 0) & (across >= 0), jnp.maximum(down, 0), jnp.maximum(across, 0)
    if group.is_diagonal:
        own = entries[below, 0, 0, state] ** 2 * curvature[below, 0, state]
        return matrix + jnp.where(is_here & (below == right), own, 0.0)

    def add_item(item: Array, matrix: Array) -> Array:
        left = [jnp.where(down >= 0, entries[item, d, below, state], 0.0) for d in range(group.dim)]
        rows = [jnp.where(across >= 0, entries[item, d, right, state], 0.0) for d in range(group.dim)]
        bent = _bent(group, [curvature[item, d, state] for d in range(curvature.shape[1])], rows)
        return matrix + linear.add(one * other for one, other in zip(left, bent, strict=True))

    return jax.lax.fori_loop(0, group.num, add_item, matrix)


def _bent(group: Group, bends: list[Array], rows: list[Array]) -> list[Array]:
    """Return s'' times the rows of one item, from what `SparseRows.curvatures` says of it."""
    dim = group.dim
    if group.is_pyramid:
        tangents = list(zip(bends[1:dim], bends[dim:], rows[1:], strict=True))
        normal = bends[0] * rows[0] + linear.add(coupling * row for coupling, _, row in tangents)
        return [normal, *(coupling * rows[0] + own * row for coupling, own, row in tangents)]
    if len(bends) == dim:
        return [bend * row for bend, row in zip(bends, rows, strict=True)]
    return [linear.add(bends[d * dim + e] * rows[e] for e in range(dim)) for d in range(dim)]
