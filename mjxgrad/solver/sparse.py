r"""The entries of the constraint Jacobian, without those that are always zero.

The solve needs them many times over, but a contact moves few joints of the model, and which ones is known before anything
is compiled: those between its two bodies. Arrays may carry the batch as trailing axes, see `linear`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjxgrad.batched import linear
from mjxgrad.solver.constraint import Bend, RowLayout
from mjxgrad.solver.jacobian import DenseRows, Group, RowMap, dense, edges, flat, fold

_Entries = Float[Array, "num dim dofs *batch"]
_Square = Float[Array, "dofs dofs *batch"]

# Beyond so many groups the entries are kept in one matrix with its zeros: every group is some operations more to compile.
_MOST_GROUPS = 24


class SparseRows(eqx.Module):
    """The entries of a Jacobian, group by group, without those that are always zero.

    `pieces` are by item, direction and joint velocity, `tilts` μ of each tangent of a pyramid.
    """

    pieces: tuple[Float[Array, "_ _ _ *batch"], ...]
    tilts: tuple[Float[Array, "_ _ *batch"] | None, ...]
    groups: tuple[Group, ...] = eqx.field(static=True)
    num_dofs: int = eqx.field(static=True)

    @classmethod
    def of(cls, rows: RowMap, is_active: Bool[Array, "rows *batch"], num_dofs: int) -> "SparseRows":
        """Return the entries of a map; rows that are not active are zero."""
        if not _keeps_groups(rows):
            rows = DenseRows(
                rows.matrix(num_dofs), tuple((g.num, g.dim) for g in rows.groups if g.dim > 1 and not g.is_pyramid)
            )
        pieces, start = [], 0
        for group, entries in zip(rows.groups, rows.directions(), strict=True):
            active = is_active[start : start + group.num_rows].reshape(group.num, group.rows_each, *is_active.shape[1:])
            active = active[:, :1] if group.is_pyramid else active
            pieces.append(jnp.where(active[:, :, None], entries, 0.0))
            start += group.num_rows
        return cls(tuple(pieces), tuple(rows.tilts()), rows.groups, num_dofs)

    def matvec(self, x: Float[Array, "nv *batch"]) -> Float[Array, "rows *batch"]:
        """Return J x."""
        rows = []
        for group, entries, tilt in zip(self.groups, self.pieces, self.tilts, strict=True):
            moving = linear.take(x, group.dofs)
            along = entries[:, :, 0] * moving[:, None] if group.is_diagonal else _over_dofs(entries, moving)
            rows.append(edges(along, tilt).reshape(group.num_rows, *x.shape[1:]))
        return jnp.concatenate(rows)

    def rmatvec(self, force: Float[Array, "rows *batch"]) -> Float[Array, "nv *batch"]:
        """Return Jᵀ force."""
        total, start = jnp.zeros((self.num_dofs, *force.shape[1:]), force.dtype), 0
        for group, entries, tilt in zip(self.groups, self.pieces, self.tilts, strict=True):
            own = force[start : start + group.num_rows].reshape(group.num, group.rows_each, *force.shape[1:])
            start += group.num_rows
            push = fold(own, tilt)
            part = entries[:, 0, 0] * push[:, 0] if group.is_diagonal else _over_rows(entries, push)
            total = linear.add_at(total, group.dofs, part)
        return total

    def gram(self, mass: Float[Array, "nv nv *batch"], layout: RowLayout, bend: Bend) -> Float[Array, "nv nv *batch"]:
        """Return mass + Jᵀ s'' J, of which each group adds to what it moves and to nothing else; s'' by `constraint.bend`."""
        total, start = mass, 0
        for group, entries, tilt in zip(self.groups, self.pieces, self.tilts, strict=True):
            rows = slice(start, start + group.num_rows)
            start = rows.stop
            if rows.start >= layout.simple_stop:
                square = _gram(entries, _cone_product(layout, bend, rows, entries))
            elif group.is_diagonal:
                total = linear.add_to_diagonal(total, group.dofs, entries[:, 0, 0] ** 2 * bend.simple[rows])
                continue
            elif tilt is None:
                bent = bend.simple[rows].reshape(*entries.shape[:2], 1, *mass.shape[2:])
                square = _gram(entries, bent * entries)
            else:
                square = _pyramid_square(bend.simple[rows].reshape(*tilt.shape[:2], 2, *mass.shape[2:]), tilt, entries)
            total = linear.add_to_block(total, group.dofs, square)
        return total

    def together(self) -> Float[Array, "together nv *batch"]:
        """Return J, zeros and all, without the rows that see one joint velocity each."""
        # As the entries stand: else XLA computes them anew for every edge that they are in.
        pieces = jax.lax.optimization_barrier(self.pieces)
        chosen = [one for one in zip(self.groups, pieces, self.tilts, strict=True) if not one[0].is_diagonal]
        if not chosen:
            return jnp.zeros((0, self.num_dofs, *pieces[0].shape[3:]), pieces[0].dtype)
        groups, entries, tilts = (list(of) for of in zip(*chosen, strict=True))
        return dense(groups, entries, tilts, self.num_dofs)

    def apart(self, x: Float[Array, "rows *batch"]) -> tuple[Array, ...]:
        """Return of what belongs to rows the part of those of `together`, and that of each other group by joint velocity."""
        others, single, start = [x[:0]], [], 0
        for group in self.groups:
            own, start = x[start : start + group.num_rows], start + group.num_rows
            if group.is_diagonal:
                single.append(self._by_dof(group, own))
            else:
                others.append(own)
        return jnp.concatenate(others), *single

    def signs(self) -> tuple[Float[Array, "nv *batch"], ...]:
        """Return the entries of the groups whose rows see one joint velocity each, by joint velocity."""
        pairs = zip(self.groups, self.pieces, strict=True)
        return tuple(self._by_dof(group, entries[:, 0, 0]) for group, entries in pairs if group.is_diagonal)

    def _by_dof(self, group: Group, own: Float[Array, "num *batch"]) -> Float[Array, "nv *batch"]:
        return linear.add_at(jnp.zeros((self.num_dofs, *own.shape[1:]), own.dtype), group.dofs, own)

    def bent(
        self, together: Float[Array, "together nv *batch"], layout: RowLayout, bend: Bend
    ) -> tuple[Float[Array, "together *batch"], Float[Array, "together nv *batch"] | None, Float[Array, "nv *batch"]]:
        """Return Jᵀ s'' J in parts: factors of the rows of `together`; their partners, if not themselves; a diagonal."""
        num_coupled = layout.num_rows - layout.simple_stop
        coupled = jnp.ones((num_coupled, *bend.simple.shape[1:]), bend.simple.dtype)
        factors, *single = self.apart(jnp.concatenate([bend.simple, coupled]))
        diagonal = [sign**2 * own for sign, own in zip(self.signs(), single, strict=True)]
        diagonal = linear.add([jnp.zeros_like(together, shape=(self.num_dofs, *together.shape[2:])), *diagonal])
        if not layout.cones:
            return factors, None, diagonal
        first = layout.num_rows - len(together)  # cones come last
        parts = [together[: layout.simple_stop - first]]
        for cone, square in zip(layout.cones, bend.cones, strict=True):
            own = together[cone.start - first : cone.stop - first].reshape(cone.count, cone.dim, *together.shape[1:])
            both = linear.add(square[:, :, k, None] * own[:, None, k] for k in range(cone.dim))
            parts.append(both.reshape(-1, *together.shape[1:]))
        return factors, jnp.concatenate(parts), diagonal


def num_together(rows: RowMap) -> int:
    """Return the number of rows of `SparseRows.together`."""
    keeps_groups = _keeps_groups(rows)
    return sum(group.num_rows for group in rows.groups if not (keeps_groups and group.is_diagonal))


def _keeps_groups(rows: RowMap) -> bool:
    return len(rows.groups) <= _MOST_GROUPS


def _gram(left: _Entries, right: _Entries) -> _Square:
    """Return leftᵀ right."""
    if left.ndim == 3 or left.shape[0] * left.shape[1] > linear.LONGEST_SUM:
        return linear.gram(flat(left), flat(right))
    return linear.add(a[:, None] * b[None] for a, b in zip(_rows(left), _rows(right), strict=True))


def _over_dofs(entries: _Entries, x: Float[Array, "dofs *batch"]) -> Float[Array, "num dim *batch"]:
    """Return entries x."""
    if entries.ndim == 3 or len(x) > linear.LONGEST_SUM:
        return linear.matvec(flat(entries), x).reshape(*entries.shape[:2], *x.shape[1:])
    return linear.add(entries[:, :, k] * one for k, one in enumerate(x))


def _over_rows(entries: _Entries, force: Float[Array, "num dim *batch"]) -> Float[Array, "dofs *batch"]:
    """Return entriesᵀ force."""
    if entries.ndim == 3 or entries.shape[0] * entries.shape[1] > linear.LONGEST_SUM:
        return linear.rmatvec(flat(entries), flat(force))
    return linear.add(a * f for a, f in zip(_rows(entries), _rows(force), strict=True))


def _rows(entries: Array) -> list[Array]:
    """Return all rows, one by one. As one array of another shape XLA would compute the entries again for it."""
    return [entries[i, k] for i in range(entries.shape[0]) for k in range(entries.shape[1])]


def _pyramid_square(
    bend: Float[Array, "num tangents 2 *batch"], tilt: Float[Array, "num tangents *batch"], entries: _Entries
) -> _Square:
    """Return Jᵀ s'' J of pyramids, J the edges n ± μ t, from their directions."""
    both, difference = _both_edges(bend, tilt)
    difference, (normal, tangents) = difference[:, :, None], (entries[:, 0], entries[:, 1:])
    of_normal = linear.add(both[:, k, None] * normal + difference[:, k] * tangents[:, k] for k in range(both.shape[1]))
    of_tangents = difference * normal[:, None] + (tilt**2 * both)[:, :, None] * tangents
    return linear.gram(normal, of_normal) + _gram(tangents, of_tangents)


def _both_edges(bend: Float[Array, "num tangents 2 *batch"], tilt: Float[Array, "num tangents *batch"]):
    """Return s'' of both edges of each tangent: the sum, and μ times the difference."""
    return bend[:, :, 0] + bend[:, :, 1], tilt * (bend[:, :, 0] - bend[:, :, 1])


def _cone_product(layout: RowLayout, bend: Bend, rows: slice, entries: _Entries) -> _Entries:
    """Return s'' of neighbouring elliptic contacts times their rows."""
    matrix = _cone_matrices(layout, bend, rows, len(entries))
    return linear.add(matrix[:, :, k, None] * entries[:, None, k] for k in range(entries.shape[1]))


def _cone_matrices(layout: RowLayout, bend: Bend, rows: slice, num: int) -> Float[Array, "num dim dim *batch"]:
    """Return s'' of neighbouring elliptic contacts."""
    which = next(k for k, cone in enumerate(layout.cones) if cone.start <= rows.start < cone.stop)
    cone = layout.cones[which]
    first = (rows.start - cone.start) // cone.dim
    return bend.cones[which][first : first + num]
