"""A motion sampled at a few times, in one program for every time step."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

import mjxgrad as mg
from mjxgrad._mjx import mjx

Read = Callable[[Float[Array, " nq"], Float[Array, " nv"]], Float[Array, "..."]]

# What derivatives are compared: MuJoCo's motion with either of its own, and a motion whose contacts begin within the step.
DISCRETE, EVENT, CONTINUOUS = "discrete", "event", "continuous onset"
ARMS = {DISCRETE: ("discrete", None), EVENT: ("event", None), CONTINUOUS: ("discrete", mg.Onset())}

_STATE = ("qpos", "qvel", "act", "time", "qacc_warmstart")


def at_time_step(model: mjx.Model, timestep: ArrayLike) -> mjx.Model:
    """Give a model with another time step, which may be traced."""
    return model.tree_replace({"opt.timestep": jnp.asarray(timestep, model.opt.timestep.dtype)})  # pyright: ignore[reportReturnType]


def motion(
    model: mjx.Model,
    data: mjx.Data,
    read: Read,
    *,
    num_times: int,
    steps_between: Int[ArrayLike, ""],
    gradient: str,
    onset: mg.Onset | None = None,
) -> Float[Array, "times *outcome"]:
    """Step, and read the state at equal intervals. `mg.rollout` would compile anew for every number of steps.

    Args:
        model: of the scene, as `at_time_step` gives it.
        data: the start.
        read: from positions and velocities to what is kept.
        num_times: how often to read.
        steps_between: steps from one reading to the next; may be traced, and the whole is then for forward mode alone.
        gradient: which derivative the steps have.
        onset: of contacts within the step; None is MuJoCo's motion.

    Returns:
        The readings, the first `steps_between` steps after the start.
    """

    def step(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        moved = mg.step(model, data.replace(**dict(zip(_STATE, state, strict=True))), gradient=gradient, onset=onset)
        return tuple(getattr(moved, name) for name in _STATE)

    def until_next(state: tuple[Array, ...], _: None):
        state = jax.lax.fori_loop(0, steps_between, step, state)
        return state, read(state[0], state[1])

    start = tuple(getattr(data, name) for name in _STATE)
    return jax.lax.scan(until_next, start, length=num_times)[1]
