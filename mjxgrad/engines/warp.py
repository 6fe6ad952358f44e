"""MuJoCo Warp, by MJX's bridge: nearly any scene, for thousands of states at once on NVIDIA GPUs, in single precision.

It has no derivative of its own. A step's derivative is by central differences of whole steps: every column is two more worlds of
the same call. Rounding wants other widths for positions, which curve, than for velocities and inputs, which hardly do. Reverse
mode keeps states alone and makes the columns again, as many at a time as memory takes.
"""

import dataclasses
import functools
import logging
import sys
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.engines.engine import Inputs, Motion, Observe, Rows
from mjxgrad.engines.mjx import MJX, Moving, Scan, roll_out
from mjxgrad.engines.mujoco import observed
from mjxgrad.engines.state import State, Trajectory, state_of
from mjxgrad.scene import Scene, SceneError
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Contact, Discrete

_POSITION, _OTHER = 3e-5, 1e-3  # widths of differences (m or rad; m/s, rad/s or the unit of an input)
_AT_ONCE = 2**32  # bytes of the worlds that are stepped in one call
_ROOM = 48  # contacts of a world, unless `max_contacts` says
_TILE = 64  # Warp reads rows in blocks of so many, beyond the end if they do not fit
_MOTION = ("qpos", "qvel", "act")
_INPUTS = ("qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat")
_VARIED = (*_MOTION, "ctrl", *_INPUTS)  # by which there are derivatives
_GIVEN = (*_VARIED, "qacc_warmstart", "time")
_NUMBER = "model."  # before the names of the model's numbers that are not those of its file
# Bits of Warp's overflow: iterations of the solver and of its line search; others are of room.
_INEXACT = 1 << 9 | 1 << 10
_Values = dict[str, Array]


class Warp(MJX):
    """MuJoCo Warp; see `engines.engine.Engine`. What it shares with MJX is the loop over steps."""

    title: ClassVar[str] = "MuJoCo Warp"
    contacts: ClassVar[tuple[type, ...]] = (Discrete,)

    def complete(self, scene: Scene, state: State, contact: Contact) -> State:
        return state

    def roll_out(self, motion: Motion, state: State, rows: Rows) -> Trajectory:
        return roll_out(motion, state, rows, _Scan)

    def hold(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact) -> State:
        rows = Rows(jnp.broadcast_to(ctrl, (num_steps, len(ctrl))), jnp.zeros((num_steps, len(ctrl))), {})
        return self.roll_out(Motion(scene, None, None, None, "state", True, contact), state, rows).final

    def look(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, observe: Observe, contact: Contact
    ) -> PyTree:
        readings = _step(scene, state, ctrl, inputs)["sensordata"]
        return observed(scene, state, ctrl, inputs, readings, observe)

    def linearise(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact
    ) -> tuple[Array, Array, Array, Array]:
        worlds, given = worlds_of(scene.mj_model, scene.max_contacts), _given(scene, state, ctrl, {})
        matrix = worlds.derivative(given, tuple(name for name in (*_MOTION, "ctrl") if given[name].size))
        size = 2 * scene.model.nv + scene.model.na
        A, C = jnp.split(matrix[:, :size], [size])
        B, D = jnp.split(matrix[:, size:], [size])
        return A, B, C, D


class _Scan(Scan):
    """The loop of a rollout by Warp."""

    def step(self, moving: Moving, data: mjx.Data) -> tuple[Any, Moving]:
        found = _step(self.scene, state_of(data), data.ctrl, {name: getattr(data, name) for name in _INPUTS})
        parts = {name: found[name] for name in _MOTION} | {"time": found["time"], "warmstart": found["qacc_warmstart"]}
        return found, Moving(dataclasses.replace(moving.state, **parts), None)

    def troubles(self, stepped: _Values) -> tuple[Array, Array]:
        overflow = stepped["overflow"]
        return (overflow & _INEXACT) > 0, (overflow & ~_INEXACT) > 0

    def look(self, state: State, ctrl: Array, forces: dict, stepped: _Values | None = None) -> PyTree:
        if self.observe is None:
            return None
        found = _step(self.scene, state, ctrl, forces) if stepped is None else stepped
        return observed(self.scene, state, ctrl, forces, found["sensordata"], self.observe)


class Worlds:
    """Steps of many worlds of one C model, and their differences."""

    def __init__(self, mj_model: mujoco.MjModel, room: int | None):
        self.mj_model, self._room = mj_model, room or _ROOM
        dims = np.concatenate([mj_model.geom_condim, mj_model.pair_dim, [1]])
        self._rows = mj_model.nv + 6 * mj_model.neq + mj_model.njnt + 2 * mj_model.ntendon
        self._rows += self._room * max(1, 2 * (int(dims.max()) - 1))
        self._rows = -(-self._rows // _TILE) * _TILE
        warp = sys.modules.get("warp")
        if warp:
            warp.config.log_level = max(warp.config.log_level, logging.WARNING)  # a library must not print
        try:
            with jax.ensure_compile_time_eval():  # also within a traced function
                self._model = mjx.put_model(mj_model, impl="warp", graph_mode=warp and warp.JaxCallableGraphMode.NONE)
            self._size = sum(x.nbytes for x in jax.tree.leaves(self._data(1)) if eqx.is_array(x))
        except (NotImplementedError, RuntimeError) as error:
            raise SceneError(f"MuJoCo Warp cannot step it: {error}") from error
        self._run = custom_vmap(self._once)
        self._run.def_vmap(self._batched)
        self.step = jax.custom_jvp(self._step)
        self.step.defjvp(self._derived, symbolic_zeros=True)

    def _data(self, count: int) -> mjx.Data:
        with jax.ensure_compile_time_eval():
            return mjx.make_data(self.mj_model, impl="warp", naconmax=count * self._room, njmax=self._rows)

    def _once(self, given: _Values) -> _Values:
        """Return the next states of worlds, which are the leading axis."""
        count = len(given["qpos"])
        most = max(1, _AT_ONCE // self._size)
        if count > most:
            num = -(-count // most)
            each = -(-count // num)
            padded = {
                k: jnp.pad(x, [(0, num * each - count)] + [(0, 0)] * (x.ndim - 1), mode="edge")
                for k, x in given.items()
            }
            parts = {k: x.reshape(num, each, *x.shape[1:]) for k, x in padded.items()}
            found = jax.lax.map(self._once, parts)
            return {k: x.reshape(num * each, *x.shape[2:])[:count] for k, x in found.items()}
        data = self._data(count)
        single = {k: x.astype(jnp.float32) for k, x in given.items()}

        def one(given: _Values) -> mjx.Data:
            numbers: Any = {k.removeprefix(_NUMBER): x for k, x in given.items() if k.startswith(_NUMBER)}
            state = {k: x for k, x in given.items() if k in _GIVEN}
            return mjx.step(self._model.tree_replace(numbers) if numbers else self._model, data.replace(**state))

        after = jax.vmap(one)(single)
        dtype = given["qpos"].dtype
        found = {k: getattr(after, k).astype(dtype) for k in (*_MOTION, "time", "qacc_warmstart", "sensordata")}
        return found | {"overflow": after._impl.overflow.reshape(count)}

    def _batched(self, size: int, is_batched: list, given: _Values) -> tuple[_Values, dict]:
        (flags,) = is_batched
        whole = {k: x if flags[k] else jnp.broadcast_to(x, (size, *x.shape)) for k, x in given.items()}
        found = self._run({k: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]) for k, x in whole.items()})
        found = {k: x.reshape(size, len(x) // size, *x.shape[1:]) for k, x in found.items()}
        return found, dict.fromkeys(found, True)

    def _step(self, given: _Values) -> _Values:
        return {k: x[0] for k, x in self._run({k: x[None] for k, x in given.items()}).items()}

    def _derived(self, primals: tuple, tangents: tuple) -> tuple[_Values, dict[str, Any]]:
        (given,), (changes,) = primals, tangents
        found = self.step(given)
        names = tuple(k for k, x in given.items() if x.size and not isinstance(changes[k], SymbolicZero))
        if numbers := [k.removeprefix(_NUMBER) for k in names if k.startswith(_NUMBER)]:
            told = f"MuJoCo Warp has no derivative by {', '.join(numbers)}"
            raise NotImplementedError(f"{told}: take scene.with_engine('mujoco'), or jax.lax.stop_gradient of it")
        names = tuple(k for k in names if k in _VARIED)
        zeros = {
            k: jnp.zeros_like(x) if eqx.is_inexact_array(x) else np.zeros(x.shape, jax.dtypes.float0)
            for k, x in found.items()
        }
        if not names:
            return found, zeros
        parts = [self._to_tangent(given[k], changes[k]) if k == "qpos" else changes[k].reshape(-1) for k in names]
        moved = jnp.matmul(self.derivative(given, names), jnp.concatenate(parts), precision="highest")
        sizes = [self.mj_model.nv, self.mj_model.nv, self.mj_model.na]
        qpos, qvel, act, sensed = jnp.split(moved, np.cumsum(sizes))
        return found, zeros | {
            "qpos": self._from_tangent(found["qpos"], qpos), "qvel": qvel, "act": act, "sensordata": sensed,
        }  # fmt: skip

    def derivative(self, given: _Values, names: tuple[str, ...]) -> Float[Array, "outputs columns"]:
        """Return the derivative of the next state, in tangent space, and of readings by what is given, by central differences."""
        dtype, points, widths = given["qpos"].dtype, [], []
        given = {k: jax.lax.stop_gradient(x).astype(jnp.float32) for k, x in given.items()}  # so that widths are Warp's
        for name in names:
            size = self.mj_model.nv if name == "qpos" else given[name].size
            away = (_POSITION if name == "qpos" else _OTHER) * jnp.eye(size, dtype=jnp.float32)
            ends = [self._moved(given, name, sign * away) for sign in (1.0, -1.0)]
            widths.append(self._apart(name, ends[0], ends[1]))
            points += [
                {k: jnp.broadcast_to(x, (size, *x.shape)) for k, x in given.items()} | {name: end} for end in ends
            ]
        found = self._run({k: jnp.concatenate([one[k] for one in points]) for k in given})
        ends = np.cumsum([0] + [len(one["qpos"]) for one in points])
        columns = []
        for i, width in enumerate(widths):
            after, before = ({k: x[ends[j] : ends[j + 1]] for k, x in found.items()} for j in (2 * i, 2 * i + 1))
            apart = [jax.vmap(self._to_tangent)(before["qpos"], after["qpos"] - before["qpos"])]
            apart += [after[k] - before[k] for k in ("qvel", "act", "sensordata")]
            columns.append(jnp.concatenate(apart, axis=1) / width[:, None])
        return jnp.concatenate(columns).T.astype(dtype)

    def _moved(self, given: _Values, name: str, changes: Float[Array, "columns size"]) -> Array:
        if name != "qpos":
            return given[name] + changes.reshape(-1, *given[name].shape)
        return given["qpos"] + jax.vmap(functools.partial(self._from_tangent, given["qpos"]))(changes)

    def _apart(self, name: str, after: Array, before: Array) -> Float[Array, " columns"]:
        """Return how far apart points are that were rounded."""
        if name != "qpos":
            return jnp.sum((after - before).reshape(len(after), -1), axis=1)
        return jnp.diagonal(jax.vmap(self._to_tangent)(before, after - before))

    def _to_tangent(self, qpos: Float[Array, " nq"], change: Float[Array, " nq"]) -> Float[Array, " nv"]:
        """Return a small change of positions in tangent space."""
        return jax.jvp(functools.partial(position_change, self.mj_model, qpos), (qpos,), (change,))[1]

    def _from_tangent(self, qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
        """Return a small change in tangent space as one of positions."""
        moved = lambda change: integrate_position(self.mj_model, qpos, change, 1.0)  # noqa: E731
        return jax.jvp(moved, (jnp.zeros_like(change),), (change,))[1]


@functools.lru_cache(maxsize=16)
def worlds_of(mj_model: mujoco.MjModel, room: int | None) -> Worlds:
    """Return the worlds of a C model, with room for so many contacts each."""
    return Worlds(mj_model, room)


def _given(scene: Scene, state: State, ctrl: Array, inputs: Inputs) -> _Values:
    found = {name: getattr(scene.data, name) for name in _INPUTS} | inputs
    found |= {name: getattr(state, name) for name in _MOTION}
    found |= {"ctrl": ctrl, "qacc_warmstart": state.warmstart, "time": state.time}
    numbers = {_NUMBER + name: value for name, value in changed_numbers(scene).items()}
    return {name: jnp.asarray(x) for name, x in ({k: found[k] for k in _GIVEN} | numbers).items()}


def _step(scene: Scene, state: State, ctrl: Array, inputs: Inputs) -> _Values:
    return worlds_of(scene.mj_model, scene.max_contacts).step(_given(scene, state, ctrl, inputs))
