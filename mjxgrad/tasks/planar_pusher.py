r"""A round finger pushes a rod over a table, from a start where they do not touch.

The state is where finger and rod are and how fast they move, in the order finger x, y, rod x, y and turn; a control is the
speed of the finger.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad.rollout import initial_state
from mjxgrad.scene import load_scene
from mjxgrad.smoothing.system import SceneSystem
from mjxgrad.tasks.files import scene_path

SPEED_LIMIT = 0.4  # m/s, per axis; the range of the scene's actuators
# 0.1 s per decision: four time constants of the damped rod.
_NUM_SUBSTEPS = 10


class PlanarPusher(eqx.Module):
    """Where the rod is and where it is to be.

    Attributes:
        system: finger and rod, a decision every 0.1 s.
        start: the first state, at rest.
        goal: with the rod where it is to be; only its coordinates count.
        speed_limit: of the finger (m/s).
    """

    system: SceneSystem
    start: Float[Array, " state"]
    goal: Float[Array, " state"]
    speed_limit: float = eqx.field(static=True, default=SPEED_LIMIT)


def planar_pusher(
    finger: Float[ArrayLike, " 2"] = (0.0, -0.15),
    rod: Float[ArrayLike, " 3"] = (0.0, 0.0, 0.0),
    goal: Float[ArrayLike, " 3"] = (0.0, 0.12, 0.0),
    *,
    num_substeps: int = _NUM_SUBSTEPS,
) -> PlanarPusher:
    """Load the pusher.

    Args:
        finger: where it starts, x and y (m). It has a radius of 0.02 m.
        rod: where it starts, x, y (m) and turn (rad). It is a capsule of radius 0.02 m and length 0.24 m.
        goal: where the rod is to be.
        num_substeps: of 0.01 s, per decision.

    Returns:
        The task.
    """
    system = SceneSystem(load_scene(scene_path("planar_pusher")), num_substeps)

    def at(pose: Float[ArrayLike, " 3"]) -> Float[Array, " state"]:
        qpos = jnp.concatenate([jnp.asarray(finger, float), jnp.asarray(pose, float)])
        return system.flatten(initial_state(system.scene, qpos=qpos))

    return PlanarPusher(system, at(rod), at(goal))
