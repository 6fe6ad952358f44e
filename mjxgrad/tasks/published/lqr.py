r"""A linear system under a static gain: the cost is a polynomial in the gain, of high degree.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 and its published settings.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.tasks.published.dynamics import DynamicsTask, QuadraticCost

START_STDDEV = 0.001


class LQR(DynamicsTask):
    """The state is a vector x, the control a vector u of the same size, and x' = x + u.

    Attributes:
        cost: quadratic.
        num_controls: size of both.
        horizon: number of steps.
    """

    cost: QuadraticCost
    num_controls: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True)

    def nominal_start(self) -> Float[Array, " states"]:
        """Give all ones."""
        return jnp.ones(self.num_controls)

    def sample_start(self, key: PRNGKeyArray) -> Float[Array, " states"]:
        """Draw a state beside it."""
        return self.nominal_start() + START_STDDEV * jax.random.normal(key, (self.num_controls,))

    def advance(self, state: Float[Array, " states"], control: Float[Array, " states"]) -> Float[Array, " states"]:
        """Give the next state."""
        return state + control


def lqr_task(num_states: int = 100) -> LQR:
    """Make the task; see `LQR`."""
    ones = jnp.ones(num_states)
    cost = QuadraticCost(0 * ones, ones, 10 * ones, jnp.array(0.1))
    return LQR(cost=cost, num_controls=num_states, horizon=10)
