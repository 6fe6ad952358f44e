"""Tasks: horizon, number of controls, start and cost of a controlled system, the input of an objective."""

import dataclasses
import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import form, function, instance, one_of, traceable, whole
from mjxgrad.contact import Softness
from mjxgrad.engines.state import check_scene
from mjxgrad.rollouts import Observe, PolicyFunction, Sees, State, Trajectory, rollout
from mjxgrad.rollouts.rollout import started
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, EngineName, Slope, check_contact


class Outcome(eqx.Module):
    """The result of one rollout; under `jax.vmap` every field gains leading axes.

    Attributes:
        cost: cost of the whole rollout, NaN if it diverged.
        states: states in which the controls were chosen, the inputs of a policy; the leading axis is `horizon`.
        step_costs: costs charged at steps 0 to `horizon`, with the sum `cost`. Entry t depends only on states and
            controls up to t, so a control at t affects only the entries from t on. None where only the total is known.
    """

    cost: Float[Array, ""]
    states: PyTree
    step_costs: Float[Array, " steps"] | None = None


class Task(eqx.Module):
    """A map from controls to a cost; its dynamics need not be MuJoCo's.

    A subclass gives `horizon`, `num_controls` and `run`; with random starts also `nominal_start` and `sample_start`.
    """

    horizon: eqx.AbstractVar[int]
    num_controls: eqx.AbstractVar[int]

    @abstractmethod
    def run(
        self,
        controls: Float[Array, "horizon nu"] | PolicyFunction,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
        start: PyTree = None,
    ) -> Outcome:
        """Roll out once, by default from the nominal start; return the cost, and the states in which the controls were chosen.

        The controls are those of each step, or a policy from parameters and a state to controls. The noise is added to them.
        """

    def nominal_start(self) -> PyTree:
        """Return the default start of a rollout; None if it is not defined outside the task."""
        return None

    def sample_start(self, key: PRNGKeyArray) -> PyTree:
        """Draw the start of a rollout, with the shapes of `nominal_start`; None if the start is fixed."""
        return None


def as_pytree(function: Any) -> Any:
    """Return a function as a pytree, so that a module that holds it can pass through jit and vmap; others unchanged."""
    is_one = not callable(function) or isinstance(function, eqx.Module | jax.tree_util.Partial)
    return function if is_one else jax.tree_util.Partial(function)


# Not typing.Self, which beartype refuses in methods that are checked one by one.
Same = TypeVar("Same", bound="InScene")


class InScene(eqx.Module):
    """A scene with a choice of how its contacts are stepped.

    Attributes:
        scene: the scene, from `load_scene`.
        contact: how contact is stepped, see `rollout`; by default with the derivative that descents need, the slope.
    """

    scene: Scene
    contact: Contact = eqx.field(default=Slope(), kw_only=True)

    def __check_init__(self):
        check_scene(self.scene)
        if not isinstance(self.contact, Contact):  # lengths with a leading axis may be for jax.vmap
            check_contact(self.contact)

    def with_contact(self: Same, contact: Contact) -> Same:
        """Return a copy whose contacts are stepped otherwise."""
        check_contact(contact)
        return dataclasses.replace(self, contact=contact)

    def with_engine(self: Same, engine: EngineName) -> Same:
        """Return a copy that this engine steps, see `Scene.with_engine`."""
        return dataclasses.replace(self, scene=self.scene.with_engine(engine))

    def with_softness(self: Same, softness: Softness | None) -> Same:
        """Return a copy with other contact softness; None leaves it unchanged."""
        return self if softness is None else dataclasses.replace(self, scene=self.scene.with_softness(softness))


class SceneTask(Task, InScene):
    """A scene with a start, a horizon, and a cost of the trajectory.

    Attributes:
        state: the nominal start.
        cost: function from a trajectory to a number, or to one number per state (`horizon + 1`) whose sum is the cost;
            traceable. The number at t must depend on states and controls up to t. It may read `trajectory.observations`.
        horizon: number of steps.
        start_distribution: function from a key to the start of a rollout; None if it is always `state`.
        observe: function from model and data to a pytree of arrays, for the cost and the policy; see `rollout`.
        policy_sees: the input of a policy, "state" or "observations"; see `rollout`.
    """

    state: State = eqx.field(repr=False)
    cost: Callable[[Trajectory], Float[Array, "..."]] = eqx.field(converter=as_pytree)
    horizon: int = eqx.field(static=True, converter=functools.partial(whole, "horizon"))
    start_distribution: Callable[[PRNGKeyArray], State] | None = eqx.field(converter=as_pytree, default=None)
    observe: Observe | None = eqx.field(converter=as_pytree, default=None, kw_only=True)
    policy_sees: Sees = eqx.field(static=True, default="state", kw_only=True)

    def __check_init__(self):
        started(self.scene, self.state)  # refuses what is none
        one_of("policy_sees", self.policy_sees, get_args(Sees))
        function("cost", self.cost, "trajectory", is_needed=True)
        function("start_distribution", self.start_distribution, "key")
        function("observe", self.observe, "model", "data")

    @property
    def num_controls(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.scene.model.nu

    def nominal_start(self) -> State:
        return self.state

    def sample_start(self, key: PRNGKeyArray) -> State | None:
        """Return a draw from `start_distribution`, or None without one."""
        if self.start_distribution is None:
            return None
        instance("what start_distribution returns", drawn := self.start_distribution(key), State, "of mg.initial_state")
        return drawn

    def run(
        self,
        controls: Float[Array, "horizon nu"] | PolicyFunction,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
        start: State | None = None,
    ) -> Outcome:
        """Roll out once; see `Task.run`. The states have no warm start: a policy must not depend on it.

        Raises:
            ValueError: if the cost is neither a number nor one number per state.
        """
        start = self.state if start is None else start
        how: Any = {name: getattr(self, name) for name in ("horizon", "observe", "policy_sees", "contact")}
        trajectory = rollout(self.scene, start, controls, params, noise, **how)
        states = trajectory.seen
        if states is None:
            qpos, qvel, act = (x[:-1] for x in (trajectory.qpos, trajectory.qvel, jnp.asarray(trajectory.act)))
            time = start.time + self.scene.model.opt.timestep * jnp.arange(self.horizon)
            states = jax.vmap(State)(qpos, qvel, act, time, jnp.zeros_like(qvel))
        with traceable("the task's cost"):
            cost = self.cost(trajectory)
        charged = finite_cost(checked_cost(cost, self.horizon), trajectory)
        return Outcome(charged.sum(), states, charged if charged.ndim else None)


def checked_cost(cost: Any, horizon: int) -> Float[Array, "*steps"]:
    """Return a cost; refuse all but a number and one number per state."""
    if not eqx.is_array_like(cost) or jnp.shape(cost) not in ((), (horizon + 1,)):
        wanted = f"a scalar of shape () or one number per state, shape ({horizon + 1},)"
        raise ValueError(f"the task's cost must return {wanted}, got {form(cost)}")
    if jnp.iscomplexobj(cost):
        raise ValueError(f"the task's cost must return real numbers, got {jnp.result_type(cost)}")
    return jnp.asarray(cost, jnp.result_type(cost, float))


def finite_cost(cost: Float[Array, "*steps"], trajectory: Trajectory) -> Float[Array, "*steps"]:
    """Return the cost, or NaN if the rollout diverged, so that estimators leave it out."""
    return jnp.where(trajectory.diverged, jnp.nan, cost)
