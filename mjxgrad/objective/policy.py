"""The linear policy from states to controls."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.objective.task import as_pytree
from mjxgrad.rollouts import State


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
    """Return the policy u = K x + k, with parameters that are zero: K is their `weight`, k their `bias`.

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
    for name, number in (("num_states", num_states), ("num_controls", num_controls)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    drawn = eqx.nn.Linear(num_states, num_controls, use_bias=bias, key=jax.random.key(0))
    return LinearPolicy(observe), jax.tree.map(jnp.zeros_like, drawn)
