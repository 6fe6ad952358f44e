"""The system of one Newton step, (M + Jᵀ s'' J) x = v: assembled and solved in the way that suits the device.

Arrays may carry the batch as trailing axis, see `linear`. A CPU assembles the matrix and factors it, operation by operation along
the batch. On a GPU the matrix of many states would go to memory and back many times; there one kernel does it all, with the
matrices of some neighbouring states in the registers of a few warps. The kernel (Triton's, by `jax.experimental.pallas`)
is written with whole matrices and no entries, so that it is short: with one thread for each state and its entries by name it
took up to a quarter less time on 32768 states, and a minute to compile.
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
# Entries in the registers of one thread, and threads of a warp.
_EACH, _WARP = 32, 32


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
    """Do what `solve` does, by elimination above and below the diagonal; `interpret` runs on any device, slowly."""
    # Imported here: no other device needs it, and it takes half a second.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    (size, num), groups = vector.shape, jacobian.groups
    padded = max(8, 1 << (size - 1).bit_length())
    states = max(8, 256 // padded)  # neighbours in memory, so that whole sectors of it are read

    def kernel(mass, vector, places, *refs):
        *refs, solution, diagonal = refs
        # Places beyond the batch repeat its last member, those beyond the matrix are an identity.
        state = jnp.minimum(pallas.program_id(0) * states + jnp.arange(states, dtype=jnp.int32), num - 1)
        index = jnp.arange(padded, dtype=jnp.int32)
        i, j, k = index[:, None, None], index[None, :, None], index[:, None]
        last = size - 1
        matrix = mass[jnp.minimum(i, last), jnp.minimum(j, last), state[None, None]]
        matrix = jnp.where((i < size) & (j < size), matrix, jnp.where(i == j, 1.0, 0.0).astype(matrix.dtype))
        for number, (group, entries, curvature) in enumerate(
            zip(groups, refs[: len(groups)], refs[len(groups) :], strict=True)
        ):
            matrix = _with_group(
                matrix, group, entries, curvature, places[number, i], places[number, j], state[None, None]
            )
        on_diagonal = jnp.where(i == j, matrix, 0.0).sum(axis=1)
        rest = jnp.where(k < size, vector[jnp.minimum(k, last), state[None]], 0.0)

        def eliminate(pivot, carry):
            matrix, rest = carry
            row = jnp.where(i == pivot, matrix, 0.0).sum(axis=0)
            column = jnp.where(j == pivot, matrix, 0.0).sum(axis=1)
            # By the root, so that a pivot that is not positive spoils all.
            inverse = jax.lax.rsqrt(jnp.where(k == pivot, column, 0.0).sum(axis=0)) ** 2
            own = jnp.where(k == pivot, rest, 0.0).sum(axis=0)
            factor = jnp.where(k == pivot, 0.0, column * inverse[None])
            return matrix - factor[:, None] * row[None], rest - factor * own[None]

        matrix, rest = jax.lax.fori_loop(0, size, eliminate, (matrix, rest))
        pivots = jnp.where(i == j, matrix, 0.0).sum(axis=1)
        solution[k, state[None]] = rest * jax.lax.rsqrt(pivots) ** 2
        diagonal[k, state[None]] = on_diagonal

    shape = jax.ShapeDtypeStruct((padded, num), vector.dtype)
    found = pallas.pallas_call(
        kernel,
        out_shape=(shape, shape),
        grid=(-(-num // states),),
        compiler_params=triton.CompilerParams(num_warps=max(1, padded**2 * states // (_EACH * _WARP)), num_stages=1),
        interpret=interpret,
    )(mass, vector, _places(groups, padded), *jacobian.pieces, *jacobian.curvatures(layout, bend))
    return found[0][:size], found[1][:size]


def _places(groups: tuple[Group, ...], padded: int) -> Array:
    """Return where each joint velocity is among those of each group; -1 if it is not."""
    places = np.full((len(groups), padded), -1, np.int32)
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
