r"""Contacts of two boxes, where C MuJoCo 3.17 has them: up to eight where faces touch, one where edges cross.

- **Which axis.** Boxes overlap unless an axis separates them: a face normal of either, or an edge of one across an edge of the
  other. Along a unit axis $n$ their separation is $|n·p| - \sum_i h_i |n·a_i|$, with $p$ between the centres, $a_i$ the axes of
  both and $h_i$ half their length (m). The axis with the largest separation is the contact's normal. Edges have to be better than
  faces by a millionth of the separation, and by 5 % if they differ by less than 8° from the best face.
- **Faces.** The box with that normal clips the face of the other box that looks most against it. The corners of what is left are
  the contacts, half way between both surfaces along the normal.
- **Edges.** The contact is in the middle between the nearest points of both edges, and its distance is along the normal.
- **Derivatives** are those of these formulas in the branch taken. An edge nearly parallel to a side of the clipping face cuts it
  anywhere: the place of such a cut on its edge is a constant to the derivative.

References:
    Gottschalk, Lin, Manocha. OBBTree: a hierarchical structure for rapid interference detection. SIGGRAPH 1996.
    Liang, Barsky. A new concept and method for line clipping. ACM Transactions on Graphics 3, 1984.
    MuJoCo's `engine_collision_box.c` (`mjc_BoxBox`), from which the thresholds are; formulas and code are our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjxgrad._mjx import make_frame

NUM_CONTACTS = 8
"""Contact slots of a pair: a rectangle clipped by a rectangle has at most eight corners."""
ABSENT = 1.0
"""Distance of a slot without a contact (m)."""

_Vector = Float[Array, "3"]
_Matrix = Float[Array, "3 3"]
_Contacts = tuple[Float[Array, "8"], Float[Array, "8 3"], _Vector]
# Relative amount by which an edge axis must beat a face axis, and the one where it is within 8 degrees of that axis.
_EDGE_BIAS, _ALIKE_BIAS, _ALIKE = 1e-6, 0.05, 0.99
# Slope of an edge against a side of the clipping face below which the derivative takes their crossing as fixed on the edge.
_FLAT = 1e-5
_PARALLEL = 1e-30  # slope below which both are parallel: quotients stay finite in single precision
# The three cyclic permutations: row k of the a-th is the axis after a by k + 1.
_CYCLES = np.array([np.roll(np.eye(3), -a - 1, axis=0) for a in range(3)])
_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


class Box(NamedTuple):
    """A box: its centre (m), its axes as columns, and half its lengths (m)."""

    centre: _Vector
    axes: _Matrix
    half: _Vector


class _Axis(NamedTuple):
    """The axis of contact: face 0 to 5 of both boxes, and the pair of edges that takes its place."""

    face: Int[Array, ""]
    is_edge: Bool[Array, ""]
    edges: tuple[Int[Array, ""], Int[Array, ""]]


def box_box(first: Box, second: Box) -> tuple[Float[Array, "8"], Float[Array, "8 3"], Float[Array, "8 3 3"]]:
    """Return the contacts of two boxes: distances (m; `ABSENT` in slots that are not used), positions (m), and frames."""
    # The first rows of frames are normals, which point away from the first box.
    turn = _product(first.axes.T, second.axes)
    ways = _product(first.axes.T, second.centre - first.centre), _product(second.axes.T, first.centre - second.centre)
    axis = _separating_axis(turn, ways, first.half, second.half)
    of_faces, of_edges = _faces(first, second, turn, ways, axis), _edges(first, second, turn, ways[0], axis)
    dist, pos, normal = (jnp.where(axis.is_edge, x, y) for x, y in zip(of_edges, of_faces, strict=True))
    return dist, pos, jnp.tile(make_frame(normal), (NUM_CONTACTS, 1, 1))


def _product(a: Float[Array, "n k"], b: Float[Array, "k *m"]) -> Float[Array, "n *m"]:
    """Return a product of small matrices, at full precision on every device."""
    return jnp.sum(a.reshape(*a.shape, *(1,) * (b.ndim - 1)) * b, axis=1)


def _separating_axis(turn: _Matrix, ways: tuple[_Vector, _Vector], half1: _Vector, half2: _Vector) -> _Axis:
    """Return the axis along which the boxes are farthest apart, or overlap least; it has no derivative."""
    turn, (way, back), half1, half2 = jax.lax.stop_gradient((turn, ways, half1, half2))
    size = jnp.abs(turn)
    of_first, of_second = half1 + _product(size, half2), half2 + _product(size.T, half1)
    faces = jnp.concatenate([jnp.abs(way) - of_first, jnp.abs(back) - of_second])
    face, of_face = jnp.argmax(faces), jnp.max(faces)
    # Edge i across edge j has the axis e_i × t_j / sine, t_j a column of the turn; its components are entries of the turn.
    square = _product(1.0 - jnp.eye(3, dtype=turn.dtype), turn * turn)
    is_axis = square > (1e-16 if turn.dtype == jnp.float64 else 1e-7)
    sine = jnp.sqrt(jnp.where(is_axis, square, 1.0))
    along = jnp.cross(way, jnp.eye(3, dtype=turn.dtype))
    reach = _product(_others(half1), size) + _product(size, _others(half2))
    edges = jnp.where(is_axis, (jnp.abs(_product(along, turn)) - reach) / sine, -jnp.inf).reshape(-1)
    of_edge = jnp.max(edges)
    # Of edges that are equal up to the bias, C MuJoCo takes the first.
    is_better = edges - _EDGE_BIAS * jnp.abs(edges) > of_face
    pair = jnp.argmax(is_better & (edges >= of_edge - _EDGE_BIAS * jnp.abs(of_edge)))
    edge = pair // 3, pair % 3
    axes = jnp.concatenate([jnp.eye(3, dtype=turn.dtype), turn.T])
    cosine = jnp.abs(jnp.sum(jnp.cross(axes[edge[0]], turn[:, edge[1]]) * axes[face])) / sine[edge]
    is_alike = (cosine > _ALIKE) & (edges[pair] < of_face + _ALIKE_BIAS * jnp.abs(of_face) + 1e-15)
    return _Axis(face, jnp.any(is_better) & ~is_alike, edge)


def _others(x: _Vector) -> _Matrix:
    """Return the matrix whose entry (i, j) is the component that is neither i nor j; zero on the diagonal."""
    zero = jnp.zeros_like(x[0])
    return jnp.stack([jnp.stack(row) for row in ((zero, x[2], x[1]), (x[2], zero, x[0]), (x[1], x[0], zero))])


def _faces(first: Box, second: Box, turn: _Matrix, ways: tuple[_Vector, _Vector], axis: _Axis) -> _Contacts:
    is_second = axis.face >= 3
    box, other = (jax.tree.map(lambda x, y: jnp.where(is_second, y, x), *p) for p in ((first, second), (second, first)))
    # Coordinates from here on: two axes of the clipping face, and the height above it.
    cycle = jnp.asarray(_CYCLES, turn.dtype)[axis.face % 3]
    turn, way = _product(cycle, jnp.where(is_second, turn.T, turn)), _product(cycle, jnp.where(is_second, *ways[::-1]))
    side, is_height = jnp.where(way[2] >= 0, 1.0, -1.0), np.arange(3) == 2
    upright = jnp.where(is_height, side, 1.0)
    half = _product(cycle, box.half)
    # Columns: both axes of the face that is clipped, then its normal, against that of the clipping face.
    columns = jnp.asarray(_CYCLES, turn.dtype)[jnp.argmax(jnp.abs(turn[2]))]
    spans = upright[:, None] * _product(turn, columns.T) * _product(columns, other.half)
    below = jnp.where(spans[2, 2] > 0, -1.0, 1.0)
    middle = upright * way + below * spans[:, 2] - jnp.where(is_height, half, 0.0)
    points, is_corner = _packed(*_clipped(middle, spans[:, :2].T, half[:2]), half[:2])
    local = jnp.concatenate([points[:, :2], side * (half[2] + 0.5 * points[:, 2:])], axis=1)
    world = _product(box.axes, cycle.T)
    normal = jnp.where(is_second, -side, side) * world[:, 2]
    return jnp.where(is_corner, points[:, 2], ABSENT), box.centre + _product(local, world.T), normal


def _clipped(
    middle: _Vector, spans: Float[Array, "2 3"], half: Float[Array, "2"]
) -> tuple[Float[Array, "12 3"], Bool[Array, "12"]]:
    """Return corners of a parallelogram clipped by an upright rectangle, and which of them there are."""
    # They are on the parallelogram's four edges, where each begins or enters and where it leaves, and at the rectangle's corners.
    slack = 16 * jnp.finfo(half.dtype).eps
    corners = jnp.asarray(_CORNERS, half.dtype)
    start = middle + _product(corners, spans)
    step = jnp.roll(start, -1, axis=0) - start
    x, dx, limit = start[:, :2], step[:, :2], half * (1 + slack)
    is_inside = jnp.all(jnp.abs(x) <= limit, axis=1)
    slope = jnp.abs(jax.lax.stop_gradient(dx))
    is_steep, is_parallel = slope > _FLAT * jnp.max(slope, axis=1, keepdims=True), slope < _PARALLEL
    steep, flat = jnp.where(is_steep, dx, 1.0), jax.lax.stop_gradient(jnp.where(is_parallel, 1.0, dx))
    # Where each edge passes both limits of each coordinate, as a share of its length.
    passes = [jnp.where(is_steep, way / steep, jax.lax.stop_gradient(way) / flat) for way in (-limit - x, limit - x)]
    between = jnp.abs(x) <= limit
    enter = jnp.max(jnp.where(is_parallel, jnp.where(between, -1.0, 2.0), jnp.minimum(*passes)), axis=1)
    leave = jnp.min(jnp.where(is_parallel, jnp.where(between, 2.0, -1.0), jnp.maximum(*passes)), axis=1)
    is_next = jnp.roll(is_inside, -1)
    is_cut = is_inside | is_next | ((enter < leave) & (enter < 1) & (leave > 0))
    first, last = jnp.where(is_inside, 0.0, jnp.clip(enter, 0, 1)), jnp.clip(leave, 0, 1)
    # The rectangle's corners in the parallelogram's own coordinates.
    (a, b, rise), (c, d, slant) = spans
    way = corners * half - middle[:2]
    own = jnp.stack([way[:, 0] * d - way[:, 1] * c, way[:, 1] * a - way[:, 0] * b], axis=1) / (a * d - b * c)
    height = middle[2] + own[:, 0] * rise + own[:, 1] * slant
    of_rectangle = jnp.concatenate([corners * half, height[:, None]], axis=1)
    points = jnp.concatenate([start + first[:, None] * step, start + last[:, None] * step, of_rectangle])
    return points, jnp.concatenate([is_cut, is_cut & ~is_next, jnp.all(jnp.abs(own) <= 1 + slack, axis=1)])


def _packed(
    points: Float[Array, "12 3"], is_corner: Bool[Array, "12"], half: Float[Array, "2"]
) -> tuple[Float[Array, "8 3"], Bool[Array, "8"]]:
    """Return the points that count, each once, at the front of the slots; and which slots are used."""
    order = np.arange(len(points))
    square = 1e-14 if half.dtype == jnp.float64 else 1e-10
    apart = jax.lax.stop_gradient(points[:, None, :2] - points[None, :, :2])
    is_same = jnp.sum(apart * apart, axis=2) < square * jnp.sum(jax.lax.stop_gradient(half * half))
    is_new = is_corner & ~jnp.any(is_same & is_corner[None] & (order[:, None] > order), axis=1)
    slot = jnp.cumsum(is_new) - 1
    chosen = is_new & (slot == jnp.arange(NUM_CONTACTS)[:, None])
    return jnp.sum(jnp.where(chosen[..., None], points, 0.0), axis=1), chosen.any(axis=1)


def _edges(first: Box, second: Box, turn: _Matrix, way: _Vector, axis: _Axis) -> _Contacts:
    along1, at2 = ((jnp.arange(3) == index).astype(turn.dtype) for index in axis.edges)
    along2 = _product(turn, at2)
    cross = jnp.cross(along1, along2)
    square = jnp.where(axis.is_edge, jnp.sum(cross * cross), 1.0)
    normal = cross / jnp.sqrt(square)
    normal = jnp.where(jnp.sum(normal * way) < 0, -normal, normal)
    # A point of each edge, and the nearest points of both lines within the edges.
    mid1 = jnp.where(normal >= 0, first.half, -first.half) * (1 - along1)
    against = jnp.where(_product(turn.T, normal) >= 0, -second.half, second.half)
    mid2 = way + _product(turn, against * (1 - at2))
    gap = mid2 - mid1
    half1, half2 = jnp.sum(along1 * first.half), jnp.sum(at2 * second.half)
    cosine, gap1, gap2 = jnp.sum(along1 * along2), jnp.sum(along1 * gap), jnp.sum(along2 * gap)
    # The same as (gap1 - cosine gap2) / square, without a difference of numbers that are nearly equal.
    s = jnp.clip(jnp.sum(jnp.cross(gap, along2) * cross) / square, -half1, half1)
    t = jnp.clip(cosine * s - gap2, -half2, half2)
    s = jnp.clip(gap1 + cosine * t, -half1, half1)
    point1, point2 = mid1 + s * along1, mid2 + t * along2
    dist = jnp.where(jnp.arange(NUM_CONTACTS) == 0, jnp.sum((point2 - point1) * normal), ABSENT)
    pos = first.centre + _product(first.axes, 0.5 * (point1 + point2))
    return dist, jnp.tile(pos, (NUM_CONTACTS, 1)), _product(first.axes, normal)
