"""A Unitree G1 that is pushed and stays up: it observes its joints, how its pelvis leans, turns and moves, and its last action.

The robot is that of mjlab, downloaded on first use: 29 position servos on a floor, its real masses, torques and feet.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from experiments.problems.quadruped import in_trunk
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.stepping import EngineName

Memory = dict[str, Float[Array, "..."]]
_WHEEL, _FILE = "mjlab==1.6.0", "mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml"
# By parts of a joint's name: angle at rest (rad), stiffness (N m/rad), most torque (N m).
_JOINTS = {
    "hip_pitch": (-0.31, 100.0, 88.0), "hip_roll": (0.0, 100.0, 88.0), "hip_yaw": (0.0, 100.0, 88.0),
    "knee": (0.67, 150.0, 139.0), "ankle": (0.0, 40.0, 50.0), "waist": (0.0, 100.0, 50.0),
    "shoulder": (0.0, 40.0, 25.0), "elbow": (0.6, 40.0, 25.0), "wrist": (0.0, 20.0, 5.0),
}  # fmt: skip
_REST = {"ankle_pitch": -0.36, "left_shoulder_roll": 0.2, "right_shoulder_roll": -0.2, "shoulder_pitch": 0.2}
_DAMPING, _ARMATURE = 0.05, 0.02  # s, times stiffness; kg m²
_HEIGHT, _LOWEST, _LEAST_UP = 0.755, 0.45, 0.6  # m of the pelvis; cosine of its lean
_REACH = 0.5  # rad that an action of 1 moves a joint's target
_PUSH = (0.2, 0.7)  # m/s that the robot is given at once
_EVERY = 100  # actions from push to push
_SUN = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL


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


def g1() -> mujoco.MjModel:
    """Return the robot on a floor, with servos, its key frame a pose of bent knees."""
    # Imported here: it brings pandas.
    from experiments.robots import fetched

    spec = mujoco.MjSpec.from_file(str(fetched(_WHEEL) / _FILE))
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], material="floor")
    spec.body("pelvis").add_camera(
        name="track",
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[2.4, -1.6, 0.3],
        xyaxes=[0.55, 0.83, 0, -0.15, 0.1, 1],
    )
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0.2, 0.3, -1], diffuse=[0.3] * 3, castshadow=False, type=_SUN)
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
    spec.add_texture(name="sky", **sky, rgb1=[0.85, 0.9, 0.95], rgb2=[1, 1, 1], width=32, height=32)
    checks = {"type": mujoco.mjtTexture.mjTEXTURE_2D, "builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER}
    spec.add_texture(name="checks", **checks, rgb1=[0.75, 0.75, 0.75], rgb2=[0.82, 0.82, 0.82], width=64, height=64)
    floor = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checks"
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    rest = [0.0, 0.0, _HEIGHT, 1.0, 0.0, 0.0, 0.0]
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            angle, stiffness, torque = next(x for name, x in _JOINTS.items() if name in joint.name)
            rest.append(next((x for name, x in _REST.items() if name in joint.name), angle))
            joint.armature = _ARMATURE
            servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=stiffness, kv=_DAMPING * stiffness)
            servo.forcerange = [-torque, torque]
    spec.add_key(name="rest", qpos=rest, ctrl=rest[7:])
    return spec.compile()


def _push(key: PRNGKeyArray) -> Float[Array, "2"]:
    size, where = jax.random.split(key)
    angle = jax.random.uniform(where, (), maxval=2 * np.pi)
    speed = jax.random.uniform(size, (), minval=_PUSH[0], maxval=_PUSH[1])
    return speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
