"""Simple volumes around geoms, and how far they are apart."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

_GEOM = mujoco.mjtGeom


@dataclass(frozen=True)
class Volume:
    """A capsule or a half-space, in the frame of a body.

    Attributes:
        ends: of the capsule's segment (m); of a half-space a point of its plane and that plus the outer normal.
        radius: of the capsule (m).
        is_plane: whether it is a half-space.
    """

    ends: Float[np.ndarray, "2 3"]
    radius: float
    is_plane: bool = False

    @property
    def ball(self) -> tuple[Float[np.ndarray, " 3"], float]:
        """Centre and radius of a ball around it."""
        if self.is_plane:
            return self.ends[0], np.inf
        return self.ends.mean(axis=0), float(np.linalg.norm(self.ends[1] - self.ends[0]) / 2 + self.radius)


@dataclass(frozen=True)
class Carried:
    """A volume at several places.

    Attributes:
        ends: as of `Volume`.
        radius: of the capsules (m).
        is_plane: as of `Volume`.
    """

    ends: Float[np.ndarray, "places 2 3"]
    radius: Float[np.ndarray, " places"]
    is_plane: bool


def volume_of(model: mujoco.MjModel, geom: int) -> Volume:
    """A capsule around a geom, in the frame of its body; for a plane its half-space."""
    kind, size = _GEOM(int(model.geom_type[geom])), model.geom_size[geom]
    centre, axis = np.zeros(3), np.array([0.0, 0.0, 1.0])
    if kind == _GEOM.mjGEOM_PLANE:
        ends, radius = np.stack([centre, axis]), 0.0
    else:
        if kind == _GEOM.mjGEOM_SPHERE:
            half, radius = 0.0, float(size[0])
        elif kind in (_GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CYLINDER):
            half, radius = float(size[1]), float(size[0])
        elif kind == _GEOM.mjGEOM_ELLIPSOID:
            order = np.argsort(size)
            axis = np.eye(3)[order[2]]
            # b² - (x - a + b)² is at least b² (1 - x² / a²) from x = a - b on, so the caps hold the ends.
            half, radius = float(size[order[2]] - size[order[1]]), float(size[order[1]])
        else:
            # Boxes, meshes and height fields by their box; the axis along its longest edge.
            centre, extent = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            longest = int(np.argmax(extent))
            axis, half = np.eye(3)[longest], float(extent[longest])
            radius = float(np.linalg.norm(np.delete(extent, longest)))
        ends = np.stack([centre - half * axis, centre + half * axis])
    placed = ends @ rotation_matrix(model.geom_quat[geom]).T + model.geom_pos[geom]
    return Volume(placed, radius, kind == _GEOM.mjGEOM_PLANE)


def rotation_matrix(quaternion: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    """The matrix of a unit quaternion."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.ascontiguousarray(quaternion, dtype=float))
    return matrix.reshape(3, 3)


def distance_from(first: Carried, second: Volume) -> Float[np.ndarray, " places"]:
    """Distance (m) of a volume at several places from another one; where they overlap, at most zero."""
    ends = first.ends
    if first.is_plane:
        normal = ends[:, 1] - ends[:, 0]
        height = np.einsum("bi,bei->be", normal, second.ends[None] - ends[:, :1])
        return height.min(axis=1) - second.radius
    if second.is_plane:
        return ((ends - second.ends[0]) @ (second.ends[1] - second.ends[0])).min(axis=1) - first.radius
    return _segment_distance(ends, np.broadcast_to(second.ends, ends.shape)) - first.radius - second.radius


def _segment_distance(one: Float[np.ndarray, "n 2 3"], two: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    """Distance of segments: where the lines are closest, if that is within both, else at an end of one of them."""
    from_end = [_point_distance(one[:, i], two) for i in (0, 1)] + [_point_distance(two[:, i], one) for i in (0, 1)]
    u, v, w = one[:, 1] - one[:, 0], two[:, 1] - two[:, 0], one[:, 0] - two[:, 0]
    uu, vv, uv, uw, vw = (np.einsum("ni,ni->n", *pair) for pair in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    determinant = uu * vv - uv**2
    scale = np.where(determinant > 0, determinant, 1.0)
    s, t = np.clip((uv * vw - vv * uw) / scale, 0, 1), np.clip((uu * vw - uv * uw) / scale, 0, 1)
    between = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)
    return np.min([*from_end, between], axis=0)


def _point_distance(point: Float[np.ndarray, "n 3"], segment: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    along, arm = segment[:, 1] - segment[:, 0], point - segment[:, 0]
    length = np.einsum("ni,ni->n", along, along)
    share = np.einsum("ni,ni->n", arm, along) / np.where(length > 0, length, 1.0)
    return np.linalg.norm(arm - np.clip(share, 0, 1)[:, None] * along, axis=1)
