r"""What an estimator sees: a value under noise, and the score of that noise.

Noise smooths a cost: $F(\theta) = \mathbb{E}[f(\theta, w)]$. An estimator of $\nabla F$ needs
three things of a problem and nothing else: a draw of the noise, the value under it, and the
score $s$, the gradient of the log density of the noisy quantity with respect to $\theta$, for
which $\mathbb{E}[s] = 0$ and $\nabla F = \mathbb{E}[f s]$.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad.task import Task


class Objective(eqx.Module):
    """A cost under noise, as estimators see it.

    A subclass gives `dim`, `sample_noise`, `value` and `score`. It overrides `value_and_score`
    if both come from one rollout, and `mirror` and `zero_noise` if its noise is not symmetric
    about zero.
    """

    dim: eqx.AbstractVar[int | None]

    @abstractmethod
    def sample_noise(self, key: PRNGKeyArray) -> PyTree:
        """Draw the noise of one rollout; the key is consumed."""

    @abstractmethod
    def value(self, params: Float[Array, " dim"], noise: PyTree) -> Float[Array, ""]:
        """Give the cost of one rollout, NaN if the rollout diverged."""

    @abstractmethod
    def score(self, params: Float[Array, " dim"], noise: PyTree) -> Float[Array, " dim"]:
        """Give the gradient of the log density of the noisy quantity."""

    def value_and_score(
        self, params: Float[Array, " dim"], noise: PyTree
    ) -> tuple[Float[Array, ""], Float[Array, " dim"]]:
        """Give the cost and the score; one rollout where the score depends on the states."""
        return self.value(params, noise), self.score(params, noise)

    def mirror(self, noise: PyTree) -> PyTree:
        """Give the equally likely noise on the other side, for antithetic pairs."""
        return jax.tree.map(jnp.negative, noise)

    def zero_noise(self) -> PyTree:
        """Give the noise that changes nothing."""
        shapes = jax.eval_shape(self.sample_noise, jax.random.key(0))
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def sized_for(self, params: Float[Array, " dim"]) -> "Objective":
        """Give the objective with its `dim` settled by the parameters.

        Args:
            params: the point at which it is about to be evaluated.

        Returns:
            The objective itself, or one that has taken its `dim` from `params`.

        Raises:
            ValueError: if `params` is not a vector of floating-point numbers, or not of
                length `dim`.
        """
        shape = jnp.shape(params)
        if len(shape) != 1:
            raise ValueError(
                f"params must be a vector of shape (dim,), got shape {shape}; "
                "use jnp.atleast_1d for one number, objective.ravel for a pytree"
            )
        if not jnp.issubdtype(jnp.result_type(params), jnp.floating):
            raise ValueError(f"params must be floating-point, got {jnp.result_type(params)}; write 1.0 in place of 1")
        if self.dim is None:
            return dataclasses.replace(self, dim=shape[0])
        if shape[0] != self.dim:
            raise ValueError(f"params must have shape ({self.dim},), got {shape}")
        return self


class ParameterNoise(Objective):
    r"""$f(\theta + w)$ with $w \sim N(0, \mathrm{stddev}^2)$ on the parameters; see `parameter_noise`."""

    function: Callable[[Float[Array, " dim"]], Float[Array, ""]]
    stddev: Float[Array, " *dim"]
    dim: int | None = eqx.field(static=True)

    def sample_noise(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        """Draw noise for the parameters."""
        if self.dim is None:
            raise ValueError("dim is not known: pass dim=... to parameter_noise")
        return _gaussian(key, self.stddev, (self.dim,))

    def value(self, params: Float[Array, " dim"], noise: Float[Array, " dim"]) -> Float[Array, ""]:
        """Evaluate the function at the noisy parameters."""
        return _scalar(self.function(params + noise.astype(params.dtype)), "function")

    def score(self, params: Float[Array, " dim"], noise: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Give w/σ²."""
        return (noise / self.stddev**2).astype(params.dtype)


class OpenLoop(Objective):
    """The cost of a task under controls with noise on them; see `open_loop`."""

    task: Task
    stddev: Float[Array, "..."]
    dim: int | None = eqx.field(static=True)

    def ravel(self, controls: Float[Array, "horizon nu"]) -> Float[Array, " dim"]:
        """Flatten controls to parameters."""
        return jnp.ravel(controls)

    def unravel(self, params: Float[Array, " dim"]) -> Float[Array, "horizon nu"]:
        """Give parameters the shape of controls."""
        return params.reshape(self.task.horizon, self.task.num_controls)

    def sample_noise(self, key: PRNGKeyArray) -> Float[Array, "horizon nu"]:
        """Draw noise for every control."""
        return _gaussian(key, self.stddev, (self.task.horizon, self.task.num_controls))

    def value(self, params: Float[Array, " dim"], noise: Float[Array, "horizon nu"]) -> Float[Array, ""]:
        """Give the cost under the noisy controls."""
        cost, _ = self.task.run(self.unravel(params), noise=noise.astype(params.dtype))
        return _scalar(cost, "the task's cost")

    def score(self, params: Float[Array, " dim"], noise: Float[Array, "horizon nu"]) -> Float[Array, " dim"]:
        """Give w/σ², flattened."""
        return jnp.ravel(noise / self.stddev**2).astype(params.dtype)


class ClosedLoop(Objective):
    """The cost of a task under a policy with noise on its actions; see `closed_loop`."""

    task: Task
    policy: Callable[[PyTree, Any], Float[Array, " nu"]]
    stddev: Float[Array, "..."]
    unravel: Callable[[Float[Array, " dim"]], PyTree] = eqx.field(static=True)
    dim: int | None = eqx.field(static=True)

    def ravel(self, policy_params: PyTree) -> Float[Array, " dim"]:
        """Flatten the policy's parameters."""
        return ravel_pytree(policy_params)[0]

    def sample_noise(self, key: PRNGKeyArray) -> Float[Array, "horizon nu"]:
        """Draw noise for every action."""
        return _gaussian(key, self.stddev, (self.task.horizon, self.task.num_controls))

    def value(self, params: Float[Array, " dim"], noise: Float[Array, "horizon nu"]) -> Float[Array, ""]:
        """Give the cost under the noisy policy."""
        return self._run(params, noise)[0]

    def score(self, params: Float[Array, " dim"], noise: Float[Array, "horizon nu"]) -> Float[Array, " dim"]:
        """Give Σ_t (∂π(x_t)/∂θ)ᵀ w_t/σ²; it takes a rollout."""
        return self.value_and_score(params, noise)[1]

    def value_and_score(
        self, params: Float[Array, " dim"], noise: Float[Array, "horizon nu"]
    ) -> tuple[Float[Array, ""], Float[Array, " dim"]]:
        """Give both from one rollout."""
        cost, states = self._run(params, noise)
        # Given the state, the action is Gaussian about the policy; the chance of the next state
        # given state and action does not depend on the parameters. So the states are data here.
        states = jax.lax.stop_gradient(states)

        def actions(flat: Float[Array, " dim"]) -> Float[Array, "horizon nu"]:
            return jax.vmap(lambda state: self.policy(self.unravel(flat), state))(states)

        _, pull_back = jax.vjp(actions, params)
        (score,) = pull_back((noise / self.stddev**2).astype(params.dtype))
        return cost, score

    def _run(self, params: Float[Array, " dim"], noise: Float[Array, "horizon nu"]) -> tuple[Float[Array, ""], PyTree]:
        noise = noise.astype(params.dtype)
        cost, states = self.task.run(self.policy, self.unravel(params), noise)
        return _scalar(cost, "the task's cost"), states


def parameter_noise(
    function: Callable[[Float[Array, " dim"]], Float[Array, ""]],
    stddev: float | Float[Array, ""] | Float[Array, " dim"],
    dim: int | None = None,
) -> ParameterNoise:
    r"""Smooth any function of a vector by Gaussian noise on the vector.

    $F(\theta) = \mathbb{E}[f(\theta + w)]$, $w \sim N(0, \sigma^2 I)$, with score $w/\sigma^2$.

    Args:
        function: takes a vector, gives a scalar; traceable by JAX.
        stddev: $\sigma > 0$, in the parameters' units; one number, or one per parameter.
        dim: number of parameters. Needed only to draw noise by hand: an estimator takes it from
            the parameters it is given.

    Returns:
        The objective.

    Raises:
        ValueError: if `stddev` is not positive, or neither one number nor `dim` of them.
    """
    stddev = _positive(stddev)
    if stddev.ndim > 1 or (stddev.ndim == 1 and dim not in (None, stddev.shape[0])):
        raise ValueError(f"stddev must be one number or {dim or 'dim'}, got shape {stddev.shape}")
    if stddev.ndim == 1:
        dim = stddev.shape[0]
    return ParameterNoise(function=_as_pytree(function), stddev=stddev, dim=dim)


def open_loop(task: Task, stddev: float | Float[Array, "..."]) -> OpenLoop:
    r"""Give the cost of a task as a function of its controls, with noise on each.

    The parameters are the controls, flattened by `objective.ravel`; the score is $w/\sigma^2$.

    Args:
        task: what is controlled, and what it costs.
        stddev: $\sigma > 0$ in units of the controls; any shape that broadcasts to
            (horizon, nu).

    Returns:
        The objective, with `dim` = horizon * nu.

    Raises:
        ValueError: if `stddev` is not positive or does not broadcast, or if the task has no
            controls.
    """
    stddev = _action_stddev(task, stddev)
    return OpenLoop(task=task, stddev=stddev, dim=task.horizon * task.num_controls)


def closed_loop(
    task: Task,
    policy: Callable[[PyTree, Any], Float[Array, " nu"]],
    stddev: float | Float[Array, "..."],
    *,
    params: PyTree = None,
) -> ClosedLoop:
    r"""Give the cost of a task as a function of a policy's parameters, with noise on its actions.

    The action is $u_t = \pi_\theta(x_t) + w_t$; the score of a rollout is
    $\sum_t (\partial\pi_\theta(x_t)/\partial\theta)^\top w_t/\sigma^2$, the states taken as data.
    Value and score come from one rollout.

    Args:
        task: what is controlled, and what it costs.
        policy: takes its parameters and a state, gives controls of shape (nu,).
        stddev: $\sigma > 0$ in units of the controls; any shape that broadcasts to
            (horizon, nu).
        params: an example of the policy's parameters; only its structure and shapes count.
            Without it the policy is handed the flat vector itself.

    Returns:
        The objective; `objective.ravel` and `objective.unravel` go between the policy's
        parameters and the flat vector.

    Raises:
        ValueError: if `stddev` is not positive or does not broadcast, or if the task has no
            controls.

    References:
        Williams. Simple statistical gradient-following algorithms for connectionist
        reinforcement learning. Machine Learning 8, 1992, theorem 1.
    """
    stddev = _action_stddev(task, stddev)
    flat, unravel = (None, _unchanged) if params is None else ravel_pytree(params)
    return ClosedLoop(
        task=task,
        policy=_as_pytree(policy),
        stddev=stddev,
        unravel=unravel,
        dim=None if flat is None else flat.size,
    )


def _unchanged(params: Float[Array, " dim"]) -> Float[Array, " dim"]:
    return params


def _gaussian(key: PRNGKeyArray, stddev: Float[Array, "..."], shape: tuple[int, ...]) -> Float[Array, "..."]:
    return stddev * jax.random.normal(key, shape, stddev.dtype)


def _scalar(value: Array, name: str) -> Float[Array, ""]:
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must return a scalar of shape (), got shape {jnp.shape(value)}")
    return value


def _as_pytree(function: Callable) -> Callable:
    """Wrap a plain function so that an objective is a pytree of arrays, fit for jit and vmap."""
    if isinstance(function, eqx.Module):
        return function  # pyright: ignore[reportReturnType]
    return function if isinstance(function, jax.tree_util.Partial) else jax.tree_util.Partial(function)


def _positive(stddev: float | Float[Array, "..."]) -> Float[Array, "..."]:
    stddev = jnp.asarray(stddev, jnp.result_type(stddev, float))
    # A traced value (a noise schedule, a sweep) cannot be looked at here.
    if not isinstance(stddev, jax.core.Tracer) and not bool((stddev > 0).all()):
        raise ValueError(f"stddev must be positive, got {stddev}")
    return stddev


def _action_stddev(task: Task, stddev: float | Float[Array, "..."]) -> Float[Array, "..."]:
    shape = (task.horizon, task.num_controls)
    if task.horizon * task.num_controls == 0:
        raise ValueError(
            f"action noise needs controls, got a task of (horizon, nu) = {shape}; "
            "for noise on other parameters use parameter_noise"
        )
    stddev = _positive(stddev)
    try:
        fits = jnp.broadcast_shapes(stddev.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(f"stddev must broadcast to (horizon, nu) = {shape}, got {stddev.shape}")
    return stddev
