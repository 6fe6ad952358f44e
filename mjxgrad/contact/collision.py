"""Contacts between geoms: MJX's pairs and slots, and some of its functions.

Contacts of planes, balls and capsules are in `capsules`, those of two boxes in `boxes`, and of boxes and cylinders with planes,
balls and capsules in `solids`. All other kinds of pair are MJX's, with two changes for meshes. Contacts of two faces lie half way
between both, as in C MuJoCo, and edges of a mesh that lies flat up to rounding are not taken as touching.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, SupportsInt

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjxgrad._mjx import COLLISION_FUNCTIONS as _PLAIN
from mjxgrad._mjx import contact_groups, custom_number, geom_groups, mjx
from mjxgrad.batched import maps
from mjxgrad.batched.maps import pick
from mjxgrad.bodies.mended import copy_of
from mjxgrad.contact import boxes, capsules, solids

_PerPair = Float[Array, " pairs"]
_Frames = Float[Array, "pairs 3 3"]
_Points = Float[Array, "pairs 3"]
_Point, _Polygon = Float[Array, "3"], Float[Array, "_ 3"]
_Pairs = Int[Array | np.ndarray, "pairs 2"]
# Plain integers: the numbers in MJX's keys do not equal members of an enumeration.
_PLANE, _HEIGHT_FIELD, _SPHERE, _CAPSULE, _ELLIPSOID, _BOX, _CYLINDER, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "BOX", "CYLINDER", "MESH")
)
CONVEX, WITHOUT_CENTRE = (_BOX, _MESH, _HEIGHT_FIELD), (_PLANE, _HEIGHT_FIELD, _MESH)
# Contacts with another convex geom; of flat faces C MuJoCo finds four.
_OF_ROUND = {_SPHERE: 1, _ELLIPSOID: 1, _CAPSULE: 2}
_SLOTS = {(_BOX, _BOX): boxes.NUM_CONTACTS, (_PLANE, _CYLINDER): 4}  # unlike MJX
_WITHOUT_BROAD_PHASE = {_PLANE, _HEIGHT_FIELD}
"""Types without a bounding sphere."""
_ROUND_EDGES = 4.0  # weight of a ball's distance outside an edge: both faces act on it only close to the edge
# Length of an edge times a distance from a plane (m²) below which the product is rounding, in either precision.
_PARALLEL = 1e-12
# Angle of two edges (rad) below which a face touches: more than single-precision rounding, less than angles seen in motions.
_ALIGNED = 1e-5


def collide(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Fill in the contacts; a drop-in for `mjx.collision`, with the same order of pairs."""
    # Where data has fewer slots for contacts of one dimension than there could be contacts, the nearest ones get them.
    if not data._impl.ncon:
        return data
    most_pairs = custom_number(model, "max_geom_pairs")
    contacts, members = contact_groups(model, data), geom_groups(model)
    pairs: dict[Any, Array | np.ndarray] = {}
    for key, contact in contacts.items():
        pairs[key] = geoms = np.array(members[key])[:, :2]
        if len(geoms) > most_pairs > -1 and not _WITHOUT_BROAD_PHASE & set(key.types):
            first, second = data.geom_xpos[geoms.T]
            gaps = jnp.linalg.norm(second - first, axis=1) - jnp.sum(model.geom_rbound[geoms], axis=1)
            contacts[key] = nearest = _greatest(contact, -gaps, most_pairs)
            pairs[key] = nearest.geom
    # MJX finds the contacts of pairs that are known only at run time.
    known = {
        key: geoms
        for key, geoms in pairs.items()
        if isinstance(geoms, np.ndarray) and tuple(key.types) in capsules.KINDS
    }
    found = capsules.find(model, data, known)
    by_dim: dict[int, list] = {}
    for key, geoms in pairs.items():
        find = _FUNCTIONS.get(key.types) or _MJX_FUNCTIONS[key.types]  # pyright: ignore[reportArgumentType]
        dist, pos, frame = found[key] if key in found else find(model, data, key, geoms)
        count = len(dist) // len(geoms)
        contact = jax.tree.map(lambda x, count=count: jnp.repeat(x, count, axis=0), contacts[key])
        if key.types == (_BOX, _BOX):
            # Beyond the margin C MuJoCo has no contact, and other code takes it that the distance is not known.
            dist = jnp.where(dist > contact.includemargin, boxes.ABSENT, dist)
        by_dim.setdefault(int(key.condim), []).append(contact.replace(dist=dist, pos=pos, frame=frame))
    ordered = []
    for dim in sorted(by_dim):
        contact = _joined(by_dim[dim])
        count = int(np.sum(data._impl.contact.dim == dim))
        if len(contact.dist) > count:
            contact = _greatest(contact, contact.includemargin - contact.dist, count)
        ordered.append(contact)
    return data.tree_replace({"_impl.contact": _joined(ordered)})  # pyright: ignore[reportReturnType]


def slot_geoms(model: mjx.Model, data: mjx.Data) -> Int[np.ndarray, "contacts 2"] | None:
    """Return the two geoms of each contact slot; None where slots are assigned at run time."""
    every = candidates(model)
    found = np.concatenate([np.zeros((0, 2), int), *(every[dim] for dim in sorted(every))])
    return found if len(found) == len(data._impl.contact.dim) else None


def candidates(model: mjx.Model) -> dict[int, np.ndarray]:
    """Return the two geoms of each possible contact, by dimension."""
    by_dim: dict[int, list[np.ndarray]] = {}
    for key, members in geom_groups(model).items():
        found = np.repeat(np.array(members)[:, :2], most_contacts(key.types), axis=0)
        by_dim.setdefault(int(key.condim), []).append(found)
    return {dim: np.concatenate(geoms) for dim, geoms in by_dim.items()}


def most_contacts(kinds: tuple[SupportsInt, SupportsInt]) -> int:
    """Return the largest number of contacts of a pair of geoms of two types."""
    first, second = map(int, kinds)
    if (first, second) in _SLOTS:
        return _SLOTS[first, second]
    if (first, second) in _MJX_FUNCTIONS:
        return _MJX_FUNCTIONS[first, second].ncon  # pyright: ignore
    return min(_OF_ROUND.get(kind, 4) for kind in (first, second))  # C MuJoCo's, which alone steps such pairs


def slot_dims(model: mjx.Model) -> Int[np.ndarray, " contacts"]:
    """Return the friction dimension of each contact slot, with the limits that a scene sets for MJX."""
    most_pairs, most_points = (custom_number(model, f"max_{name}") for name in ("geom_pairs", "contact_points"))
    counts: dict[int, int] = {}
    for key, members in geom_groups(model).items():
        is_limited = most_pairs > -1 and not _WITHOUT_BROAD_PHASE & set(key.types)
        num_pairs = min(len(members), most_pairs) if is_limited else len(members)
        count = counts.get(int(key.condim), 0) + num_pairs * most_contacts(key.types)
        counts[int(key.condim)] = min(count, most_points) if most_points > -1 else count
    return np.repeat(sorted(counts), [counts[dim] for dim in sorted(counts)]).astype(int)


def first_missed(model: mjx.Model, data: mjx.Data) -> Float[Array, ""]:
    """Return the distance less the margin beyond which contacts may lack a slot (m); infinite if all have one."""
    contact, gap = data._impl.contact, data._impl.contact.dist - data._impl.contact.includemargin
    slots = {dim: np.flatnonzero(np.asarray(contact.dim) == dim) for dim in np.unique(contact.dim)}
    crowded = [gap[of_dim].max() for dim, of_dim in slots.items() if len(of_dim) < len(candidates(model)[dim])]
    return jnp.min(jnp.stack(crowded)) if crowded else jnp.asarray(jnp.inf, data.qpos.dtype)


def is_blind(model: mjx.Model, geoms: Array | np.ndarray) -> Array | np.ndarray:
    """Return which pairs have a known distance only where they overlap."""
    is_plane, is_round, is_box, is_convex = (
        are(model, geoms, kinds).any(axis=1) for kinds in ((_PLANE,), (_SPHERE, _CAPSULE), (_BOX,), CONVEX)
    )
    return is_convex & ~is_plane & ~(is_round & is_box)  # pyright: ignore[reportReturnType]


def are(model: mjx.Model, geoms: Array | np.ndarray, kinds: tuple[int, ...]) -> Array | np.ndarray:
    """Return which geoms are of the given types; a constant if `geoms` is one."""
    table = np.isin(np.asarray(model.geom_type), kinds)
    return np.asarray(table[geoms]) if isinstance(geoms, np.ndarray) else jnp.asarray(table)[geoms]


def other_sides(
    model: mjx.Model, data: mjx.Data, contact: Any, geoms: Int[np.ndarray, "contacts 2"] | Array
) -> tuple[Any, Float[Array, " contacts"]]:
    """Return the contact that would replace each one as bodies move on, and by how much the present one is nearer (m)."""
    # Where two centres pass each other along the normal, that is the mirrored contact. For a ball within a box it is
    # the contact with the second nearest face. Outside an edge the components along both faces are exchanged, so that
    # the contact is continuous. Faces of boxes are considered only where the geoms are constants.
    towards = pick(geoms[:, 1], data.geom_xpos) - pick(geoms[:, 0], data.geom_xpos)
    pos, frame, nearer = contact.pos, -contact.frame, 2 * jnp.sum(contact.frame[:, 0] * towards, axis=1)
    if isinstance(geoms, np.ndarray):
        kinds = np.asarray(model.geom_type)[geoms]
        in_box = np.flatnonzero((kinds == (_SPHERE, _BOX)).all(axis=1))
        if in_box.size:
            faces = _next_face(model, data, geoms[in_box])
            pos, frame, nearer = (x.at[in_box].set(new) for x, new in zip((pos, frame, nearer), faces, strict=True))
    return contact.replace(pos=pos, frame=frame), nearer


def _next_face(model: mjx.Model, data: mjx.Data, geoms: _Pairs) -> tuple[_Points, _Frames, _PerPair]:
    """Return position and frame of a ball's contact with a box's second nearest face, and how much farther that is."""
    distance, outward, beyond, sign = solids.from_box(model, data, geoms)
    nearest = solids.largest(beyond)
    opposite = -beyond - 2 * pick(geoms[:, 1], model.geom_size)
    rest = jnp.where(nearest, opposite, beyond)
    second = solids.largest(rest)
    along_nearest, along_second = (jnp.sum(jnp.abs(outward) * axis, axis=1)[:, None] for axis in (nearest, second))
    traded = outward + sign * (along_second - along_nearest) * (1.0 * nearest - 1.0 * second)
    is_opposite = jnp.any(nearest & second, axis=1)
    pos, frame = solids.towards(model, data, geoms, distance, jnp.where(is_opposite[:, None], -outward, traded))
    next_one = jnp.max(rest, axis=1)
    # Round an edge the normal turns continuously with the ball, so the contact need not change sides.
    return pos, frame, jnp.max(beyond, axis=1) - next_one + _ROUND_EDGES * jnp.where(next_one > 0, next_one, 0.0)


def _joined(contacts: list):
    return jax.tree.map(lambda *x: jnp.concatenate(x), *contacts)


def _greatest(contact, score: Float[Array, " contacts"], count: int):
    index = jax.lax.top_k(score, k=count)[1]
    chosen = jax.tree.map(lambda x: x[index], contact)
    if contact.dist is None:  # before distances are computed
        return chosen
    places = jnp.concatenate([contact.dist[:, None], contact.pos, contact.frame.reshape(-1, 9)], axis=1)
    dist, pos, frame = jnp.split(maps.choose(index, places), (1, 4), axis=1)
    return chosen.replace(dist=dist[:, 0], pos=pos, frame=frame.reshape(-1, 3, 3))


def _box_box(model: mjx.Model, data: mjx.Data, _, geoms: _Pairs) -> capsules.Found:
    places = data.geom_xpos, data.geom_xmat, model.geom_size
    dist, pos, frame = jax.vmap(boxes.box_box)(*(boxes.Box(*(pick(geom, x) for x in places)) for geom in geoms.T))
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


_FUNCTIONS = {
    (_PLANE, _BOX): solids.plane_box,
    (_PLANE, _CYLINDER): solids.plane_cylinder,
    (_SPHERE, _BOX): solids.sphere_box,
    (_SPHERE, _CYLINDER): solids.sphere_cylinder,
    (_CAPSULE, _BOX): solids.capsule_box,
    (_BOX, _BOX): _box_box,
}


def _divisor(x: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.where(jnp.abs(x) >= _PARALLEL, x, 1e-6)


def _closest_segment_point_plane(a: _Point, b: _Point, p0: _Point, plane_normal: _Point) -> _Point:
    """Return the point where a segment meets a plane, or its nearer end; some point if they are parallel."""
    along = jnp.sum(plane_normal * (b - a))
    share = (jnp.sum(p0 * plane_normal) - jnp.sum(plane_normal * a)) / _divisor(along)
    return a + jnp.clip(share, 0, 1) * (b - a)


def _project_poly_onto_poly_plane(poly1: _Polygon, norm1: _Point, poly2: _Polygon, norm2: _Point) -> _Polygon:
    """Return the first polygon, projected along its normal onto the plane of the second."""
    way = (poly2[0].dot(norm2) - poly1.dot(norm2)) / _divisor(norm1.dot(norm2))
    return poly1 + way.reshape(-1, 1) * norm1


def _half_way(
    manifold: Callable, one: _Polygon, other: _Polygon, normal: _Point, other_normal: _Point, axis: _Point
) -> tuple[Float[Array, "_"], _Polygon, _Polygon]:
    """Return the contacts of two faces, half way between both; the axis stands upright on the face that clips."""
    faces, normals = (one, other), (normal, other_normal)
    if one.shape == other.shape:
        is_other = jnp.abs(axis.dot(other_normal)) > jnp.abs(axis.dot(normal))
        faces, normals = ((jnp.where(is_other, y, x), jnp.where(is_other, x, y)) for x, y in (faces, normals))
    distance, position, normal = manifold(*faces, *normals, axis)
    return distance, position + 0.5 * distance[:, None] * normals[0], normal


def _once(search: Callable, *shapes: Any) -> tuple[Float[Array, "_"], _Polygon, _Polygon]:
    """Return contacts as a search of MJX does; of fewer than four it takes one several times, which would count as many."""
    distance, position, normal = search(*shapes)
    order = jnp.arange(len(position))
    is_same = jnp.all(position[:, None] == position[None], axis=2) & (order[:, None] > order)
    return jnp.where(is_same.any(axis=1), 1.0, distance), position, normal


def _arcs_intersect(a: _Point, b: _Point, c: _Point, d: _Point) -> Bool[Array, ""]:
    """Return whether arcs AB and CD of the unit sphere cross by more than rounding."""
    first, second = jnp.cross(b, a), jnp.cross(d, c)
    sides = jnp.stack([c.dot(first), -d.dot(first), b.dot(second), -a.dot(second)])
    return jnp.all(sides > _ALIGNED) | jnp.all(sides < -_ALIGNED)


_mended = (_arcs_intersect, _closest_segment_point_plane, _project_poly_onto_poly_plane)
_convex = copy_of("collision_convex", **{function.__name__: function for function in _mended})
_convex._create_contact_manifold = partial(_half_way, _convex._create_contact_manifold)
# MJX decides between faces and edges by the distances of all four: repeated contacts are marked after that.
_convex._sat_gaussmap = partial(_once, _convex._sat_gaussmap)
_own = {f: getattr(_convex, name) for name, f in vars(sys.modules[_convex.__name__]).items() if hasattr(f, "ncon")}
# MJX's function for each pair of types; those of capsules, meshes and height fields are copies with safe quotients.
_MJX_FUNCTIONS = {kinds: _own.get(f, f) for kinds, f in _PLAIN.items()}
