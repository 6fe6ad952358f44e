"""Batches of motions with their derivatives along one direction, by C MuJoCo, which compiles nothing."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad.batched import device
from mjxgrad.checking.motions import held, run
from mjxgrad.contact import Softness
from mjxgrad.native.derivative import to_coordinates
from mjxgrad.objective.task import finite_cost
from mjxgrad.rollouts import State, Trajectory
from mjxgrad.scene import Scene

Kind = Literal["slope", "discrete", "fine"]
KINDS: tuple[Kind, ...] = ("slope", "discrete")
"""Kind of derivative of MuJoCo's motion; "fine" is the motion at a `REFINED` times shorter time step, without derivatives."""
REFINED = 4
CONTACT_FIELDS = ("geom_solref", "geom_solimp", "pair_solref", "pair_solimp")
# XLA's optimisation level 1 halves the time to compile (hopper, jax 0.10.2: 12 s in place of 24); the code is as fast.
_OPTIONS = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}

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
    """

    scene: Scene
    size: int
    outcomes: Outcomes
    end: float = math.inf

    def __post_init__(self):
        self._judges: dict[tuple[int, ...], Callable] = {}
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
        softness: Softness | None = None,
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
        follow = None if kind == "fine" else (kind, (np.tile(change, (num, 1)), pushes))
        refined = REFINED if kind == "fine" else 1
        started = time.perf_counter()
        found = run(self.scene, start, controls, softness=softness, refined=refined, follow=follow)
        self._num_steps, self._seconds = self._num_steps + steps, self._seconds + time.perf_counter() - started
        course = found.pop("change", np.full((num, steps, len(change)), np.nan))
        path, bad_steps = held({name: x[:, ::refined] for name, x in found.items()})
        bad = bad_steps >= 0
        course = np.concatenate([np.tile(change, (num, 1, 1)), np.where(bad[:, None, None], 0.0, course)], axis=1)
        outcomes, derivatives = self._judge(tuple(lengths))(bad, (*path.values(), controls), course, pushes)
        growth = np.linalg.norm(course[:, list(lengths)], axis=2) / (np.linalg.norm(change) or 1.0)
        return Moved(np.asarray(outcomes), np.asarray(derivatives), growth, int(bad.sum()))

    def _judge(self, lengths: tuple[int, ...]) -> Callable:
        """Return a compiled function from a batch of motions and tangents to outcomes and their derivatives."""
        if lengths in self._judges:
            return self._judges[lengths]
        nv = self.scene.model.nv

        def at(length: int, bad: Array, qpos: Array, qvel: Array, act: Array, controls: Array) -> Array:
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
            return jax.vmap(lambda one: finite_cost(one, trajectory))(self.outcomes(trajectory))

        def one(bad: Array, motion: tuple[Array, ...], course: Array, pushes: Array) -> tuple[Array, Array]:
            parts = jnp.split(course, (nv, 2 * nv), axis=1)
            parts[0] = jax.vmap(functools.partial(to_coordinates, self.scene))(motion[0], parts[0])
            outcomes = lambda *motion: jnp.stack([at(length, bad, *motion) for length in lengths])  # noqa: E731
            return jax.jvp(outcomes, motion, (*parts, pushes))

        return self._judges.setdefault(lengths, jax.jit(jax.vmap(one)))


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


def compiler_options() -> dict | None:
    """Return options that halve XLA's compile time, where known."""
    is_known = device.is_cpu() and jax.__version_info__ < (0, 11)
    return _OPTIONS if is_known else None
