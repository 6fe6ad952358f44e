"""Bundled contact gradients: where contact pushes hard, the derivative of a step is the mean of those at nearby states.

References:
    Bundled Contact Gradients. arXiv:2609.30951: ten branches of 1 cm and 2 cm/s over two control steps, where a foot of a
    humanoid carries 400 N. Here each control step has its own branches.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad._arrays import real, whole
from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.envs import Environment, EnvState
from mjxgrad.stepping.rows import has_pyramids


@dataclasses.dataclass(frozen=True)
class Bundle:
    """Branches over which the derivative of a control step is averaged, at the cost of a step each; the motion is as it is.

    Attributes:
        num_branches: number of branches.
        position_stddev: standard deviation of the change of each position (m or rad).
        velocity_stddev: standard deviation of the change of each velocity (m/s or rad/s).
        force: total normal force of all contacts, before or after the step, above which derivatives are averaged (N).
    """

    num_branches: int = 10
    position_stddev: float = 0.01
    velocity_stddev: float = 0.02
    force: float = 400.0

    def __post_init__(self):
        whole("num_branches", self.num_branches)
        if np.asarray(real("spreads and force", dataclasses.astuple(self)[1:])).min() < 0:
            raise ValueError(f"spreads and force must not be negative, got {self}")

    def step_on(self, environment: Environment, state: EnvState, action: Float[Array, " nu"]):
        """Return what `environment.step_on` returns, with the derivative of the mean where contact pushes hard."""

        def branch(key: PRNGKeyArray) -> tuple[EnvState, EnvState]:
            start, (turn, push) = state.physics, jax.random.normal(key, (2, *state.physics.qvel.shape))
            qpos = integrate_position(environment.scene.model, start.qpos, self.position_stddev * turn, 1.0)
            near = dataclasses.replace(start, qpos=qpos, qvel=start.qvel + self.velocity_stddev * push)
            return environment.step_on(dataclasses.replace(state, physics=near), action)

        plain = environment.step_on(state, action)
        # The third of three keys: a step consumes the first two.
        branches = jax.vmap(branch)(jax.random.split(jax.random.split(state.key, 3)[2], self.num_branches))
        forces = [environment.look(one.physics, _total_force, action) for one in (state, plain[0])]
        is_hard = jnp.maximum(*jax.lax.stop_gradient(forces)) > self.force

        def averaged(x: Array, each: Array) -> Array:
            if not eqx.is_inexact_array(x):
                return x
            # Infinity less infinity is no number, and a memory may hold infinities.
            change = jnp.where(jnp.isfinite(each), each - jax.lax.stop_gradient(each), 0).mean(axis=0)
            return jnp.where(is_hard, jax.lax.stop_gradient(x) + change, x)

        return jax.tree.map(averaged, plain, branches)


def _total_force(model, data) -> Float[Array, ""]:
    """Return the normal force of all contacts; pyramids share it among their edges."""
    contact, force = data._impl.contact, data._impl.efc_force
    first = zip(contact.efc_address.tolist(), contact.dim.tolist(), strict=True)
    rows = [a + k for a, dim in first for k in range(2 * (dim - 1) if has_pyramids(model, dim) else 1)]
    return force[jnp.array(rows, int)].sum()
