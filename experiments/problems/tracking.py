"""A Unitree G1 that tracks reference motions: it squats, marches on the spot, twists with swinging arms, and waves.

References are angles over time, periodic, and begin and end in the pose at rest; the pelvis is as high as the lowest foot allows.
They ask no dynamics: how to march without falling the policy finds. Each term of the reward is between 0 and 1, and
weights add to 1, so that the mean of an episode's rewards is its normalised return.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from experiments.problems.mjlab import g1, touching_the_floor_alone
from experiments.problems.quadruped import in_trunk
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.stepping import EngineName

Memory = dict[str, Array]
CLIPS = ("squat", "march", "twist", "wave")
_ACTIONS, _INTERVAL = 100, 0.02  # of each clip; s
_REACH = 0.3  # rad beyond the references that an action of 1 moves a joint's target
_AHEAD = (1, 5)  # actions from now, of which the policy sees the reference
_LOWEST, _LEAST_UP = 0.35, 0.5  # m of the pelvis; cosine of its lean


class Tracking(Environment):
    """A humanoid of 29 servos, 50 actions a second; each episode has one of the clips, again and again."""

    angles: Float[Array, "clips actions nu"]  # rad
    speeds: Float[Array, "clips actions nu"]  # rad/s
    heights: Float[Array, "clips actions"]  # of the pelvis (m)
    reach: Float[Array, " nu"]  # rad that an action of 1 moves a joint's target

    def start(self, key: PRNGKeyArray) -> State:
        rest, (joints, speeds) = self.scene.data, jax.random.split(key)
        posture = rest.qpos[7:] + jax.random.uniform(joints, (self.num_actions,), minval=-0.02, maxval=0.02)
        speed = jax.random.uniform(speeds, rest.qvel.shape, minval=-0.05, maxval=0.05)
        return initial_state(self.scene, jnp.concatenate([rest.qpos[:7], posture]), speed)

    def first_memory(self, key: PRNGKeyArray) -> Memory:
        clip = jax.random.randint(key, (), 0, len(CLIPS))
        return {"clip": clip, "time": jnp.zeros((), jnp.int32), "action": jnp.zeros(self.num_actions)}

    def next_memory(self, memory: Memory, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> Memory:
        return {"clip": memory["clip"], "time": memory["time"] + 1, "action": action}

    def _wanted(self, name: str, memory: Memory, ahead: int | Int[Array, "..."] = 0) -> Float[Array, "..."]:
        """Return what a reference has so many actions from now."""
        return getattr(self, name)[memory["clip"], (memory["time"] + ahead) % _ACTIONS]

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        return self.scene.data.qpos[7:] + self.reach * action

    def observe(self, state: State, memory: Memory) -> Float[Array, " obs"]:
        down, speed, turning = in_trunk(state)
        rest = self.scene.data.qpos
        wanted = [self._wanted("angles", memory, k) - rest[7:] for k in _AHEAD]
        posture = state.qpos[7:] - rest[7:]
        place = [down, speed, turning, state.qpos[:3] - rest[:3], _heading(state)]
        parts = [
            *place,
            posture,
            0.1 * state.qvel[6:],
            memory["action"],
            *wanted,
            0.1 * self._wanted("speeds", memory, 1),
        ]
        return jnp.concatenate(parts)

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: Memory) -> Rewards:
        down, speed, _ = in_trunk(after)
        joints = ((after.qpos[7:] - self._wanted("angles", memory, 1)) ** 2).sum()
        speeds = ((after.qvel[6:] - self._wanted("speeds", memory, 1)) ** 2).sum()
        height = (after.qpos[2] - self._wanted("heights", memory, 1)) ** 2
        place = ((after.qpos[:2] - self.scene.data.qpos[:2]) ** 2).sum()
        lean = (down[:2] ** 2).sum() + _heading(after)[1] ** 2
        return {
            "joints": 0.4 * jnp.exp(-joints),
            "speeds": 0.1 * jnp.exp(-0.01 * speeds),
            "height": 0.2 * jnp.exp(-40.0 * height),
            "lean": 0.2 * jnp.exp(-4.0 * lean),
            "place": 0.1 * jnp.exp(-2.0 * place - 0.2 * (speed**2).sum()),
        }

    def is_over(self, state: State) -> Bool[Array, ""]:
        return (state.qpos[2] < _LOWEST) | (-in_trunk(state)[0][2] < _LEAST_UP)


def tracking(engine: EngineName = "mjx") -> Tracking:
    """Return the task; an action holds for four steps of 5 ms, an episode lasts 8 s, and the robot touches the floor alone."""
    model = touching_the_floor_alone(g1())
    scene = load_scene(model, engine=engine, max_contacts=20)
    angles, speeds, heights = map(jnp.asarray, references(model))
    reach = _REACH + jnp.abs(angles - model.key_qpos[0, 7:]).max(axis=(0, 1))
    return Tracking(scene, angles, speeds, heights, reach, frame_skip=4, episode_length=400)


def references(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angles (rad), speeds (rad/s) and the pelvis' height (m) of each clip and action."""
    rest = model.key_qpos[0]
    angles = np.stack([rest[7:] + _bent(model, name) for name in CLIPS])
    speeds = (np.roll(angles, -1, axis=1) - np.roll(angles, 1, axis=1)) / (2 * _INTERVAL)
    feet = [k for k in range(model.ngeom) if "_foot" in model.geom(k).name]
    data, heights = mujoco.MjData(model), np.zeros(angles.shape[:2])
    for clip, time in np.ndindex(*heights.shape):
        data.qpos[:] = np.concatenate([rest[:7], angles[clip, time]])
        mujoco.mj_kinematics(model, data)
        # A capsule's lowest point.
        drop = np.abs(data.geom_xmat[feet, 8]) * model.geom_size[feet, 1] + model.geom_size[feet, 0]
        heights[clip, time] = rest[2] - (data.geom_xpos[feet, 2] - drop).min()
    return angles, speeds, heights


def _bent(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return by how much the joints of a clip differ from the pose at rest, over one period (rad)."""
    time = np.arange(_ACTIONS) / _ACTIONS
    swell, swing = 0.5 * (1 - np.cos(2 * np.pi * time)), np.sin(2 * np.pi * time)
    left, right = (np.maximum(sign * np.sin(4 * np.pi * time), 0.0) ** 2 for sign in (1, -1))  # two steps of each foot
    sway = 0.06 * np.sin(4 * np.pi * time)
    moved: dict[str, np.ndarray] = {
        "squat": {
            "hip_pitch": -0.75 * swell, "knee": 1.3 * swell, "ankle_pitch": -0.45 * swell, "waist_pitch": 0.25 * swell,
            "shoulder_pitch": -1.2 * swell, "elbow": -0.3 * swell,
        },
        "march": {
            "left_hip_pitch": -0.6 * left, "left_knee": 0.9 * left, "left_ankle_pitch": -0.3 * left,
            "right_hip_pitch": -0.6 * right, "right_knee": 0.9 * right, "right_ankle_pitch": -0.3 * right,
            "left_shoulder_pitch": 0.5 * (left - right), "right_shoulder_pitch": 0.5 * (right - left),
            "hip_roll": sway, "ankle_roll": -sway,
        },
        "twist": {
            "waist_yaw": 0.8 * swing, "left_shoulder_pitch": -0.8 * swing, "right_shoulder_pitch": 0.8 * swing,
            "elbow": 0.4 * swell,
        },
        "wave": {
            "right_shoulder_roll": -1.6 * swell, "right_elbow": -0.6 * swell, "waist_roll": 0.2 * swing,
            "right_shoulder_yaw": 0.5 * swell * np.sin(8 * np.pi * time), "left_shoulder_pitch": -0.6 * swell,
        },
    }[name]  # fmt: skip
    names = [model.actuator(k).name for k in range(model.nu)]
    return np.stack([sum((x for part, x in moved.items() if part in one), np.zeros(_ACTIONS)) for one in names], axis=1)


def _heading(state: State) -> Float[Array, "2"]:
    """Return cosine and sine of the angle by which the pelvis has turned about the vertical."""
    w, x, y, z = state.qpos[3:7]
    ahead = jnp.stack([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z)])
    return ahead / jnp.sqrt((ahead**2).sum() + 1e-6)
