"""The analytic limits that heat maps are compared with."""

import mujoco
import numpy as np
from jaxtyping import Float

from experiments.stability.grid import Points
from experiments.stability.scenes import RADIUS, StabilityScene, effective
from mjxgrad.scene.contact_check import largest_stable_step


def load(scene: StabilityScene, points: Points) -> Float[np.ndarray, " points"]:
    r"""Give the time step over the largest at which one spring gains no energy: unstable from 1 on.

    $h \omega_0 / (2 (\sqrt{1 + \zeta^2} - \zeta))$, in the standard format $h / t_c$ over $2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$.

    Args:
        scene: of the catalogue.
        points: of its grid.
    """
    found = np.empty(len(points))
    for i in range(len(points)):
        stiffness, damping = effective(scene, points[i])
        frequency = np.sqrt(stiffness)
        limit = largest_stable_step(damping / (2 * frequency), mujoco.mjtIntegrator.mjINT_EULER)
        found[i] = points.values["timestep"][i] * frequency / limit
    return found


def crossing(points: Points) -> Float[np.ndarray, " points"]:
    """Give what two balls fly in one step over the distance of their centres: beyond 1 they can pass unseen.

    Args:
        points: of the grid of two balls.
    """
    return points.values["speed"] * points.values["timestep"] / (2 * RADIUS)


def limit_curve(scene: StabilityScene, points: Points, plane: int) -> np.ndarray | None:
    """Arrange the limit that belongs to a plane as an image whose contour at 1 is to be drawn.

    Args:
        scene: of the catalogue.
        points: of its grid.
        plane: index of the plane.

    Returns:
        The image, or None where no limit passes through the plane.
    """
    names = set(points.planes[plane])
    decides_spring = names & {"timestep", "time_constant", "damping_ratio", "stiffness"}
    if scene.family == "two balls" and "speed" in names and "timestep" in names:
        values = crossing(points)
    elif decides_spring:
        values = load(scene, points)
    else:
        return None
    chosen = values[points.family == plane]
    image = chosen.reshape(round(np.sqrt(len(chosen))), -1)
    return image if image.min() < 1 < image.max() else None
