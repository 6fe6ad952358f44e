r"""A trot on the spot: ANYmal C imitates a gait of cosine waves, the task by which MuJoCo shows analytic policy gradients.

What is seen, done, paid and over is the notebook's, as it runs. Three things there are not as they read:

- The policy sees the reference of the last action, and is charged for joints and speeds before its action, for feet after it.
- A third term, on places and speeds of all bodies, compares the robot with itself: they are not computed anew for the reference.
  It is zero and is left out here, as is the return to the reference where that comparison finds a large error.
- Feet and base are those of one time step (2 ms) before the action's end. Here they are those of its end.

Its simulator solves contact by one iteration, which is not enough: under the notebook's noise a robot that stands returns -58,
and -50 where the same code solves until it converges, as here.

References:
    MuJoCo, `mjx/training_apg.ipynb`, study 1 (Google DeepMind, 2024).
"""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mjxgrad import learning
from mjxgrad.bodies.kinematics import kinematics
from mjxgrad.bodies.spatial import rotation_matrix
from mjxgrad.engines.state import data_of
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path

Memory = dict[str, Array]
_FEET = ("LF_foot", "RF_foot", "LH_foot", "RH_foot")
_BENT = (1, 1, -1, -1)  # hind legs are bent the other way
_LIFTED = ((0, 1, 1, 0), (1, 0, 0, 1))  # in the first and in the second half of the gait
_HALF = 13  # actions
_LIFT = 0.3  # rad, of the hip; of the knee twice as much
_REACH = (0.2, 0.8, 0.8)  # rad that an action of 1 moves a joint's target
_LOWEST = 0.25  # m, of the base
_FRAME_SKIP = 10
_JOINTS_WEIGHT = 2.5 * 3e-3


class Trot(Environment):
    """Twelve position servos, 50 actions a second; diagonal legs are lifted in turn, each pair for 0.26 s."""

    stance: Float[Array, " nq"]  # where episodes start: at rest, on the feet
    base: Float[Array, "3"]  # where the base is to stay (m)
    angles: Float[Array, "actions nu"]  # that the joints are to have, action by action of one gait (rad)
    speeds: Float[Array, "actions nu"]  # likewise (rad/s)
    heights: Float[Array, "actions feet"]  # of the centres of the feet when all of that is so (m)

    def start(self, key: PRNGKeyArray) -> State:
        return initial_state(self.scene, self.stance)

    def first_memory(self, key: PRNGKeyArray) -> Memory:
        return {"num_actions": jnp.zeros((), jnp.int32), "targets": jnp.zeros(self.num_actions)}

    def next_memory(self, memory: Memory, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> Memory:
        return {"num_actions": memory["num_actions"] + 1, "targets": self.control(action)}

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        return self.stance[7:] + jnp.tile(jnp.array(_REACH), 4) * action

    def observe(self, state: State, memory: Memory) -> Float[Array, " 40"]:
        down = -rotation_matrix(state.qpos[None, 3:7])[0, 2]
        posture = state.qpos[7:] - self.stance[7:]
        wanted = self.angles[self._phase(jnp.maximum(memory["num_actions"] - 1, 0))]
        return jnp.concatenate([0.25 * state.qvel[5:6], down, posture, memory["targets"], wanted])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: Memory) -> Rewards:
        phase = self._phase(memory["num_actions"])
        place = jnp.concatenate([before.qpos[:3] - self.base, before.qpos[7:] - self.angles[phase]])
        speed = jnp.concatenate([before.qvel[:6], before.qvel[6:] - self.speeds[phase]])
        height = self._feet(after)[:, 2]
        return {
            "joints": -_JOINTS_WEIGHT * (_length(place) + _length(speed)),
            "feet": -jnp.abs(height - self.heights[phase]).sum(),
        }

    def is_over(self, state: State) -> Bool[Array, ""]:
        return (state.qpos[2] < _LOWEST) | (rotation_matrix(state.qpos[None, 3:7])[0, 2, 2] < 0)

    def _phase(self, num_actions: Int[Array, ""]) -> Int[Array, ""]:
        return num_actions % len(self.angles)

    def _feet(self, state: State) -> Float[Array, "feet 3"]:
        feet = np.array([self.scene.mj_model.geom(name).id for name in _FEET])
        return kinematics(self.scene.model, data_of(self.scene, state, self.scene.data.ctrl)).geom_xpos[feet]


def trot() -> Trot:
    """Return the task on an ANYmal C of 45 kg; an action holds for ten time steps of 2 ms, an episode takes 240."""
    scene = load_scene(scene_path("anymal"), max_contacts=4)
    model = scene.to_mujoco()
    standing = model.key("standing").qpos
    interval = _FRAME_SKIP * model.opt.timestep
    turn = 2 * np.pi * np.arange(_HALF) / _HALF
    change = _of_joints(0.5 * _LIFT * (1 - np.cos(turn)))
    speeds = _of_joints(_LIFT * np.pi / (_HALF * interval) * np.sin(turn))
    poses = standing + np.concatenate([np.zeros((len(change), 7)), change], axis=1)
    heights = np.array([_foot_heights(model, pose) for pose in poses])
    on_feet = standing.copy()
    on_feet[2] -= (_foot_heights(model, standing) - model.geom(_FEET[0]).size[0]).min()
    return Trot(
        scene,
        stance=jnp.array(on_feet),
        base=jnp.array(standing[:3]),
        angles=jnp.array(poses[:, 7:]),
        speeds=jnp.array(speeds),
        heights=jnp.array(heights),
        frame_skip=_FRAME_SKIP,
        episode_length=240,
    )


def _of_joints(wave: Float[np.ndarray, " half"]) -> Float[np.ndarray, "actions nu"]:
    """Return a course of the lifted legs as one of all joints: abduction, hip and knee of each leg in both halves."""
    each = np.einsum("hl,t,l,j->htlj", _LIFTED, wave, _BENT, (0, 1, -2))
    return each.reshape(2 * len(wave), 12)


def _foot_heights(model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"]) -> Float[np.ndarray, " feet"]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return np.array([data.geom(name).xpos[2] for name in _FEET])


def _length(x: Float[Array, " n"]) -> Float[Array, ""]:
    """Return a vector's length, with derivative zero where it is zero: at the start the robot rests, as does the reference."""
    square = (x**2).sum()
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def apg(**changes: Any) -> learning.Settings:
    """Return the settings of analytic policy gradients in brax, with which MuJoCo's notebook learns to trot.

    There is no value function, and windows follow one another. Three things differ from brax. The noise is not learned but
    falls linearly from 0.07 to 0.01; being so small, it limits no step. Gradients are clipped by their norm, not by number,
    and long derivatives are shortened, which allows larger rates.

    References:
        Freeman et al. Brax: A Differentiable Physics Engine for Large Scale Rigid Body Simulation. arXiv:2106.13281
        (`brax/training/agents/apg`).
    """
    rates = {"stddev": (0.07, 0.01), "actor_rate": 1e-4, "actor_decay": 0.997}
    network = {"actor_layers": (256, 128), "actor_scale": 0.01}
    plain = {"discount": 1.0, "trace": 1.0, "alpha": 1.0, "has_critic": False, "largest_change": np.inf}
    return learning.Settings(**rates | network | plain | changes)
