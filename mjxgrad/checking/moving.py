"""Batches of motions with their derivatives along one direction, by C MuJoCo or MJX, for all measurements.

C MuJoCo propagates a tangent step by step without compilation: a quadruped takes seconds. MJX's step is the one that a GPU
runs; its derivatives compile for a minute. Contact parameters are arguments of both.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.batched import device
from mjxgrad.native.derivative import to_coordinates, to_tangent
from mjxgrad.native.engine import engine_of
from mjxgrad.objective.task import finite_cost
from mjxgrad.rollouts import State, Trajectory, rollout
from mjxgrad.scene import Scene
from mjxgrad.stepping import own_motion

Kind = Literal["slope", "discrete", "fine"]
KINDS: tuple[Kind, ...] = ("slope", "discrete")
"""Kind of derivative of MuJoCo's motion; "fine" is the motion at a `REFINED` times shorter time step, without derivatives."""
REFINED = 4
CONTACT_FIELDS = ("geom_solref", "geom_solimp", "pair_solref", "pair_solimp")
# XLA's optimisation level 1 halves the time to compile (hopper, jax 0.10.2: 12 s in place of 24); the code is as fast.
_OPTIONS = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
_TINY = 1e-5  # m, rad: step of a central difference through the exponential map; its error is second order
_VELOCITY_LIMIT = 1e4

Outcomes = Callable[[Trajectory], Float[Array, " outcomes"]]


@dataclass(frozen=True)
class Direction:
    """A change of a motion: of its initial positions (m, rad) and velocities (m/s, rad/s), and of its controls."""

    positions: Float[np.ndarray, " nv"]
    velocities: Float[np.ndarray, " nv"]
    controls: Float[np.ndarray, "steps nu"]

    @property
    def moves_start(self) -> bool:
        """Whether it changes the start at all."""
        return bool(self.positions.any() or self.velocities.any())


@dataclass(frozen=True)
class Moved:
    """Outcomes of a batch of motions at several times, and their derivatives along a direction.

    Attributes:
        outcomes: outcomes; NaN for motions that diverged.
        derivatives: derivatives along the direction; NaN for motions that diverged.
        growth: growth of the tangent of the state relative to the start.
        num_diverged: number of motions that diverged.
    """

    outcomes: Float[np.ndarray, "motions times outcomes"]
    derivatives: Float[np.ndarray, "motions times outcomes"]
    growth: Float[np.ndarray, "motions times"]
    num_diverged: int

    def where(self, is_felt: Bool[np.ndarray, "times outcomes"]) -> "Moved":
        """Return the same with insensitive outcomes as constants: rounding has jumps and slopes of its own."""
        mean = np.nansum(self.outcomes, axis=0) / np.maximum(np.isfinite(self.outcomes).sum(axis=0), 1)
        kept = is_felt | np.isnan(self.outcomes)
        return dataclasses.replace(self, outcomes=np.where(kept, self.outcomes, mean))


@dataclass
class Mover:
    """Simulator of batches of motions in a scene.

    Attributes:
        scene: the scene.
        size: number of motions in a batch.
        outcomes: function from a trajectory to its outcomes.
        end: latest start of a batch, by `time.perf_counter`.
        engine: "mujoco" or "mjx".
    """

    scene: Scene
    size: int
    outcomes: Outcomes
    end: float = math.inf
    engine: Literal["mjx", "mujoco"] = "mujoco"

    def __post_init__(self):
        self.contact = contact_of(self.scene.model)
        self._judges: dict[tuple[int, ...], Callable] = {}
        self._compiled: dict[tuple[str, int], Callable] = {}
        self._num_steps, self._seconds = 0, 0.0

    @property
    def step_seconds(self) -> float:
        """The mean duration of a step of a batch so far."""
        return self._seconds / max(self._num_steps, 1)

    def move(
        self,
        kind: Kind,
        states: State,
        controls: Float[np.ndarray, "motions steps nu"],
        direction: Direction,
        lengths: Sequence[int],
        contact: dict[str, Array] | None = None,
    ) -> Moved:
        """Simulate a batch with its tangent along a direction, and return the outcomes after the given steps.

        Raises:
            TimeoutError: after `end`.
        """
        if time.perf_counter() > self.end:
            raise TimeoutError
        start = {k: np.asarray(getattr(states, k), float) for k in ("qpos", "qvel", "act")}
        num, steps = len(controls), lengths[-1]
        controls = np.asarray(controls, float)[:, :steps]
        pushes = np.broadcast_to(direction.controls[:steps], controls.shape)
        change = np.concatenate([direction.positions, direction.velocities, np.zeros(start["act"].shape[1])])
        contact = self.contact if contact is None else contact
        by = self._by_mjx if self.engine == "mjx" and kind != "fine" else self._by_mujoco
        started = time.perf_counter()
        path, course = by(kind, start, controls, (np.tile(change, (num, 1)), pushes), contact)
        self._num_steps, self._seconds = self._num_steps + steps, self._seconds + time.perf_counter() - started
        bad = ~np.all(np.abs(np.nan_to_num(path[1], nan=np.inf)) < _VELOCITY_LIMIT, axis=(1, 2))
        path = [np.concatenate([start[k][:, None], x], axis=1) for k, x in zip(start, path, strict=True)]
        path = [np.where(bad[:, None, None], part[:, :1], part) for part in path]
        nv = self.scene.model.nv
        course = np.concatenate([np.tile(change, (num, 1, 1)), np.where(bad[:, None, None], 0.0, course)], axis=1)
        coordinates = self._turned(to_coordinates, path[0], course[..., :nv])
        outcomes, derivatives = self._judge(tuple(lengths))(
            (*path, controls, bad), (coordinates, course[..., nv : 2 * nv], course[..., 2 * nv :], pushes)
        )
        size = np.linalg.norm(course[:, list(lengths)], axis=2)
        first = np.linalg.norm(change)
        return Moved(np.asarray(outcomes), np.asarray(derivatives), size / (first or 1.0), int(bad.sum()))

    def _by_mujoco(self, kind: Kind, start: dict, controls: np.ndarray, changes: tuple, contact: dict) -> tuple:
        """Return the path and its tangent, by C MuJoCo."""
        # The batch shares them, without a leading axis.
        engine, numbers = engine_of(self.scene.mj_model), {k: np.asarray(v)[None] for k, v in contact.items()}
        given = {"time": np.zeros((len(controls), 1)), **start}
        if kind == "fine":
            numbers["opt.timestep"] = np.asarray(self.scene.model.opt.timestep)[None] / REFINED
            found = engine.run(numbers, given, {"ctrl": np.repeat(controls, REFINED, axis=1)})
            path = [found[k][:, REFINED - 1 :: REFINED] for k in start]
            return path, np.full((*controls.shape[:2], changes[0].shape[1]), np.nan)
        found = engine.follow(kind, numbers, given, {"ctrl": controls}, changes)
        return [found[k] for k in start], found["change"]

    def _by_mjx(self, kind: Kind, start: dict, controls: np.ndarray, changes: tuple, contact: dict) -> tuple:
        """Return the path and its tangent by MJX's step; compiled once for each kind and number of steps."""
        scene, nv, dtype = self.scene, self.scene.model.nv, self.scene.data.qpos.dtype
        moves = change_of_poses(scene.mj_model, start["qpos"], changes[0][0, :nv])
        tangents = (moves, changes[0][:, nv : 2 * nv], changes[0][:, 2 * nv :], changes[1])

        def one(contact: dict, primals: tuple, tangents: tuple) -> tuple:
            def run(qpos: Array, qvel: Array, act: Array, ctrl: Array) -> tuple:
                state = State(qpos, qvel, act, jnp.zeros((), dtype), jnp.zeros_like(qvel))
                course = rollout(
                    eqx.tree_at(lambda s: s.model, scene, scene.model.replace(**contact)),
                    state,
                    ctrl,
                    contact=own_motion(kind, "mjx"),
                    checkpoint=False,
                )
                return course.qpos[1:], course.qvel[1:], jnp.asarray(course.act)[1:]

            return jax.jvp(run, primals, tangents)

        given = jax.tree.map(lambda x: jnp.asarray(x, dtype), ((*start.values(), controls), tangents))
        key = (kind, controls.shape[1])
        if key not in self._compiled:
            lowered = jax.jit(jax.vmap(one, in_axes=(None, 0, 0))).lower(contact, *given)
            self._compiled[key] = lowered.compile(compiler_options=compiler_options())
        path, (turned, *rest) = jax.tree.map(lambda x: np.asarray(x, float), self._compiled[key](contact, *given))
        return list(path), np.concatenate([self._turned(to_tangent, path[0], turned), *rest], axis=2)

    def _turned(self, convert: Callable, qpos: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return the tangents of poses as changes of coordinates, or the reverse."""
        if self.scene.model.nq == self.scene.model.nv:
            return change
        return np.asarray(_over_all(convert, self.scene, jnp.asarray(qpos), jnp.asarray(change, qpos.dtype)))

    def _judge(self, lengths: tuple[int, ...]) -> Callable:
        """Return a compiled function from a batch of motions and tangents to outcomes and their derivatives."""
        if lengths in self._judges:
            return self._judges[lengths]

        def at_all(bad: Bool[Array, ""], qpos: Array, qvel: Array, act: Array, controls: Array) -> Array:
            found = []
            for length in lengths:
                trajectory = Trajectory(
                    qpos[: length + 1],
                    qvel[: length + 1],
                    controls[:length],
                    observations=None,
                    final=State(qpos[length], qvel[length], act[length], jnp.zeros(()), jnp.zeros_like(qvel[0])),
                    diverged=bad,
                    first_bad_step=jnp.where(bad, 0, -1),
                    act=act[: length + 1],
                )
                found.append(jax.vmap(lambda one, t=trajectory: finite_cost(one, t))(self.outcomes(trajectory)))
            return jnp.stack(found)

        def one(motion: tuple, change: tuple) -> tuple[Array, Array]:
            qpos, qvel, act, controls, bad = motion
            return jax.jvp(lambda *parts: at_all(bad, *parts), (qpos, qvel, act, controls), change)

        return self._judges.setdefault(lengths, jax.jit(jax.vmap(one)))


@eqx.filter_jit
def _over_all(convert: Callable, scene: Scene, qpos: Float[Array, "a b nq"], change: Float[Array, "a b _"]) -> Array:
    return jax.vmap(jax.vmap(lambda q, v: convert(scene, q, v)))(qpos, change)


def moved(
    model: mujoco.MjModel,
    qpos: Float[ArrayLike, "motions nq"],
    positions: Float[np.ndarray, " nv"],
    places: Float[np.ndarray, " motions"] | float,
) -> Float[np.ndarray, "motions nq"]:
    """Return poses moved along a change of positions, with quaternions by the exponential map."""
    found = np.array(qpos, float)
    for one, place in zip(found, np.broadcast_to(places, len(found)), strict=True):
        mujoco.mj_integratePos(model, one, positions, float(place))
    return found


def change_of_poses(
    model: mujoco.MjModel, qpos: Float[ArrayLike, "motions nq"], positions: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, "motions nq"]:
    """Return the derivative of `moved` with respect to the place, at zero."""
    below, above = (moved(model, qpos, positions, x) for x in (-_TINY, _TINY))
    return (above - below) / (2 * _TINY)


def contact_of(model: mjx.Model) -> dict[str, Array]:
    """Return the fields of a model that `Softness` changes, except margins."""
    return {name: jnp.asarray(getattr(model, name)) for name in CONTACT_FIELDS}


def compiler_options() -> dict | None:
    """Return options that halve XLA's compile time, where known."""
    is_known = device.is_cpu() and jax.__version_info__ < (0, 11)
    return _OPTIONS if is_known else None
