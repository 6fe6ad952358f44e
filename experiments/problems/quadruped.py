"""A blind quadruped that follows velocity commands: it observes its joints, its angular velocity and gravity, not its speed.

References:
    Open-DiffLoco, arXiv:2608.02069 (rewards, commands, pushes, ends and the spread of the models, there on another robot
    and without a reward for not falling).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from experiments.problems.mjlab import go1
from mjxgrad.bodies.spatial import rotation_matrix
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import Scene, load_scene
from mjxgrad.tasks import scene_path

Memory = dict[str, Float[Array, "..."]]
MOST_COMMAND = (2.0, 1.0, 1.5)  # m/s forward, m/s to the left, rad/s about the vertical
_CHANGE = 0.004  # chance per action of a new command: after 5 s on average
_PUSH = 1.0  # m/s, at most along either axis
_PUSHED = 0.005  # chance per action of a push: after 4 s on average
_REACH = 0.5  # rad that an action of 1 moves a joint's target
_LOWEST = 0.6  # of the trunk's height, below which it has fallen
_ALIVE = 4.0  # without it an early policy would be charged least for falling at once


class Quadruped(Environment):
    """A quadruped with twelve position servos, 50 actions a second; on average a new command every 5 s, a push every 4 s."""

    height: float = eqx.field(static=True, default=0.3, kw_only=True)  # m, at which the trunk is to be

    def start(self, key: PRNGKeyArray) -> State:
        joints, speeds = jax.random.split(key)
        rest = self.scene.data
        posture = rest.qpos[7:] + jax.random.uniform(joints, (12,), minval=-0.1, maxval=0.1)
        speed = jax.random.uniform(speeds, rest.qvel.shape, minval=-0.1, maxval=0.1)
        return initial_state(self.scene, jnp.concatenate([rest.qpos[:7], posture]), speed)

    def first_memory(self, key: PRNGKeyArray) -> Memory:
        return {"command": _command(key), "push": jnp.zeros(2), "action": jnp.zeros(12)}

    def next_memory(self, memory: Memory, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> Memory:
        change, draw, push, where = jax.random.split(key, 4)
        command = jnp.where(jax.random.bernoulli(change, _CHANGE), _command(draw), memory["command"])
        kick = jax.random.uniform(where, (2,), minval=-_PUSH, maxval=_PUSH)
        return {"command": command, "push": jnp.where(jax.random.bernoulli(push, _PUSHED), kick, 0.0), "action": action}

    def disturbed(self, state: State, memory: Memory) -> State:
        return dataclasses.replace(state, qvel=state.qvel.at[:2].add(memory["push"]))

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        return self.scene.data.qpos[7:] + _REACH * action

    def observe(self, state: State, memory: Memory) -> Float[Array, " 45"]:
        down, _, turning = in_trunk(state)
        posture = state.qpos[7:] - self.scene.data.qpos[7:]
        return jnp.concatenate([turning, down, memory["command"], posture, 0.1 * state.qvel[6:], memory["action"]])

    def privileged(self, state: State, memory: Memory) -> Float[Array, " 7"]:
        """Return speed and height, which the rewards are about, the next push, and the friction."""
        friction = self.scene.model.geom_friction[:1, 0]
        return jnp.concatenate([in_trunk(state)[1], state.qpos[2:3], memory["push"], friction])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: Memory) -> Rewards:
        down, speed, turning = in_trunk(after)
        command = memory["command"]
        return {
            "speed": -((speed[:2] - command[:2]) ** 2).sum(),
            "turning": -((turning[2] - command[2]) ** 2),
            "height": jnp.exp(-10 * (after.qpos[2] - self.height) ** 2),
            "bouncing": -0.5 * speed[2] ** 2,
            "upright": -0.5 * down[2],
            "rocking": -0.05 * (turning[:2] ** 2).sum(),
            "posture": -0.3 * ((after.qpos[7:] - self.scene.data.qpos[7:]) ** 2).sum(),
            "change": -0.02 * ((action - memory["action"]) ** 2).sum(),
            "action": -0.05 * (action**2).sum(),
            "alive": jnp.full_like(speed[0], _ALIVE),
        }

    def is_over(self, state: State) -> Bool[Array, ""]:
        return (state.qpos[2] < _LOWEST * self.height) | (in_trunk(state)[0][2] > -0.3)


def quadruped() -> Quadruped:
    """Return the task on a robot of 12 kg, each copy another one; a time step is 4 ms, an action holds for five."""
    scene = load_scene(scene_path("quadruped"), timestep=0.004, max_contacts=8)
    return Quadruped(scene, frame_skip=5, randomisation=spread)


def go1_joystick() -> Quadruped:
    """Return the same task on mjlab's Unitree Go1, of 12.7 kg."""
    scene = load_scene(go1(), max_contacts=8)
    return Quadruped(scene, frame_skip=5, randomisation=spread, height=0.28)


def spread(key: PRNGKeyArray, scene: Scene) -> Scene:
    """Return a scene with random friction (0.5 to 2), masses (± 15 %), servo stiffness (± 25 %) and damping (± 40 %)."""
    friction, mass, stiffness, damping = jax.random.split(key, 4)
    model = scene.model
    sliding = jax.random.uniform(friction, (), minval=0.5, maxval=2.0)
    gain = jax.random.uniform(stiffness, (model.nu, 1), minval=0.75, maxval=1.25)
    return scene.with_model(
        geom_friction=model.geom_friction.at[:, 0].set(sliding),
        body_mass=model.body_mass * jax.random.uniform(mass, (model.nbody,), minval=0.85, maxval=1.15),
        actuator_gainprm=model.actuator_gainprm * gain,
        actuator_biasprm=model.actuator_biasprm * gain,
        dof_damping=model.dof_damping * jax.random.uniform(damping, (model.nv,), minval=0.6, maxval=1.4),
    )


def _command(key: PRNGKeyArray) -> Float[Array, "3"]:
    most = jnp.array(MOST_COMMAND)
    return jax.random.uniform(key, (3,), minval=-most, maxval=most)


def in_trunk(state: State) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """Return the downward direction, the velocity (m/s) and the angular velocity (rad/s) in the axes of a free trunk."""
    turn = rotation_matrix(state.qpos[None, 3:7])[0]
    return -turn[2], turn.T @ state.qvel[:3], state.qvel[3:6]
