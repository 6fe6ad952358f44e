"""An engine steps a scene, and takes derivatives of its steps.

A further engine is a file with such a class, and a line in `engines`.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from mjxgrad._arrays import form, real
from mjxgrad._mjx import mjx
from mjxgrad.engines.state import State, Trajectory
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact

PolicyFunction = Callable[[PyTree, Any], Float[Array, " nu"]]
"""Function from policy parameters and the state or observations to controls."""
Observe = Callable[[mjx.Model, mjx.Data], PyTree]
"""Function from model and data to a pytree of arrays."""
Inputs = dict[str, Array]
"""Inputs of a step beside controls, by MuJoCo's names."""
Sees = Literal["state", "observations"]


class Motion(eqx.Module):
    """How a scene moves; the arguments of `rollout`, by the same names."""

    scene: Scene
    policy: PolicyFunction | None
    params: PyTree
    observe: Observe | None
    policy_sees: Sees
    checkpoint: bool
    contact: Contact


class Rows(eqx.Module):
    """Numbers of each step: controls without noise, which a policy replaces; noise; and other inputs by MuJoCo's names."""

    controls: Float[Array, "horizon nu"]
    noise: Float[Array, "horizon nu"]
    inputs: dict[str, Array]


@runtime_checkable
class Engine(Protocol):
    """Who steps a scene."""

    title: ClassVar[str]  # its name in a sentence
    contacts: ClassVar[tuple[type, ...]]  # the ways of contact that it steps; others are stepped by MJX
    compiles: ClassVar[bool]  # whether its programs are compiled, and worth keeping
    steers: ClassVar[bool]  # whether it has `steer` and `product`, which take a whole trajectory in one call

    def complete(self, scene: Scene, state: State, contact: Contact) -> State:
        """Return a state with all that this engine goes on with from one rollout to the next."""
        ...

    def roll_out(self, motion: Motion, state: State, rows: Rows) -> Trajectory:
        """Return the result of `rollout`, for checked arguments."""
        ...

    def linearise(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact
    ) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C and D of one step, see `rollouts.Linearisation`."""
        ...

    def hold(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact) -> State:
        """Return the state after a control was held for some steps; differentiable."""
        ...

    def look(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, observe: Observe, contact: Contact
    ) -> PyTree:
        """Return what a function of model and data sees in a state under a control and other inputs; differentiable."""
        ...


def one_each(chosen: Any, count: int) -> Float[Array, " nu"]:
    """Refuse controls of a policy unless there is one per actuator: other shapes would silently be added or broadcast."""
    chosen = jnp.asarray(chosen) if isinstance(chosen, list) else chosen
    if not eqx.is_array_like(chosen) or jnp.shape(chosen) != (count,):
        raise ValueError(f"the policy must return one control per actuator, shape ({count},), got {form(chosen)}")
    is_switch = getattr(chosen, "dtype", None) == np.bool_
    return real("the policy's controls", chosen * 1 if is_switch else chosen)
