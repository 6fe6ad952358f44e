"""A Unitree G1 that is pushed and stays up: it observes its joints, how its pelvis leans, turns and moves, and its last action.

The robot is that of mjlab, downloaded on first use: 29 position servos on a floor, its real masses, torques and feet.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from experiments.problems.mjlab import g1
from experiments.problems.quadruped import in_trunk
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.stepping import EngineName

Memory = dict[str, Float[Array, "..."]]
_HEIGHT, _LOWEST, _LEAST_UP = 0.755, 0.45, 0.6  # m of the pelvis; cosine of its lean
_REACH = 0.5  # rad that an action of 1 moves a joint's target
_PUSH = (0.2, 0.7)  # m/s that the robot is given at once
_EVERY = 100  # actions from push to push


class PushedHumanoid(Environment):
    """A humanoid that is pushed into a random direction every 2 s; 50 actions a second."""

    def start(self, key: PRNGKeyArray) -> State:
        joints, speeds = jax.random.split(key)
        rest = self.scene.data.qpos
        posture = rest[7:] + jax.random.uniform(joints, rest[7:].shape, minval=-0.05, maxval=0.05)
        speed = jax.random.uniform(speeds, self.scene.data.qvel.shape, minval=-0.1, maxval=0.1)
        return initial_state(self.scene, jnp.concatenate([rest[:7], posture]), speed)

    def first_memory(self, key: PRNGKeyArray) -> Memory:
        wait, draw = jax.random.split(key)
        waits = jax.random.randint(wait, (), 0, _EVERY).astype(float)
        return {"push": jnp.zeros(2), "next": _push(draw), "wait": waits, "action": jnp.zeros(self.num_actions)}

    def next_memory(self, memory: Memory, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> Memory:
        is_due = memory["wait"] <= 0
        return {
            "push": jnp.where(is_due, memory["next"], 0.0),
            "next": jnp.where(is_due, _push(key), memory["next"]),
            "wait": jnp.where(is_due, float(_EVERY), memory["wait"] - 1),
            "action": action,
        }

    def disturbed(self, state: State, memory: Memory) -> State:
        return dataclasses.replace(state, qvel=state.qvel.at[:2].add(memory["push"]))

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        return self.scene.data.qpos[7:] + _REACH * action

    def observe(self, state: State, memory: Memory) -> Float[Array, " obs"]:
        down, speed, turning = in_trunk(state)
        posture = state.qpos[7:] - self.scene.data.qpos[7:]
        parts = [down, speed, turning, state.qpos[2:3], posture, 0.1 * state.qvel[6:], memory["action"]]
        return jnp.concatenate(parts)

    def privileged(self, state: State, memory: Memory) -> Float[Array, " 4"]:
        """Return the push to come, and when."""
        return jnp.concatenate([memory["push"], memory["next"], memory["wait"][None] / _EVERY])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: Memory) -> Rewards:
        down, speed, turning = in_trunk(after)
        return {
            "alive": jnp.full_like(speed[0], 3.0),
            "speed": -(speed**2).sum(),
            "upright": -2.0 * (down[:2] ** 2).sum(),
            "height": -20.0 * (after.qpos[2] - _HEIGHT) ** 2,
            "turning": -0.1 * (turning**2).sum(),
            "posture": -0.2 * ((after.qpos[7:] - self.scene.data.qpos[7:]) ** 2).sum(),
            "motion": -5e-4 * (after.qvel[6:] ** 2).sum(),
            "change": -0.01 * ((action - memory["action"]) ** 2).sum(),
            "action": -0.02 * (action**2).sum(),
        }

    def is_over(self, state: State) -> Bool[Array, ""]:
        return (state.qpos[2] < _LOWEST) | (-in_trunk(state)[0][2] < _LEAST_UP)


def pushed_humanoid(engine: EngineName = "mjx") -> PushedHumanoid:
    """Return the task; a time step is 5 ms, an action holds for four, an episode lasts 8 s."""
    return PushedHumanoid(load_scene(g1(), engine=engine), frame_skip=4, episode_length=400)


def _push(key: PRNGKeyArray) -> Float[Array, "2"]:
    size, where = jax.random.split(key)
    angle = jax.random.uniform(where, (), maxval=2 * np.pi)
    speed = jax.random.uniform(size, (), minval=_PUSH[0], maxval=_PUSH[1])
    return speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
