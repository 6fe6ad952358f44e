"""C MuJoCo: on all cores of the processor, without compilation, differentiable once; any scene that MuJoCo loads."""

import dataclasses
from collections.abc import Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, PyTree

from mjxgrad._arrays import is_known
from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import com_pos, kinematics
from mjxgrad.engines import rule
from mjxgrad.engines.engine import Inputs, Motion, Observe, Rows, one_each
from mjxgrad.engines.layout import INPUTS, MOTION
from mjxgrad.engines.pool import pool_of
from mjxgrad.engines.state import Pairs, State, Trajectory, data_of, is_sound
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Contact, Discrete, Gradient, Slope

_PLACES = (
    "xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat",
    "subtree_com",
)  # fmt: skip


@jax.tree_util.register_static
class _Unknown:
    """Stands for what only MJX's own data have, such as contacts: whoever asks is told so."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # as Python itself and copies ask
            raise AttributeError(name)
        raise ValueError(
            f"data has no {name} by C MuJoCo and Warp, which give sensors and places: for a force between two geoms add "
            '<sensor><contact name="push" geom1="floor" geom2="foot" data="force" reduce="netforce"/></sensor> to the MJCF, '
            'and read mg.sensor(model, data, "push")'
        )


class MuJoCo:
    """MuJoCo itself; see `engines.engine.Engine`."""

    title: ClassVar[str] = "C MuJoCo"
    contacts: ClassVar[tuple[type, ...]] = (Discrete, Slope)
    compiles: ClassVar[bool] = False
    steers: ClassVar[bool] = True

    def complete(self, scene: Scene, state: State, contact: Contact = Slope()) -> State:
        """Return a state with histories as they are at first, and no pairs, unless it has some."""
        pool, dtype = pool_of(scene.mj_model), state.qpos.dtype
        first = np.concatenate([pool.first[name] for name in MOTION[3:]])
        history = state.history if state.history.size == first.size else jnp.asarray(first, dtype)
        nothing = [jnp.zeros(shape, dtype) for shape in (pool.flight_shape, pool.flight_shape[:1])]
        pairs = state.pairs if isinstance(state.pairs, Pairs) else Pairs(*nothing)
        return dataclasses.replace(state, history=history, pairs=pairs)

    def roll_out(self, motion: Motion, state: State, rows: Rows) -> Trajectory:
        """Return the rollout under controls or a policy; the last good state is held."""
        scene, contact, observe = motion.scene, motion.contact, motion.observe
        given, state, seen = state, self.complete(scene, state), None
        if motion.policy is None:
            found, history = _course(scene, state, rows.controls + rows.noise, rows.inputs, contact.gradient)
        else:
            found, history, seen = _closed(motion, state, rows)
        observations = None if observe is None else _observations(scene, state, found, history, rows.inputs, observe)
        # What a scan carries has to look as it did.
        final = found.final if given.pairs is not None else dataclasses.replace(found.final, pairs=None)
        final = final if given.history.size == final.history.size else dataclasses.replace(final, history=given.history)
        return dataclasses.replace(found, final=final, observations=observations, seen=seen)

    def look(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, observe: Observe, contact: Contact
    ) -> PyTree:
        """Return what a function of model and data sees: sensors, and places of bodies, geoms and sites; the rest is NaN."""
        return _observed(scene, self.complete(scene, state), ctrl, inputs, observe)

    def linearise(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact
    ) -> tuple[Array, Array, Array, Array]:
        start, inputs = self._held(scene, state, ctrl, 1)
        A, B, C, D = rule.linearise(scene, start, inputs, gradient=contact.gradient)
        size = 2 * scene.model.nv + scene.model.na  # histories of delays come after
        return A[:size, :size], B[:size], C[:, :size], D

    def hold(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact) -> State:
        start, inputs = self._held(scene, state, ctrl, num_steps)
        found = rule.roll_out(scene, changed_numbers(scene), start, inputs, contact.gradient)
        parts = {name: found[name][-1] for name in ("qpos", "qvel", "act")}
        return dataclasses.replace(state, **parts)

    def product(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact
    ) -> tuple[Float[Array, " state"], Float[Array, "changes both"]]:
        """Return the state after a control was held, NaN if it is not finite, and the derivative by state and control."""
        start, inputs = self._held(scene, state, ctrl, num_steps)
        found = rule.product(scene, start, inputs, gradient=contact.gradient)
        size = 2 * scene.model.nv + scene.model.na
        matrix = jnp.concatenate([found["state"][:size, :size], found["ctrl"][:size]], axis=1)
        return found["end"][: scene.model.nq + scene.model.nv + scene.model.na], matrix

    def steer(self, scene: Scene, state: State, num_steps: int, **law: Array) -> tuple[Array, Array]:
        """Return states and controls under a feedback law, see `engines.pool.Pool.steer`."""
        start, resting = _arguments(scene, self.complete(scene, state))
        return rule.steer(scene, {"time": start["time"], **resting}, law, num_steps)

    def _held(self, scene: Scene, state: State, ctrl: Array, num_steps: int) -> tuple[Inputs, Inputs]:
        start, resting = _arguments(scene, self.complete(scene, state))
        return start, jax.tree.map(lambda x: jnp.stack([x] * num_steps), resting | {"ctrl": ctrl})


def _arguments(scene: Scene, state: State) -> tuple[Inputs, Inputs]:
    """Return a complete state, and the scene's inputs beside controls where they are not those of its file."""
    pool = pool_of(scene.mj_model)
    size = pool.first["history"].size
    start = {"time": jnp.asarray(state.time)[None], "qpos": state.qpos, "qvel": state.qvel, "act": state.act}
    start |= {"history": state.history[:size], "plugin": state.history[size:]}
    given = {name: getattr(scene.data, name) for name in INPUTS[1:]}
    is_own = lambda name: is_known(given[name]) and np.array_equal(given[name], getattr(pool.start, name))  # noqa: E731
    return start, {name: value for name, value in given.items() if value.size and not is_own(name)}


def _closed(motion: Motion, state: State, rows: Rows) -> tuple[Trajectory, Float[Array, "states _"], PyTree]:
    """Return the motion under a policy, step by step, what else goes on, and what the policy saw."""
    scene, contact, policy, looks = motion.scene, motion.contact, motion.policy, motion.policy_sees == "observations"
    assert policy is not None

    def advance(carry: tuple[State, Array, Array], given: tuple[Array, Rows]) -> tuple:
        state, first_bad, before = carry
        index, row = given
        seen = None
        if looks and motion.observe is not None:
            seen = _observed(scene, state, before, row.inputs, motion.observe)
        ctrl = one_each(policy(motion.params, seen if looks else state), scene.model.nu) + row.noise
        one, _ = _course(scene, state, ctrl[None], jax.tree.map(lambda x: x[None], row.inputs), contact.gradient)
        first_bad = jnp.where((first_bad < 0) & one.diverged, index, first_bad)
        moved = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, one.final)
        states = (state.qpos, state.qvel, state.act, state.history)
        return (moved, first_bad, ctrl.astype(before.dtype)), (states, ctrl, seen)

    first, steps = (state, jnp.int32(-1), scene.data.ctrl), jnp.arange(len(rows.noise), dtype=jnp.int32)
    (final, first_bad, _), (states, ctrl, seen) = jax.lax.scan(advance, first, (steps, rows))
    last = (final.qpos, final.qvel, final.act, final.history)
    states = [jnp.concatenate([x, end[None]]) for x, end in zip(states, last, strict=True)]
    found = Trajectory(*states[:2], ctrl, None, final, first_bad >= 0, first_bad, act=states[2])  # pyright: ignore[reportCallIssue]
    return found, states[3], seen


class _Fixed:
    """A scene whose numbers are those of its C model, but for some: programs for it are compiled once, and need no others."""

    # A call of C MuJoCo from a program takes a twentieth of a millisecond for each array that it is given; a model has a hundred.

    def __init__(self, scene: Scene, changed: Iterable[str]):
        self.scene, self.key = scene, (id(scene.mj_model), frozenset(changed))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Fixed) and other.scene.mj_model is self.scene.mj_model and other.key == self.key


def _course(
    scene: Scene, state: State, ctrl: Float[Array, "horizon nu"], inputs: Inputs, gradient: Gradient
) -> tuple[Trajectory, Float[Array, "states _"]]:
    """Return the motion under known controls, and what else goes on: one call of C MuJoCo."""
    numbers, (start, resting) = changed_numbers(scene), _arguments(scene, state)
    return _steps(_Fixed(scene, numbers), numbers, start, resting | inputs, state, ctrl, gradient)


@eqx.filter_jit
def _steps(
    fixed: _Fixed, numbers: Inputs, start: Inputs, inputs: Inputs, state: State, ctrl: Float[Array, "horizon nu"],
    gradient: Gradient,
) -> tuple[Trajectory, Float[Array, "states _"]]:  # fmt: skip
    is_finite = jnp.abs(ctrl) <= mujoco.mjMAXVAL  # MuJoCo replaces others by zero
    assert state.pairs is not None
    start |= {"warmstart": state.warmstart, "flight": state.pairs.flight, "held": state.pairs.held}
    shapes = {name: (len(ctrl), *np.shape(getattr(fixed.scene.data, name))) for name in inputs}
    given = {name: jnp.broadcast_to(value, shapes[name]) for name, value in inputs.items()}
    given["ctrl"] = jnp.where(is_finite, ctrl, 0.0)
    found = rule.roll_out(fixed.scene, numbers, start, given, gradient)
    qpos, qvel, act = (jnp.concatenate([getattr(state, k)[None], found[k]]) for k in ("qpos", "qvel", "act"))
    history = jnp.concatenate([state.history[None], jnp.concatenate([found["history"], found["plugin"]], axis=1)])
    is_good = jax.vmap(is_sound)(qpos, qvel, act)
    is_bad = ~(is_good[1:] & jnp.all(is_finite, axis=1))
    first_bad = jnp.where(jnp.any(is_bad), jnp.argmax(is_bad).astype(jnp.int32), -1)
    kept = jnp.arange(len(ctrl) + 1)
    kept = jnp.where(first_bad >= 0, jnp.minimum(kept, first_bad), kept)
    qpos, qvel, act, history = (x[kept] for x in (qpos, qvel, act, history))
    timestep: Any = numbers.get("opt.timestep", fixed.scene.mj_model.opt.timestep)
    time = state.time + timestep * kept[-1]
    pairs = Pairs(found["flight"], found["held"])
    pairs = jax.tree.map(lambda x: jnp.where(first_bad >= 0, 0.0, x), pairs)
    final = State(qpos[-1], qvel[-1], act[-1], time, found["warmstart"], history[-1], pairs)
    return Trajectory(qpos, qvel, ctrl, None, final, first_bad >= 0, first_bad, act=act), history  # pyright: ignore[reportCallIssue]


def _observations(
    scene: Scene, start: State, found: Trajectory, history: Float[Array, "states _"], inputs: Inputs, observe: Observe
) -> PyTree:
    """Return what is observed in each state of a motion, the last one under the last control."""
    assert found.act is not None
    steps = jnp.minimum(jnp.arange(len(found.qpos)), len(found.ctrl) - 1)
    time = start.time + scene.model.opt.timestep * jnp.arange(len(found.qpos))
    states = jax.vmap(State)(found.qpos, found.qvel, found.act, time, jnp.zeros_like(found.qvel), history)
    look = lambda state, ctrl, row: _observed(scene, state, ctrl, row, observe)  # noqa: E731
    return jax.vmap(look)(states, found.ctrl[steps], jax.tree.map(lambda x: x[steps], inputs))


def _observed(scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, observe: Observe) -> PyTree:
    """Return what a function of model and data sees in a state under a control: sensors, and places of bodies, geoms, sites."""
    start, resting = _arguments(scene, state)
    given = {name: value[None] for name, value in (resting | inputs | {"ctrl": ctrl}).items()}
    readings = rule.sense(scene, {name: value[None] for name, value in start.items()}, given)[0]
    return observed(scene, state, ctrl, inputs, readings, observe)


def observed(
    scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, readings: Float[Array, " sensors"], observe: Observe
) -> PyTree:  # fmt: skip
    """Return what a function of model and data sees where the readings of sensors are known, and places by kinematics."""
    known = {"qpos": state.qpos, "qvel": state.qvel, "act": state.act, "ctrl": ctrl, "time": state.time, **inputs}
    at = data_of(scene, state, ctrl).replace(**inputs)
    known |= _places(scene.model, at) | {"sensordata": readings}

    def unknown(value: Any) -> Any:
        is_number = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)
        return jnp.full_like(value, jnp.nan) if is_number else value

    # Forces and accelerations that only MuJoCo has would be zeros of the template.
    data: mjx.Data = jax.tree.map(unknown, scene.data).replace(**known, _impl=_Unknown())
    return observe(scene.model.replace(sensor_needstage=scene.mj_model.sensor_needstage), data)  # pyright: ignore[reportCallIssue]


# Operation by operation 200 small programs would be compiled instead of this one.
@eqx.filter_jit
def _places(model: mjx.Model, data: mjx.Data) -> dict[str, Array]:
    placed = com_pos(model, kinematics(model, data))
    return {name: getattr(placed, name) for name in _PLACES if hasattr(placed, name)}
