r"""The constraint Jacobian as a linear map: applied without being formed, and formed without its zeros.

The two uses of J want two shapes of it. A derivative of the solve needs J only times a vector, and the reverse mode of
a product that was never spelled out is as cheap as the product: a contact's rows are the relative velocity of two
bodies at a point, six numbers per body, whatever the number of joints. The solve needs the entries, many times over,
but a contact moves few joints of the model, and which ones is known before anything is compiled: those between its two
bodies. Rows are kept as `SparseRows`, which hold no other columns, and a pyramid's edges n ± μ t as its directions n, t.

Arrays of `SparseRows`, and of the maps while they are made into such, may carry the batch as trailing axes, see `linear`.
"""

import abc
import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad.dynamics import linear, spatial
from mjxgrad.dynamics.constraint import Bend, RowLayout
from mjxgrad.dynamics.spatial import combine, contract

# Beyond so many groups the entries are kept in one matrix with its zeros: every group is some operations more to compile.
_MOST_GROUPS = 24


@dataclasses.dataclass(frozen=True)
class Group:
    """Items, contacts or single rows, that act on the same joint velocities.

    Attributes:
        dofs: which, ascending.
        num: number of items.
        dim: directions of each.
        is_pyramid: whether their rows are the edges n ± μ t of a pyramid, two for each direction but the first.
        is_diagonal: whether each item acts on one of the joint velocities alone, in their order.
    """

    dofs: tuple[int, ...]
    num: int
    dim: int = 1
    is_pyramid: bool = False
    is_diagonal: bool = False

    @property
    def rows_each(self) -> int:
        return 2 * (self.dim - 1) if self.is_pyramid else self.dim

    @property
    def num_rows(self) -> int:
        return self.num * self.rows_each


class RowMap(eqx.Module):
    """Some constraint rows as a linear map from joint velocities."""

    @property
    @abc.abstractmethod
    def groups(self) -> tuple[Group, ...]:
        """The rows in order, by the joint velocities that they see."""

    @abc.abstractmethod
    def rates(self, velocity: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Return J v."""

    @abc.abstractmethod
    def pull(self, force: Float[Array, " rows"]) -> Float[Array, " nv"]:
        """Return Jᵀ f."""

    @abc.abstractmethod
    def directions(self) -> list[Float[Array, "num dim dofs *batch"]]:
        """Return the entries, one array per group; pyramids by their directions."""

    @abc.abstractmethod
    def tilts(self) -> list[Float[Array, "num tangents *batch"] | None]:
        """Return μ of each tangent of a pyramid, one array per group; None where there is none."""

    @abc.abstractmethod
    def matrix(self) -> Float[Array, "rows nv"]:
        """Return J."""


class DenseRows(RowMap):
    """Rows that are few, or that may move every joint.

    Attributes:
        entries: J.
        cones: number and dimension of elliptic contacts among them, in order of rows; rows before stand for themselves.
    """

    entries: Float[Array, "rows nv *batch"]
    cones: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())

    @classmethod
    def of_contacts(
        cls, directions: Float[Array, "contacts dim nv"], friction: Float[Array, "contacts tangents"] | None
    ) -> "DenseRows":
        """Return the rows of contacts: the edges of pyramids if there is friction for them, or the directions."""
        count, dim, num_dofs = directions.shape
        if friction is None:
            return cls(_flat(directions), ((count, dim),) if dim > 1 else ())
        return cls(_edges(directions, friction[:, :, None]).reshape(-1, num_dofs))

    @property
    def groups(self) -> tuple[Group, ...]:
        dofs, coupled = tuple(range(self.entries.shape[1])), sum(num * dim for num, dim in self.cones)
        single = len(self.entries) - coupled
        return (*([Group(dofs, single)] if single else []), *(Group(dofs, *cone) for cone in self.cones))

    def rates(self, velocity):
        return contract("rv,v->r", self.entries, velocity)

    def pull(self, force):
        return contract("rv,r->v", self.entries, force)

    def directions(self):
        pieces, start = [], 0
        for group in self.groups:
            rows = self.entries[start : start + group.num_rows]
            pieces.append(rows.reshape(group.num, group.dim, *rows.shape[1:]))
            start += group.num_rows
        return pieces

    def tilts(self):
        return [None] * len(self.groups)

    def matrix(self):
        return self.entries


class AxisRows(RowMap):
    """Rows of one joint velocity each.

    Attributes:
        sign: the entries.
        dofs: which joint velocity.
        num_dofs: nv.
    """

    sign: Float[Array, "rows *batch"]
    dofs: tuple[int, ...] = eqx.field(static=True)
    num_dofs: int = eqx.field(static=True)

    @property
    def groups(self) -> tuple[Group, ...]:
        return (Group(self.dofs, len(self.dofs), is_diagonal=True),)

    def rates(self, velocity):
        return self.sign * spatial.pick(np.array(self.dofs), velocity)

    def pull(self, force):
        return combine(_selection(self.dofs, self.num_dofs).T, self.sign * force)

    def directions(self):
        return [self.sign[:, None, None]]

    def tilts(self):
        return [None]

    def matrix(self):
        selection = _selection(self.dofs, self.num_dofs)
        return self.sign[:, None] * selection.reshape(*selection.shape, *(1,) * (self.sign.ndim - 1))


@dataclasses.dataclass(frozen=True)
class Side:
    """One of the two bodies of a contact, if it moves.

    Attributes:
        contact: which contact.
        sign: 1 for the second body, -1 for the first.
        dofs: joint velocities that move it and not the other one too; what moves both does nothing to a contact.
    """

    contact: int
    sign: float
    dofs: tuple[int, ...]


class ContactRows(RowMap):
    """Rows of contacts of one dimension.

    A unit force along a frame axis, taken as a wrench about the centre of mass that the joint axes refer to, does work
    on a joint velocity at the rate (axis · wrench).

    Attributes:
        lever: from that centre of each side to the point of contact (m).
        frame: normal and tangents.
        axes: motion of unit joint velocities.
        friction: μ of each tangent of a pyramid, n ± μ t its edges; None for frictionless and elliptic contacts.
        sides: whose motion counts, by contact.
        dim: directions of each contact.
    """

    lever: Float[Array, "sides 3 *batch"]
    frame: Float[Array, "contacts 3 3 *batch"]
    axes: Float[Array, "nv 6 *batch"]
    friction: Float[Array, "contacts tangents *batch"] | None
    sides: tuple[Side, ...] = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    @property
    def groups(self) -> tuple[Group, ...]:
        return tuple(
            Group(dofs, stop - start, self.dim, self.friction is not None) for start, stop, dofs in self._runs()
        )

    def _runs(self) -> list[tuple[int, int, tuple[int, ...]]]:
        """Return neighbouring contacts of the same joint velocities: first, one after the last, dofs."""
        moved = [tuple(self.sides[side].dofs for side in own) for own in self._by_contact()]
        starts = [k for k in range(len(moved)) if k == 0 or moved[k] != moved[k - 1]]
        stops = [*starts[1:], len(moved)]
        # A contact that nothing moves keeps a column of zeros.
        return [(a, b, tuple(sorted(sum(moved[a], ()))) or (0,)) for a, b in zip(starts, stops, strict=True)]

    def _by_contact(self) -> list[list[int]]:
        own: list[list[int]] = [[] for _ in range(len(self.frame))]
        for index, side in enumerate(self.sides):
            own[side.contact].append(index)
        return own

    def _moves(self) -> np.ndarray:
        moves = np.zeros((len(self.sides), self.axes.shape[0]))
        for row, side in zip(moves, self.sides, strict=True):
            row[list(side.dofs)] = side.sign
        return moves

    def _of_contacts(self) -> np.ndarray:
        """Return which sides belong to a contact."""
        owner = np.array([side.contact for side in self.sides], int)
        return (np.arange(len(self.frame))[:, None] == owner).astype(float)

    def rates(self, velocity):
        motion = combine(self._moves(), spatial.scale(velocity, self.axes))
        turning, moving = motion[:, :3], motion[:, 3:]
        gather = self._of_contacts()
        relative = combine(gather, moving + spatial.cross(turning, self.lever))
        along = contract("ckx,cx->ck", self.frame[:, : min(self.dim, 3)], relative)
        if self.dim > 3:
            spin = combine(gather, turning)
            along = jnp.concatenate([along, contract("ckx,cx->ck", self.frame[:, : self.dim - 3], spin)], axis=1)
        return _edges(along, self.friction).reshape(-1)

    def pull(self, force):
        force = _fold(force.reshape(len(self.frame), -1), self.friction)
        num_axes = min(self.dim, 3)
        push = contract("ckx,ck->cx", self.frame[:, :num_axes], force[:, :num_axes])
        of_sides = self._of_contacts().T
        torque = spatial.cross(self.lever, combine(of_sides, push))
        if self.dim > 3:
            twist = contract("ckx,ck->cx", self.frame[:, : self.dim - 3], force[:, 3:])
            torque += combine(of_sides, twist)
        wrench = jnp.concatenate([torque, combine(of_sides, push)], axis=1)
        return spatial.dot(self.axes, combine(self._moves().T, wrench))

    def directions(self):
        own = self._by_contact()
        return [self._entries(range(start, stop), own, dofs) for start, stop, dofs in self._runs()]

    def _entries(
        self, contacts: range, own: list[list[int]], dofs: tuple[int, ...]
    ) -> Float[Array, "num dim dofs *batch"]:
        """Return the entries of contacts whose sides have the same joint velocities."""
        first = own[contacts.start]
        frame = self.frame[contacts.start : contacts.stop]
        num_axes = min(self.dim, 3)
        if not first:
            return jnp.zeros((len(contacts), self.dim, 1, *frame.shape[3:]), frame.dtype)
        columns, order = [], []
        for place, side in enumerate(first):
            lever = jnp.stack([self.lever[own[contact][place]] for contact in contacts])
            axes = linear.take(self.axes, self.sides[side].dofs)
            force = frame[:, :num_axes]
            torque = _cross(lever[:, None], force)
            rows = _along(torque, axes[:, :3]) + _along(force, axes[:, 3:])
            if self.dim > 3:
                rows = jnp.concatenate([rows, _along(frame[:, : self.dim - 3], axes[:, :3])], axis=1)
            columns.append(self.sides[side].sign * rows)
            order += self.sides[side].dofs
        entries = columns[0] if len(columns) == 1 else jnp.concatenate(columns, axis=2)
        if tuple(order) == dofs:
            return entries
        return jnp.concatenate([entries[:, :, (at := order.index(dof)) : at + 1] for dof in dofs], axis=2)

    def tilts(self):
        return [None if self.friction is None else self.friction[start:stop] for start, stop, _ in self._runs()]

    def matrix(self):
        rows = []
        for entries, group, tilt in zip(self.directions(), self.groups, self.tilts(), strict=True):
            edges = _edges(_spread(entries, group.dofs, len(self.axes)), None if tilt is None else tilt[:, :, None])
            rows.append(edges.reshape(group.num_rows, *edges.shape[2:]))
        return jnp.concatenate(rows)


class JoinedRows(RowMap):
    """Rows of several maps, one after the other."""

    parts: tuple[RowMap, ...]

    @property
    def groups(self) -> tuple[Group, ...]:
        return tuple(group for part in self.parts for group in part.groups)

    def rates(self, velocity):
        return jnp.concatenate([part.rates(velocity) for part in self.parts])

    def pull(self, force):
        total, start = jnp.zeros((), force.dtype), 0
        for part in self.parts:
            stop = start + sum(group.num_rows for group in part.groups)
            total, start = total + part.pull(force[start:stop]), stop
        return total

    def directions(self):
        return [piece for part in self.parts for piece in part.directions()]

    def tilts(self):
        return [tilt for part in self.parts for tilt in part.tilts()]

    def matrix(self):
        return jnp.concatenate([part.matrix() for part in self.parts])


class SparseRows(eqx.Module):
    """The entries of a Jacobian, group by group, without those that are always zero.

    Attributes:
        pieces: entries of each group, by item, direction and joint velocity.
        tilts: μ of each tangent of a pyramid; None for other groups.
        groups: which joint velocities, and what the directions mean.
        num_dofs: nv.
    """

    pieces: tuple[Float[Array, "_ _ _ *batch"], ...]
    tilts: tuple[Float[Array, "_ _ *batch"] | None, ...]
    groups: tuple[Group, ...] = eqx.field(static=True)
    num_dofs: int = eqx.field(static=True)

    @classmethod
    def of(cls, rows: RowMap, is_active: Bool[Array, "rows *batch"], num_dofs: int) -> "SparseRows":
        """Return the entries of a map; rows that are not active are zero."""
        if len(rows.groups) > _MOST_GROUPS:
            rows = DenseRows(
                rows.matrix(), tuple((g.num, g.dim) for g in rows.groups if g.dim > 1 and not g.is_pyramid)
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
            if group.is_diagonal:
                along = entries[:, :, 0] * moving[:, None]
            else:
                along = linear.matvec(_flat(entries), moving).reshape(group.num, group.dim, *x.shape[1:])
            rows.append(_edges(along, tilt).reshape(group.num_rows, *x.shape[1:]))
        return jnp.concatenate(rows)

    def rmatvec(self, force: Float[Array, "rows *batch"]) -> Float[Array, "nv *batch"]:
        """Return Jᵀ force."""
        total, start = jnp.zeros((self.num_dofs, *force.shape[1:]), force.dtype), 0
        for group, entries, tilt in zip(self.groups, self.pieces, self.tilts, strict=True):
            own = force[start : start + group.num_rows].reshape(group.num, group.rows_each, *force.shape[1:])
            start += group.num_rows
            push = _fold(own, tilt)
            part = entries[:, 0, 0] * push[:, 0] if group.is_diagonal else linear.rmatvec(_flat(entries), _flat(push))
            for run in linear.runs(group.dofs):
                total = total.at[run.target].add(part[run.source])
        return total

    def gram(self, mass: Float[Array, "nv nv *batch"], layout: RowLayout, bend: Bend) -> Float[Array, "nv nv *batch"]:
        """Return mass + Jᵀ s'' J, of which each group adds to what it moves and to nothing else.

        Args:
            mass: to be added to.
            layout: the laws of the rows.
            bend: s'', see `constraint.bend`.
        """
        total, start = mass, 0
        for group, entries, tilt in zip(self.groups, self.pieces, self.tilts, strict=True):
            rows = slice(start, start + group.num_rows)
            start = rows.stop
            if rows.start < layout.simple_stop:
                of_rows = bend.simple[rows].reshape(group.num, group.rows_each, *mass.shape[2:])
                curved = of_rows[:, :, None] * entries if tilt is None else _pyramid_product(of_rows, tilt, entries)
            else:
                curved = _cone_product(layout, bend, rows, entries)
            if group.is_diagonal:
                square = entries[:, 0, 0] * curved[:, 0, 0]
                for place, dof in enumerate(group.dofs):
                    total = total.at[dof, dof].add(square[place])
                continue
            square = linear.gram(_flat(entries), _flat(curved))
            for across in linear.runs(group.dofs):
                for down in linear.runs(group.dofs):
                    total = total.at[down.target, across.target].add(square[down.source, across.source])
        return total


def _pyramid_product(
    bend: Float[Array, "num edges *batch"],
    tilt: Float[Array, "num tangents *batch"],
    entries: Float[Array, "num dim dofs *batch"],
) -> Float[Array, "num dim dofs *batch"]:
    """Return Eᵀ s'' E times the directions, E the edges n ± μ t."""
    pairs = bend.reshape(len(bend), -1, 2, *bend.shape[2:])
    both, difference = pairs[:, :, 0] + pairs[:, :, 1], tilt * (pairs[:, :, 0] - pairs[:, :, 1])
    normal, tangents = entries[:, :1], entries[:, 1:]
    along = linear.sum_of_few(both)[:, :, None] * normal + linear.sum_of_few(difference[:, :, None] * tangents)
    return jnp.concatenate([along, difference[:, :, None] * normal + (tilt**2 * both)[:, :, None] * tangents], axis=1)


def _cone_product(
    layout: RowLayout, bend: Bend, rows: slice, entries: Float[Array, "num dim dofs *batch"]
) -> Float[Array, "num dim dofs *batch"]:
    """Return s'' of neighbouring elliptic contacts times their rows."""
    which = next(k for k, cone in enumerate(layout.cones) if cone.start <= rows.start < cone.stop)
    cone = layout.cones[which]
    first = (rows.start - cone.start) // cone.dim
    matrix = bend.cones[which][first : first + len(entries)]
    return linear.add(matrix[:, :, k, None] * entries[:, None, k] for k in range(cone.dim))


def _edges(along: Float[Array, "n dim *rest"], tilt: Float[Array, "n tangents *#rest"] | None) -> Array:
    """Return the edges n ± μ t of pyramids; without μ the directions themselves."""
    if tilt is None:
        return along
    normal, tangent = along[:, :1], tilt * along[:, 1:]
    edges = jnp.stack([normal + tangent, normal - tangent], axis=2)
    return edges.reshape(len(along), -1, *along.shape[2:])


def _fold(force: Float[Array, "n rows *rest"], tilt: Float[Array, "n tangents *#rest"] | None) -> Array:
    """Return the forces along directions that forces along edges add up to; the transpose of `_edges`."""
    if tilt is None:
        return force
    pairs = force.reshape(len(force), -1, 2, *force.shape[2:])
    plus, minus = pairs[:, :, 0], pairs[:, :, 1]
    return jnp.concatenate([linear.sum_of_few(plus + minus), tilt * (plus - minus)], axis=1)


def _flat(x: Float[Array, "num dim *rest"]) -> Float[Array, "rows *rest"]:
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


def _cross(a: Float[Array, "n #k 3 *batch"], b: Float[Array, "n #k 3 *batch"]) -> Float[Array, "n k 3 *batch"]:
    a0, a1, a2, b0, b1, b2 = (x[:, :, i] for x in (a, b) for i in range(3))
    return jnp.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=2)


def _along(
    vectors: Float[Array, "n k 3 *batch"], axes: Float[Array, "dofs 3 *batch"]
) -> Float[Array, "n k dofs *batch"]:
    # Written out: XLA's CPU backend crashed on the derivative of the reduction under two jax.vmap (jax 0.10.2).
    return linear.add(vectors[:, :, None, i] * axes[:, i] for i in range(3))


def _spread(
    entries: Float[Array, "num dim dofs *batch"], dofs: tuple[int, ...], num_dofs: int
) -> Float[Array, "num dim nv *batch"]:
    """Return entries with zeros for all other joint velocities."""
    if len(dofs) == num_dofs:
        return entries
    columns, at = [], 0
    for run in linear.runs(dofs):
        columns.append(jnp.zeros((*entries.shape[:2], run.target.start - at, *entries.shape[3:]), entries.dtype))
        columns.append(entries[:, :, run.source])
        at = run.target.stop
    columns.append(jnp.zeros((*entries.shape[:2], num_dofs - at, *entries.shape[3:]), entries.dtype))
    return jnp.concatenate(columns, axis=2)


def _selection(dofs: tuple[int, ...], num_dofs: int) -> np.ndarray:
    """Return the matrix that picks some joint velocities."""
    return (np.array(dofs, int)[:, None] == np.arange(num_dofs)).astype(float)
