"""Gymnasium's hopper, dropped onto its foot under a linear policy that holds a posture.

Nothing in it jumps, yet the discrete derivative is wrong for every parameter that shifts the time of landing: the impedance
is not zero at first touch.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.objective import linear_policy
from mjxgrad.rollouts import State, Trajectory, initial_state
from mjxgrad.tasks.action_task import ActionTask, robot_scene

# Bent legs absorb the landing; with the downward speed the foot lands after 70 ms.
START_POSE = (0.0, 1.22, 0.0, -0.4, -0.5, 0.3)  # m, m, rad
START_VELOCITY = (0.5, -1.0, 0.0, 0.0, 0.0, 0.0)
# In actions per rad and per rad/s; an action of 1 is 200 Nm.
STIFFNESS, DAMPING = (0.5, 0.5, 0.3), (0.05, 0.05, 0.03)


def jump_cost(trajectory: Trajectory) -> Float[Array, ""]:
    """Return minus the forward distance minus the final height of the torso, in m."""
    return -trajectory.qpos[-1, 0] - trajectory.qpos[-1, 1]


def hopper(*, horizon: int = 150) -> ActionTask:
    """Return the drop: the foot lands after 70 ms, and the cost depends on the torso's final position.

    Model and contact are gymnasium's; steps are Euler's, at a quarter of the cost of RK4. The policy observes angles and
    speeds of the three joints. At first it holds the posture like springs and dampers. A step is 2 ms.
    """
    scene = robot_scene("hopper")
    policy, zero = linear_policy(6, 3, observe=joints)
    stiffness, damping = jnp.array(STIFFNESS), jnp.array(DAMPING)
    gain = -jnp.concatenate([jnp.diag(stiffness), jnp.diag(damping)], axis=1)
    offset = stiffness * jnp.array(START_POSE[3:])
    posture = eqx.tree_at(lambda layer: (layer.weight, layer.bias), zero, (gain, offset))
    # The number of controls is the scene's; pyright expects an argument, since `Task` declares a variable.
    return ActionTask(  # pyright: ignore[reportCallIssue]
        scene=scene,
        state=initial_state(scene, jnp.array(START_POSE), jnp.array(START_VELOCITY)),
        cost=jump_cost,
        horizon=horizon,
        policy=policy,
        start_params=posture,
    )


def joints(state: State) -> Float[Array, " 6"]:
    """Return the angles of thigh, leg and foot in rad, then their speeds in rad/s."""
    return jnp.concatenate([state.qpos[3:], state.qvel[3:]])
