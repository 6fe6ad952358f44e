r"""A point in the plane that stops at seven discs on its way.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 and its published settings.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.tasks.published.dynamics import DynamicsTask, QuadraticCost

TIMESTEP = 0.01  # s
CENTRES = ((-0.2, 0.5), (0.5, 1.2), (0.0, 2.3), (0.4, 3.2), (-0.8, 3.8), (-1.0, 1.0), (0.0, 1.5))  # m
RADII = (0.2, 0.2, 0.3, 0.5, 0.1, 0.5, 0.2)  # m


class MotionPlanning(DynamicsTask):
    """The state is a position (m), the control a velocity (m/s); a step that would end in a disc is not taken.

    Attributes:
        cost: quadratic.
        horizon: number of steps.
    """

    cost: QuadraticCost
    horizon: int = eqx.field(static=True)
    num_controls: int = eqx.field(static=True, default=2)

    def nominal_start(self) -> Float[Array, " 2"]:
        """Give the origin."""
        return jnp.zeros(2)

    def advance(self, state: Float[Array, " 2"], control: Float[Array, " 2"]) -> Float[Array, " 2"]:
        """Give the next position."""
        moved = state + TIMESTEP * control
        squared_distances = ((moved - jnp.array(CENTRES)) ** 2).sum(axis=1)
        is_blocked = (squared_distances < jnp.array(RADII) ** 2).any()
        return jnp.where(is_blocked, state, moved)


def motion_planning_task() -> MotionPlanning:
    """Make the task; see `MotionPlanning`."""
    cost = QuadraticCost(jnp.array([0.0, 4.0]), jnp.ones(2), 10 * jnp.ones(2), jnp.array(0.001))
    return MotionPlanning(cost=cost, horizon=200)
