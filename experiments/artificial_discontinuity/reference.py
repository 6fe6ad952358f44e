"""A force that geometry alone gives: the gradient of the volume that two convex bodies share.

The volume is continuous, and so is its gradient but where faces that are parallel part. A penalty on it is what pressure
fields tend to; jumps that it does not have are none of the motion's.
"""

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from scipy.spatial.transform import Rotation

from experiments.artificial_discontinuity.shapes import HALF

_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_THINNEST = 1e-9  # m; of a thinner overlap nothing is known


def overlap_force(poses: Float[np.ndarray, "points 7"]) -> Float[np.ndarray, "points 3"]:
    """Give the force of unit pressure on a cube in another: less the integral of its normal over what lies inside.

    Args:
        poses: of the moved cube, as of a free joint; the other one is fixed at the origin.

    Returns:
        Less the derivative of the shared volume by the position, in m²; zero without overlap.
    """
    return np.array([_force(pose) for pose in poses])


def _force(pose: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 3"]:
    normals = Rotation.from_quat(pose[3:], scalar_first=True).apply(_AXES)
    # Half spaces as scipy takes them, a·x + b ≤ 0; those of the moved cube last.
    offsets = np.concatenate([np.full(6, -HALF), -HALF - normals @ pose[:3]])
    spaces = np.column_stack([np.concatenate([_AXES, normals]), offsets])
    # The largest ball inside both: where its radius is positive they overlap, and its centre lies inside.
    ball = linprog([0, 0, 0, -1], np.column_stack([spaces[:, :3], np.ones(12)]), -offsets, bounds=[(None, None)] * 4)
    if not ball.success or ball.x[3] < _THINNEST:
        return np.zeros(3)
    try:
        hull = ConvexHull(HalfspaceIntersection(spaces, ball.x[:3]).intersections)
    except QhullError:
        return np.zeros(3)
    corners = hull.points[hull.simplices]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    outward, distance = hull.equations[:, :3], hull.equations[:, 3]
    is_moved = np.isclose(outward @ normals.T, 1, atol=1e-7) & np.isclose(distance[:, None], offsets[6:], atol=1e-7)
    return -(areas * is_moved.any(axis=1)) @ outward
