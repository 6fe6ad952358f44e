r"""A robot, driven by velocity, finds its way between seven pillars that stop it.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 (there a step into an obstacle is not taken).
"""

import jax.numpy as jnp

from mjxgrad.scene import load_scene
from mjxgrad.tasks.action_task import ActionTask, quadratic_task
from mjxgrad.tasks.files import scene_path
from mjxgrad.tasks.published import QuadraticCost

START_SPEED = 0.01  # m/s


def motion_planning(*, horizon: int = 100) -> ActionTask:
    """Load the robot and the pillars: it is to reach the point 4 m ahead and stay.

    The course, start, goal and cost are the published ones, in half as many steps of twice the length.

    Args:
        horizon: number of steps; the default is 2 s.

    Returns:
        The task. The state is position and velocity; the controls are the velocities asked for, in m/s.
    """
    scene = load_scene(scene_path("motion_planning"))
    weight = jnp.array([1.0, 1.0, 0.0, 0.0])
    cost = QuadraticCost(jnp.array([0.0, 4.0, 0.0, 0.0]), weight, 10 * weight, jnp.array(0.001))
    return quadratic_task(
        scene,
        cost,
        horizon,
        start_params=jnp.full((horizon, 2), START_SPEED),
        stddev=0.3,
    )
