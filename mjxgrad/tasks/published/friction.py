r"""One body drags another along by dry friction while they lie on each other.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 and its published settings.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.tasks.published.dynamics import DynamicsTask, QuadraticCost

MASS, TIMESTEP = 0.1, 0.005  # kg, s
OVERLAP = 0.1  # m: farther apart the bodies do not touch
SLOPE, LIMIT = 1.8, 0.18  # N s/m, N


class Friction(DynamicsTask):
    r"""The state is two positions (m) and two velocities (m/s), the control a force (N) on the first body.

    Friction on the second is $\mathrm{clip}(1.8(v_1 - v_2), \pm 0.18)$ within 0.1 m of the first, and none beyond: the
    cost jumps where the first slips from under it.

    Attributes:
        cost: quadratic.
        horizon: number of steps.
    """

    cost: QuadraticCost
    horizon: int = eqx.field(static=True)
    num_controls: int = eqx.field(static=True, default=1)

    def nominal_start(self) -> Float[Array, " 4"]:
        """Give both bodies at rest, one on the other."""
        return jnp.zeros(4)

    def advance(self, state: Float[Array, " 4"], control: Float[Array, " 1"]) -> Float[Array, " 4"]:
        """Give the next state."""
        positions, velocities = state[:2], state[2:]
        is_touching = jnp.abs(positions[1] - positions[0]) < OVERLAP
        drag = jnp.where(is_touching, jnp.clip(SLOPE * (velocities[0] - velocities[1]), -LIMIT, LIMIT), 0.0)
        velocities = velocities + TIMESTEP / MASS * jnp.stack([control[0] - drag, drag])
        return jnp.concatenate([positions + TIMESTEP * velocities, velocities])


def friction_task() -> Friction:
    """Make the task; see `Friction`."""
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = QuadraticCost(jnp.array([2.0, 2.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return Friction(cost=cost, horizon=400)
