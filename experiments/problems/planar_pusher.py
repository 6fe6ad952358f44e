r"""A round finger pushes a rod over a table, from a start where they do not touch.

The state is where finger and rod are and how fast they move, in the order finger x, y, rod x, y and turn; a control is the
speed of the finger.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.planning import GoalCost, SceneSystem
from mjxgrad.rollouts import initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path

# Of 0.01 s; a decision every 0.1 s, four time constants of the damped rod.
_NUM_SUBSTEPS = 10
# Weights of the rod's x, y and turn; a turn of 0.17 rad counts as much as 0.03 m.
_ROD = (0.0, 0.0, 1.0, 1.0, 0.03, 0.0, 0.0, 0.0, 0.0, 0.0)


class PlanarPusher(eqx.Module):
    """Where the rod is and where it is to be."""

    system: SceneSystem  # finger and rod
    start: Float[Array, " state"]  # the first state, at rest
    goal: Float[Array, " state"]  # with the rod where it is to be; only its coordinates count
    # Of the finger along each axis (m/s), the range of the scene's actuators.
    speed_limit: float = eqx.field(static=True, default=0.4)

    @property
    def cost(self) -> GoalCost:
        """Price of the way to the goal, of its end, and of the squared speed of the finger."""
        weight = jnp.array(_ROD)
        return GoalCost(self.goal, 0.3 * weight, 100 * weight, 0.02)


def planar_pusher(
    finger: tuple[float, float] = (0.0, -0.15),
    goal: tuple[float, float, float] = (0.0, 0.12, 0.0),
) -> PlanarPusher:
    """Load the pusher; the rod, a capsule of radius 0.02 m and length 0.24 m, starts at the origin.

    The finger of radius 0.02 m starts at x and y (m); the goal of the rod is x, y (m) and turn (rad).
    """
    scene = load_scene(scene_path("planar_pusher"))
    # The sizes are the scene's; pyright takes them for arguments, since `System` declares them as variables.
    system = SceneSystem(scene=scene, num_substeps=_NUM_SUBSTEPS)  # pyright: ignore[reportCallIssue]

    def at(pose: tuple[float, float, float]) -> Float[Array, " state"]:
        qpos = jnp.concatenate([jnp.asarray(finger, float), jnp.asarray(pose, float)])
        return system.flatten(initial_state(system.scene, qpos=qpos))

    return PlanarPusher(system, at((0.0, 0.0, 0.0)), at(goal))
