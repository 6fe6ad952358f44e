r"""The tasks on which SHAC and its successors are compared: ant, hopper, cheetah, humanoid and a cart-pole swing-up.

Observations, rewards, ends and all starts but the cart-pole's are DiffRL's, bodies gymnasium's. Contact is MuJoCo's, so
returns compare with published ones only as ratios. An action holds for 1/60 s, and an episode has 1000 (cart-pole 240).

References:
    Xu, Makoviychuk, Narang, Ramos, Matusik, Garg, Macklin. Accelerated Policy Learning with Parallel Differentiable Simulation.
    ICLR 2022, arXiv:2204.07137 (SHAC and these tasks).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from mjxgrad.bodies.spatial import exponential, multiply, rotation_matrix
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import Scene, load_scene
from mjxgrad.tasks import robot_scene, scene_path

Memory = dict[str, Float[Array, "..."]]
_TILT = jnp.pi / 24  # rad, largest tilt of a floating base at the start
_UPRIGHT = jnp.pi / 6  # rad, tilt of a planar torso at which its reward is zero


class Walker(Environment):
    """A floating base that is to run upright along x: ant and humanoid; the policy sees its last action.

    Attributes:
        fallen: height of the torso below which the episode is over (m).
        action_weight: cost per squared action.
        rise_scale: reward per m above the wanted height, 0.1 m above `fallen`. None rewards each m above `fallen` by 1 (ant).
    """

    fallen: float = eqx.field(static=True, kw_only=True)
    action_weight: float = eqx.field(static=True, default=0.0, kw_only=True)
    rise_scale: float | None = eqx.field(static=True, default=None, kw_only=True)

    def first_memory(self, key: PRNGKeyArray) -> Memory:
        return {"action": jnp.zeros(self.num_actions)}

    def next_memory(self, memory: Memory, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> Memory:
        return {"action": action}

    def start(self, key: PRNGKeyArray) -> State:
        place, axis, angle, joints, speeds = jax.random.split(key, 5)
        rest = self.scene.data
        where = rest.qpos[:3] + jax.random.uniform(place, (3,), minval=-0.1, maxval=0.1)
        direction = jax.random.uniform(axis, (3,), minval=-1, maxval=1)
        direction = direction / jnp.linalg.norm(direction)
        tilt = exponential(direction * jax.random.uniform(angle, (), minval=-_TILT, maxval=_TILT))
        posture = rest.qpos[7:] + jax.random.uniform(joints, rest.qpos[7:].shape, minval=-0.2, maxval=0.2)
        qpos = jnp.concatenate([where, multiply(rest.qpos[3:7], tilt), posture])
        return initial_state(self.scene, qpos, jax.random.uniform(speeds, rest.qvel.shape, minval=-0.25, maxval=0.25))

    def observe(self, state: State, memory: Memory) -> Float[Array, " obs"]:
        upright, heading = _posture(state)
        base, joints = state.qpos[2:7], state.qpos[7:]
        course = jnp.stack([upright, heading])
        return jnp.concatenate([base, state.qvel[:6], joints, 0.1 * state.qvel[6:], course, memory["action"]])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: Memory) -> Rewards:
        upright, heading = _posture(after)
        height = after.qpos[2] - self.fallen
        rise = height if self.rise_scale is None else _rise(height - 0.1, self.rise_scale, 0.1)
        terms = {"forward": after.qvel[0], "upright": 0.1 * upright, "heading": heading, "height": rise}
        return {**terms, "action": -self.action_weight * (action**2).sum()}

    def is_over(self, state: State) -> Bool[Array, ""]:
        return state.qpos[2] < self.fallen


class Planar(Environment):
    """A body in a plane that is to run along x: hopper and cheetah.

    Attributes:
        fallen: change of the torso's height below which the episode is over (m). None: never, and posture has no reward.
    """

    fallen: float | None = eqx.field(static=True, default=None, kw_only=True)

    def start(self, key: PRNGKeyArray) -> State:
        place, tilt, joints, speeds = jax.random.split(key, 4)
        rest = self.scene.data
        draws = ((place, 2, 0.05), (tilt, 1, 0.1), (joints, rest.qpos.size - 3, 0.05))
        change = jnp.concatenate([jax.random.uniform(k, (n,), minval=-most, maxval=most) for k, n, most in draws])
        speed = jax.random.uniform(speeds, rest.qvel.shape, minval=-0.05, maxval=0.05)
        return initial_state(self.scene, rest.qpos + change, speed)

    def observe(self, state: State, memory: PyTree) -> Float[Array, " obs"]:
        return jnp.concatenate([state.qpos[1:], state.qvel])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: PyTree) -> Rewards:
        terms = {"forward": after.qvel[0], "action": -0.1 * (action**2).sum()}
        if self.fallen is None:
            return terms
        rest = self.scene.data.qpos[1]
        rise = _rise(after.qpos[1] - rest - self.fallen - 0.15, 1.0, 0.3)
        return {**terms, "height": rise, "upright": 1 - (after.qpos[2] / _UPRIGHT) ** 2}

    def is_over(self, state: State) -> Bool[Array, ""]:
        return jnp.array(False) if self.fallen is None else state.qpos[1] - self.scene.data.qpos[1] < self.fallen


class CartPole(Environment):
    """A pole that hangs from a cart, to be swung up and held upright."""

    def start(self, key: PRNGKeyArray) -> State:
        place, speed = jax.random.split(key)
        spread = jnp.array([0.5, jnp.pi / 4])
        hanging = jnp.array([0.0, jnp.pi])
        qpos = hanging + spread * jax.random.uniform(place, (2,), minval=-1, maxval=1)
        return initial_state(self.scene, qpos, 0.5 * jax.random.uniform(speed, (2,), minval=-1, maxval=1))

    def observe(self, state: State, memory: PyTree) -> Float[Array, " 5"]:
        (place, angle), (speed, rate) = state.qpos, state.qvel
        return jnp.stack([place, speed, jnp.sin(angle), jnp.cos(angle), rate])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: PyTree) -> Rewards:
        (place, angle), (speed, rate) = after.qpos, after.qvel
        upward = jnp.arctan2(jnp.sin(angle), jnp.cos(angle))
        return {"pole": -(upward**2) - 0.1 * rate**2, "cart": -0.05 * place**2 - 0.1 * speed**2}


def cartpole() -> CartPole:
    """Return the swing-up: a cart of 1 kg, a pole of 0.1 kg and 1 m, at most 20 N; an angle of zero is upright."""
    return CartPole(load_scene(scene_path("cartpole")), frame_skip=2, episode_length=240)


def hopper(*, num_substeps: int = 4) -> Planar:
    """Return the hopper; an episode is over when the torso is 0.45 m below its reference height.

    An action has `num_substeps` time steps, together 1/60 s; stiffer contact needs more.
    """
    return Planar(_scene("hopper", num_substeps), frame_skip=num_substeps, fallen=-0.45)


def half_cheetah(*, num_substeps: int = 2) -> Planar:
    """Return the cheetah, whose episodes end only by time; `num_substeps` as for `hopper`."""
    return Planar(_scene("half_cheetah", num_substeps), frame_skip=num_substeps)


def ant(*, num_substeps: int = 2) -> Walker:
    """Return the ant; an episode is over when the torso is below 0.27 m; `num_substeps` as for `hopper`."""
    return Walker(_scene("ant", num_substeps, max_contacts=8), frame_skip=num_substeps, fallen=0.27)


def humanoid(*, num_substeps: int = 4) -> Walker:
    """Return the humanoid; an episode is over when the torso is below 0.74 m; `num_substeps` as for `hopper`."""
    scene = _scene("humanoid", num_substeps, max_contacts=12)
    return Walker(scene, frame_skip=num_substeps, fallen=0.74, action_weight=0.002, rise_scale=10.0)


def _scene(name: str, num_substeps: int, *, max_contacts: int | None = None) -> Scene:
    return robot_scene(name, timestep=1 / (60 * num_substeps), max_contacts=max_contacts)


def _posture(state: State) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the vertical component of the torso's z axis and the forward component of its x axis."""
    turn = rotation_matrix(state.qpos[None, 3:7])[0]
    return turn[2, 2], turn[0, 0]


def _rise(height: Float[Array, ""], scale: float, most: float) -> Float[Array, ""]:
    """Return the reward for a height above the wanted one: linear up to `most`, minus its scaled square below zero."""
    height = jnp.clip(height, -1.0, most)
    return jnp.where(height < 0, -200 * height**2, scale * height)
