"""What is to be linearised: a map from a state and a control to the next state.

A state is one flat vector; a change of it has the coordinates of its tangent space, which for quaternions are fewer. Whoever
linearises, samples or plans moves states by `retract` and compares them by `difference`, and so need not know which is which.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._mjx import mjx
from mjxgrad._rollout import State
from mjxgrad.dynamics import Smoothing, step
from mjxgrad.dynamics.kinematics import integrate_position, position_change
from mjxgrad.scene import Scene
from mjxgrad.task import as_pytree

StateVector = Float[Array, " state"]
ControlVector = Float[Array, " m"]
ChangeVector = Float[Array, " n"]


class System(eqx.Module):
    """A discrete map with a control.

    Attributes:
        num_changes: dimension n of the tangent space.
        num_positions: how many of its leading coordinates are positions; the rest are velocities and activations.
        num_controls: dimension m of the control.
    """

    num_changes: eqx.AbstractVar[int]
    num_positions: eqx.AbstractVar[int]
    num_controls: eqx.AbstractVar[int]

    @abstractmethod
    def step(self, state: StateVector, control: ControlVector) -> StateVector:
        """Return the next state."""

    def retract(self, state: StateVector, change: ChangeVector) -> StateVector:
        """Return the state moved by a change."""
        return state + change

    def difference(self, end: StateVector, start: StateVector) -> ChangeVector:
        """Return the change that moves `start` to `end`; the inverse of `retract`."""
        return end - start

    def __hash__(self) -> int:
        # `jax.jit(system.step)` asks for one, and arrays have none.
        return id(self)

    @property
    def control_limits(self) -> tuple[ControlVector, ControlVector]:
        """The least and the largest control; infinite where there is no limit."""
        unlimited = jnp.full(self.num_controls, jnp.inf)
        return -unlimited, unlimited

    def limits(
        self, lower: ArrayLike | None, upper: ArrayLike | None, dtype: jnp.dtype
    ) -> tuple[ControlVector, ControlVector]:
        """Return limits, a number or one per control, for each control; `control_limits` where there is None."""
        low, high = (
            jnp.broadcast_to(jnp.asarray(own if given is None else given, dtype), (self.num_controls,))
            for given, own in zip((lower, upper), self.control_limits, strict=True)
        )
        return low, high

    def with_smoothing(self, smoothing: Smoothing | None) -> "System":
        """Give the system with another analytic smoothing of its contacts.

        Raises:
            ValueError: if the system has no contacts to smooth.
        """
        if smoothing is None:
            return self
        raise ValueError(
            f"analytic smoothing must be of a SceneSystem, got {type(self).__name__}: take samples, by Sampled"
        )


class FunctionSystem(System):
    """Any function of two vectors, all of whose states are positions.

    Attributes:
        function: from state and control to the next state.
    """

    function: Callable[[ChangeVector, ControlVector], ChangeVector] = eqx.field(converter=as_pytree)
    num_changes: int = eqx.field(static=True)
    num_controls: int = eqx.field(static=True)

    @property
    def num_positions(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The number of all states."""
        return self.num_changes

    def step(self, state: ChangeVector, control: ControlVector) -> ChangeVector:
        return self.function(state, control)


class SceneSystem(System):
    """A scene under a control that is held for one or several time steps.

    The state is (qpos, qvel, act); its tangent space has the coordinates of velocities in place of positions, so that a
    quaternion counts three. Time is not part of the state.

    Attributes:
        scene: from `load_scene`.
        num_substeps: time steps per step of the system.
        gradient: which derivative of contact and limit events, "discrete" or "event"; see `mjxgrad.step`.
        smoothing: of contacts and limits in the solver, or None; see `mjxgrad.step`.
    """

    scene: Scene
    num_substeps: int = eqx.field(static=True, default=1)
    gradient: Literal["discrete", "event"] = eqx.field(static=True, default="discrete")
    smoothing: Smoothing | None = None

    def __check_init__(self):
        if self.num_substeps < 1:
            raise ValueError(f"num_substeps must be at least 1, got {self.num_substeps}")

    @property
    def num_changes(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 2 * self.scene.model.nv + self.scene.model.na

    @property
    def num_positions(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.scene.model.nv

    @property
    def num_controls(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.scene.model.nu

    @property
    def control_limits(self) -> tuple[ControlVector, ControlVector]:
        """The actuators' `ctrlrange`, infinite where they have none."""
        model = self.scene.model
        is_limited, ranges = np.asarray(model.actuator_ctrllimited, bool), model.actuator_ctrlrange
        return jnp.where(is_limited, ranges[:, 0], -jnp.inf), jnp.where(is_limited, ranges[:, 1], jnp.inf)

    def flatten(self, state: State) -> StateVector:
        """Return a rollout's state as a vector; time and warm start are left out."""
        return jnp.concatenate([state.qpos, state.qvel, state.act])

    def positions(self, state: Float[Array, "*batch state"]) -> Float[Array, "*batch nq"]:
        """Return the qpos of states."""
        return state[..., : self.scene.model.nq]

    def step(self, state: StateVector, control: ControlVector) -> StateVector:
        nq, nv = self.scene.model.nq, self.scene.model.nv
        data = self.scene.data.replace(
            qpos=state[:nq],
            qvel=state[nq : nq + nv],
            act=state[nq + nv :],
            qacc_warmstart=jnp.zeros_like(state[nq : nq + nv]),
            ctrl=control,
        )

        def advance(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            # Only what the next step needs is carried: the rest of Data would be copied in every turn.
            moved = step(self.scene.model, data, gradient=self.gradient, smoothing=self.smoothing)
            names = ("qpos", "qvel", "act", "qacc_warmstart")
            return data.replace(**{name: getattr(moved, name) for name in names}), None

        data, _ = jax.lax.scan(advance, data, None, length=self.num_substeps)
        return jnp.concatenate([data.qpos, data.qvel, data.act])

    def retract(self, state: StateVector, change: ChangeVector) -> StateVector:
        nq, nv = self.scene.model.nq, self.scene.model.nv
        qpos = integrate_position(self.scene.model, state[:nq], change[:nv], 1.0)
        return jnp.concatenate([qpos, state[nq:] + change[nv:]])

    def difference(self, end: StateVector, start: StateVector) -> ChangeVector:
        nq = self.scene.model.nq
        moved = position_change(self.scene.model, start[:nq], end[:nq])
        return jnp.concatenate([moved, end[nq:] - start[nq:]])

    def with_smoothing(self, smoothing: Smoothing | None) -> "SceneSystem":
        """Give the system with another smoothing; None takes it away."""
        return eqx.tree_at(lambda system: system.smoothing, self, smoothing, is_leaf=lambda x: x is None)
