"""Tasks in plain JAX: a map from one state to the next, and a quadratic cost."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mjxgrad.task import Outcome, Policy, Task


class QuadraticCost(eqx.Module):
    """Squares of what is left to the goal, and of the controls.

    Attributes:
        goal: g.
        weight: diagonal of Q, charged before every step.
        final_weight: diagonal of Q_d, charged after the last.
        control_weight: R, of the squared norm of the controls.
    """

    goal: Float[Array, " states"]
    weight: Float[Array, " states"]
    final_weight: Float[Array, " states"]
    control_weight: Float[Array, ""]

    def stage(self, state: Float[Array, " states"], control: Float[Array, " nu"]) -> Float[Array, ""]:
        """Give (x − g)ᵀQ(x − g) + R‖u‖²."""
        return self.weight @ (state - self.goal) ** 2 + self.control_weight * (control**2).sum()

    def terminal(self, state: Float[Array, " states"]) -> Float[Array, ""]:
        """Give (x − g)ᵀQ_d(x − g)."""
        return self.final_weight @ (state - self.goal) ** 2


class DynamicsTask(Task):
    """A task whose state is a vector; a subclass gives `advance`, the nominal start and the cost."""

    cost: eqx.AbstractVar[QuadraticCost]

    @abstractmethod
    def advance(self, state: Float[Array, " states"], control: Float[Array, " nu"]) -> Float[Array, " states"]:
        """Give the next state."""

    def run(
        self,
        controls: Float[Array, "horizon nu"] | Policy,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
        start: Float[Array, " states"] | None = None,
    ) -> Outcome:
        """Roll out once; see `Task.run`."""
        start = self.nominal_start() if start is None else start
        shape = (self.horizon, self.num_controls)
        rows = jnp.zeros(shape) if callable(controls) else controls
        disturbances = jnp.zeros(shape) if noise is None else noise

        def step(state: Array, inputs: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            row, disturbance = inputs
            control = (controls(params, state) if callable(controls) else row) + disturbance
            return self.advance(state, control), (state, self.cost.stage(state, control))

        final, (states, charged) = jax.lax.scan(step, start, (rows, disturbances))
        step_costs = jnp.append(charged, self.cost.terminal(final))
        return Outcome(step_costs.sum(), states, step_costs)
