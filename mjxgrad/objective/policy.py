"""Policies from states to controls, with separate parameters: linear, and a multilayer perceptron."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from mjxgrad.objective.task import as_pytree
from mjxgrad.rollouts import State

# The last layer starts a hundred times smaller than the others, so that the first actions are near zero and depend
# little on the state. Among initialisations this choice mattered most in Andrychowicz et al. (below).
FINAL_SCALE = 0.01


class Affine(eqx.Module):
    """A linear map by a matrix, the gain, with an optional offset."""

    gain: Float[Array, "outputs inputs"]
    offset: Float[Array, " outputs"] | None

    def __call__(self, inputs: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        if inputs.shape != self.gain.shape[1:]:
            raise ValueError(
                f"the policy must observe {self.gain.shape[1]} numbers, got shape {inputs.shape}; "
                "set num_states, or observe"
            )
        return self.gain @ inputs if self.offset is None else self.gain @ inputs + self.offset


class FeedforwardPolicy(eqx.Module):
    """The policy of `linear_policy` and `mlp_policy`, which differ in the number of layers."""

    observe: Callable[[Any], Float[Array, " observed"]] = eqx.field(converter=as_pytree)
    limits: Float[Array, "nu 2"] | None = None

    def __call__(self, params: Affine | tuple[Affine, ...], state: Any) -> Float[Array, " nu"]:
        *layers, last = (params,) if isinstance(params, Affine) else params
        hidden = self.observe(state)
        for layer in layers:
            hidden = jnp.tanh(layer(hidden))
        action = last(hidden)
        if self.limits is None:
            return action
        low, high = self.limits.T
        is_bounded = jnp.isfinite(high - low)
        middle, half = (jnp.where(is_bounded, x / 2, 1.0) for x in (low + high, high - low))
        return jnp.where(is_bounded, middle + half * jnp.tanh(action / half), action)


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
) -> tuple[FeedforwardPolicy, Affine]:
    """Return the policy u = K x + k, with parameters that are zero.

        policy, params = linear_policy(4, 1)
        objective = closed_loop(task, policy, stddev=0.1, params=params)

    Actions are not bounded: beyond an actuator's `ctrlrange` MuJoCo clips them, and their derivative is zero.

    Args:
        num_states: number of observed values.
        num_controls: number of controls.
        bias: whether there is the constant k.
        observe: function from the task's state or observations to a vector. Positions of a free body contain a
            quaternion, and angles do not wrap, so choose what you need.

    Returns:
        The policy, called as `policy(params, state)`, and its parameters.

    Raises:
        ValueError: if a number is below 1.
    """
    _check_positive(num_states=num_states, num_controls=num_controls)
    offset = jnp.zeros(num_controls) if bias else None
    return FeedforwardPolicy(observe), Affine(jnp.zeros((num_controls, num_states)), offset)


def mlp_policy(
    num_states: int,
    num_controls: int,
    *,
    width: int,
    depth: int,
    key: PRNGKeyArray,
    limits: Float[ArrayLike, "nu 2"] | None = None,
    observe: Callable[[Any], Float[Array, " observed"]] = whole_state,
) -> tuple[FeedforwardPolicy, tuple[Affine, ...]]:
    r"""Return a multilayer perceptron with tanh between its layers.

    The last layer is linear unless there are limits. Within limits $m \pm l$ the action is $m + l\tanh(y/l)$, of slope 1
    in the middle. Its derivative is therefore not zero where MuJoCo would clip the action.

    Gains start as $N(0, 1/\text{inputs})$, in the last layer 100 times smaller; offsets start as zero.

    Args:
        num_states: number of observed values.
        num_controls: number of controls.
        width: size of every hidden layer.
        depth: number of hidden layers.
        key: key of the gains; consumed here.
        limits: the least and largest value of each control, such as `scene.ctrlrange`; infinite limits do not bound.
        observe: function from the task's state to a vector; see `linear_policy`.

    Returns:
        The policy, called as `policy(params, state)`, and its parameters, layer by layer.

    Raises:
        ValueError: if a number is below 1, or there is not one pair of limits per control.

    References:
        Andrychowicz et al. What Matters for On-Policy Deep Actor-Critic Methods? A Large-Scale Study. ICLR 2021,
        arXiv:2006.05990, section 3.2.
    """
    _check_positive(num_states=num_states, num_controls=num_controls, width=width, depth=depth)
    bounds = None if limits is None else jnp.asarray(limits, float)
    if bounds is not None and bounds.shape != (num_controls, 2):
        raise ValueError(
            f"limits must have shape ({num_controls}, 2), low and high of each control, got {bounds.shape}"
        )
    sizes = [num_states, *[width] * depth, num_controls]
    keys = jax.random.split(key, depth + 1)
    scales = [1.0] * depth + [FINAL_SCALE]
    layers = [
        Affine(scale * jax.random.normal(k, (outputs, inputs)) / inputs**0.5, jnp.zeros(outputs))
        for k, scale, inputs, outputs in zip(keys, scales, sizes[:-1], sizes[1:], strict=True)
    ]
    return FeedforwardPolicy(observe, bounds), tuple(layers)


def _check_positive(**numbers: int) -> None:
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
