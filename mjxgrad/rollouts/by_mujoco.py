"""A rollout by C MuJoCo: on all cores of the processor, without compilation, differentiable once."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from mjxgrad.native import roll_out
from mjxgrad.rollouts.arguments import Policy, arguments_of, one_each
from mjxgrad.rollouts.state import State, direction, is_sound
from mjxgrad.rollouts.trajectory import Trajectory
from mjxgrad.scene import Scene
from mjxgrad.stepping import Gradient

_Inputs = dict[str, Array]


def rolled_out(
    scene: Scene,
    state: State,
    controls: Policy | Float[Array, "horizon nu"],
    params: PyTree,
    noise: Float[Array, "horizon nu"],
    inputs: _Inputs,
    gradient: Gradient,
    *,
    measure_growth: bool,
) -> Trajectory:
    """Return C MuJoCo's rollout under controls, noise included, or a policy; the last good state is held."""
    if not callable(controls):
        found = _course(scene, state, controls, inputs, gradient)
    else:

        def advance(carry: tuple[State, Array], given: tuple[Array, Array, _Inputs]) -> tuple:
            state, first_bad = carry
            index, disturbance, row = given
            ctrl = one_each(controls(params, state), scene.model.nu) + disturbance
            one = _course(scene, state, ctrl[None], jax.tree.map(lambda x: x[None], row), gradient)
            first_bad = jnp.where((first_bad < 0) & one.diverged, index, first_bad)
            moved = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, one.final)
            return (moved, first_bad), (state, ctrl)

        # Step by step, since each control depends on the state before it.
        rows = (jnp.arange(len(noise), dtype=jnp.int32), noise, inputs)
        (final, first_bad), (states, ctrl) = jax.lax.scan(advance, (state, jnp.int32(-1)), rows)
        states = jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), states, final)
        found = _trajectory(states, ctrl, first_bad)
    growth = _growth(scene, state, found.ctrl, inputs, gradient) if measure_growth else None
    return dataclasses.replace(found, growth=growth)


@eqx.filter_jit
def _course(
    scene: Scene, state: State, ctrl: Float[Array, "horizon nu"], inputs: _Inputs, gradient: Gradient
) -> Trajectory:
    """Return the motion under known controls: one call of C MuJoCo."""
    is_finite = jnp.isfinite(ctrl)  # MuJoCo replaces others by zero
    start, resting = arguments_of(scene, state)
    given = {name: jnp.broadcast_to(value, (len(ctrl), *value.shape)) for name, value in resting.items()}
    found = roll_out(scene, start, given | inputs | {"ctrl": jnp.where(is_finite, ctrl, 0.0)}, gradient)
    begin = (state.qpos, state.qvel, state.act)
    qpos, qvel, act = (jnp.concatenate([first[None], rest]) for first, rest in zip(begin, found, strict=True))
    time = state.time + scene.model.opt.timestep * jnp.arange(len(ctrl) + 1)
    states = jax.vmap(State)(qpos, qvel, act, time, jnp.zeros_like(qvel))
    is_bad = ~(jax.vmap(is_sound)(states)[1:] & jnp.all(is_finite, axis=1))
    first_bad = jnp.where(jnp.any(is_bad), jnp.argmax(is_bad).astype(jnp.int32), -1)
    kept = jnp.arange(len(ctrl) + 1)
    kept = jnp.where(first_bad >= 0, jnp.minimum(kept, first_bad), kept)
    return _trajectory(jax.tree.map(lambda x: x[kept], states), ctrl, first_bad)


def _trajectory(states: State, ctrl: Float[Array, "horizon nu"], first_bad: Int[Array, ""]) -> Trajectory:
    final = jax.tree.map(lambda x: x[-1], states)
    return Trajectory(states.qpos, states.qvel, ctrl, None, final, first_bad >= 0, first_bad, act=states.act)  # pyright: ignore[reportCallIssue]


def _growth(scene: Scene, state: State, ctrl: Array, inputs: _Inputs, gradient: Gradient) -> Float[Array, ""]:
    """Return the growth of a tangent of the start; it has no derivative."""
    fixed = lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x  # noqa: E731
    scene, state, ctrl, inputs = jax.tree.map(fixed, (scene, state, ctrl, inputs))

    def course(qpos: Array, qvel: Array) -> tuple[Array, Array]:
        found = _course(scene, dataclasses.replace(state, qpos=qpos, qvel=qvel), ctrl, inputs, gradient)
        return found.qpos, found.qvel

    _, change = jax.jvp(course, (state.qpos, state.qvel), direction(state))
    size = jnp.linalg.norm(jnp.concatenate(change, axis=1), axis=1).max()
    return jnp.where(jnp.isfinite(size), jnp.maximum(size, 1.0), jnp.inf)
