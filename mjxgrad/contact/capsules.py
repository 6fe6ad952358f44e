"""Contacts of planes, balls and capsules; a ball is a capsule of length zero.

All pairs with a plane share one formula, and all others another: forty pairs of a robot take as many operations as one.
All agree with C MuJoCo. MJX has other tangents for capsules that lean by more than 60° from a plane, such as standing legs.

Nearest points of two segments, with unit axes a₁ and a₂ and centres r apart: the first line is nearest to the second at
s = (a₂·r a₁·a₂ - a₁·r) / (1 - (a₁·a₂)²), and t = a₂·r + s a₁·a₂ is the point of the second line nearest to s. s is clamped
to its segment and gives t; t is clamped and gives s again. A second round changes nothing.

References:
    Ericson. Real-Time Collision Detection. Morgan Kaufmann 2005, section 5.1.9.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import Bilinear, dot, pick, scale
from mjxgrad.bodies.spatial import cross

_PerPair = Float[Array, " pairs"]
_Vectors = Float[Array, "pairs 3"]
_Frames = Float[Array, "pairs 3 3"]
_Pairs = Int[np.ndarray, "pairs 2"]
_Group = Int[np.ndarray, "_ 2"]
Found = tuple[Float[Array, " contacts"], Float[Array, "contacts 3"], Float[Array, "contacts 3 3"]]
"""Distances, positions and frames."""
_PLANE, _SPHERE, _CAPSULE = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "SPHERE", "CAPSULE"))
KINDS = {(first, second) for first in (_PLANE, _SPHERE, _CAPSULE) for second in (_SPHERE, _CAPSULE)}
# Tilt of an upright axis over rounding, which gives no tangent; square of one over a root of rounding, below small differences:
# there the tangent turns so fast that its derivative means nothing.
_UPRIGHT, _NEARLY = 16.0, 0.01


def find(model: mjx.Model, data: mjx.Data, groups: Mapping[Any, _Group]) -> dict[Any, Found]:
    """Return the contacts of groups of pairs; all pairs of a group have the same two types."""
    found: dict[Any, Found] = {}
    for has_plane, contacts in ((True, _on_planes), (False, _between)):
        chosen = [key for key in groups if (key.types[0] == _PLANE) == has_plane]
        if chosen:
            every, counts = contacts(model, data, [groups[key] for key in chosen])
            parts = zip(*(jnp.split(x, np.cumsum(counts)[:-1]) for x in every), strict=True)
            found |= zip(chosen, parts, strict=True)
    return found


def _on_planes(model: mjx.Model, data: mjx.Data, groups: list[_Group]) -> tuple[Found, list[int]]:
    """Return one contact for each ball and two for each capsule, its head first, and the number of each group."""
    ends = [np.array([1.0, -1.0] if model.geom_type[pairs[0, 1]] == _CAPSULE else [0.0]) for pairs in groups]
    counts = [len(pairs) * len(of_one) for pairs, of_one in zip(groups, ends, strict=True)]
    pairs = np.concatenate([np.repeat(pairs, len(of_one), axis=0) for pairs, of_one in zip(groups, ends, strict=True)])
    end = np.concatenate([np.tile(of_one, len(pairs)) for pairs, of_one in zip(groups, ends, strict=True)])
    origin, normal, centre, axis = _placed(data, pairs)
    radius, half = _sizes(model, pairs[:, 1])
    along, lean = jnp.asarray(end, half.dtype) * half, dot(normal, axis)
    dist = dot(normal, centre - origin) + along * lean - radius
    pos = centre + scale(along, axis) - scale(radius + 0.5 * dist, normal)
    tilt, rounding = axis - scale(lean, normal), float(jnp.finfo(axis.dtype).eps)
    square = dot(tilt, tilt)[:, None]
    axis = jnp.where(square < _NEARLY * rounding**0.5, jax.lax.stop_gradient(axis), axis)
    x = jnp.where(jnp.abs(normal[:, :1]) < 0.5, jnp.array([1.0, 0.0, 0.0], axis.dtype), _sideways(normal))
    along = jnp.where(square < (_UPRIGHT * rounding) ** 2, x, axis)
    return (dist, pos, _frames(normal, jnp.where((end != 0)[:, None], along, _sideways(normal)))), counts


def _between(model: mjx.Model, data: mjx.Data, groups: list[_Group]) -> tuple[Found, list[int]]:
    """Return the contacts of balls and capsules, one for each pair, and the number of each group."""
    pairs = np.concatenate(groups)
    centre, axis, other, other_axis = _placed(data, pairs)
    (radius, half), (other_radius, other_half) = (_sizes(model, geoms) for geoms in pairs.T)
    apart = centre - other
    factors = jnp.concatenate([axis, other_axis], axis=1), jnp.concatenate([other_axis, apart], axis=1)
    cosine, ahead, behind = _products(*factors).T
    across = cross(axis, other_axis)
    sine2 = dot(across, across)
    # Below this squared sine axes count as parallel, and the nearest point is the middle of the first.
    parallel = max(1e-6, float(jnp.finfo(axis.dtype).eps) ** 0.5)
    # 1 / sin² up to the fourth power of parallel / (sin² + parallel), and bounded by 4 / parallel.
    ratio = parallel / (sine2 + parallel)
    sharpness = (1 + ratio) * (1 + ratio**2) / (sine2 + parallel)
    first = _kept(sharpness * (cosine * behind - ahead), half)
    second = _kept(behind + cosine * first, other_half)
    first = _kept(cosine * second - ahead, half)
    point = centre + scale(first, axis)
    towards = other + scale(second, other_axis) - point
    square, rounding = dot(towards, towards), 16 * float(jnp.finfo(axis.dtype).eps)
    is_same = square <= (rounding * (radius + half + other_radius + other_half)) ** 2
    length = jnp.sqrt(jnp.where(is_same, 1.0, square))
    # Where axes cross, as in planar robots, the normal is perpendicular to both; where they coincide, it is the x axis.
    is_crossing = sine2 > parallel
    x = jnp.array([1.0, 0.0, 0.0], axis.dtype)
    crossing = jnp.where(is_crossing[:, None], scale(jax.lax.rsqrt(jnp.where(is_crossing, sine2, 1.0)), across), x)
    normal = jnp.where(is_same[:, None], crossing, scale(1 / length, towards))
    dist = jnp.where(is_same, 0.0, length) - (radius + other_radius)
    pos = point + scale(radius + 0.5 * dist, normal)
    return (dist, pos, _frames(normal, _sideways(normal))), [len(pairs) for pairs in groups]


def _placed(data: mjx.Data, pairs: _Pairs) -> tuple[_Vectors, _Vectors, _Vectors, _Vectors]:
    """Return position and third axis (a plane's normal) of the first geom of each pair, then of the second."""
    places = jnp.concatenate([data.geom_xpos, data.geom_xmat[:, :, 2]], axis=1)
    of_pairs = pick(pairs.T.reshape(-1), places).reshape(2, len(pairs), 6)
    return of_pairs[0, :, :3], of_pairs[0, :, 3:], of_pairs[1, :, :3], of_pairs[1, :, 3:]


def _sizes(model: mjx.Model, geoms: Int[np.ndarray, " pairs"]) -> tuple[_PerPair, _PerPair]:
    sizes = pick(geoms, model.geom_size)
    return sizes[:, 0], jnp.where(model.geom_type[geoms] == _CAPSULE, sizes[:, 1], 0.0)


def _kept(place: _PerPair, half: _PerPair) -> _PerPair:
    """Return places clamped to between -half and half; those of a ball, zero, have no derivative."""
    return jnp.where(jnp.abs(place) < half, place, jnp.where(place < 0, -half, half))


def _sideways(normal: _Vectors) -> _Vectors:
    """Return the axis, y or z, that defines a contact's first tangent."""
    is_y = (jnp.abs(normal[:, 1]) < 0.5)[:, None]
    y, z = jnp.eye(3, dtype=normal.dtype)[1:]
    return jnp.where(is_y, y, z)


def _frames(normal: _Vectors, towards: _Vectors) -> _Frames:
    """Return normals and two tangents, the first as far as possible towards a vector."""
    across = towards - scale(dot(normal, towards), normal)
    tangent = scale(jax.lax.rsqrt(dot(across, across)), across)
    return jnp.stack([normal, tangent, cross(normal, tangent)], axis=1)


_products = Bilinear(np.kron([[[1, 0], [0, 0]], [[0, 1], [0, 0]], [[0, 0], [0, 1]]], np.eye(3)))
"""a·b, a·c and b·c, from (a, b) and (b, c)."""
