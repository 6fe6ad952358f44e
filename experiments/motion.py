"""One stepping loop for all experiments, and own tasks."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

import mjxgrad as mg
from experiments.config import ExperimentError
from experiments.settings import OwnScene
from mjxgrad._mjx import mjx
from mjxgrad.checking.sweep import scene_task
from mjxgrad.stepping import Contact

Read = Callable[[Float[Array, " nq"], Float[Array, " nv"]], Float[Array, "..."]]

# What derivatives are compared: MuJoCo's motion with either of its own, and a motion whose contacts begin within the step.
DISCRETE, SLOPE, CONTINUOUS = "discrete", "slope", "continuous onset"
ARMS: dict[str, Contact] = {DISCRETE: mg.Discrete(), SLOPE: mg.Slope(), CONTINUOUS: mg.Onset()}

_STATE = ("qpos", "qvel", "act", "time", "qacc_warmstart")


def advance(step: Callable[[mjx.Data], mjx.Data], data: mjx.Data, num_steps: Int[ArrayLike, ""]) -> mjx.Data:
    """Step many times, the state alone carried along; `mg.rollout` would compile anew for every number of steps.

    The number may be traced, and the whole is then for forward mode alone.
    """

    def once(_: Array, state: dict[str, Array]) -> dict[str, Array]:
        moved = step(data.replace(**state))
        return {name: getattr(moved, name) for name in _STATE}

    return data.replace(**jax.lax.fori_loop(0, num_steps, once, {name: getattr(data, name) for name in _STATE}))


def own_task(settings: OwnScene, **others: Any) -> mg.SceneTask:
    """Make the task of a scene of one's own; its mistakes are one sentence."""
    try:
        scene = mg.load_scene(str(settings.scene))
        task = scene_task(scene, settings.cost, start=settings.start, horizon=settings.horizon, **others)
        # What the cost returns is only known once it is called.
        jax.eval_shape(task.run, jnp.zeros((task.horizon, task.num_controls)))
    except ValueError as error:
        raise ExperimentError(str(error)) from error
    return task
