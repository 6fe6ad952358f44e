"""Systems and costs for planning: a map from a state and a control to the next state, and the cost of a plan.

A state is one flat vector. A change of it has the coordinates of the tangent space: `retract` and `difference` convert.
"""

import copy
import dataclasses
import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from mjxgrad._arrays import Legible, function, known, real, traceable, whole
from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled
from mjxgrad.bodies.kinematics import integrate_position, kinematics, position_change
from mjxgrad.engines import Engine, engine_of
from mjxgrad.engines.state import check_scene
from mjxgrad.objective.base import as_scalar
from mjxgrad.objective.task import as_pytree
from mjxgrad.rollouts import State
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, Discrete, check_contact

StateVector = Float[Array, " state"]
ControlVector = Float[Array, " m"]
ChangeVector = Float[Array, " n"]
_REACH = 4.0  # lengths
_ALONE = 1e6  # of a geom's weight beside another's, so that its impedance is that of the contact
_HAIR = 1e-3  # m: what is drawn on a table touches it to rounding, or not quite
_Jacobian = Float[Array, "n both"]


class System(eqx.Module):
    """A discrete map with a control.

    Attributes:
        num_changes: dimension n of the tangent space.
        num_controls: dimension m of the control.
    """

    num_changes: eqx.AbstractVar[int]
    num_controls: eqx.AbstractVar[int]

    @property
    def origin(self) -> StateVector:
        """A state: zeros, or the reference pose of a scene at rest."""
        return jnp.zeros(self.num_changes)

    @abstractmethod
    def step(self, state: StateVector, control: ControlVector) -> StateVector:
        """Return the next state."""

    def retract(self, state: StateVector, change: ChangeVector) -> StateVector:
        """Return the state moved by a change."""
        return state + change

    def difference(self, end: StateVector, start: StateVector) -> ChangeVector:
        """Return the change that moves `start` to `end`; the inverse of `retract`."""
        return end - start

    @property
    def steers(self) -> bool:
        """Whether it has `steer`, which takes a whole trajectory under a feedback law in one call."""
        return False

    def linearised(self, state: StateVector, control: ControlVector) -> tuple[StateVector, _Jacobian]:
        """Return the next state, and the derivative of its change by state and control."""
        n = self.num_changes

        def moved(change: Float[Array, " both"]) -> tuple[StateVector, StateVector]:
            end = self.step(self.retract(state, change[:n]), control + change[n:])
            return end, end

        jacobian, end = jax.jacfwd(moved, has_aux=True)(jnp.zeros(n + self.num_controls, state.dtype))
        return end, jax.jacfwd(self.difference)(end, end) @ jacobian

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the coordinates of a change, of which several may be alike."""
        return tuple(f"coordinate {k}" for k in range(self.num_changes))

    def __hash__(self) -> int:
        # `jax.jit(system.step)` needs a hash, and arrays have none.
        return id(self)

    @property
    def control_limits(self) -> tuple[ControlVector, ControlVector]:
        """The least and the largest control; infinite where there is no limit."""
        unlimited = jnp.full(self.num_controls, jnp.inf)
        return -unlimited, unlimited

    def with_contact(self, contact: Contact) -> "System":
        """Return the system with its contacts stepped otherwise, such as smoothed.

        Raises:
            ValueError: if the system has no contacts.
        """
        raise ValueError(
            f"analytic smoothing must be of a SceneSystem, got {type(self).__name__}: take a Smoother of your own"
        )


class FunctionSystem(System):
    """A function from state and control to the next state as a system."""

    function: Callable[[ChangeVector, ControlVector], ChangeVector] = eqx.field(converter=as_pytree)
    num_changes: int = eqx.field(static=True)
    num_controls: int = eqx.field(static=True)

    def __check_init__(self):
        function("function", self.function, "state", "control", is_needed=True)
        whole("num_changes", self.num_changes)
        whole("num_controls", self.num_controls, 0)

    def step(self, state: ChangeVector, control: ControlVector) -> ChangeVector:
        with traceable("function"):
            after = real("the next state by function", self.function(state, control))
        if after.shape != state.shape:
            raise ValueError(f"function must return the next state, of shape {state.shape}, got {after.shape}")
        return after.astype(jnp.result_type(after, float))


class SceneSystem(System):
    """A scene under a control that is held for one or several time steps.

    The state is (qpos, qvel, act). Its tangent space has the coordinates of velocities in place of positions, so a
    quaternion counts three. Time is not part of the state.

    Attributes:
        scene: the scene, from `load_scene`.
        num_substeps: time steps per step of the system.
        contact: how contact is stepped, see `mjxgrad.step`.
    """

    scene: Scene
    num_substeps: int = eqx.field(static=True, default=1)
    contact: Contact = Discrete()

    def __check_init__(self):
        check_scene(self.scene)
        whole("num_substeps", self.num_substeps)
        if not isinstance(self.contact, Contact):  # lengths with a leading axis may be for jax.vmap
            check_contact(self.contact)

    @property
    def num_changes(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 2 * self.scene.model.nv + self.scene.model.na

    @property
    def origin(self) -> StateVector:
        return self.flatten(self.scene.data)

    @property
    def num_controls(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.scene.model.nu

    @property
    def control_limits(self) -> tuple[ControlVector, ControlVector]:
        """The actuators' `ctrlrange`, infinite where they have none."""
        low, high = self.scene.ctrlrange.T
        return low, high

    def flatten(self, state: State | mjx.Data) -> StateVector:
        """Return a rollout's state as a vector, without time and warm start."""
        return jnp.concatenate([state.qpos, state.qvel, state.act])

    @property
    def engine(self) -> Engine:
        """Who steps the scene, see `mjxgrad.engines`."""
        return engine_of(self.scene, self.contact)

    @property
    def steers(self) -> bool:
        return self.engine.steers

    def steer(self, **law: Array) -> tuple[Float[Array, "states state"], Float[Array, "horizon m"]]:
        """Return states and controls under a feedback law, by an engine that steers."""
        return self.engine.steer(self.scene, self._unflattened(law["states"][0]), self.num_substeps, **law)  # pyright: ignore

    def linearised(self, state: StateVector, control: ControlVector) -> tuple[StateVector, _Jacobian]:
        if not self.steers:
            return super().linearised(state, control)
        given = self.scene, self._unflattened(state), control, self.num_substeps, self.contact
        return self.engine.product(*given)  # pyright: ignore

    def _unflattened(self, state: StateVector) -> State:
        nq, nv = self.scene.model.nq, self.scene.model.nv
        qvel = state[nq : nq + nv]
        return State(state[:nq], qvel, state[nq + nv :], self.scene.data.time, jnp.zeros_like(qvel))

    @property
    def names(self) -> tuple[str, ...]:
        model = self.scene.mj_model
        joints = [(model.joint(k).name, model.body(model.jnt_bodyid[k]).name) for k in range(model.njnt)]
        own = [name or f"joint of {body}" for name, body in joints]
        moved = [own[joint] for joint in model.dof_jntid]
        return *moved, *(f"speed of {name}" for name in moved), *(f"activation {k}" for k in range(model.na))

    def placed(self, state: StateVector) -> mjx.Data:
        """Return data that has the places of bodies, geoms and sites in a state, such as `site_xpos`, for costs."""
        return kinematics(self.scene.model, self.scene.data.replace(qpos=state[: self.scene.model.nq]))

    @compiled
    def step(self, state: StateVector, control: ControlVector) -> StateVector:
        given = self.scene, self._unflattened(state), control, self.num_substeps, self.contact
        return self.flatten(self.engine.hold(*given))

    def retract(self, state: StateVector, change: ChangeVector) -> StateVector:
        nq, nv = self.scene.model.nq, self.scene.model.nv
        qpos = integrate_position(self.scene.model, state[:nq], change[:nv], 1.0)
        return jnp.concatenate([qpos, state[nq:] + change[nv:]])

    def difference(self, end: StateVector, start: StateVector) -> ChangeVector:
        nq = self.scene.model.nq
        moved = position_change(self.scene.model, start[:nq], end[:nq])
        return jnp.concatenate([moved, end[nq:] - start[nq:]])

    def widened(self, length: ArrayLike) -> "SceneSystem":
        """Return the system with contacts that act from a distance, by C MuJoCo's margins.

        The force rises from nothing at four lengths (m), where that of normal noise has all but vanished. MuJoCo adds
        margins, so each geom has half of that; a contact of `<pair>` has all of it.

        Geoms that touch fixed ones in the reference pose would hover. Where there are any, they and all fixed geoms are as they
        were, and the others have all four lengths. Two of these others then begin at eight lengths, unless they have a `<pair>`:
        no margins of geoms suit all pairs there.
        """
        model, given = self.scene.mj_model, self.scene.model
        touching = resting(model, model.qpos0)
        is_wide = model.body_weldid[model.geom_bodyid] != 0
        is_wide[touching] = False
        share = is_wide.astype(float) if len(touching) else np.full(model.ngeom, 0.5)
        held = {frozenset(pair) for pair in touching.tolist()}
        explicit = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        is_wide_pair = np.array([frozenset(pair) not in held for pair in explicit], bool)
        reach = _REACH * jnp.asarray(length)

        def wide(solimp: Float[Array, "rows 5"], chosen: np.ndarray) -> Float[Array, "rows 5"]:
            softened = solimp.at[:, 2].set(reach).at[:, jnp.array([0, 3, 4])].set(jnp.array([1e-4, 0.9, 3.0]))
            return jnp.where(chosen[:, None], softened, solimp)

        return dataclasses.replace(
            self,
            scene=self.scene.with_model(
                geom_margin=given.geom_margin + share * reach,
                geom_solimp=wide(given.geom_solimp, is_wide),
                geom_solmix=jnp.where(is_wide, _ALONE * given.geom_solmix, given.geom_solmix),
                pair_margin=given.pair_margin + is_wide_pair * reach,
                pair_solimp=wide(given.pair_solimp, is_wide_pair),
            ),
        )

    def with_contact(self, contact: Contact) -> "SceneSystem":
        check_contact(contact)
        return dataclasses.replace(self, contact=contact)


def resting(model: mujoco.MjModel, qpos: Float[ArrayLike, " nq"]) -> Int[np.ndarray, "contacts 2"]:
    """Return the pairs of geoms that touch in a pose, or nearly, of which one is fixed."""
    model = copy.copy(model)
    model.geom_margin += _HAIR / 2  # margins of two geoms add up, and a `<pair>` has one
    model.pair_margin += _HAIR
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    pairs = np.array(data.contact.geom, int).reshape(-1, 2)
    return pairs[(model.body_weldid[model.geom_bodyid] == 0)[pairs].any(axis=1)]


class Cost(Legible):
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
        one = lambda state, control: as_scalar(self.stage(system, state, control), "stage of a cost")  # noqa: E731
        stages, end = jax.vmap(one)(states[:-1], controls), self.terminal(system, states[-1])
        return stages.sum() + as_scalar(end, "terminal of a cost")


class LeastSquares(Cost):
    """Half the sum of squared residuals. Its linear-quadratic models need first derivatives alone, and are soon compiled."""

    @abstractmethod
    def residuals(self, system: System, state: StateVector, control: ControlVector) -> Float[Array, " residuals"]:
        """Return the residuals of one step."""

    @abstractmethod
    def terminal_residuals(self, system: System, state: StateVector) -> Float[Array, " residuals"]:
        """Return the residuals of the last state."""

    def stage(self, system: System, state: StateVector, control: ControlVector) -> Float[Array, ""]:
        return 0.5 * jnp.sum(_residuals(self, "residuals", system, state, control) ** 2)

    def terminal(self, system: System, state: StateVector) -> Float[Array, ""]:
        return 0.5 * jnp.sum(_residuals(self, "terminal_residuals", system, state) ** 2)


def _residuals(cost: Cost, method: str, *given: Any) -> Float[Array, " residuals"]:
    """Return what a method of the subclass gave as floats."""
    name = f"{method} of {type(cost).__name__}"
    vector = real(name, getattr(cost, method)(*given))
    if vector.ndim != 1:
        raise ValueError(f"{name} must return a vector, got shape {vector.shape}")
    return vector.astype(jnp.result_type(vector, float))


class GoalCost(LeastSquares):
    """Weighted squared distances to a goal and squared controls, each with a factor of one half.

    Attributes:
        goal: state to be reached.
        stage_weight: weight of the distance in each step, per coordinate of a change.
        terminal_weight: weight of the distance at the end, per coordinate of a change.
        control_weight: weight of each control.
    """

    goal: StateVector = eqx.field(converter=functools.partial(real, "goal"))
    stage_weight: Float[Array, "..."] = eqx.field(converter=functools.partial(real, "stage_weight"))
    terminal_weight: Float[Array, "..."] = eqx.field(converter=functools.partial(real, "terminal_weight"))
    control_weight: Float[Array, "..."] = eqx.field(converter=functools.partial(real, "control_weight"))

    def __check_init__(self):
        # By NumPy: operations of JAX are traced inside jit even on known values.
        if (goal := known(self.goal)) is not None and not np.isfinite(goal).all():
            raise ValueError(f"goal must be finite, got {goal}")
        for name in ("stage_weight", "terminal_weight", "control_weight"):
            weight = known(getattr(self, name))
            if weight is not None and not ((weight >= 0) & (weight < np.inf)).all():
                raise ValueError(f"{name} must be at least 0 and finite, got {weight}")

    def residuals(self, system: System, state: StateVector, control: ControlVector) -> Float[Array, " residuals"]:
        away = self._weighted("stage_weight", self._away(system, state))
        return jnp.concatenate([away, self._weighted("control_weight", control)])

    def terminal_residuals(self, system: System, state: StateVector) -> Float[Array, " residuals"]:
        return self._weighted("terminal_weight", self._away(system, state))

    def _away(self, system: System, state: StateVector) -> Float[Array, " changes"]:
        if self.goal.shape != state.shape:
            raise ValueError(f"goal must be a state of this system, of shape {state.shape}, got {self.goal.shape}")
        return system.difference(state, self.goal)

    def _weighted(self, name: str, change: Float[Array, " size"]) -> Float[Array, " size"]:
        weight = getattr(self, name)
        if weight.shape not in ((), change.shape):
            raise ValueError(f"{name} must be one number or have shape {change.shape}, got {weight.shape}")
        return jnp.sqrt(weight) * change


class Quadratic(eqx.Module):
    """A convex quadratic model in changes of state, then control; the terminal model has no control."""

    gradient: Float[Array, " both"]
    hessian: Float[Array, "both both"]


def stage_model(cost: Cost, system: System, state: StateVector, control: ControlVector) -> Quadratic:
    """Return the expansion of the cost of a step around a state and a control."""
    is_squares, n = isinstance(cost, LeastSquares), system.num_changes
    function = functools.partial(_residuals, cost, "residuals") if is_squares else cost.stage
    moved = lambda change: function(system, system.retract(state, change[:n]), control + change[n:])  # noqa: E731
    return _model(cost, moved, jnp.zeros(n + control.size, state.dtype))


def terminal_model(cost: Cost, system: System, state: StateVector) -> Quadratic:
    """Return the expansion of the terminal cost around the last state."""
    is_squares, n = isinstance(cost, LeastSquares), system.num_changes
    function = functools.partial(_residuals, cost, "terminal_residuals") if is_squares else cost.terminal
    return _model(cost, lambda change: function(system, system.retract(state, change)), jnp.zeros(n, state.dtype))


def _model(cost: Cost, function: Callable[[Array], Array], at: Float[Array, " both"]) -> Quadratic:
    """Return the expansion of a number or, by Gauss and Newton, of residuals.

    Negative curvature is removed, which would turn descent into ascent.
    """
    if isinstance(cost, LeastSquares):
        value, jacobian = function(at), jax.jacfwd(function)(at)
        return Quadratic(jacobian.T @ value, jacobian.T @ jacobian)
    number = lambda change: as_scalar(function(change), "stage or terminal of a cost")  # noqa: E731
    hessian = jax.hessian(number)(at)
    values, vectors = jnp.linalg.eigh(0.5 * (hessian + hessian.T))
    return Quadratic(jax.grad(number)(at), (vectors * jnp.maximum(values, 0)) @ vectors.T)
