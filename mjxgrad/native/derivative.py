"""Rollouts of C MuJoCo under `jax.grad`, `jax.jacfwd`, `jax.vmap` and `jax.jit`.

The motion is one call; the Jacobians of all its steps are another, once the motion is known, and a recursion in tangent space
takes a change of the start to the end. JAX transposes that recursion, so forward and reverse mode are one formula.
"""

import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.native.engine import PAIRS, Engine, engine_of, with_pairs
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Gradient

_Arrays = Mapping[str, Array]


def roll_out(
    scene: Scene, start: _Arrays, inputs: _Arrays, gradient: Gradient
) -> tuple[Float[Array, "horizon nq"], Float[Array, "horizon nv"], Float[Array, "horizon na"]]:
    """Return positions, velocities and activations after each step, as MuJoCo gives them.

    Args:
        scene: its model's numbers are arguments of the call, so that they may be traced, mapped over and differentiated by.
        start: `time` of shape (1,), `qpos`, `qvel` and `act`.
        inputs: arrays with one row per step, under names of `INPUTS`; `ctrl` at least.
        gradient: "discrete", the derivative of MuJoCo's step, or "slope", that of its outcome; see `native.events`.

    Returns:
        Each with one row per step. Differentiable once, by start, inputs and numbers.
    """
    engine, dtype = engine_of(scene.mj_model), start["qpos"].dtype
    horizon = len(inputs["ctrl"])
    shapes = {k: jax.ShapeDtypeStruct((horizon, *start[k].shape), dtype) for k in ("qpos", "qvel", "act")}

    @jax.custom_jvp
    def call(numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> dict[str, Array]:
        return _callback(engine.run, shapes, numbers, start, inputs)

    @functools.partial(call.defjvp, symbolic_zeros=True)
    def _derivative(primals, tangents) -> tuple[dict[str, Array], dict[str, Array]]:
        numbers, start, inputs = primals
        found = call(*primals)
        by_number, by_start, by_input = tangents
        given = {k: t for k, t in {**by_input, **by_number}.items() if not isinstance(t, SymbolicZero)}
        before = {k: jnp.concatenate([start[k][None], found[k][:-1]]) for k in found}
        before["time"] = (
            start["time"]
            + numbers.get("opt.timestep", scene.mj_model.opt.timestep) * jnp.arange(horizon, dtype=dtype)[:, None]
        )
        wanted = with_pairs(tuple(given)) if gradient == "slope" else tuple(given)
        found_by = _jacobians(engine, numbers, before, inputs, gradient=gradient, wanted=wanted)
        forced = {part: jnp.zeros(found_by[part].shape[:2], dtype) for part in ("state", "felt") if part in found_by}
        for part, name in itertools.product(forced, given):
            own = name if part == "state" else f"{part} {name}"
            if own in found_by:
                change = given[name].reshape((horizon, -1) if name in by_input else -1).astype(dtype)
                forced[part] += jnp.einsum("tsc,tc->ts" if name in by_input else "tsc,c->ts", found_by[own], change)
        zero = lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, SymbolicZero) else x  # noqa: E731  # pyright: ignore
        changes = {k: zero(by_start[k]) for k in found}
        to_tangent = functools.partial(position_change, scene.model, start["qpos"])
        moved = jax.jvp(to_tangent, (start["qpos"],), (changes["qpos"],))[1]
        first = jnp.concatenate([moved, changes["qvel"], changes["act"]])

        product = functools.partial(jnp.einsum, "rc,c->r", precision="highest")

        def advance(carry: tuple[Array, Array], step: dict[str, Array]) -> tuple[tuple[Array, Array], Array]:
            (change, kept), rest = carry, 0.0
            end = product(step["state"], change) + step["by state"]
            if "felt" in step:
                is_own = (step["slot"] == jnp.arange(len(kept))[:, None]).astype(kept.dtype)
                held = kept + product(is_own, product(step["felt"], change) + step["by felt"])
                kept = step["stays"] * held
                end, rest = end + product(step["apart"], held), product(step["apart"], kept)
            return (end - rest, kept), end

        steps = {name: found_by[name] for name in ("state", *PAIRS) if name in found_by}
        steps |= {f"by {name}": x for name, x in forced.items()}
        none = jnp.zeros_like(steps["stays"][0]) if "stays" in steps else jnp.zeros(())
        _, course = jax.lax.scan(advance, (first, none), steps)
        nv = scene.model.nv
        parts = jnp.split(course, (nv, 2 * nv), axis=1)
        parts[0] = jax.vmap(functools.partial(to_coordinates, scene))(found["qpos"], parts[0])
        return found, dict(zip(("qpos", "qvel", "act"), parts, strict=True))

    found = call(changed_numbers(scene), start, inputs)
    return found["qpos"], found["qvel"], found["act"]


def steer(scene: Scene, start: _Arrays, law: _Arrays, num_substeps: int) -> tuple[Array, Array]:
    """Return states and controls of a feedback law in one call, see `Engine.steer`."""
    engine, first = engine_of(scene.mj_model), law["states"][0]
    shapes = {name: jax.ShapeDtypeStruct(law[name].shape, first.dtype) for name in ("states", "controls")}
    function = functools.partial(engine.steer, num_substeps, first.dtype)
    found = _callback(function, shapes, changed_numbers(scene), start, law)
    return jnp.concatenate([first[None], found["states"]]), found["controls"]


def linearise(scene: Scene, start: _Arrays, inputs: _Arrays, **how: Any) -> dict[str, Array]:
    """Return the Jacobians of one step by "state" and all that is wanted, see `Engine.linearise`."""
    before = {name: x[None] for name, x in start.items()}
    found = _jacobians(engine_of(scene.mj_model), changed_numbers(scene), before, inputs, **how)
    return {name: value[0] for name, value in found.items()}


def _jacobians(engine: Engine, numbers: _Arrays, before: _Arrays, inputs: _Arrays, **how: Any) -> dict[str, Array]:
    """Return what `Engine.linearise` gives of states before each step; it has no derivative of its own."""
    horizon, dtype = len(inputs["ctrl"]), before["qpos"].dtype
    sizes = {name: math.prod(x.shape[1:]) for name, x in inputs.items()} | {name: x.size for name, x in numbers.items()}
    shapes = {name: (horizon, *shape) for name, shape in engine.shapes(how["wanted"], sizes).items()}
    shapes = {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()}

    @jax.custom_jvp
    def call(numbers, before, inputs):
        return _callback(functools.partial(engine.linearise, **how), shapes, numbers, before, inputs)

    @call.defjvp
    def _refuse(primals, tangents):
        raise ValueError('C MuJoCo has first derivatives alone: for second ones take engine "mjx"')

    return call(numbers, before, inputs)


def _callback(function, shapes: dict, *arguments) -> dict[str, Array]:
    def run(*given) -> dict[str, np.ndarray]:
        given = jax.tree.map(np.asarray, given)
        return {k: np.asarray(x, shapes[k].dtype) for k, x in function(*given).items()}

    return jax.pure_callback(run, shapes, *arguments, vmap_method="expand_dims")


def to_coordinates(scene: Scene, qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Return a change in tangent space as one of coordinates."""
    rest = jnp.zeros_like(change)
    return jax.jvp(lambda velocity: integrate_position(scene.model, qpos, velocity, 1.0), (rest,), (change,))[1]
