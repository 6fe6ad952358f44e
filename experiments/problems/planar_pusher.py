r"""A round finger pushes a rod over a table, from a start where they do not touch.

The state is where finger and rod are and how fast they move, in the order finger x, y, rod x, y and turn; a control is the
speed of the finger.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.planning import SceneSystem
from mjxgrad.rollouts import initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path

# Of 0.01 s; a decision every 0.1 s, four time constants of the damped rod.
_NUM_SUBSTEPS = 10
_HALF_LENGTH = 0.1  # m, of the rod's axis
_BESIDE = 0.045  # m from that axis to the finger's centre: both radii and 5 mm
_END_SHARE = 0.2  # of the rod's circumference the two ends have about a fifth


class PlanarPusher(eqx.Module):
    """Where the rod is and where it is to be.

    Attributes:
        system: finger and rod.
        start: the first state, at rest.
        goal: with the rod where it is to be; only its coordinates count.
        speed_limit: of the finger (m/s).
    """

    system: SceneSystem
    start: Float[Array, " state"]
    goal: Float[Array, " state"]
    speed_limit: float = eqx.field(static=True, default=0.4)  # m/s, per axis; the range of the scene's actuators


def beside_rod(key: PRNGKeyArray, state: Float[Array, " state"]) -> Float[Array, " state"]:
    """Draw a state in which the finger is just beside the rod, along its sides or before an end; the rod stays, at rest."""
    side_key, end_key, along_key = jax.random.split(key, 3)
    side = jnp.where(jax.random.bernoulli(side_key), _BESIDE, -_BESIDE)
    along = jax.random.uniform(along_key, minval=-_HALF_LENGTH, maxval=_HALF_LENGTH)
    is_end = jax.random.bernoulli(end_key, _END_SHARE)
    before_end = jnp.sign(side) * (_HALF_LENGTH + _BESIDE)
    x, y = jnp.where(is_end, before_end, along), jnp.where(is_end, 0.0, side)
    rod_x, rod_y, turn = state[2:5]
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    finger = jnp.stack([rod_x + cos * x - sin * y, rod_y + sin * x + cos * y])
    return jnp.concatenate([finger, state[2:5], jnp.zeros_like(state[5:])])


def planar_pusher(
    finger: tuple[float, float] = (0.0, -0.15),
    goal: tuple[float, float, float] = (0.0, 0.12, 0.0),
) -> PlanarPusher:
    """Load the pusher; the rod, a capsule of radius 0.02 m and length 0.24 m, starts at the origin.

    Args:
        finger: where it starts, x and y (m). It has a radius of 0.02 m.
        goal: where the rod is to be, x, y (m) and turn (rad).

    Returns:
        The task.
    """
    scene = load_scene(scene_path("planar_pusher"))
    # The sizes are the scene's; pyright takes them for arguments, since `System` declares them as variables.
    system = SceneSystem(scene=scene, num_substeps=_NUM_SUBSTEPS)  # pyright: ignore[reportCallIssue]

    def at(pose: tuple[float, float, float]) -> Float[Array, " state"]:
        qpos = jnp.concatenate([jnp.asarray(finger, float), jnp.asarray(pose, float)])
        return system.flatten(initial_state(system.scene, qpos=qpos))

    return PlanarPusher(system, at((0.0, 0.0, 0.0)), at(goal))
