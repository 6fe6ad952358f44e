r"""The published push with MuJoCo's contact in place of a spring of its own.

Sizes, masses, starts, goals and costs are the published ones, where nothing else is said.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5.
"""

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float

from experiments.problems import published
from mjxgrad.contact import Softness
from mjxgrad.rollouts import Trajectory, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import ActionTask, scene_path

PUSH_CONTACT = (("pusher", "pushed"),)
# Two bodies of 0.1 kg move against each other like one of half that mass.
REDUCED_MASS = 0.05  # kg


def quadratic_cost(quadratic: published.QuadraticCost, trajectory: Trajectory) -> Float[Array, " steps"]:
    """Return the cost of every state, positions before velocities: that of a step, and after the last the final one."""
    states = jnp.concatenate([trajectory.qpos, trajectory.qvel], axis=1)
    charged = jax.vmap(quadratic.stage)(states[:-1], trajectory.ctrl)
    return jnp.append(charged, quadratic.terminal(states[-1]))


def push(stiffness: float = 10.0, *, horizon: int = 200) -> ActionTask:
    """Load the push: both balls are to be 1 m ahead and at rest, the second above all; 200 steps are 1 s.

    The published tasks of 10 and 1000 N/m differ in damping and horizon, too; here in stiffness (N/m) alone. The state is
    how far both have come, then their velocities; the control is the force on the first, in N.
    """
    scene = load_scene(scene_path("push"), softness=push_softness(stiffness))
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = published.QuadraticCost(jnp.array([1.0, 1.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    # The number of controls is the scene's; pyright takes it for an argument, since `Task` declares it as a variable.
    return ActionTask(  # pyright: ignore[reportCallIssue]
        scene=scene,
        state=initial_state(scene, scene.data.qpos),
        cost=Partial(quadratic_cost, cost),
        horizon=horizon,
        start_params=jnp.full((horizon, 1), 0.1),  # N
    )


def push_softness(stiffness: float | Float[Array, "..."]) -> Softness:
    """Return the elastic contact of the balls.

    Args:
        stiffness: in N/m; 10 is soft, 1000 stiff. A knock adds energy where it takes few time steps: 6 % at 1000.

    Returns:
        The softness, or a stack of them if the argument has an axis.
    """
    return Softness(jnp.asarray(stiffness, float) / REDUCED_MASS, 0.0, pairs=PUSH_CONTACT)
