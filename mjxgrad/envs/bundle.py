r"""Bundled gradients: the derivative of a step as a mean over perturbed starts, along the motion as it is.

$\partial f/\partial x \approx \frac1B \sum_b \partial f/\partial x\,(x + \delta_b, a)$: sampling in place of what an onset
does in closed form, at B more rollouts per step.

References:
    Bundled Contact Gradients, arXiv:2609.30951, there where the force of contact is high; here everywhere. Suh, Pang, Tedrake.
    Bundled Gradients Through Contact Via Randomized Smoothing. RA-L 2022, arXiv:2109.05143 (the idea).
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad._rollout import State
from mjxgrad.dynamics.kinematics import integrate_position
from mjxgrad.scene import Scene

Advance = Callable[[State, Float[Array, " nu"]], State]


class Bundle(eqx.Module):
    """How starts are perturbed.

    Attributes:
        num_branches: rollouts over which a derivative is averaged.
        length: standard deviation of the positions (m, rad).
        speed: of the velocities (m/s, rad/s).
    """

    num_branches: int = eqx.field(static=True, default=10)
    length: float = eqx.field(static=True, default=0.01)
    speed: float = eqx.field(static=True, default=0.02)

    def __check_init__(self):
        if self.num_branches < 1:
            raise ValueError(f"num_branches must be at least 1, got {self.num_branches}")

    def average(
        self, advance: Advance, scene: Scene, state: State, ctrl: Float[Array, " nu"], key: PRNGKeyArray
    ) -> State:
        """Return where a step leads, with the mean of the branches' derivatives."""

        def branch(key: PRNGKeyArray) -> State:
            position, velocity = jax.random.split(key)
            change = self.length * jax.random.normal(position, state.qvel.shape, state.qvel.dtype)
            speed = self.speed * jax.random.normal(velocity, state.qvel.shape, state.qvel.dtype)
            qpos = integrate_position(scene.model, state.qpos, change, 1.0)
            return advance(dataclasses.replace(state, qpos=qpos, qvel=state.qvel + speed), ctrl)

        plain = jax.lax.stop_gradient(advance(state, ctrl))
        ends = jax.vmap(branch)(jax.random.split(key, self.num_branches))
        # Of value zero, and with the derivative of the mean.
        return jax.tree.map(lambda x, y: x + (y - jax.lax.stop_gradient(y)).mean(axis=0), plain, ends)
