"""What an objective needs of a thing to be controlled: how long, how many controls, where it starts, a cost."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import form
from mjxgrad.contact import Softness
from mjxgrad.rollouts import Engine, Observe, Policy, Sees, State, Trajectory, rollout
from mjxgrad.scene import Scene
from mjxgrad.stepping import Gradient, Onset, Smoothing, check_gradient


class Outcome(eqx.Module):
    """What came of one rollout; under `jax.vmap` every field gains leading axes.

    Attributes:
        cost: of the whole rollout, NaN if it diverged.
        states: in which the controls were chosen, with a leading axis of `horizon`: what a policy was called with.
        step_costs: what was charged at steps 0 to `horizon`, with the sum `cost`. Entry t depends only on states and
            controls up to t, so a control at t answers for the entries from t on and for no others. None where only
            the total is known.
    """

    cost: Float[Array, ""]
    states: PyTree
    step_costs: Float[Array, " steps"] | None = None


class Task(eqx.Module):
    """Anything that turns controls into a cost; its dynamics need not be MuJoCo's.

    A subclass gives `horizon`, `num_controls` and `run`. One whose rollouts may start in different states gives
    `nominal_start` too, and one whose start is random `sample_start`.
    """

    horizon: eqx.AbstractVar[int]
    num_controls: eqx.AbstractVar[int]

    @abstractmethod
    def run(
        self,
        controls: Float[Array, "horizon nu"] | Policy,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
        start: PyTree = None,
    ) -> Outcome:
        """Roll out once.

        Args:
            controls: what to apply at each step, or a policy from parameters and a state to
                what to apply.
            params: the policy's parameters.
            noise: added to the controls.
            start: where to begin; None is the nominal start.

        Returns:
            The cost, and the states that the controls were chosen in.
        """

    def nominal_start(self) -> PyTree:
        """Return where a rollout begins if nothing else is said; None if that has no name outside the task."""
        return None

    def sample_start(self, key: PRNGKeyArray) -> PyTree:
        """Draw where a rollout begins, shaped as `nominal_start`; None if it always begins at the same place."""
        return None


def as_pytree(function: Callable) -> Callable:
    """Wrap a plain function so that what holds it is a pytree of arrays, fit for jit and vmap."""
    if isinstance(function, eqx.Module | jax.tree_util.Partial):
        return function  # pyright: ignore[reportReturnType]
    return jax.tree_util.Partial(function)


def optional_pytree(function: Callable | None) -> Callable | None:
    """Wrap a function as `as_pytree` does, if there is one."""
    return None if function is None else as_pytree(function)


# Not typing.Self, which beartype refuses in methods that are checked one by one.
Same = TypeVar("Same", bound="InScene")


class InScene(eqx.Module):
    """What moves in a scene, whose contacts may be stepped in several ways.

    Attributes:
        scene: from `load_scene`.
        gradient: of each step, "slope" or "discrete", see `rollout`. The slope is that of the outcome, hit or miss apart.
        onset: None for MuJoCo's own motion, or how contacts begin within the step: a continuous motion of its own. A leaf.
        smoothing: of the contacts in each step, see `step`; a leaf, so that a sweep over its length is one `jax.vmap`.
        engine: "mjx" or "mujoco", see `rollout`; None is the scene's own.
    """

    scene: Scene
    gradient: Gradient = eqx.field(static=True, default="slope", kw_only=True)
    onset: Onset | None = eqx.field(default=None, kw_only=True)
    smoothing: Smoothing | None = eqx.field(default=None, kw_only=True)
    engine: Engine | None = eqx.field(static=True, default=None, kw_only=True)

    def with_gradient(self: Same, gradient: Gradient) -> Same:
        """Return the same with MuJoCo's own motion and one of its derivatives."""
        check_gradient(gradient)
        return dataclasses.replace(self, gradient=gradient, onset=None)

    def with_onset(self: Same, onset: Onset | None) -> Same:
        """Return the same with contacts that begin within the step; None is MuJoCo's motion and the slope."""
        return dataclasses.replace(self, gradient="slope" if onset is None else "discrete", onset=onset)

    def with_engine(self: Same, engine: Engine) -> Same:
        """Return the same in MuJoCo's own motion, by MJX or by C MuJoCo."""
        return dataclasses.replace(self, onset=None, engine=engine)

    def with_smoothing(self: Same, smoothing: Smoothing | None) -> Same:
        """Return the same with contact averaged over noise."""
        return dataclasses.replace(self, smoothing=smoothing)

    def with_softness(self: Same, softness: Softness) -> Same:
        """Return the same with other contact softness."""
        return dataclasses.replace(self, scene=self.scene.with_softness(softness))


class SceneTask(Task, InScene):
    """A scene, where it starts, how long it runs, and what the trajectory costs.

    Attributes:
        state: the nominal start.
        cost: from a trajectory to a number, or to one number per state of it (`horizon + 1`), the one at t from states
            and controls up to t, whose sum is the cost; traceable. It may read `trajectory.observations`.
        horizon: number of steps.
        start_distribution: from a key to the state where a rollout begins; None if it is always `state`.
        observe: from model and data to anything made of arrays, for the cost and the policy; see `rollout`.
        policy_sees: "state", or "observations": what a policy is called with; see `rollout`.
    """

    state: State
    cost: Callable[[Trajectory], Float[Array, "..."]] = eqx.field(converter=as_pytree)
    horizon: int = eqx.field(static=True)
    start_distribution: Callable[[PRNGKeyArray], State] | None = eqx.field(converter=optional_pytree, default=None)
    observe: Observe | None = eqx.field(converter=optional_pytree, default=None, kw_only=True)
    policy_sees: Sees = eqx.field(static=True, default="state", kw_only=True)

    @property
    def num_controls(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.scene.model.nu

    def nominal_start(self) -> State:
        return self.state

    def sample_start(self, key: PRNGKeyArray) -> State | None:
        """Draw from `start_distribution`, if there is one."""
        return None if self.start_distribution is None else self.start_distribution(key)

    def run(
        self,
        controls: Float[Array, "horizon nu"] | Policy,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
        start: State | None = None,
    ) -> Outcome:
        """Roll out once; see `Task.run`. The states have no warm start: a policy must not depend on it.

        Raises:
            ValueError: if the cost is neither a number nor one number per state.
        """
        start = self.state if start is None else start
        trajectory = rollout(
            self.scene,
            start,
            controls,
            params,
            noise,
            horizon=self.horizon,
            observe=self.observe,
            policy_sees=self.policy_sees,
            gradient=self.gradient,
            onset=self.onset,
            smoothing=self.smoothing,
            engine=self.engine,
        )
        states = trajectory.seen
        if states is None:
            qpos, qvel, act = (x[:-1] for x in (trajectory.qpos, trajectory.qvel, jnp.asarray(trajectory.act)))
            time = start.time + self.scene.model.opt.timestep * jnp.arange(self.horizon)
            states = jax.vmap(State)(qpos, qvel, act, time, jnp.zeros_like(qvel))
        cost = self.cost(trajectory)
        if not eqx.is_array_like(cost) or jnp.shape(cost) not in ((), (self.horizon + 1,)):
            raise ValueError(
                "the task's cost must return a scalar of shape () or one number per state, "
                f"shape ({self.horizon + 1},), got {form(cost)}"
            )
        charged = finite_cost(jnp.asarray(cost), trajectory)
        return Outcome(charged.sum(), states, charged if charged.ndim else None)


def finite_cost(cost: Float[Array, "*steps"], trajectory: Trajectory) -> Float[Array, "*steps"]:
    """Return the cost, or NaN if the rollout diverged, by which estimators know to leave it out."""
    return jnp.where(trajectory.diverged, jnp.nan, cost)
