r"""Linear solves of Newton's method, (M + Jᵀ s'' J) x = v, from the entries of J without those that are always zero.

Arrays may carry the batch as trailing axes, see `linear`. A CPU assembles the matrix and factors it, each operation along the
batch. A GPU would move the matrices of many states to memory and back many times, so it uses a single kernel.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjxgrad.batched import cholesky, device, linear, on_gpu
from mjxgrad.solver.constraint import RowHessian, RowLayout
from mjxgrad.solver.jacobian import Group, Piece, RowMap, as_rows, dense, edges, flat, fold

_Vector = Float[Array, "nv *batch"]
_Matrix = Float[Array, "nv nv *batch"]
_Entries = Float[Array, "num dim dofs *batch"]
_Square = Float[Array, "dofs dofs *batch"]

# With more groups the entries are kept in one dense matrix, since every group adds operations to compile.
_MOST_GROUPS = 24
MAX_SHIFT = 0.01
"""Upper bound on the regularisation of an indefinite matrix, as a share of its diagonal."""


class SparseRows(eqx.Module):
    """The entries of a Jacobian, group by group, without those that are always zero."""

    pieces: tuple[Piece, ...]
    groups: tuple[Group, ...] = eqx.field(static=True)
    num_dofs: int = eqx.field(static=True)

    @classmethod
    def of(cls, rows: RowMap, is_active: Bool[Array, "rows *batch"], num_dofs: int) -> "SparseRows":
        """Return the entries of a map; inactive rows are zero."""
        if not _keeps_groups(rows):
            cones = [(g.num, g.dim) for g in rows.groups if g.dim > 1 and not g.is_pyramid]
            rows = as_rows(rows.matrix(num_dofs), cones)
        pieces, start = [], 0
        for group, (entries, mu) in zip(rows.groups, rows.pieces(), strict=True):
            active = is_active[start : start + group.num_rows].reshape(group.num, group.rows_each, *is_active.shape[1:])
            active = active[:, :1] if group.is_pyramid else active
            pieces.append((jnp.where(active[:, :, None], entries, 0.0), mu))
            start += group.num_rows
        return cls(tuple(pieces), rows.groups, num_dofs)

    def matvec(self, x: Float[Array, "nv *batch"]) -> Float[Array, "rows *batch"]:
        """Return J x."""
        rows = []
        for group, (entries, mu) in zip(self.groups, self.pieces, strict=True):
            moving = linear.take(x, group.dofs)
            along = entries[:, :, 0] * moving[:, None] if group.is_diagonal else _over_dofs(entries, moving)
            rows.append(edges(along, mu).reshape(group.num_rows, *x.shape[1:]))
        return jnp.concatenate(rows)

    def rmatvec(self, force: Float[Array, "rows *batch"]) -> Float[Array, "nv *batch"]:
        """Return Jᵀ force."""
        total, start = jnp.zeros((self.num_dofs, *force.shape[1:]), force.dtype), 0
        for group, (entries, mu) in zip(self.groups, self.pieces, strict=True):
            own = force[start : start + group.num_rows].reshape(group.num, group.rows_each, *force.shape[1:])
            start += group.num_rows
            force_along = fold(own, mu)
            part = entries[:, 0, 0] * force_along[:, 0] if group.is_diagonal else _over_rows(entries, force_along)
            total = linear.add_at(total, group.dofs, part)
        return total

    def gram(self, mass: _Matrix, layout: RowLayout, row_hessian: RowHessian) -> _Matrix:
        """Return mass + Jᵀ s'' J with s'' from `constraint.hessian`; each group adds only to the block of its dofs."""
        total, start = mass, 0
        for group, (entries, mu) in zip(self.groups, self.pieces, strict=True):
            rows = slice(start, start + group.num_rows)
            start = rows.stop
            if rows.start >= layout.simple_stop:
                square = _gram(entries, _cone_product(layout, row_hessian, rows, entries))
            elif group.is_diagonal:
                total = linear.add_to_diagonal(total, group.dofs, entries[:, 0, 0] ** 2 * row_hessian.simple[rows])
                continue
            elif mu is None:
                curvature = row_hessian.simple[rows].reshape(*entries.shape[:2], 1, *mass.shape[2:])
                square = _gram(entries, curvature * entries)
            else:
                curvature = row_hessian.simple[rows].reshape(*mu.shape[:2], 2, *mass.shape[2:])
                square = _pyramid_square(curvature, mu, entries)
            total = linear.add_to_block(total, group.dofs, square)
        return total

    def dense_rows(self) -> Float[Array, "dense nv *batch"]:
        """Return J with its zeros, without the rows that act on one joint velocity each."""
        # The barrier keeps XLA from computing an entry again for every edge.
        pieces = jax.lax.optimization_barrier(self.pieces)
        chosen = [one for one in zip(self.groups, pieces, strict=True) if not one[0].is_diagonal]
        if not chosen:
            return jnp.zeros((0, self.num_dofs, *pieces[0][0].shape[3:]), pieces[0][0].dtype)
        groups, pieces = zip(*chosen, strict=True)
        return dense(groups, pieces, self.num_dofs)

    def split(self, x: Float[Array, "rows *batch"]) -> tuple[Array, ...]:
        """Return the values of the rows in `dense_rows`, then those of each other group by joint velocity."""
        others, single, start = [x[:0]], [], 0
        for group in self.groups:
            own, start = x[start : start + group.num_rows], start + group.num_rows
            if group.is_diagonal:
                single.append(self._by_dof(group, own))
            else:
                others.append(own)
        return jnp.concatenate(others), *single

    def signs(self) -> tuple[Float[Array, "nv *batch"], ...]:
        """Return the entries of rows that act on one joint velocity each, one array by joint velocity per group."""
        pairs = zip(self.groups, self.pieces, strict=True)
        return tuple(self._by_dof(group, entries[:, 0, 0]) for group, (entries, _) in pairs if group.is_diagonal)

    def _by_dof(self, group: Group, own: Float[Array, "num *batch"]) -> Float[Array, "nv *batch"]:
        return linear.add_at(jnp.zeros((self.num_dofs, *own.shape[1:]), own.dtype), group.dofs, own)

    def hessian_factors(
        self, dense_rows: Float[Array, "dense nv *batch"], layout: RowLayout, row_hessian: RowHessian
    ) -> tuple[Float[Array, "dense *batch"], Float[Array, "dense nv *batch"] | None, Float[Array, "nv *batch"]]:
        """Return Jᵀ s'' J in parts: factors of `dense_rows`, their right factors if these differ, and a diagonal."""
        num_coupled = layout.num_rows - layout.simple_stop
        coupled = jnp.ones((num_coupled, *row_hessian.simple.shape[1:]), row_hessian.simple.dtype)
        factors, *single = self.split(jnp.concatenate([row_hessian.simple, coupled]))
        diagonal = [sign**2 * own for sign, own in zip(self.signs(), single, strict=True)]
        diagonal = linear.add([jnp.zeros_like(dense_rows, shape=(self.num_dofs, *dense_rows.shape[2:])), *diagonal])
        if not layout.cones:
            return factors, None, diagonal
        first = layout.num_rows - len(dense_rows)  # cones come last
        parts = [dense_rows[: layout.simple_stop - first]]
        for cone, square in zip(layout.cones, row_hessian.cones, strict=True):
            own = dense_rows[cone.start - first : cone.stop - first]
            own = own.reshape(cone.count, cone.dim, *dense_rows.shape[1:])
            both = linear.add(square[:, :, k, None] * own[:, None, k] for k in range(cone.dim))
            parts.append(both.reshape(-1, *dense_rows.shape[1:]))
        return factors, jnp.concatenate(parts), diagonal


def num_dense_rows(rows: RowMap) -> int:
    """Return the number of rows of `SparseRows.dense_rows`."""
    keeps_groups = _keeps_groups(rows)
    return sum(group.num_rows for group in rows.groups if not (keeps_groups and group.is_diagonal))


def _keeps_groups(rows: RowMap) -> bool:
    return len(rows.groups) <= _MOST_GROUPS


def _gram(left: _Entries, right: _Entries) -> _Square:
    if left.ndim == 3 or left.shape[0] * left.shape[1] > linear.LONGEST_SUM:
        return jnp.einsum("ri...,rj...->ij...", flat(left), flat(right), precision="highest")
    return linear.add(a[:, None] * b[None] for a, b in zip(_rows(left), _rows(right), strict=True))


def _over_dofs(entries: _Entries, x: Float[Array, "dofs *batch"]) -> Float[Array, "num dim *batch"]:
    if entries.ndim == 3 or len(x) > linear.LONGEST_SUM:
        return linear.matvec(flat(entries), x).reshape(*entries.shape[:2], *x.shape[1:])
    return linear.add(entries[:, :, k] * one for k, one in enumerate(x))


def _over_rows(entries: _Entries, force: Float[Array, "num dim *batch"]) -> Float[Array, "dofs *batch"]:
    if entries.ndim == 3 or entries.shape[0] * entries.shape[1] > linear.LONGEST_SUM:
        return linear.rmatvec(flat(entries), flat(force))
    return linear.add(a * f for a, f in zip(_rows(entries), _rows(force), strict=True))


def _rows(entries: Array) -> list[Array]:
    """Return the rows as separate arrays: for one reshaped array XLA would compute the entries again."""
    return [entries[i, k] for i in range(entries.shape[0]) for k in range(entries.shape[1])]


def _pyramid_square(
    row_hessian: Float[Array, "num tangents 2 *batch"], friction: Float[Array, "num tangents *batch"], entries: _Entries
) -> _Square:
    """Return Jᵀ s'' J of pyramids from their directions; J has the edges n ± μ t as rows."""
    # The sum of s'' at the two edges of each tangent, and μ times the difference.
    both = row_hessian[:, :, 0] + row_hessian[:, :, 1]
    difference = friction * (row_hessian[:, :, 0] - row_hessian[:, :, 1])
    difference, (normal, tangents) = difference[:, :, None], (entries[:, 0], entries[:, 1:])
    of_normal = linear.add(both[:, k, None] * normal + difference[:, k] * tangents[:, k] for k in range(both.shape[1]))
    of_tangents = difference * normal[:, None] + (friction**2 * both)[:, :, None] * tangents
    return _gram(normal[:, None], of_normal[:, None]) + _gram(tangents, of_tangents)


def _cone_product(layout: RowLayout, row_hessian: RowHessian, rows: slice, entries: _Entries) -> _Entries:
    """Return s'' of neighbouring elliptic contacts times their rows."""
    which = next(k for k, cone in enumerate(layout.cones) if cone.start <= rows.start < cone.stop)
    first = (rows.start - layout.cones[which].start) // layout.cones[which].dim
    matrix = row_hessian.cones[which][first : first + len(entries)]
    return linear.add(matrix[:, :, k, None] * entries[:, None, k] for k in range(entries.shape[1]))


def solve(
    mass: _Matrix, jacobian: SparseRows, layout: RowLayout, row_hessian: RowHessian, vector: _Vector, shift: float = 0.0
) -> tuple[_Vector, _Vector]:
    """Return (M + Jᵀ s'' J)⁻¹ vector, non-finite where the matrix is not positive definite, and the matrix's diagonal."""
    # At an impedance near 1, s'' may exceed M so far that M is lost in single precision. Then the smallest share of the
    # diagonal below `shift` that suffices is added, which makes the step shorter.

    def step_by_step(mass, jacobian, row_hessian, vector):
        hessian = jacobian.gram(mass, layout, row_hessian)
        diagonal = linear.diagonal(hessian)
        return _shifted(hessian, diagonal, vector, shift), diagonal

    system = mass, jacobian, row_hessian, vector
    if vector.ndim == 2 and on_gpu.solves(layout.num_rows, len(vector)):
        at_once = functools.partial(in_one_kernel, layout, max_shift=shift)
        return device.by_platform(*system, gpu=at_once, default=step_by_step)
    return step_by_step(*system)


def _shifted(hessian: _Matrix, diagonal: _Vector, vector: _Vector, max_shift: float) -> _Vector:
    """Return hessian⁻¹ vector, with shares of the diagonal tried in powers of four from rounding on."""
    if not max_shift:
        return cholesky.cholesky_solve(hessian, vector)
    unit = jnp.eye(len(vector), dtype=vector.dtype).reshape(len(vector), -1, *(1,) * (vector.ndim - 1))
    can_be = jnp.isfinite(jnp.stack([diagonal, vector])).all(axis=(0, 1))

    def attempt(state):
        known, is_known, share = state
        found = cholesky.cholesky_solve(hessian + unit * (share * diagonal), vector)
        is_lost = can_be & ~jnp.isfinite(found).all(axis=0)
        return jnp.where(is_known, known, found), is_known | ~is_lost, on_gpu.next_share(share)

    first = jnp.zeros_like(vector), jnp.zeros(vector.shape[1:], bool), jnp.zeros((), vector.dtype)
    return jax.lax.while_loop(lambda s: ~s[1].all() & (s[2] < max_shift), attempt, first)[0]


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
    """Compute `solve` in one kernel; `interpret` runs on any device, slowly."""
    rows = jacobian.dense_rows()
    factors, right, diagonal = jacobian.hessian_factors(rows, layout, row_hessian)
    mass = mass + jnp.eye(len(vector), dtype=mass.dtype)[:, :, None] * diagonal
    return on_gpu.solve(mass, vector, rows, factors, right, max_shift=max_shift, interpret=interpret)
