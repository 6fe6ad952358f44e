r"""Smoothed linear models of a step: the mean next state, over a little noise, as a linear function of state and control.

Around a state $x$ and a control $u$, with noise $w = (w_x, w_u) \sim N(0, \operatorname{diag} s^2)$, the mean step is

    E f(x + dx + w_x, u + du + w_u)  ≈  E f(x + w_x, u + w_u) + A dx + B du.

Sums of states are `System.retract`; the change on the left is taken from $f(x, u)$, in the coordinates of its tangent space.
Across a contact the mean is smooth even where f is not: A and B contain the effect of a push already before the touch.

`Analytic` differentiates a step whose solver averages the contact force. The noise is on the distance of contacts, not on the
state, and the acceleration is solved for after the average. It agrees with the mean above for impedances far below one. Another
way to this model is a `Smoother` of your own.

References:
    Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic Contact
    Models. T-RO 2023, arXiv:2206.10787.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from mjxgrad._arrays import is_known
from mjxgrad._text import name_pairs
from mjxgrad.planning.system import ControlVector, SceneSystem, StateVector, System
from mjxgrad.stepping import Smoothing


class LinearModel(eqx.Module):
    """A linear model of a step; under `jax.vmap` every field gains leading axes.

    Attributes:
        A: derivative of the next state's change by the present state's; NaN, like all, if the step is not finite.
        B: derivative of the next state's change by the control.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]


class Smoother(eqx.Module):
    """A smoothed step with its derivative. The same key gives the same step, so that costs can be compared."""

    @abstractmethod
    def step(self, system: System, state: StateVector, control: ControlVector, key: PRNGKeyArray) -> StateVector:
        """Return the next state of the smoothed system."""

    @abstractmethod
    def linear_model(
        self, system: System, state: StateVector, control: ControlVector, key: PRNGKeyArray
    ) -> LinearModel:
        """Return the linear model of the smoothed system; the key is consumed."""

    def scaled(self, factor: ArrayLike) -> "Smoother":
        """Return the smoother with its arrays, which are lengths and standard deviations, multiplied by a factor."""
        return jax.tree.map(lambda length: factor * length, self)

    def warnings(self, system: System, start: StateVector) -> list[str]:
        """Return warnings about unwanted effects of this smoothing at a start; none for traced numbers."""
        return []


class Analytic(Smoother):
    """Contacts averaged in the solver, without sampling: the result does not depend on the key.

    Attributes:
        smoothing: smoothing of contacts and limits; None is the system itself.
    """

    smoothing: Smoothing | None

    def step(self, system, state, control, key):
        return self._smoothed(system).step(state, control)

    def linear_model(self, system, state, control, key):
        native, system = self.native(system), self._smoothed(system)
        end, jacobian = _linearised(system, state, control) if native is None else native.linearised(state, control)
        exists = jnp.all(jnp.isfinite(jacobian)) & jnp.all(jnp.isfinite(end))
        return LinearModel(*jnp.split(jnp.where(exists, jacobian, jnp.nan), [system.num_changes], axis=1))

    def native(self, system: System) -> SceneSystem | None:
        """Return the system to be stepped if its engine takes a whole trajectory in one call; otherwise None."""
        system = self._smoothed(system)
        if isinstance(system, SceneSystem) and system.engine.steers:
            return system

    def _smoothed(self, system: System) -> System:
        return system if self.smoothing is None else system.with_contact(self.smoothing)

    def warnings(self, system: System, start: StateVector) -> list[str]:
        if self.smoothing is None or not isinstance(system, SceneSystem):
            return []
        given, pairs = system.scene.model, [pair for pair in system.scene.pairs if pair.condim > 1]
        if not all(is_known(x) for x in (start, given.geom_size, given.body_pos, given.geom_pos)):
            return []
        model = system.scene.to_mujoco()
        data = mujoco.MjData(model)
        data.qpos[:] = start[: model.nq]
        mujoco.mj_fwdPosition(model, data)
        is_fixed = model.body_weldid[model.geom_bodyid] == 0
        touching = {frozenset(geoms) for geoms in data.contact.geom.tolist() if is_fixed[geoms].any()}
        resting = [pair for pair in pairs if {pair.geom1, pair.geom2} in touching]
        if not resting:
            return []
        told = f"smoothing also reaches {name_pairs(resting)}, which touch at the start: their friction then acts at a distance"
        return [f"{told}, and bodies that should slide or roll hardly move; for planning set their condim to 1"]


class Exact(Analytic):
    """No smoothing: the system itself."""

    smoothing: Smoothing | None = None


def _linearised(
    system: System, state: StateVector, control: ControlVector
) -> tuple[StateVector, Float[Array, "n both"]]:
    """Return the next state, and the derivative of its change by state and control."""
    n = system.num_changes

    def moved(change):
        end = system.step(system.retract(state, change[:n]), control + change[n:])
        return end, end

    jacobian, end = jax.jacfwd(moved, has_aux=True)(jnp.zeros(n + system.num_controls, state.dtype))
    return end, jax.jacfwd(system.difference)(end, end) @ jacobian
