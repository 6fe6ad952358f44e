r"""A ball on a level table, returned by a pad that a linear policy moves and turns.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 (there with a reflection in place of contact).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad._rollout import State, initial_state
from mjxgrad.policy import linear_policy
from mjxgrad.scene import load_scene
from mjxgrad.tasks.action_task import ActionTask, quadratic_task
from mjxgrad.tasks.files import scene_path
from mjxgrad.tasks.published import QuadraticCost
from mjxgrad.tasks.published.tennis import Tennis, tennis_task


class Starts(eqx.Module):
    """Draws the published starts: a ball on its way to the origin, and a pad near it.

    Attributes:
        like: a state of the scene.
        published: the task that has the distribution.
    """

    like: State
    published: Tennis

    def __call__(self, key: PRNGKeyArray) -> State:
        """Draw a state."""
        return self.state(self.published.sample_start(key))

    def state(self, vector: Float[Array, " 7"]) -> State:
        """Give the scene's state of a published one; the pad is at rest."""
        ball, velocity, pad = vector[:2], vector[2:4], vector[4:]
        return eqx.tree_at(
            lambda state: (state.qpos, state.qvel),
            self.like,
            (jnp.concatenate([ball, pad]), jnp.concatenate([velocity, jnp.zeros(3)])),
        )


def tennis(*, horizon: int = 200) -> ActionTask:
    """Load the ball and the pad: the ball is to end at rest 2.5 m from where the pad begins.

    Sizes, starts, goal and cost are the published ones.

    Args:
        horizon: number of steps; the default is 10 s.

    Returns:
        The task. The policy sees the ball's position and velocity, then the pad's position and angle, and gives the pad's
        velocity and rate of turning (m, m/s, rad, rad/s).
    """
    scene = load_scene(scene_path("tennis"))
    published = tennis_task()
    starts = Starts(initial_state(scene), published)
    policy, params = linear_policy(7, 3, bias=False, observe=published_state)
    goal = jnp.zeros(10).at[1].set(2.5)
    final_weight = jnp.zeros(10).at[jnp.array([0, 1, 5, 6])].set(jnp.array([100.0, 100.0, 10.0, 10.0]))
    return quadratic_task(
        scene,
        QuadraticCost(goal, jnp.zeros(10), final_weight, jnp.array(0.001)),
        horizon,
        state=starts.state(published.nominal_start()),
        start_distribution=starts,
        start_params=params,
        policy=policy,
        gradient="discrete",  # Contact sets in without a jump: there is nothing to correct.
    )


def published_state(state: State) -> Float[Array, " 7"]:
    """Give the state as it was published, without the pad's velocity."""
    return jnp.concatenate([state.qpos[:2], state.qvel[:2], state.qpos[2:]])
