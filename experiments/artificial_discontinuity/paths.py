"""One-parameter paths of a body over the cube."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from experiments.artificial_discontinuity.shapes import HALF, Shape

# Off the planes of symmetry, where several things would happen at once.
_ASIDE = 0.013  # m
# One corner down: turned about the diagonal's horizontal normal until the diagonal is vertical.
_ON_CORNER = Rotation.align_vectors([[0.0, 0.0, -1.0]], [[-1.0, -1.0, -1.0] / np.sqrt(3.0)])[0]


@dataclass(frozen=True)
class Path:
    """How a body is moved: along x, or turned about an axis.

    Attributes:
        title: for figures and tables.
        interval: of the parameter, in m or rad.
        axis: about which it is turned; None where it slides.
        x: where it is turned (m).
        start: its orientation at parameter zero.
    """

    title: str
    interval: tuple[float, float]
    axis: tuple[float, float, float] | None = None
    x: float = 0.0
    start: Rotation = Rotation.identity()  # noqa: RUF009

    @property
    def unit(self) -> str:
        """Of the parameter."""
        return "rad" if self.axis else "m"

    @property
    def length(self) -> float:
        """Of the interval."""
        return self.interval[1] - self.interval[0]

    def poses(
        self, shape: Shape, depth: float, parameters: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 7"]:
        """Give positions and quaternions; the centre's height is that at which the lowest point is as deep at parameter zero."""
        still = np.zeros_like(parameters)
        turns = np.multiply.outer(parameters if self.axis else still, self.axis or (0.0, 0.0, 1.0))
        reach = shape.radius - self.start.apply(shape.hull)[:, 2].min()
        x = still + self.x if self.axis else parameters
        places = np.stack([x, still + _ASIDE, still + HALF + reach - depth], axis=1)
        return np.concatenate([places, (Rotation.from_rotvec(turns) * self.start).as_quat(scalar_first=True)], axis=1)


PATHS = {
    "slide": Path("slide past the edge", (0.0, 0.21)),
    "askew": Path("slide askew", (0.0, 0.25), start=Rotation.from_euler("z", 0.4)),
    "roll": Path("roll", (-0.12, 0.12), (0.0, 1.0, 0.0), 0.03),
    "yaw": Path("yaw", (0.0, np.pi / 2), (0.0, 0.0, 1.0), 0.05),
    "corner": Path("corner past the edge", (0.0, 0.11), start=_ON_CORNER),
}
