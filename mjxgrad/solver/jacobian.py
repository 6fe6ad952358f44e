r"""The constraint Jacobian as a linear map, applied without being formed.

A derivative of the solve needs only products of J and a vector. A contact's rows are the relative velocity of two bodies at a
point: six numbers per body, whatever the number of joints. The solve needs the entries, see `hessian`: group by group, of a
pyramid's edges n ± μ t as its directions n, t. They may have the batch as trailing axes; a map is applied to one state.
"""

import abc
import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.batched import linear, maps
from mjxgrad.batched.maps import combine, contract
from mjxgrad.bodies import spatial

_PerRow = Float[Array, " rows"]
_Vector = Float[Array, " nv"]
Piece = tuple[Float[Array, "_ _ _ *batch"], Float[Array, "_ _ *batch"] | None]
"""Entries by item, direction and joint velocity; μ of each tangent of a pyramid, None for other rows."""
Side = tuple[float, tuple[int, ...]]
"""One of a contact's two bodies: its sign, 1 for the second, and the joint velocities that move it and not the other."""
_WASTE = 2.0  # largest growth of a Hessian's entries when neighbouring contacts are joined in one group


@dataclasses.dataclass(frozen=True)
class Group:
    """Contacts or single rows (items) that act on the same joint velocities."""

    dofs: tuple[int, ...]  # indices of these joint velocities, ascending
    num: int  # number of items
    dim: int = 1  # directions of each item
    is_pyramid: bool = False  # whether the rows are a pyramid's edges n ± μ t, two for each direction but the first
    is_diagonal: bool = False  # whether each item acts on a single joint velocity, in the order of `dofs`

    @property
    def rows_each(self) -> int:
        return 2 * (self.dim - 1) if self.is_pyramid else self.dim

    @property
    def num_rows(self) -> int:
        return self.num * self.rows_each


class RowMap(eqx.Module):
    """Constraint rows as a linear map from joint velocities."""

    @property
    @abc.abstractmethod
    def groups(self) -> tuple[Group, ...]:
        """The rows in order, grouped by the joint velocities that they act on."""

    @abc.abstractmethod
    def mv(self, velocity: _Vector) -> _PerRow:
        """Return J v."""

    @abc.abstractmethod
    def rmv(self, force: _PerRow) -> _Vector:
        """Return Jᵀ f."""

    @abc.abstractmethod
    def pieces(self) -> Sequence[Piece]:
        """Return the entries of each group; of a pyramid those of its directions, and μ of each tangent."""

    def matrix(self, num_dofs: int) -> Float[Array, "rows nv *batch"]:
        """Return J."""
        return dense(self.groups, self.pieces(), num_dofs)


class DenseRows(RowMap):
    """Single rows, or contacts of one dimension (items), with all entries of J; `friction` has μ of a pyramid's tangents."""

    entries: Float[Array, "items dim nv *batch"]
    friction: Float[Array, "items tangents *batch"] | None = None

    @property
    def groups(self) -> tuple[Group, ...]:
        count, dim, num_dofs = self.entries.shape[:3]
        return (Group(tuple(range(num_dofs)), count, dim, is_pyramid=self.friction is not None),)

    def mv(self, velocity):
        return edges(contract("idv,v->id", self.entries, velocity), self.friction).reshape(-1)

    def rmv(self, force):
        return contract("idv,id->v", self.entries, fold(force.reshape(len(self.entries), -1), self.friction))

    def pieces(self):
        return [(self.entries, self.friction)]


class AxisRows(RowMap):
    """Rows that act on one joint velocity each, with one entry `sign` per row."""

    sign: Float[Array, "rows *batch"]
    dofs: tuple[int, ...] = eqx.field(static=True)
    num_dofs: int = eqx.field(static=True)

    @property
    def groups(self) -> tuple[Group, ...]:
        return (Group(self.dofs, len(self.dofs), is_diagonal=True),)

    def mv(self, velocity):
        return self.sign * maps.pick(np.array(self.dofs), velocity)

    def rmv(self, force):
        return combine(np.eye(self.num_dofs)[:, list(self.dofs)], self.sign * force)

    def pieces(self):
        return [(self.sign[:, None, None], None)]


class ContactRows(RowMap):
    """Rows of contacts of one dimension.

    An entry of J is (axis · wrench): the power of a unit force along a frame axis at a unit joint velocity. The wrench is about
    the centre of mass that the joint axes refer to. All contacts have the same number of sides; one at rest has no dofs.
    """

    lever: Float[Array, "contacts sides 3 *batch"]  # from that centre to the contact point (m)
    frame: Float[Array, "contacts 3 3 *batch"]  # normal and tangents
    axes: Float[Array, "nv 6 *batch"]  # motions of unit joint velocities
    friction: Float[Array, "contacts tangents *batch"] | None  # μ of a pyramid's tangents, with the edges n ± μ t
    sides: tuple[tuple[Side, ...], ...] = eqx.field(static=True)  # of each contact
    dim: int = eqx.field(static=True)

    @property
    def groups(self) -> tuple[Group, ...]:
        has_edges = self.friction is not None
        return tuple(Group(dofs, stop - start, self.dim, has_edges) for start, stop, dofs in self._runs())

    def _runs(self) -> list[tuple[int, int, tuple[int, ...]]]:
        """Return runs of neighbouring contacts with common dofs: (first, one after the last, dofs)."""
        # Every run costs some operations, and every column that one contact of a run does not need is wasted. So
        # contacts are joined while that no more than doubles the entries of the Hessian.
        runs: list[tuple[int, int, tuple[int, ...], int]] = []
        for contact, sides in enumerate(self.sides):
            # A contact of bodies at rest keeps a column of zeros.
            dofs = {dof for _, own in sides for dof in own} or {0}
            least = len(dofs) ** 2
            if runs:
                start, _, others, least_others = runs[-1]
                both = dofs | set(others)
                if (contact + 1 - start) * len(both) ** 2 <= _WASTE * (least + least_others):
                    runs[-1] = (start, contact + 1, tuple(sorted(both)), least + least_others)
                    continue
            runs.append((contact, contact + 1, tuple(sorted(dofs)), least))
        return [run[:3] for run in runs]

    def _moves(self, contacts: slice, dofs: tuple[int, ...]) -> np.ndarray:
        """Return the signs with which joint velocities move the sides of contacts."""
        chosen = self.sides[contacts]
        moves = np.zeros((len(chosen), len(chosen[0]), self.axes.shape[0]))
        for contact, sides in enumerate(chosen):
            for place, (sign, own) in enumerate(sides):
                moves[contact, place, list(own)] = sign
        return moves[..., list(dofs)]

    def _all_moves(self) -> np.ndarray:
        return self._moves(slice(None), tuple(range(self.axes.shape[0]))).reshape(-1, self.axes.shape[0])

    def mv(self, velocity):
        motion = combine(self._all_moves(), maps.scale(velocity, self.axes))
        turning, moving = motion[:, :3], motion[:, 3:]
        relative = self._sum(moving + spatial.cross(turning, self.lever.reshape(-1, 3)))
        along = contract("ckx,cx->ck", self.frame[:, : min(self.dim, 3)], relative)
        if self.dim > 3:
            spin = self._sum(turning)
            along = jnp.concatenate([along, contract("ckx,cx->ck", self.frame[:, : self.dim - 3], spin)], axis=1)
        return edges(along, self.friction).reshape(-1)

    def _sum(self, of_sides: Float[Array, "sides 3"]) -> Float[Array, "contacts 3"]:
        by_contact = of_sides.reshape(self.lever.shape)
        return linear.add(by_contact[:, side] for side in range(by_contact.shape[1]))

    def rmv(self, force):
        force = fold(force.reshape(len(self.frame), -1), self.friction)
        num_axes, num_sides = min(self.dim, 3), self.lever.shape[1]
        push = contract("ckx,ck->cx", self.frame[:, :num_axes], force[:, :num_axes])
        force_at_point = jnp.repeat(push, num_sides, axis=0)
        torque = spatial.cross(self.lever.reshape(-1, 3), force_at_point)
        if self.dim > 3:
            twist = contract("ckx,ck->cx", self.frame[:, : self.dim - 3], force[:, 3:])
            torque += jnp.repeat(twist, num_sides, axis=0)
        wrench = jnp.concatenate([torque, force_at_point], axis=1)
        return maps.dot(self.axes, combine(self._all_moves().T, wrench))

    def pieces(self):
        runs = [(slice(start, stop), dofs) for start, stop, dofs in self._runs()]
        return [(self._entries(at, dofs), None if self.friction is None else self.friction[at]) for at, dofs in runs]

    def _entries(self, contacts: slice, dofs: tuple[int, ...]) -> Float[Array, "num dim dofs *batch"]:
        frame, axes = self.frame[contacts], linear.take(self.axes, dofs)
        force, num_batch = frame[:, : min(self.dim, 3)], frame.ndim - 3
        moves = jnp.asarray(self._moves(contacts, dofs), frame.dtype)
        moves = moves.reshape(*moves.shape, *(1,) * num_batch)
        forces, parts = [force[:, :, i] for i in range(3)], []
        for side in range(moves.shape[1]):
            lever = [self.lever[contacts, side, i, None] for i in range(3)]
            torques = [lever[i] * forces[j] - lever[j] * forces[i] for i, j in ((1, 2), (2, 0), (0, 1))]
            rows = _along(torques + forces, axes)
            if self.dim > 3:
                twists = [frame[:, : self.dim - 3, i] for i in range(3)]
                rows = jnp.concatenate([rows, _along(twists, axes[:, :3])], axis=1)
            parts.append(moves[:, side, None] * rows)
        return linear.add(parts)


class JoinedRows(RowMap):
    """The rows of several maps, concatenated."""

    parts: tuple[RowMap, ...]

    def with_parts(self, others: tuple[RowMap | None, ...] | None) -> "JoinedRows":
        """Return the map with some parts replaced; None leaves a part as it is."""
        if others is None:
            return self
        pairs = zip(self.parts, others, strict=True)
        return JoinedRows(tuple(own if other is None else other for own, other in pairs))

    @property
    def groups(self) -> tuple[Group, ...]:
        return tuple(group for part in self.parts for group in part.groups)

    def mv(self, velocity):
        return jnp.concatenate([part.mv(velocity) for part in self.parts])

    def rmv(self, force):
        total, start = jnp.zeros((), force.dtype), 0
        for part in self.parts:
            stop = start + sum(group.num_rows for group in part.groups)
            total, start = total + part.rmv(force[start:stop]), stop
        return total

    def pieces(self):
        return [piece for part in self.parts for piece in part.pieces()]


def as_rows(matrix: Float[Array, "rows nv *batch"], cones: Sequence[tuple[int, int]]) -> JoinedRows:
    """Return J as a map; `cones` has number and dimension of the elliptic contacts, which come last."""
    items = ((len(matrix) - sum(num * dim for num, dim in cones), 1), *cones)
    pieces = jnp.split(matrix, np.cumsum([num * dim for num, dim in items])[:-1])
    pairs = zip(pieces, items, strict=True)
    return JoinedRows(tuple(DenseRows(x.reshape(*size, *x.shape[1:])) for x, size in pairs if len(x)))


def dense(groups: Sequence[Group], pieces: Sequence[Piece], num_dofs: int) -> Float[Array, "rows nv *batch"]:
    """Return J from its entries, group by group."""
    rows = []
    for group, (entries, mu) in zip(groups, pieces, strict=True):
        if group.is_diagonal:
            selection = np.eye(num_dofs)[list(group.dofs)]
            own = entries[:, 0] * selection.reshape(*selection.shape, *(1,) * (entries.ndim - 3))
        else:
            own = edges(_spread(entries, group.dofs, num_dofs), None if mu is None else mu[:, :, None])
        rows.append(own.reshape(group.num_rows, num_dofs, *entries.shape[3:]))
    return jnp.concatenate(rows)


def edges(along: Float[Array, "n dim *rest"], friction: Float[Array, "n tangents *#rest"] | None) -> Array:
    """Return the edges n ± μ t of pyramids, or the directions themselves without μ."""
    if friction is None:
        return along
    normal, tangent = along[:, :1], friction * along[:, 1:]
    both = jnp.stack([normal + tangent, normal - tangent], axis=2)
    return both.reshape(len(along), -1, *along.shape[2:])


def fold(force: Float[Array, "n rows *rest"], friction: Float[Array, "n tangents *#rest"] | None) -> Array:
    """Return the forces along directions, the sums of those along edges; the transpose of `edges`."""
    if friction is None:
        return force
    pairs = force.reshape(len(force), -1, 2, *force.shape[2:])
    plus, minus = pairs[:, :, 0], pairs[:, :, 1]
    return jnp.concatenate([linear.sum_of_few(plus + minus), friction * (plus - minus)], axis=1)


def flat(x: Float[Array, "num dim *rest"]) -> Float[Array, "rows *rest"]:
    """Return an array with items and directions merged into rows."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


def _along(
    parts: list[Float[Array, "n k *batch"]], axes: Float[Array, "dofs entries *batch"]
) -> Float[Array, "n k dofs *batch"]:
    """Return the products of vectors, given entry by entry, with axes."""
    # The sum is written out over separate entries: XLA's CPU backend runs along the batch only where nothing is
    # concatenated. (It also crashed on the derivative of the reduction under two `jax.vmap`, jax 0.10.2.)
    return linear.add(part[:, :, None] * axes[:, i] for i, part in enumerate(parts))


def _spread(
    entries: Float[Array, "num dim dofs *batch"], dofs: tuple[int, ...], num_dofs: int
) -> Float[Array, "num dim nv *batch"]:
    if len(dofs) == num_dofs:
        return entries
    columns, at = [], 0
    for target, source in linear.runs(dofs):
        columns.append(jnp.zeros((*entries.shape[:2], target.start - at, *entries.shape[3:]), entries.dtype))
        columns.append(entries[:, :, source])
        at = target.stop
    columns.append(jnp.zeros((*entries.shape[:2], num_dofs - at, *entries.shape[3:]), entries.dtype))
    return jnp.concatenate(columns, axis=2)
