r"""A ball pushes another along a rail, by contact of any stiffness.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 (there with a spring in place of contact).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.contact import Softness
from mjxgrad.scene import load_scene
from mjxgrad.tasks.action_task import ActionTask, quadratic_task
from mjxgrad.tasks.files import scene_path
from mjxgrad.tasks.published import QuadraticCost

PUSH_CONTACT = (("pusher", "pushed"),)
# Two bodies of 0.1 kg move against each other like one of half that mass.
REDUCED_MASS = 0.05  # kg
START_FORCE = 0.1  # N


def push(stiffness: float = 10.0, *, horizon: int = 200) -> ActionTask:
    """Load the push: both balls are to be 1 m ahead and at rest, the second above all.

    Masses, time step, start, goal and cost are the published ones. Those of 10 and 1000 N/m differ there in damping and
    horizon, too; here in stiffness alone.

    Args:
        stiffness: of the contact, in N/m.
        horizon: number of steps; the default is 1 s.

    Returns:
        The task. The state is how far both have come, then their velocities; the control is the force on the first, in N.
    """
    scene = load_scene(scene_path("push"), softness=push_softness(stiffness))
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = QuadraticCost(jnp.array([1.0, 1.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return quadratic_task(
        scene,
        cost,
        horizon,
        start_params=jnp.full((horizon, 1), START_FORCE),
        gradient="discrete",  # Contact sets in without a jump: there is nothing to correct.
    )


def push_softness(stiffness: float | Float[Array, "..."], damping_ratio: float | Float[Array, "..."] = 0.0) -> Softness:
    """Set the softness of the balls' contact.

    Args:
        stiffness: in N/m; 10 is soft, 1000 stiff. Undamped, a knock adds energy where it takes few time steps: 6 % at
            1000.
        damping_ratio: 0 is elastic, as published; 1 is critical.

    Returns:
        The softness, or a stack of them if an argument has an axis.
    """
    stiffness, damping_ratio = jnp.broadcast_arrays(jnp.asarray(stiffness, float), jnp.asarray(damping_ratio, float))
    return Softness(stiffness / REDUCED_MASS, damping_ratio, pairs=PUSH_CONTACT)
