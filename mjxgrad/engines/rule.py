"""Rollouts of C MuJoCo under `jax.grad`, `jax.jacfwd`, `jax.vmap` and `jax.jit`.

The motion is one call; the derivatives of all its steps are another, once the motion is known, and the recursion of
`engines.flight` takes a change of the start to the end. JAX transposes that recursion: forward and reverse mode are one formula.
Pairs of motions that are in flight at the end are part of the state while JAX differentiates, so that a rollout that goes on from
there has the derivative of one that was never interrupted.
"""

import functools
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from mjxgrad._interrupts import give_up_if_stopped
from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.engines.flight import NUM_SLOTS, PAIRS, advance, begin
from mjxgrad.engines.jacobians import with_pairs
from mjxgrad.engines.layout import MOTION
from mjxgrad.engines.pool import ONCE, pool_of
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Gradient

_Arrays = Mapping[str, Array]


def roll_out(scene: Scene, numbers: _Arrays, start: _Arrays, inputs: _Arrays, gradient: Gradient) -> dict[str, Array]:
    """Return the parts of `layout.MOTION` after each step, as MuJoCo gives them; differentiable once, by all arguments."""
    # Numbers are those of the scene's model that its C model does not have. The start has `time` of shape (1,), the parts of the
    # motion, and "warmstart", "flight" and "held" as in `State`; inputs have one row per step under names of `INPUTS`, `ctrl` at
    # least. All found has one row per step but "warmstart", "flight" and "held", which are those after the last.
    flight_shape, dtype = pool_of(scene.mj_model).flight_shape, start["qpos"].dtype
    horizon = len(inputs["ctrl"])
    shapes = {k: jax.ShapeDtypeStruct((horizon, *start[k].shape), dtype) for k in MOTION}
    shapes["warmstart"] = jax.ShapeDtypeStruct(start["qvel"].shape, dtype)
    nothing = lambda: {"flight": jnp.zeros(flight_shape, dtype), "held": jnp.zeros(NUM_SLOTS, dtype)}  # noqa: E731

    @jax.custom_jvp
    def call(numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> dict[str, Array]:
        motion = {name: start[name] for name in ("time", *MOTION, "warmstart")}
        return _callback(_by_pool(scene, "run"), shapes, numbers, motion, inputs) | nothing()

    @functools.partial(call.defjvp, symbolic_zeros=True)
    def _derivative(primals, tangents) -> tuple[dict[str, Array], dict[str, Array]]:
        numbers, start, inputs = primals
        found = call(*primals)
        by_number, by_start, by_input = tangents
        given = _without_zeros({**by_input, **by_number})
        before = {k: jnp.concatenate([start[k][None], found[k][:-1]]) for k in MOTION}
        timestep = numbers.get("opt.timestep", scene.mj_model.opt.timestep)
        before["time"] = start["time"] + timestep * jnp.arange(horizon, dtype=dtype)[:, None]
        wanted = (*with_pairs(tuple(given)), "flight") if gradient == "slope" else tuple(given)
        maps = _maps(scene, numbers, before, inputs, start["flight"], gradient=gradient, wanted=wanted)
        forced = {}
        for part, prefix in (("state", ""), ("felt", "felt ")):
            if part in maps:
                by = {name: maps[prefix + name] for name in given if prefix + name in maps}
                forced[f"by {part}"] = _added(jnp.zeros(maps[part].shape[:2], dtype), by, given, by_input)
        changes = {k: _dense(by_start[k]) for k in (*MOTION, "held")}
        to_tangent = functools.partial(position_change, scene.model, start["qpos"])
        moved = jax.jvp(to_tangent, (start["qpos"],), (changes["qpos"],))[1]
        first = jnp.concatenate([moved, *(changes[name] for name in MOTION[1:])])
        steps = {name: maps[name] for name in ("state", *PAIRS) if name in maps} | forced

        def through(carry: tuple[Array, Array], step: dict[str, Array]) -> tuple[tuple[Array, Array], Array]:
            main, held, total = advance(jnp, *carry, step)
            return (main, held), total

        carry = begin(first, changes["held"], maps) if "before" in maps else (first, changes["held"])
        with jax.default_matmul_precision("highest"):
            (_, held), course = jax.lax.scan(through, carry, steps)
        sizes = [scene.model.nv, *(start[name].size for name in MOTION[1:])]
        parts = jnp.split(course, np.cumsum(sizes)[:-1].tolist(), axis=1)
        parts[0] = jax.vmap(functools.partial(to_coordinates, scene))(found["qpos"], parts[0])
        own, change = nothing(), nothing()
        if gradient == "slope":
            own["flight"], change["held"] = maps["flight"], held
        change["warmstart"] = jnp.zeros_like(start["qvel"])
        return found | own, dict(zip(MOTION, parts, strict=True)) | change

    given = nothing() | {"warmstart": jnp.zeros_like(start["qvel"])} | dict(start)
    given |= {name: jax.lax.stop_gradient(given[name]) for name in ("flight", "warmstart")}
    return call(numbers, given, dict(inputs))


def steer(scene: Scene, start: _Arrays, law: _Arrays, num_substeps: int) -> tuple[Array, Array]:
    """Return states and controls of a feedback law in one call, see `Pool.steer`."""
    first = law["states"][0]
    shapes = {name: jax.ShapeDtypeStruct(law[name].shape, first.dtype) for name in ("states", "controls")}
    function = functools.partial(_by_pool(scene, "steer"), num_substeps, first.dtype)
    found = _callback(function, shapes, changed_numbers(scene), start, law)
    return jnp.concatenate([first[None], found["states"]]), found["controls"]


def product(scene: Scene, start: _Arrays, inputs: _Arrays, *, gradient: Gradient) -> dict[str, Array]:
    """Return the derivative of several steps by "state" and by "ctrl" that is held, and "end", the state after them."""
    pool = pool_of(scene.mj_model)
    shapes = pool.shapes(("ctrl",), _sizes({}, inputs)) | {"end": (sum(start[name].size for name in MOTION),)}
    function = _by_pool(scene, "product", gradient=gradient)
    return _once(scene, function, shapes, start["qpos"].dtype, changed_numbers(scene), start, inputs)


def linearise(
    scene: Scene, start: _Arrays, inputs: _Arrays, *, gradient: Gradient
) -> tuple[Array, Array, Array, Array]:
    """Return the derivatives of one step and of its sensors by state and controls: A, B, C and D."""
    pool, before = pool_of(scene.mj_model), {name: x[None] for name, x in start.items()}
    numbers, dtype, size = changed_numbers(scene), start["qpos"].dtype, pool.layout.num_changes
    flight = jnp.zeros(pool.flight_shape, dtype)
    found = _maps(scene, numbers, before, inputs, flight, gradient=gradient, wanted=("ctrl",))
    shapes = {
        "state": (1, scene.mj_model.nsensordata, size),
        "ctrl": (1, scene.mj_model.nsensordata, scene.mj_model.nu),
    }
    function = _by_pool(scene, "sense", wanted=("state", "ctrl"))
    sensed = _once(scene, function, shapes, dtype, numbers, before, inputs)
    return found["state"][0], found["ctrl"][0], sensed["state"][0], sensed["ctrl"][0]


def sense(scene: Scene, states: _Arrays, inputs: _Arrays) -> Float[Array, "times nsensordata"]:
    """Return the readings of all sensors in states under inputs, both with an axis of times; differentiable once."""
    num_changes, dtype = pool_of(scene.mj_model).layout.num_changes, states["qpos"].dtype
    times, count = len(inputs["ctrl"]), scene.mj_model.nsensordata

    @jax.custom_jvp
    def call(numbers: _Arrays, states: _Arrays, inputs: _Arrays) -> Array:
        shapes = {"readings": jax.ShapeDtypeStruct((times, count), dtype)}
        return _callback(_by_pool(scene, "sense"), shapes, numbers, states, inputs)["readings"]

    @functools.partial(call.defjvp, symbolic_zeros=True)
    def _derivative(primals, tangents) -> tuple[Array, Array]:
        numbers, states, inputs = primals
        by_number, by_state, by_input = tangents
        given = _without_zeros({**by_input, **by_number})
        sizes = _sizes(numbers, inputs) | {"state": num_changes}
        wanted = ("state", *given)
        shapes = {name: (times, count, sizes[name]) for name in wanted}
        function = _by_pool(scene, "sense", wanted=wanted)
        found = _once(scene, function, shapes, dtype, numbers, states, inputs)

        def in_tangent_space(qpos: Array, change: Array) -> Array:
            return jax.jvp(functools.partial(position_change, scene.model, qpos), (qpos,), (change,))[1]

        parts = [jax.vmap(in_tangent_space)(states["qpos"], _dense(by_state["qpos"]))]
        parts += [_dense(by_state[name]) for name in MOTION[1:]]
        change = jnp.einsum("tsc,tc->ts", found["state"], jnp.concatenate(parts, axis=1), precision="highest")
        return call(*primals), _added(change, found, given, by_input)

    return call(changed_numbers(scene), dict(states), dict(inputs))


def _by_pool(scene: Scene, method: str, **how: Any) -> Callable[..., dict[str, np.ndarray]]:
    """Return a method of the scene's pool, looked up when it is called: programs are kept, pools and their threads are not."""
    mj_model = scene.mj_model
    return lambda *arguments: getattr(pool_of(mj_model), method)(*arguments, **how)


def _maps(
    scene: Scene, numbers: _Arrays, before: _Arrays, inputs: _Arrays, flight: Array, **how: Any
) -> dict[str, Array]:
    pool, horizon = pool_of(scene.mj_model), len(inputs["ctrl"])
    every = pool.shapes(how["wanted"], _sizes(numbers, inputs))
    shapes = {k: v if k in ONCE else (horizon, *v) for k, v in every.items()}
    function = _by_pool(scene, "maps", **how)
    return _once(scene, function, shapes, before["qpos"].dtype, numbers, before, inputs, flight)


def _sizes(numbers: _Arrays, inputs: _Arrays) -> dict[str, int]:
    return {name: math.prod(x.shape[1:]) for name, x in inputs.items()} | {name: x.size for name, x in numbers.items()}


def _without_zeros(tangents: Mapping[str, Any]) -> dict[str, Array]:
    return {name: one for name, one in tangents.items() if not isinstance(one, SymbolicZero)}


def _dense(tangent: Any) -> Array:
    return jnp.zeros(tangent.shape, tangent.dtype) if isinstance(tangent, SymbolicZero) else tangent  # pyright: ignore[reportArgumentType]


def _added(change: Array, by: _Arrays, given: _Arrays, inputs: Mapping[str, Any]) -> Array:
    """Return changes after each step with what tangents of inputs, and of numbers that all steps share, add to them."""
    for name, matrix in by.items():
        if name in given:
            is_input, own = name in inputs, given[name].astype(change.dtype)
            own = own.reshape((len(change), -1) if is_input else -1)
            change += jnp.einsum("tsc,tc->ts" if is_input else "tsc,c->ts", matrix, own, precision="highest")
    return change


def _once(
    scene: Scene, function, shapes: Mapping[str, tuple[int, ...]], dtype: Any, *arguments: Any
) -> dict[str, Array]:
    """Call C MuJoCo for derivatives; they have none of their own."""
    wanted = {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()}

    @jax.custom_jvp
    def call(*arguments):
        return _callback(function, wanted, *arguments)

    @call.defjvp
    def _refuse(primals, tangents):
        remedy = 'for second ones take engine "mjx"'
        lack = scene.unsupported and f"for second ones MJX must step the scene: {scene.unsupported}"
        raise ValueError(f"C MuJoCo has first derivatives alone: {lack or remedy}")

    return call(*arguments)


def _callback(function, shapes: dict, *arguments) -> dict[str, Array]:
    arguments = jax.tree.map(jnp.asarray, arguments)
    types = [x.dtype for x in jax.tree.leaves(arguments)]

    def run(*given) -> dict[str, np.ndarray]:
        give_up_if_stopped()
        leaves, structure = jax.tree.flatten(given)
        leaves = [_whole(np.asarray(x), dtype) for x, dtype in zip(leaves, types, strict=True)]
        try:
            found = function(*jax.tree.unflatten(structure, leaves))
        except mujoco.FatalError as error:  # of memory, as a rule; XLA would show it in a page of its own
            reason = " ".join(str(error).split())
            warnings.warn(f"C MuJoCo gave up, and its numbers are NaN: {reason}", SceneWarning, stacklevel=2)
            inner = [np.ndim(x) for x in jax.tree.leaves(arguments)]
            parts = [x.shape[: x.ndim - n] for x, n in zip(leaves, inner, strict=True)]
            batch = np.broadcast_shapes(*parts)
            found = {name: np.full((*batch, *shape.shape), np.nan) for name, shape in shapes.items()}
        return {k: _halves(np.asarray(x, shapes[k].dtype)) for k, x in found.items()}

    cut = lambda x: jax.lax.bitcast_convert_type(x, np.uint32) if x.dtype.itemsize == 8 else x  # noqa: E731
    wanted = jax.eval_shape(lambda: {k: cut(jnp.zeros(x.shape, x.dtype)) for k, x in shapes.items()})
    found = jax.pure_callback(run, wanted, *jax.tree.map(cut, arguments), vmap_method="expand_dims")
    is_whole = {k: x.dtype == shapes[k].dtype for k, x in found.items()}
    return {k: x if is_whole[k] else jax.lax.bitcast_convert_type(x, shapes[k].dtype) for k, x in found.items()}


# Double precision crosses a callback in halves: `jax.enable_x64` as a context holds for one thread, and in XLA's others JAX would
# make single precision of it.
def _whole(value: np.ndarray, dtype: np.dtype) -> np.ndarray:
    return np.ascontiguousarray(value).view(dtype)[..., 0] if value.dtype != dtype else value


def _halves(value: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(value)[..., None].view(np.uint32) if value.dtype.itemsize == 8 else value


def to_coordinates(scene: Scene, qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Return a change in tangent space as one of coordinates."""
    rest = jnp.zeros_like(change)
    return jax.jvp(lambda velocity: integrate_position(scene.model, qpos, velocity, 1.0), (rest,), (change,))[1]
