"""Gymnasium's walking robots: its bodies, starts, observations, rewards and ends (version 5).

Two things differ. Steps are Euler's, not Runge-Kutta's, which cost four times as much; the ant's are half as long as gymnasium's,
for what runs by Euler's steps of 10 ms falls by Runge-Kutta's, and the other way round. Ant and humanoid have the options
`include_..._in_observation=False` and `contact_cost_weight=0`: contact forces and inertias are neither observed nor charged.

References:
    Towers et al. Gymnasium: A Standard Interface for Reinforcement Learning Environments. arXiv:2407.17032.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from mjxgrad.bodies.kinematics import kinematics
from mjxgrad.engines.state import data_of
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.tasks import robot_scene

_ANY = (-float("inf"), float("inf"))


class Robot(Environment):
    """A robot rewarded for moving forward and staying upright, and charged for its controls.

    Attributes:
        forward_weight: reward per m/s of the torso or of the centre of mass.
        control_weight: cost per squared control.
        alive_reward: reward for every step that ends within the healthy ranges.
        healthy_height: range of the torso's height (m); outside it an episode ends.
        healthy_angle: range of a planar torso's angle (rad).
        healthy_rest: bound on all speeds and on all positions after the first two (rad, m/s, rad/s).
        num_unseen: number of leading positions that are not observed, the location.
        speed_limit: bound to which observed speeds are clipped.
        noise: size of the uniform noise on positions and velocities at the start, about the reference pose at rest.
        is_normal: whether the noise on the velocities is normal instead.
        by_mass: whether the speed is that of the centre of mass.
    """

    forward_weight: float = eqx.field(static=True, default=1.0, kw_only=True)
    control_weight: float = eqx.field(static=True, kw_only=True)
    alive_reward: float = eqx.field(static=True, default=0.0, kw_only=True)
    healthy_height: tuple[float, float] = eqx.field(static=True, default=_ANY, kw_only=True)
    healthy_angle: tuple[float, float] = eqx.field(static=True, default=_ANY, kw_only=True)
    healthy_rest: float = eqx.field(static=True, default=float("inf"), kw_only=True)
    num_unseen: int = eqx.field(static=True, default=1, kw_only=True)
    speed_limit: float = eqx.field(static=True, default=float("inf"), kw_only=True)
    noise: float = eqx.field(static=True, kw_only=True)
    is_normal: bool = eqx.field(static=True, default=False, kw_only=True)
    by_mass: bool = eqx.field(static=True, default=False, kw_only=True)

    def start(self, key: PRNGKeyArray) -> State:
        pose, speed = jax.random.split(key)
        rest = self.scene.data
        shape, dtype = rest.qvel.shape, rest.qvel.dtype
        draw = jax.random.normal if self.is_normal else _uniform
        qpos = rest.qpos + self.noise * _uniform(pose, rest.qpos.shape, dtype)
        return initial_state(self.scene, qpos, self.noise * draw(speed, shape, dtype))

    def observe(self, state: State, memory: PyTree) -> Float[Array, " obs"]:
        speeds = jnp.clip(state.qvel, -self.speed_limit, self.speed_limit)
        return jnp.concatenate([state.qpos[self.num_unseen :], speeds])

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: PyTree) -> Rewards:
        speed = (self._place(after) - self._place(before)) / self.interval
        return {
            "forward": self.forward_weight * speed,
            "control": -self.control_weight * (self.control(action) ** 2).sum(),
            "alive": self.alive_reward * self._is_healthy(after).astype(speed.dtype),
        }

    def is_over(self, state: State) -> Bool[Array, ""]:
        return ~self._is_healthy(state)

    def _is_healthy(self, state: State) -> Bool[Array, ""]:
        is_planar = self.num_unseen == 1
        is_healthy = _is_within(state.qpos[1 if is_planar else 2], self.healthy_height)
        rest = jnp.concatenate([state.qpos[2:], state.qvel])
        is_healthy &= jnp.all(jnp.abs(rest) < self.healthy_rest)
        return is_healthy & _is_within(state.qpos[2], self.healthy_angle) if is_planar else is_healthy

    def _place(self, state: State) -> Float[Array, ""]:
        if not self.by_mass:
            return state.qpos[0]
        model = self.scene.model
        places = kinematics(model, data_of(self.scene, state, self.scene.data.ctrl)).xipos[:, 0]
        return (model.body_mass * places).sum() / model.body_mass.sum()


_PLANAR = {"frame_skip": 4, "control_weight": 1e-3, "alive_reward": 1.0, "speed_limit": 10.0, "noise": 5e-3}
_FREE: dict[str, Any] = {"frame_skip": 5, "num_unseen": 2}


def hopper() -> Robot:
    """Return Hopper-v5: one leg, three motors, 8 ms an action."""
    healthy = {"healthy_height": (0.7, float("inf")), "healthy_angle": (-0.2, 0.2), "healthy_rest": 100.0}
    return Robot(robot_scene("hopper"), **healthy, **_PLANAR)


def walker2d() -> Robot:
    """Return Walker2d-v5: two legs in a plane, six motors, 8 ms an action."""
    return Robot(robot_scene("walker2d_v5"), healthy_height=(0.8, 2.0), healthy_angle=(-1.0, 1.0), **_PLANAR)


def half_cheetah() -> Robot:
    """Return HalfCheetah-v5: six motors, 50 ms an action, never over."""
    return Robot(robot_scene("half_cheetah"), frame_skip=5, control_weight=0.1, noise=0.1, is_normal=True)


def ant() -> Robot:
    """Return Ant-v5 without contact forces: four legs, eight motors, 50 ms an action."""
    scene, healthy = (
        robot_scene("ant", timestep=5e-3, max_contacts=8),
        {"alive_reward": 1.0, "healthy_height": (0.2, 1.0)},
    )
    how = {**_FREE, "frame_skip": 10, "noise": 0.1, "is_normal": True}
    return Robot(scene, control_weight=0.5, **healthy, **how)


def humanoid() -> Robot:
    """Return Humanoid-v5 without inertias and forces: seventeen motors, 15 ms an action."""
    scene, healthy = robot_scene("humanoid", max_contacts=12), {"alive_reward": 5.0, "healthy_height": (1.0, 2.0)}
    return Robot(scene, forward_weight=1.25, control_weight=0.1, noise=1e-2, by_mass=True, **healthy, **_FREE)


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], dtype) -> Float[Array, "*shape"]:
    return jax.random.uniform(key, shape, dtype, -1, 1)


def _is_within(value: Float[Array, ""], bounds: tuple[float, float]) -> Bool[Array, ""]:
    return (value > bounds[0]) & (value < bounds[1])
