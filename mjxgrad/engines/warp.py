"""MuJoCo Warp, by MJX's bridge: nearly any scene, for thousands of states at once on NVIDIA GPUs, in single precision.

It has no derivative of its own. A step's derivative is by differences of whole steps: every column is one more world of the same
call, or two by positions, where the step curves; by velocities and inputs it hardly does, and takes wider differences. Reverse
mode keeps states alone and makes the columns again, as many at a time as memory takes. The slope is that of `stepping.pairs`; its
contacts and limits are those of a second model, in which they act at larger gaps.
"""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad.engines.bridge import NUMBER, Values
from mjxgrad.engines.engine import Inputs, Motion, Observe, Rows
from mjxgrad.engines.mjx import MJX, Moving, Scan, roll_out
from mjxgrad.engines.mujoco import observed
from mjxgrad.engines.state import State, Trajectory, state_of
from mjxgrad.engines.worlds import GIVEN, INPUTS, Worlds, worlds_of
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Contact, Discrete, Slope, pairs

# Bits of Warp's overflow: iterations of the solver and of its line search; others are of room.
_INEXACT = 1 << 9 | 1 << 10


class Warp(MJX):
    """MuJoCo Warp; see `engines.engine.Engine`. What it shares with MJX is the loop over steps."""

    title: ClassVar[str] = "MuJoCo Warp"
    contacts: ClassVar[tuple[type, ...]] = (Discrete, Slope)

    def roll_out(self, motion: Motion, state: State, rows: Rows) -> Trajectory:
        return roll_out(motion, state, rows, _Scan)

    def hold(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact) -> State:
        rows = Rows(jnp.broadcast_to(ctrl, (num_steps, len(ctrl))), jnp.zeros((num_steps, len(ctrl))), {})
        return self.roll_out(Motion(scene, None, None, None, "state", True, contact), state, rows).final

    def look(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, observe: Observe, contact: Contact
    ) -> PyTree:
        readings = _Program(scene, _world(scene, state, ctrl, inputs)).found().sensordata
        return observed(scene, state, ctrl, inputs, readings, observe)

    def after(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact) -> "World":
        program = _Program(scene, _world(scene, state, ctrl, {}))
        if isinstance(contact, Discrete):
            return program.found()
        moved, flight = pairs.follow(program, pairs.no_flight(scene.model, scene.data))
        return pairs.put(moved, pairs.whole(scene.model, pairs.taken(moved), flight))


class World(eqx.Module):
    """All that a step takes and finds; or, of each of these, whether it has a derivative."""

    qpos: Any
    qvel: Any
    act: Any
    ctrl: Any
    qfrc_applied: Any
    xfrc_applied: Any
    mocap_pos: Any
    mocap_quat: Any
    qacc_warmstart: Any
    time: Any
    sensordata: Any = None
    overflow: Any = None  # bits of `_INEXACT`, and of what lacked room

    def replace(self, **changes: Any) -> "World":
        return dataclasses.replace(self, **changes)


class _Scan(Scan):
    """The loop of a rollout by Warp."""

    def step(self, moving: Moving, data: mjx.Data) -> tuple[World, Moving]:
        inputs = {name: getattr(data, name) for name in INPUTS}
        program, flight = _Program(self.scene, _world(self.scene, state_of(data), data.ctrl, inputs)), moving.flight
        if flight is None:
            found = program.found()
        else:
            found, flight = pairs.follow(program, flight)
        return found, Moving(State(found.qpos, found.qvel, found.act, found.time, found.qacc_warmstart), flight)

    def troubles(self, stepped: World) -> tuple[Array, Array]:
        return (stepped.overflow & _INEXACT) > 0, (stepped.overflow & ~_INEXACT) > 0

    def look(self, state: State, ctrl: Array, forces: dict, stepped: World | None = None) -> PyTree:
        if self.observe is None:
            return None
        if stepped is None:
            return Warp().look(self.scene, state, ctrl, forces, self.observe, self.contact)
        return observed(self.scene, state, ctrl, forces, stepped.sensordata, self.observe)


class _Program(pairs.Program):
    """A step by Warp, and what is near its state."""

    def __init__(self, scene: Scene, world: World):
        self._scene = scene
        super().__init__(scene.model, world, is_single=True)

    def found(self) -> World:
        """Return what a step finds."""
        return self.advance(*self.all_of(self.given))

    def advance(self, model: mjx.Model, data: World) -> World:
        scene = dataclasses.replace(self._scene, model=model)
        return data.replace(**_worlds(scene).step(_values(scene, data)))

    def near(self, model: mjx.Model, data: World) -> pairs.Gaps | None:
        scene = dataclasses.replace(self._scene, model=model)
        return _worlds(scene).near(_values(scene, data)) if _worlds(scene).has_surfaces else None

    def near_after(self, given: tuple, ends: World) -> pairs.Gaps | None:
        return self.rows(given)

    def gap_rates(self, given: tuple, tangents: tuple, moving: Any) -> Array:
        told = "MuJoCo Warp's slope has no derivative by places of mocap bodies"
        raise NotImplementedError(f"{told}: take mg.Discrete(), or scene.with_engine('mujoco')")


def _world(scene: Scene, state: State, ctrl: Array, inputs: Inputs) -> World:
    found = {name: getattr(scene.data, name) for name in INPUTS} | inputs
    found |= {"qpos": state.qpos, "qvel": state.qvel, "act": state.act, "time": state.time}
    found |= {"ctrl": ctrl, "qacc_warmstart": state.warmstart}
    return World(**{name: jnp.asarray(value) for name, value in found.items()})


def _values(scene: Scene, world: World) -> Values:
    changed, worlds = changed_numbers(scene), _worlds(scene)
    if lost := [name for name in scene.more if not worlds.has(name)]:
        told = f"MuJoCo Warp has no {', '.join(lost)} of its own to change"
        raise NotImplementedError(f"{told}: take scene.with_engine('mujoco')")
    numbers = {NUMBER + name: jnp.asarray(value) for name, value in changed.items()}
    return {name: getattr(world, name) for name in GIVEN} | numbers


def _worlds(scene: Scene) -> Worlds:
    return worlds_of(scene.mj_model, scene.max_contacts)
