"""A finger learns to push a rod to where it is told, from starts where they do not touch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path

_DECISION = 10  # time steps of 0.01 s
_LENGTH = 40  # actions: 4 s


class Pusher(Environment):
    """The scene of `planar_push`; the memory is the goal of the rod's middle, its distance is what counts."""

    def start(self, key: PRNGKeyArray) -> State:
        draw = jax.random.uniform(key, (5,), minval=-1, maxval=1)
        middle, spread = jnp.array([0.0, -0.12, 0.0, 0.0, 0.0]), jnp.array([0.05, 0.03, 0.03, 0.03, 0.2])
        return initial_state(self.scene, middle + spread * draw)

    def first_memory(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        return jax.random.uniform(key, (2,), minval=jnp.array([-0.06, 0.06]), maxval=jnp.array([0.06, 0.18]))

    def observe(self, state: State, memory: Float[Array, "2"]) -> Float[Array, " 13"]:
        finger, rod, turn = state.qpos[:2], state.qpos[2:4], state.qpos[4]
        facing = jnp.stack([jnp.cos(turn), jnp.sin(turn)])
        return jnp.concatenate([10 * (rod - finger), 10 * (memory - rod), 10 * rod, facing, state.qvel])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: Float[Array, "2"]) -> Rewards:
        finger, rod = after.qpos[:2], after.qpos[2:4]
        return {
            "distance": -10 * _length(memory - rod),
            "reach": -_length(rod - finger),
            "turn": -0.1 * after.qpos[4] ** 2,
            "action": -0.01 * (action**2).sum(),
        }


def pusher() -> Pusher:
    """Return the task: ten decisions a second for 4 s, each the velocity of the finger."""
    scene = load_scene(scene_path("planar_pusher"))
    return Pusher(scene, frame_skip=_DECISION, episode_length=_LENGTH)


def _length(vector: Float[Array, "2"]) -> Float[Array, ""]:
    """Return the length, rounded off at a millimetre, where it would have a kink."""
    return jnp.sqrt((vector**2).sum() + 1e-6) - 1e-3
