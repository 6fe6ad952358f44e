r"""Contacts of boxes and cylinders with planes, balls and capsules, where C MuJoCo has them. MJX has other rules.

- **A box on a plane** touches with the lower end of each of its four diagonals, so a contact always belongs to the same one.
- **A cylinder on a plane** touches with four points: the lowest point of its lower rim, two more of this rim a third of a turn
  away, and the lowest point of its upper rim. With $m$ the plane's normal in the cylinder's frame, the lowest points lie towards
  $-(m_x, m_y)$; those of an upright cylinder, which has none, along its x axis.
- **A ball** touches at the point of a box or cylinder nearest to its centre; from inside, at the nearest face.
- **A capsule on a box** touches as two balls on its axis $p + s a$, $|s| \le 1$. The first is where the axis is nearest: an end
  over a face, or the place nearest to one of the twelve edges. Across an edge along j, with c a point on it, $s = a_\perp·(c -
  p)_\perp / |a_\perp|^2$ is beside the edge's point $p_j + s a_j$; both are clamped. The second ball is farther along the axis
  over the box, at the capsule's end or the box's, whichever comes first: from a face to the far side; from an edge over the face
  at the lower angle; from a corner along an edge within 45°, else the other way over a face. There is none where both ways lead
  off the box or both into it. Where the axis lies exactly along one of the box, rounding decides on that.

References:
    MuJoCo's `engine_collision_box.c` (`mjc_CapsuleBox`) and `engine_collision_primitive.c` (`mjc_PlaneCylinder`), from which the
    cases and thresholds are; formulas and code are our own.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._mjx import make_frame, mjx
from mjxgrad.batched.maps import contract, dot, pick, safe_norm
from mjxgrad.contact.boxes import ABSENT
from mjxgrad.contact.capsules import Found

_PerPair = Float[Array, " pairs"]
_Frames = Float[Array, "pairs 3 3"]
_Points = Float[Array, "pairs 3"]
_Pairs = Any  # of geoms, one pair a row: constants, or chosen at run time
_Vector = Float[Array, "3"]
_DIAGONALS = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]])
# The twelve edges of a box, in C MuJoCo's order: their directions, and on which side they are of the other two axes.
_WAYS = np.repeat(np.eye(3), 4, axis=0)
_SIDES = np.array([np.insert([x, y], axis, 0) for axis in range(3) for y in (-1, 1) for x in (-1, 1)])
_LEVEL = 16.0  # tilt of an upright cylinder, over rounding, that tells its lowest point
_ALIKE = 1e-15  # MuJoCo's smallest number: of squared distances (m²) that are alike, and of axes along an edge (m⁴)


def plane_box(model: mjx.Model, data: mjx.Data, _: Any, geoms: _Pairs) -> Found:
    """Return contacts at the lower end of each diagonal of the box, |n·diagonal| below the centre."""
    plane, box = geoms.T
    normal, centre = pick(plane, data.geom_xmat)[:, :, 2], pick(box, data.geom_xpos)
    height = dot(normal, centre - pick(plane, data.geom_xpos))
    halves = jnp.asarray(_DIAGONALS, centre.dtype) * pick(box, model.geom_size)[:, None]
    diagonal = contract("pij,pdj->pdi", pick(box, data.geom_xmat), halves)
    rise = contract("pi,pdi->pd", normal, diagonal)
    to_lower = jnp.where(rise > 0, -1, 1)
    return _on_plane(height[:, None] + to_lower * rise, centre[:, None] + to_lower[..., None] * diagonal, normal)


def plane_cylinder(model: mjx.Model, data: mjx.Data, _: Any, geoms: _Pairs) -> Found:
    """Return contacts at four points of the rims: the lowest of both, and two more of the lower one."""
    plane, cylinder = geoms.T
    normal, centre = pick(plane, data.geom_xmat)[:, :, 2], pick(cylinder, data.geom_xpos)
    radius, half = pick(cylinder, model.geom_size).T[:2]
    local = contract("pji,pj->pi", pick(cylinder, data.geom_xmat), normal)
    tilt = safe_norm(local[:, :2])
    rounding = float(jnp.finfo(tilt.dtype).eps)
    is_level = tilt < _LEVEL * rounding
    down = -local[:, :2] / jnp.where(is_level, 1.0, tilt)[:, None]
    down = jnp.where(is_level[:, None], jnp.array([1.0, 0.0], down.dtype), down)
    # Below a root of rounding the lowest point runs along the rim so fast that its derivative means nothing.
    down = jnp.where((tilt < rounding**0.5)[:, None], jax.lax.stop_gradient(down), down)
    lower = jnp.where(local[:, 2] > 0, -half, half)
    turn = jnp.array([[[1.0, 0], [0, 1]], [[1, 0], [0, 1]], [[-0.5, -(0.75**0.5)], [0.75**0.5, -0.5]],
                      [[-0.5, 0.75**0.5], [-(0.75**0.5), -0.5]]], down.dtype)  # fmt: skip
    around = jnp.sum(turn[None] * (radius[:, None] * down)[:, None, None], axis=3)
    along = lower[:, None] * jnp.array([1.0, -1, 1, 1], down.dtype)
    rims = jnp.concatenate([around, along[..., None]], axis=2)
    height = dot(normal, centre - pick(plane, data.geom_xpos))
    dist = height[:, None] + contract("pi,pdi->pd", local, rims)
    return _on_plane(dist, centre[:, None] + contract("pij,pdj->pdi", pick(cylinder, data.geom_xmat), rims), normal)


def sphere_box(model: mjx.Model, data: mjx.Data, _: Any, geoms: _Pairs) -> Found:
    """Return contacts at the point of the box nearest to the ball's centre; on the nearest face if it is inside."""
    distance, outward, *_ = from_box(model, data, geoms)
    pos, frame = towards(model, data, geoms, distance, outward)
    return distance - pick(geoms[:, 0], model.geom_size)[:, 0], pos, frame


def capsule_box(model: mjx.Model, data: mjx.Data, _: Any, geoms: _Pairs) -> Found:
    """Return the contacts of two balls on the axis of each capsule; the second may be absent."""
    capsule, box = geoms.T
    radius, length = (jnp.repeat(x, 2) for x in pick(capsule, model.geom_size).T[:2])
    half, axis = pick(box, model.geom_size), length[::2, None] * pick(capsule, data.geom_xmat)[:, :, 2]
    local = contract("pji,pj->pi", pick(box, data.geom_xmat), axis)
    places, is_present = jax.vmap(places_on_axis)(_centre_in(data, geoms), local, half)
    centre = (pick(capsule, data.geom_xpos)[:, None] + places[..., None] * axis[:, None]).reshape(-1, 3)
    both = jnp.repeat(box, 2) if isinstance(box, Array) else np.repeat(box, 2)
    distance, outward, *_ = _beside_box(_into(data, both, centre), pick(both, model.geom_size))
    pos, frame = _half_way(data, both, centre, radius, distance, outward)
    return jnp.where(is_present.reshape(-1), distance - radius, ABSENT), pos, frame


def sphere_cylinder(model: mjx.Model, data: mjx.Data, _: Any, geoms: _Pairs) -> Found:
    """Return contacts at the point of the cylinder nearest to the ball's centre; on the nearer of side and end if inside."""
    centre = _centre_in(data, geoms)
    radius = safe_norm(centre[:, :2])
    on_axis = (radius < 1e-12)[:, None]  # m; below it the radial direction's derivative overflows
    radial = jnp.where(on_axis, jnp.array([1.0, 0.0]), centre[:, :2] / jnp.where(on_axis, 1.0, radius[:, None]))
    # Coordinates in the half-plane of axis and centre: radial, axial.
    beyond = jnp.stack([radius, jnp.abs(centre[:, 2])], axis=1) - pick(geoms[:, 1], model.geom_size)[:, :2]
    sign = jnp.stack([jnp.ones_like(radius), jnp.where(centre[:, 2] < 0, -1.0, 1.0)], axis=1)
    distance, outward = _from_faces(beyond, sign)
    outward = jnp.concatenate([outward[:, :1] * radial, outward[:, 1:]], axis=1)
    pos, frame = towards(model, data, geoms, distance, outward)
    return distance - pick(geoms[:, 0], model.geom_size)[:, 0], pos, frame


def from_box(model: mjx.Model, data: mjx.Data, geoms: _Pairs) -> tuple[Array, Array, Array, Array]:
    """Return distance and direction of a ball's centre from a box, and its distances and signs along the axes."""
    return _beside_box(_centre_in(data, geoms), pick(geoms[:, 1], model.geom_size))


def towards(
    model: mjx.Model, data: mjx.Data, geoms: _Pairs, distance: _PerPair, outward: _Points
) -> tuple[_Points, _Frames]:
    """Return position and frame of contacts of balls, half way between both surfaces."""
    sphere, other = geoms.T
    radius = pick(sphere, model.geom_size)[:, 0]
    return _half_way(data, other, pick(sphere, data.geom_xpos), radius, distance, outward)


def largest(x: Float[Array, "pairs k"]) -> Array:
    """Return whether each number of an item is the largest."""
    return jnp.arange(x.shape[1]) == jnp.argmax(x, axis=1)[:, None]


def places_on_axis(centre: _Vector, axis: _Vector, half: _Vector) -> tuple[Float[Array, "2"], Bool[Array, "2"]]:
    """Return where a capsule's two balls are on its axis, between -1 and 1, and which there are, in the frame of a box (m)."""
    square = jnp.sum(axis * axis)
    slack = jnp.maximum(_ALIKE, float(jnp.finfo(square.dtype).eps) * square)
    ends = centre + jnp.array([[-1.0], [1.0]], axis.dtype) * axis
    beyond = jnp.abs(ends) - half
    is_over = beyond > 0
    apart = jnp.sum(jnp.where(is_over, beyond, 0.0) ** 2, axis=1)
    of_ends = jnp.where(jnp.sum(is_over, axis=1) > 1, jnp.inf, apart)  # these are nearest to an edge
    of_edges, places, on_edges, ends_of_edges = _nearest_to_edges(centre, axis, half)
    last, edge = jnp.argmin(of_ends) == 1, jnp.argmax(of_edges <= jnp.min(of_edges) + slack)
    is_face = jnp.min(of_edges) >= jnp.min(of_ends) - slack
    way, corner = (jnp.asarray(x, axis.dtype)[edge] for x in (_WAYS, _SIDES))
    of_all, is_chosen = (places, on_edges, ends_of_edges), jnp.arange(12) == edge
    place, on_edge, passed = (jnp.sum(jnp.where(is_chosen, x, 0.0)) for x in of_all)
    place = jnp.where(is_face, jnp.where(last, 1.0, -1.0), place)
    corner = corner + way * jnp.where(passed > 0, 1.0, -1.0)
    of_edge = _from_edge(axis, half, corner, way > 0, on_edge)
    of_edge = (jnp.where(passed == 0, x, y) for x, y in zip(of_edge, _from_corner(axis, half, corner), strict=True))
    end, is_above = (jnp.where(last, x[1], x[0]) for x in (ends, is_over))
    of_face = _from_face(axis, half, end, is_above, place)
    sense, reach = (jnp.where(is_face, x, y) for x, y in zip(of_face, of_edge, strict=True))
    size = jnp.abs(axis)
    moves = jnp.isfinite(reach) & (size * size > _ALIKE * square)
    far = jnp.where(moves, jnp.where(moves, reach, 1.0) / jnp.where(moves, size, 1.0), 2.0)
    second = place + sense * jnp.minimum(1 - sense * place, jnp.min(far))
    return jnp.stack([place, second]), jnp.stack([jnp.array(True), sense != 0])


def _nearest_to_edges(centre: _Vector, axis: _Vector, half: _Vector) -> tuple[Float[Array, "12"], ...]:
    """Return for each edge the squared distance, the places on axis and edge, and beyond which end of the edge it was."""
    ways = jnp.asarray(_WAYS, axis.dtype)
    middle = jnp.asarray(_SIDES, axis.dtype) * half
    length, begin, rise = (jnp.sum(ways * x, axis=1) for x in (half, centre, axis))
    across = (1 - ways) * axis
    square = jnp.sum(across * across, axis=1)
    is_apart = length**2 * square > _ALIKE

    def on_edge(place: Float[Array, "12"]) -> Float[Array, "12"]:
        return (begin + rise * place) / length

    place = jnp.sum(across * (middle - centre), axis=1) / jnp.where(is_apart, square, 1.0)
    at = on_edge(place)
    first = jnp.where(jnp.abs(at) > 1, jnp.sign(at), 0.0)
    tip = middle + (length * jnp.clip(at, -1, 1))[:, None] * ways
    place = jnp.where(first != 0, jnp.sum(axis * (tip - centre), axis=1) / jnp.sum(axis * axis), place)
    at = jnp.where(jnp.abs(place) > 1, on_edge(jnp.clip(place, -1, 1)), jnp.clip(at, -1, 1))
    place, passed = jnp.clip(place, -1, 1), jnp.where(jnp.abs(at) > 1, jnp.sign(at), first)
    at = jnp.clip(at, -1, 1)
    gap = middle + (length * at)[:, None] * ways - centre - place[:, None] * axis
    return jnp.where(is_apart, jnp.sum(gap * gap, axis=1), jnp.inf), place, at, passed


# Which way the second ball is from the first, 0 if there is none, and how far each coordinate may go (m).


def _from_corner(axis: _Vector, half: _Vector, corner: _Vector) -> tuple[Float[Array, ""], _Vector]:
    """Go along an edge, or the other way across a face; the corner has the signs of its coordinates."""
    is_opposite = (axis > 0) != (corner > 0)
    count = jnp.sum(is_opposite)
    is_odd = jnp.where(count == 1, is_opposite, ~is_opposite)
    is_along = 2 * jnp.sum(jnp.where(is_odd, axis * axis, 0.0)) > jnp.sum(axis * axis)
    sense = jnp.where((count == 1) == is_along, 1.0, -1.0)
    return jnp.where((count == 1) | (count == 2), sense, 0.0), jnp.where(is_odd == is_along, 2 * half, jnp.inf)


def _from_edge(
    axis: _Vector, half: _Vector, corner: _Vector, is_way: Bool[Array, "3"], on_edge: Float[Array, ""]
) -> tuple[Float[Array, ""], _Vector]:
    """Go across the face with the lower angle, to its far side or the edge's end."""
    is_opposite = (axis > 0) != (corner > 0)
    first, second = jnp.roll(is_way, 1), jnp.roll(is_way, 2)
    longer = jnp.sum(jnp.where(first, jnp.abs(axis), 0.0)) > jnp.sum(jnp.where(second, jnp.abs(axis), 0.0))
    is_main = jnp.where(longer, first, second)
    sense = jnp.where(jnp.any(is_opposite & is_main), 1.0, -1.0)
    rest = half * (1 - sense * jnp.where(axis > 0, 1.0, -1.0) * on_edge)
    is_one = jnp.sum(is_opposite & ~is_way) == 1
    return jnp.where(is_one, sense, 0.0), jnp.where(is_main, 2 * half, jnp.where(is_way, rest, jnp.inf))


def _from_face(
    axis: _Vector, half: _Vector, end: _Vector, is_over: Bool[Array, "3"], place: Float[Array, ""]
) -> tuple[Float[Array, ""], _Vector]:
    """Go from an end that stands over a face towards the other end; from inside the box, nowhere."""
    rest = half + jnp.where(place * axis > 0, 1.0, -1.0) * end
    return jnp.where(jnp.any(is_over), -place, 0.0), jnp.where(is_over | (rest <= 0), jnp.inf, rest)


def _on_plane(dist: Float[Array, "pairs n"], points: Float[Array, "pairs n 3"], normal: _Points) -> Found:
    frame = jnp.repeat(jax.vmap(make_frame)(normal), dist.shape[1], axis=0)
    return dist.reshape(-1), (points - 0.5 * dist[..., None] * normal[:, None]).reshape(-1, 3), frame


def _centre_in(data: mjx.Data, geoms: _Pairs) -> _Points:
    return _into(data, geoms[:, 1], pick(geoms[:, 0], data.geom_xpos))


def _into(data: mjx.Data, geoms: Any, points: _Points) -> _Points:
    return contract("pji,pj->pi", pick(geoms, data.geom_xmat), points - pick(geoms, data.geom_xpos))


def _beside_box(centre: _Points, half: _Points) -> tuple[Array, Array, Array, Array]:
    """Return distance and direction of points from boxes, and their distances and signs along the axes."""
    beyond, sign = jnp.abs(centre) - half, jnp.where(centre < 0, -1.0, 1.0)
    return *_from_faces(beyond, sign), beyond, sign


def _from_faces(beyond: Float[Array, "pairs k"], sign: Float[Array, "pairs k"]) -> tuple[_PerPair, Array]:
    """Return distance and direction of a point from a body with faces at right angles; from the nearest one if inside."""
    is_inside = jnp.all(beyond <= 0, axis=1)
    gap = sign * jnp.where(beyond > 0, beyond, 0.0)
    length, nearest = safe_norm(gap), sign * largest(beyond)
    outward = jnp.where(is_inside[:, None], nearest, gap / jnp.where(length > 0, length, 1.0)[:, None])
    return jnp.where(is_inside, jnp.max(beyond, axis=1), length), outward


def _half_way(
    data: mjx.Data, solid: Any, centre: _Points, radius: _PerPair, distance: _PerPair, outward: _Points
) -> tuple[_Points, _Frames]:
    normal = contract("pij,pj->pi", pick(solid, data.geom_xmat), -outward)
    return centre + (0.5 * (distance + radius))[:, None] * normal, jax.vmap(make_frame)(normal)
