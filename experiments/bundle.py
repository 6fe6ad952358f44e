r"""Bundled gradients: the derivative of a step as a mean over perturbed starts, along the motion as it is.

$\partial f/\partial x \approx \frac1B \sum_b \partial f/\partial x\,(x + \delta_b, a)$: sampling in place of what an onset
does in closed form, at B more rollouts per step.

References:
    Bundled Contact Gradients, arXiv:2609.30951, there where the force of contact is high; here everywhere. Suh, Pang, Tedrake.
    Bundled Gradients Through Contact Via Randomized Smoothing. RA-L 2022, arXiv:2109.05143 (the idea).
"""

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

import mjxgrad as mg
from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.envs import Environment, EnvState


@dataclass(frozen=True)
class Bundle:
    """How starts are perturbed."""

    num_branches: int = 10  # rollouts over which a derivative is averaged
    length: float = 0.01  # standard deviation of the positions (m, rad)
    speed: float = 0.02  # of the velocities (m/s, rad/s)


def bundled(environment: Environment, bundle: Bundle | None = None) -> Environment:
    """Return the environment in which the derivative of every step is averaged over perturbed starts."""
    kind = _bundled(type(environment), bundle or Bundle())
    return kind(**{field.name: getattr(environment, field.name) for field in dataclasses.fields(environment)})


@functools.cache
def _bundled(kind: type[Environment], bundle: Bundle) -> type[Environment]:
    class Bundled(kind):
        def step(self, state: EnvState, action: Float[Array, " nu"]) -> EnvState:
            def branch(key: PRNGKeyArray) -> mg.State:
                start = _perturbed(self.scene, state.physics, bundle, key)
                return kind.step(self, dataclasses.replace(state, physics=start), action).physics

            plain = kind.step(self, state, action)
            ends = jax.vmap(branch)(jax.random.split(jax.random.split(state.key, 3)[2], bundle.num_branches))
            # Of value zero, and with the derivative of the mean.
            after = jax.tree.map(
                lambda x, y: jax.lax.stop_gradient(x) + (y - jax.lax.stop_gradient(y)).mean(axis=0), plain.physics, ends
            )
            action = jnp.clip(action, -1, 1)
            terms = self.rewards(state.physics, action, after, state.memory)
            return dataclasses.replace(
                plain,
                physics=after,
                obs=self.observe(after, plain.memory),
                reward=jnp.asarray(sum(terms.values()), plain.reward.dtype),
            )

    return Bundled


def _perturbed(scene: mg.Scene, state: mg.State, bundle: Bundle, key: PRNGKeyArray) -> mg.State:
    position, velocity = jax.random.split(key)
    change = bundle.length * jax.random.normal(position, state.qvel.shape, state.qvel.dtype)
    speed = bundle.speed * jax.random.normal(velocity, state.qvel.shape, state.qvel.dtype)
    qpos = integrate_position(scene.model, state.qpos, change, 1.0)
    return dataclasses.replace(state, qpos=qpos, qvel=state.qvel + speed)
