r"""Averages over the phase: where, within a time step, the grid of times begins.

A simulated outcome depends on where within a step each contact begins: along a parameter it is a smooth trend with a sawtooth
of the height of what one step does. Its derivative is that of the tooth's flank. A rollout whose first step has the length
$\varphi h$ and whose last one the rest, $\varphi \sim U(0, 1)$, meets all places of the tooth, and the mean outcome over
$\varphi$ has the trend. The mean of *discrete* derivatives does not: each of them is the slope of a flank. The mean of
event-corrected ones does, to the order of the step.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree

from mjxgrad.dynamics import Gradient, check_gradient, step
from mjxgrad.integration.march import control_rows, march
from mjxgrad.rollout import State, Trajectory, data_of, state_of
from mjxgrad.scene import Scene


def shifted_rollout(
    scene: Scene,
    state: State,
    controls: Float[ArrayLike, "_ _"] | None = None,
    *,
    phase: Float[ArrayLike, ""],
    horizon: int | None = None,
    gradient: Gradient = "discrete",
) -> Trajectory:
    """Roll out over the same time on a grid that is shifted by a fraction of a step.

    A control acts over the same interval as in `rollout`: a shifted step that holds the end of one interval gets the mean of both
    controls, weighted by time. Differentiable both ways, traceable in the phase. Contact parameters that `refsafe` clamps at
    two time steps are clamped less in the two short steps.

    Args:
        scene: from `load_scene`.
        state: where to begin.
        controls: one row per whole step, or None for the scene's resting ones.
        phase: in [0, 1]: the first step takes this share of a time step, the last one the rest.
        horizon: number of whole steps; needed only where no controls are given.
        gradient: "discrete" or "event", see `step`.

    Returns:
        The trajectory; it has `horizon + 1` steps, the last of which ends when that of `rollout` does.

    Raises:
        ValueError: if there is no such gradient, or horizon and controls do not fit.
    """
    check_gradient(gradient)
    rows = control_rows(scene, controls, horizon)
    h = scene.model.opt.timestep
    phase = jnp.asarray(phase, state.qpos.dtype)
    durations = h * jnp.concatenate([phase[None], jnp.ones(len(rows) - 1, phase.dtype), 1 - phase[None]])
    # Shifted step k lies over the end of interval k - 1 and the beginning of interval k.
    mixed = (1 - phase) * rows[:-1] + phase * rows[1:]

    def advance(state: State, control: Float[Array, " nu"], duration: Float[Array, ""]) -> State:
        model = scene.model.tree_replace({"opt.timestep": duration})
        return state_of(step(model, data_of(scene, state, control), gradient=gradient))  # pyright: ignore[reportArgumentType]

    return march(scene, state, jnp.concatenate([rows[:1], mixed, rows[-1:]]), durations, advance)


def phase_average(
    function: Callable[..., PyTree], num_phases: int, key: PRNGKeyArray | None = None
) -> Callable[..., PyTree]:
    """Average a function of arguments and a phase over the phase.

        def outcome(height, phase):
            return shifted_rollout(scene, start(height), phase=phase, horizon=500).qpos[-1, 2]

        slope = jax.grad(phase_average(outcome, 16))(0.3)

    Args:
        function: called as `function(*args, phase)`, under `jax.vmap`.
        num_phases: N, at least 1. The phases are (i + ½)/N: where the outcome is a sawtooth in the phase their mean is off
            by 1/N of its height at most, that of N random ones by 1/√N.
        key: moves all phases by the same random amount up to 1/N, so that the mean over keys is that over all phases. None
            leaves them where they are.

    Returns:
        A function of the arguments alone.

    Raises:
        ValueError: if `num_phases` is below 1.
    """
    if num_phases < 1:
        raise ValueError(f"num_phases must be at least 1, got {num_phases}")
    offset = 0.5 if key is None else jax.random.uniform(key)
    phases = (jnp.arange(num_phases) + offset) / num_phases

    def averaged(*args: Any) -> PyTree:
        values = jax.vmap(lambda phase: function(*args, phase))(phases)
        return jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), values)

    return averaged
