"""The cost of a task with noise on its controls, in open loop and in closed loop; and the linear policy."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import function, instance, whole
from mjxgrad.objective.base import (
    Differentiated,
    Objective,
    Scalar,
    Stddev,
    Vector,
    as_scalar,
    flattened,
    gaussian,
    positive,
    unchanged,
    value_and_gradient,
)
from mjxgrad.objective.task import Outcome, PolicyFunction, Task, as_pytree
from mjxgrad.rollouts import State


class ActionNoise(Objective):
    """The common part of open loop and closed loop.

    The noise of a rollout is that of its actions, or the pair of it and a start where the task has a distribution of
    starts. The start does not depend on the parameters, so it adds nothing to the score.
    """

    task: eqx.AbstractVar[Task]
    stddev: eqx.AbstractVar[Float[Array, "..."]]

    @abstractmethod
    def controls(self, params: Vector) -> tuple[Any, PyTree]:
        """Return the first arguments of the task's `run`: controls or policy, and the policy's parameters."""

    @abstractmethod
    def pull_back_at(self, params: Vector, states: PyTree) -> Partial:
        """Return the pull-back from components by action noise, flattened, to the parameters; see `Differentiated`."""

    @property
    def noise_shape(self) -> tuple[int, int]:
        return (self.task.horizon, self.task.num_controls)

    def sample_noise(self, key: PRNGKeyArray) -> PyTree:
        """Draw noise for every action, and a start where the task has a distribution of starts."""
        if self._start_shape() is None:
            return gaussian(key, self.stddev, self.noise_shape)
        start_key, action_key = jax.random.split(key)
        return gaussian(action_key, self.stddev, self.noise_shape), self.task.sample_start(start_key)

    def mirror(self, noise: PyTree) -> PyTree:
        return self._with_actions(noise, jnp.negative)

    def redraw(self, noise: PyTree, key: PRNGKeyArray) -> PyTree:
        return self._with_actions(noise, lambda _: gaussian(key, self.stddev, self.noise_shape))

    def silence(self, noise: PyTree) -> PyTree:
        return self._with_actions(noise, jnp.zeros_like)

    def _with_actions(self, noise: PyTree, change: Callable[[Array], Array]) -> PyTree:
        # The start stays: both rollouts of a pair begin at the same place.
        actions, start = self.split(noise)
        return change(actions) if start is None else (change(actions), start)

    @property
    def has_circumstances(self) -> bool:
        return self._start_shape() is not None

    def zero_noise(self) -> PyTree:
        """Return zero action noise, with the nominal start, which must have the structure of the random ones."""
        actions, drawn = jnp.zeros(self.noise_shape, self.stddev.dtype), self._start_shape()
        if drawn is None:
            return actions
        nominal = self.task.nominal_start()
        if jax.tree.structure(nominal) != jax.tree.structure(drawn):
            raise ValueError(
                f"nominal_start must have the structure of sample_start, {jax.tree.structure(drawn)}, "
                f"got {jax.tree.structure(nominal)}"
            )
        return actions, jax.tree.map(lambda leaf, like: jnp.asarray(leaf, like.dtype), nominal, drawn)

    def split(self, noise: PyTree) -> tuple[Float[Array, "horizon nu"], PyTree]:
        """Return the action noise and the start, None where the start is not random."""
        return noise if isinstance(noise, tuple) else (noise, None)

    def outcome(self, params: Vector, noise: PyTree) -> Outcome:
        """Roll out once; return the cost, the states, and the costs by step where the task gives them."""
        actions, start = self.split(noise)
        outcome = self.task.run(*self.controls(params), actions.astype(params.dtype), start)
        return dataclasses.replace(outcome, cost=as_scalar(outcome.cost, "the task's cost"))

    def value(self, params: Vector, noise: PyTree) -> Scalar:
        return self.outcome(params, noise).cost

    def with_stddev(self, stddev: Stddev) -> "ActionNoise":
        return dataclasses.replace(self, stddev=_action_stddev(self.task, stddev))

    def _start_shape(self) -> PyTree:
        return jax.eval_shape(self.task.sample_start, jax.random.key(0))

    def _noise_score(self, params: Vector, noise: PyTree) -> Float[Array, " m"]:
        actions, _ = self.split(noise)
        return jnp.ravel(actions / self.stddev**2).astype(params.dtype)

    def differentiate(self, params: Vector, noise: PyTree) -> Differentiated:
        """Differentiate by the action noise through the whole loop, in one reverse pass.

        The parameters affect the cost only through the actions, so the pull-back of this derivative is their gradient.
        """
        actions, start = self.split(noise)

        def cost_and_states(flat: Float[Array, " m"]) -> tuple[Scalar, PyTree]:
            shaped = flat.reshape(self.noise_shape)
            outcome = self.outcome(params, shaped if start is None else (shaped, start))
            return outcome.cost, outcome.states

        flat = jnp.ravel(actions).astype(params.dtype)
        (cost, states), gradient = value_and_gradient(cost_and_states, flat, has_aux=True)
        stddev = jnp.ravel(jnp.broadcast_to(self.stddev, self.noise_shape)).astype(params.dtype)
        score, pull_back = self._noise_score(params, noise), self.pull_back_at(params, states)
        return Differentiated(cost, gradient, score, stddev, pull_back)


class OpenLoop(ActionNoise):
    """The cost of a task under controls with noise; see `open_loop`."""

    task: Task
    stddev: Float[Array, "..."]
    dim: int | None = eqx.field(static=True)

    def ravel(self, controls: Float[Array, "horizon nu"]) -> Vector:
        """Return controls as a vector of parameters."""
        return jnp.ravel(controls)

    def unravel(self, params: Vector) -> Float[Array, "horizon nu"]:
        """Return parameters in the shape of controls."""
        return params.reshape(self.noise_shape)

    def controls(self, params: Vector) -> tuple[Any, PyTree]:
        return self.unravel(params), None

    def score(self, params: Vector, noise: PyTree) -> Vector:
        return self.pull_back_at(params, None)(self._noise_score(params, noise))

    def pull_back_at(self, params: Vector, states: PyTree) -> Partial:
        return Partial(unchanged)  # the parameters are the controls


class ClosedLoop(ActionNoise):
    """The cost of a task under a policy with noise on its actions; see `closed_loop`."""

    task: Task
    policy: PolicyFunction
    stddev: Float[Array, "..."]
    unravel: Callable[[Vector], PyTree] = eqx.field(static=True)
    dim: int | None = eqx.field(static=True)

    def ravel(self, policy_params: PyTree) -> Vector:
        """Return the policy's parameters as a vector."""
        return _flat(policy_params)[0]

    def controls(self, params: Vector) -> tuple[Any, PyTree]:
        return self.policy, self.unravel(params)

    def score(self, params: Vector, noise: PyTree) -> Vector:
        """Return Σ_t (∂π(x_t)/∂θ)ᵀ w_t/σ²; it takes a rollout."""
        return self.value_and_score(params, noise)[1]

    def value_and_score(self, params: Vector, noise: PyTree) -> tuple[Scalar, Vector]:
        outcome = self.outcome(params, noise)
        return outcome.cost, self.pull_back_at(params, outcome.states)(self._noise_score(params, noise))

    def pull_back_at(self, params: Vector, states: PyTree) -> Partial:
        # Given the state, the action is Gaussian about the policy; given state and action, the distribution of the next
        # state does not depend on the parameters. The states are therefore data here.
        states = jax.lax.stop_gradient(states)
        # A vmapped function copies the content of the pull-back per sample, so it holds the policy, not the task.
        return Partial(_ActionsTranspose(self.unravel), self.policy, params, states)


def open_loop(task: Task, stddev: Stddev) -> OpenLoop:
    r"""Return the cost of a task as a function of its controls, with noise on each.

    The parameters are the horizon * nu controls, flattened by `objective.ravel`; the score is $w/\sigma^2$. Where the task has
    a distribution of starts, every rollout draws its own. The standard deviation $\sigma > 0$ is in units of the controls, of
    any shape that broadcasts to (horizon, nu).

    Raises:
        ValueError: if `stddev` is not positive or does not broadcast, or if the task has no controls.
    """
    stddev = _action_stddev(task, stddev)
    return OpenLoop(task=task, stddev=stddev, dim=task.horizon * task.num_controls)


def closed_loop(task: Task, policy: PolicyFunction, stddev: Stddev, *, params: PyTree = None) -> ClosedLoop:
    r"""Return the cost of a task as a function of a policy's parameters, with noise on its actions.

    The action is $u_t = \pi_\theta(x_t) + w_t$. The score of a rollout is
    $\sum_t (\partial\pi_\theta(x_t)/\partial\theta)^\top w_t/\sigma^2$, with the states taken as data.
    Value and score come from one rollout. Starts, `task`, `stddev` and errors are as for `open_loop`.

    Args:
        task: the controlled task with its cost.
        policy: function from its parameters and a state to controls of shape (nu,).
        stddev: standard deviation of the noise.
        params: an example of the policy's parameters, such as a dict or an equinox module. Only the shapes of its
            floating-point arrays count; all other leaves are kept. Without it the policy gets the flat vector itself.

    Returns:
        The objective; `objective.ravel` and `objective.unravel` convert the policy's parameters to the flat vector and back.

    References:
        Williams. Simple statistical gradient-following algorithms for connectionist
        reinforcement learning. Machine Learning 8, 1992, theorem 1.
    """
    instance("policy", policy, Callable, "a function of params and state")
    stddev = _action_stddev(task, stddev)
    flat, unravel = (None, unchanged) if params is None else _flat(params)
    dim, given = (None, _OfVector(as_pytree(policy))) if flat is None else (flat.size, as_pytree(policy))
    return ClosedLoop(task=task, policy=given, stddev=stddev, unravel=unravel, dim=dim)


class _OfVector(eqx.Module):
    """A policy that says what it was given where it cannot take a vector."""

    policy: PolicyFunction

    def __call__(self, params: Vector, state: PyTree) -> Float[Array, " nu"]:
        try:
            return self.policy(params, state)
        except (TypeError, AttributeError) as error:
            raise type(error)(
                f"{error}; without params= of closed_loop the policy gets a vector: give an example of its own"
            ) from error


def _flat(params: PyTree) -> tuple[Vector, Callable[[Vector], PyTree]]:
    if all(map(eqx.is_array_like, jax.tree.leaves(params))):
        return ravel_pytree(params)  # its `unravel` equals that of any pytree of the same structure
    return flattened(params)


@dataclasses.dataclass(frozen=True)
class _ActionsTranspose:
    """The transpose of the derivative of the mean actions at given states; equal settings are equal, which closures never are."""

    unravel: Callable[[Vector], PyTree]

    def __call__(
        self, policy: PolicyFunction, params: Vector, states: PyTree, by_actions: Float[Array, " m"]
    ) -> Vector:
        def actions(flat: Vector) -> Float[Array, " m"]:
            return jnp.ravel(jax.vmap(lambda state: policy(self.unravel(flat), state))(states))

        _, transpose = jax.vjp(actions, params)
        return transpose(by_actions)[0]


def _action_stddev(task: Task, stddev: Stddev) -> Float[Array, "..."]:
    instance("task", task, Task, "a task, such as mg.SceneTask")
    shape = (task.horizon, task.num_controls)
    if task.horizon * task.num_controls == 0:
        raise ValueError(
            f"action noise needs controls, got a task of (horizon, nu) = {shape}; "
            "for noise on other parameters use parameter_noise"
        )
    stddev = positive(stddev)
    try:
        fits = jnp.broadcast_shapes(stddev.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(f"stddev must broadcast to (horizon, nu) = {shape}, got {stddev.shape}")
    return stddev


class LinearPolicy(eqx.Module):
    """The policy of `linear_policy`: its parameters are a map of what it observes."""

    observe: Callable[[Any], Float[Array, " observed"]] = eqx.field(converter=as_pytree)

    def __call__(self, params: eqx.nn.Linear, state: Any) -> Float[Array, " nu"]:
        seen, size = self.observe(state), params.weight.shape[1]
        if seen.shape != (size,):
            raise ValueError(
                f"the policy must observe {size} numbers, got shape {seen.shape}; set num_states, or observe"
            )
        return params(seen)


def whole_state(state: Any) -> Float[Array, " observed"]:
    """Return a vector unchanged, or the positions, velocities and activations of a scene's state, in this order."""
    if isinstance(state, State):
        return jnp.concatenate([state.qpos, state.qvel, state.act])
    if not isinstance(state, jax.Array) or state.ndim != 1:
        raise ValueError(f"state must be a vector or a State, got {type(state).__name__}; pass observe=")
    return state


def linear_policy(
    num_states: int,
    num_controls: int,
    *,
    bias: bool = True,
    observe: Callable[[Any], Float[Array, " observed"]] = whole_state,
) -> tuple[LinearPolicy, eqx.nn.Linear]:
    """Return the policy u = K x + k and its parameters, which are zero: K is their `weight`, k their `bias`.

        policy, params = linear_policy(4, 1)
        objective = closed_loop(task, policy, stddev=0.1, params=params)

    Actions are not bounded: beyond an actuator's `ctrlrange` MuJoCo clips them, and their derivative is zero. x is the whole
    state, or the vector of `num_states` numbers that `observe` makes of the task's state or observations. Positions of a free
    body contain a quaternion, and angles do not wrap, so choose what you need. Without `bias` there is no k.

    Raises:
        ValueError: if a number is below 1.
    """
    sizes = whole("num_states", num_states), whole("num_controls", num_controls)
    function("observe", observe, "state", is_needed=True)
    drawn = eqx.nn.Linear(*sizes, use_bias=bias, key=jax.random.key(0))
    return LinearPolicy(observe), jax.tree.map(jnp.zeros_like, drawn)
