"""What a plan costs, step by step, and its quadratic model."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad.planning.system import ControlVector, StateVector, System


class Cost(eqx.Module):
    """A cost of states and controls; a subclass gives `stage` and `terminal`, twice differentiable."""

    @abstractmethod
    def stage(self, system: System, state: StateVector, control: ControlVector) -> Float[Array, ""]:
        """Return the cost of one step."""

    @abstractmethod
    def terminal(self, system: System, state: StateVector) -> Float[Array, ""]:
        """Return the cost of the last state."""

    def total(
        self, system: System, states: Float[Array, "states state"], controls: Float[Array, "horizon m"]
    ) -> Float[Array, ""]:
        """Return the cost of a trajectory of `horizon + 1` states."""
        stages = jax.vmap(lambda state, control: self.stage(system, state, control))(states[:-1], controls)
        return stages.sum() + self.terminal(system, states[-1])


class GoalCost(Cost):
    """Squared distances to a goal, weighted, and squared controls; each with a factor of one half.

    Attributes:
        goal: state to be reached.
        stage_weight: of the distance in each step, per coordinate of a change.
        terminal_weight: of that at the end.
        control_weight: per control.
        resting: the control that costs nothing.
    """

    goal: StateVector
    stage_weight: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    terminal_weight: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    control_weight: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    resting: Float[ArrayLike, "..."] = 0.0

    def stage(self, system: System, state: StateVector, control: ControlVector) -> Float[Array, ""]:
        distance, effort = system.difference(state, self.goal), control - self.resting
        return 0.5 * (jnp.sum(self.stage_weight * distance**2) + jnp.sum(self.control_weight * effort**2))

    def terminal(self, system: System, state: StateVector) -> Float[Array, ""]:
        return 0.5 * jnp.sum(self.terminal_weight * system.difference(state, self.goal) ** 2)


class Quadratic(eqx.Module):
    """A convex quadratic model in changes of state and then control; the terminal one has no control."""

    gradient: Float[Array, " both"]
    hessian: Float[Array, "both both"]


def stage_model(cost: Cost, system: System, state: StateVector, control: ControlVector) -> Quadratic:
    """Expand the cost of a step around a state and a control."""
    n = system.num_changes

    def moved(change: Float[Array, " both"]) -> Float[Array, ""]:
        return cost.stage(system, system.retract(state, change[:n]), control + change[n:])

    return _model(moved, jnp.zeros(n + control.size, state.dtype))


def terminal_model(cost: Cost, system: System, state: StateVector) -> Quadratic:
    """Expand the cost of the last state around it."""
    at = jnp.zeros(system.num_changes, state.dtype)
    return _model(lambda change: cost.terminal(system, system.retract(state, change)), at)


def _model(function, at: Float[Array, " both"]) -> Quadratic:
    """Return gradient and Hessian, without the negative curvature that would turn descent into ascent."""
    hessian = jax.hessian(function)(at)
    values, vectors = jnp.linalg.eigh(0.5 * (hessian + hessian.T))
    return Quadratic(jax.grad(function)(at), (vectors * jnp.maximum(values, 0)) @ vectors.T)
