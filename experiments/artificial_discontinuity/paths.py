"""One-parameter paths of a body over the cube."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from experiments.artificial_discontinuity.shapes import HALF, Shape

# Off the planes of symmetry, where several things would happen at once.
_ASIDE = 0.013  # m
_UPRIGHT = Rotation.identity()
# One corner down: turned about the diagonal's horizontal normal until the diagonal is vertical.
_ON_CORNER = Rotation.align_vectors([[0.0, 0.0, -1.0]], [[-1.0, -1.0, -1.0] / np.sqrt(3.0)])[0]


@dataclass(frozen=True)
class Path:
    """How a body is moved.

    Attributes:
        title: for figures and tables.
        interval: of the parameter.
        unit: of the parameter, m or rad.
        orientation: from parameters to rotations.
        place: from parameters to horizontal positions (m).
    """

    title: str
    interval: tuple[float, float]
    unit: str
    orientation: Callable[[np.ndarray], Rotation]
    place: Callable[[np.ndarray], Float[np.ndarray, "points 2"]]

    @property
    def length(self) -> float:
        """Of the interval."""
        return self.interval[1] - self.interval[0]

    def poses(
        self, shape: Shape, depth: float, parameters: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 7"]:
        """Give positions and quaternions.

        Args:
            shape: the body.
            depth: of its lowest point in the cube at parameter zero, in m; its centre stays at that height.
            parameters: along the path.
        """
        start = self.orientation(np.zeros(1))[0]
        reach = shape.radius - start.apply(shape.hull)[:, 2].min()
        height = np.full(len(parameters), HALF + reach - depth)
        quaternions = self.orientation(parameters).as_quat(scalar_first=True)
        return np.concatenate([self.place(parameters), height[:, None], quaternions], axis=1)


def _turned(*axis: float) -> Callable[[np.ndarray], Rotation]:
    """Return rotations about an axis by the parameter."""
    return lambda parameters: Rotation.from_rotvec(parameters[:, None] * np.array(axis))


def _still(orientation: Rotation) -> Callable[[np.ndarray], Rotation]:
    """Return the same rotation for all parameters."""
    return lambda parameters: Rotation.concatenate([orientation] * len(parameters))


def _along(parameters: np.ndarray) -> np.ndarray:
    return np.stack([parameters, np.full_like(parameters, _ASIDE)], axis=1)


def _at(x: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda parameters: np.broadcast_to([x, _ASIDE], (len(parameters), 2))


PATHS = {
    "slide": Path("slide past the edge", (0.0, 0.21), "m", _still(_UPRIGHT), _along),
    "askew": Path("slide askew", (0.0, 0.25), "m", _still(Rotation.from_euler("z", 0.4)), _along),
    "roll": Path("roll", (-0.12, 0.12), "rad", _turned(0.0, 1.0, 0.0), _at(0.03)),
    "yaw": Path("yaw", (0.0, np.pi / 2), "rad", _turned(0.0, 0.0, 1.0), _at(0.05)),
    "corner": Path("corner past the edge", (0.0, 0.11), "m", _still(_ON_CORNER), _along),
}
