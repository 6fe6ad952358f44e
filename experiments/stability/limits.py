"""The analytic limits that heat maps are compared with."""

import mujoco
import numpy as np
from jaxtyping import Float

from experiments.stability.grid import Points
from experiments.stability.scenes import RADIUS, StabilityScene, effective
from mjxgrad.contact.warnings import largest_stable_step, steepest
from mjxgrad.tasks.textbook import Bounce


def load(scene: StabilityScene, points: Points) -> Float[np.ndarray, " points"]:
    r"""Give the time step over the largest at which one spring gains no energy: unstable from 1 on.

    $h \omega_0 / (2 (\sqrt{1 + \zeta^2} - \zeta))$, in the standard format $h / t_c$ over $2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$.

    Args:
        scene: of the catalogue.
        points: of its grid.
    """
    found = np.empty(len(points))
    for i in range(len(points)):
        point = points[i]
        impedance = (point["impedance_first"], point["impedance_last"])
        impedance = np.clip(impedance, mujoco.mjMINIMP, mujoco.mjMAXIMP)
        stiffness, damping = steepest(*effective(scene, point), impedance, point["width"])
        frequency = np.sqrt(stiffness)
        limit = largest_stable_step(damping / (2 * frequency), mujoco.mjtIntegrator.mjINT_EULER)
        found[i] = points.values["timestep"][i] * frequency / limit
    return found


def crossing(scene: StabilityScene, points: Points) -> Float[np.ndarray, " points"]:
    r"""Give how far two balls go into each other, over the distance at which their centres meet: beyond 1 they pass.

    One step carries them $v h$, unseen; a bounce goes $v \sqrt e / \omega_0$ deep.

    Args:
        scene: of the catalogue.
        points: of the grid of two balls.
    """
    springs = np.array([effective(scene, points[i]) for i in range(len(points))])
    frequency, damping = np.sqrt(springs[:, 0]), springs[:, 1]
    restitution = np.asarray(Bounce(2 / damping, damping / (2 * frequency)).restitution)
    time = np.maximum(points.values["timestep"], np.sqrt(restitution) / frequency)
    return points.values["speed"] * time / (2 * RADIUS)


def limit_curve(scene: StabilityScene, points: Points, plane: int) -> np.ndarray | None:
    """Arrange the limit that belongs to a plane as an image of logarithms whose contour at 0 is to be drawn.

    Args:
        scene: of the catalogue.
        points: of its grid.
        plane: index of the plane.

    Returns:
        The image, or None where no limit passes through the plane.
    """
    names = set(points.planes[plane])
    decides_spring = names & {"timestep", "time_constant", "damping_ratio", "stiffness"}
    if scene.family == "two balls" and "speed" in names:
        values = crossing(scene, points)
    elif decides_spring:
        values = load(scene, points)
    else:
        return None
    chosen = np.log(values[points.family == plane])
    image = chosen.reshape(round(np.sqrt(len(chosen))), -1)
    return image if image.min() < 0 < image.max() else None
