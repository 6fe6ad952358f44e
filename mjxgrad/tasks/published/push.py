r"""Two bodies on a line: the first is pushed into the second through a spring.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 and its published settings.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.tasks.published.dynamics import DynamicsTask, QuadraticCost

MASS, TIMESTEP, REACH = 0.1, 0.005, 1.0  # kg, s, m


class Push(DynamicsTask):
    r"""The state is two positions (m) and two velocities (m/s), the control a force (N) on the first body.

    With $d = x_2 - x_1$ the spring pushes with $F = k(1 - d)$ where $d < 1$. Velocities are stepped first, and
    positions with the new ones.

    Attributes:
        stiffness: k, in N/m.
        velocity_factor: what is left of a velocity after a step.
        cost: quadratic.
        horizon: number of steps.
    """

    stiffness: Float[Array, ""]
    velocity_factor: Float[Array, ""]
    cost: QuadraticCost
    horizon: int = eqx.field(static=True)
    num_controls: int = eqx.field(static=True, default=1)

    def nominal_start(self) -> Float[Array, " 4"]:
        """Give both bodies at rest, just touching."""
        return jnp.array([0.0, REACH, 0.0, 0.0])

    def advance(self, state: Float[Array, " 4"], control: Float[Array, " 1"]) -> Float[Array, " 4"]:
        """Give the next state."""
        positions, velocities = state[:2], state[2:]
        force = self.stiffness * jnp.maximum(REACH - (positions[1] - positions[0]), 0.0)
        accelerations = jnp.stack([control[0] - force, force]) / MASS
        velocities = self.velocity_factor * velocities + TIMESTEP * accelerations
        return jnp.concatenate([positions + TIMESTEP * velocities, velocities])


def push_task(stiffness: float, velocity_factor: float, horizon: int) -> Push:
    """Make the task; see `Push`."""
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = QuadraticCost(jnp.array([1.0, 2.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return Push(
        stiffness=jnp.asarray(stiffness, float),
        velocity_factor=jnp.asarray(velocity_factor, float),
        cost=cost,
        horizon=horizon,
    )
