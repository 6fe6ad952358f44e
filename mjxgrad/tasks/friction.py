r"""A tray drags a puck by friction, and loses it if pulled too hard.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 (there with a law of friction in place of contact).
"""

import jax.numpy as jnp

from mjxgrad.scene import load_scene
from mjxgrad.tasks.action_task import ActionTask, quadratic_task
from mjxgrad.tasks.files import scene_path
from mjxgrad.tasks.published import QuadraticCost


def friction(*, horizon: int = 400) -> ActionTask:
    """Load the tray and the puck: both are to be 2 m ahead and at rest, the puck above all.

    Masses, time step, friction, start, goal and cost are the published ones. A puck that is off the tray falls, at the
    speed ahead that it has.

    Args:
        horizon: number of steps; the default is 2 s.

    Returns:
        The task. The state is the positions of the tray and of the puck (ahead, and above the tray's level), then
        their velocities; the control is the force on the tray, in N.
    """
    scene = load_scene(scene_path("friction"))
    weight = jnp.array([0.1, 10.0, 0.0, 0.1, 0.1, 0.0])
    cost = QuadraticCost(jnp.array([2.0, 2.0, 0.0, 0.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return quadratic_task(
        scene,
        cost,
        horizon,
        start_params=jnp.zeros((horizon, 1)),
        gradient="discrete",  # The contact lasts throughout: there is no event to correct.
    )
