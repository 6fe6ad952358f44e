"""One compiled program per kind of derivative, from which every measurement is taken.

Compiling a step takes longer than running thousands of it. So there is one program for each of `KINDS`, which takes a
batch of motions, and a change of each, ten steps further. Motions of any length are made of it, and a motion has all
shorter ones within it. Contact parameters are arguments, so that a sweep over softness is no new program. Forward mode along
one direction compiles in half the time of reverse mode, and gives the change of every outcome at every time.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad._rollout import State, Trajectory, initial_state, rollout
from mjxgrad.dynamics import Onset
from mjxgrad.scene import Scene
from mjxgrad.task import finite_cost

CHUNK = 10
"""Steps of one call."""
KINDS = ("onset", "discrete", "event")
"""What may be asked of a step: contacts that begin within it, and MuJoCo's motion with two derivatives; the dearest first."""
CONTACT_FIELDS = ("geom_solref", "geom_solimp", "pair_solref", "pair_solimp")
# XLA's code of the first level: half the time to compile (hopper, jax 0.10.2: 12 s in place of 24) and as fast.
_OPTIONS = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
_WORKERS = 2
_EVENT = 1.5  # times as long as the kind compiled before it takes the event gradient, at most
_TINY = 1e-5  # m, rad: of a central difference through the exponential map of orientations, exact to its square

Outcomes = Callable[[Trajectory], Float[Array, " outcomes"]]


@dataclass(frozen=True)
class Direction:
    """A change of a motion: of the positions (m, rad) and velocities at its start (m/s, rad/s), and of its controls."""

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
        outcomes: NaN for motions that diverged.
        derivatives: likewise.
        growth: how many times longer the change of the state is than at the start.
        num_crowded: motions in which contacts may have found no room.
        num_diverged: motions that left all numbers.
    """

    outcomes: Float[np.ndarray, "motions times outcomes"]
    derivatives: Float[np.ndarray, "motions times outcomes"]
    growth: Float[np.ndarray, "motions times"]
    num_crowded: int
    num_diverged: int

    def where(self, is_felt: Bool[np.ndarray, "times outcomes"]) -> "Moved":
        """Return the same with those outcomes that are not felt as constants: rounding has jumps and slopes of its own."""
        mean = np.nansum(self.outcomes, axis=0) / np.maximum(np.isfinite(self.outcomes).sum(axis=0), 1)
        kept = is_felt | np.isnan(self.outcomes)
        return dataclasses.replace(self, outcomes=np.where(kept, self.outcomes, mean))


@dataclass
class Programs:
    """The programs of a scene.

    Attributes:
        scene: that is stepped.
        size: motions in a batch.
        outcomes: of a trajectory.
        deadline: by `time.perf_counter`. What is not compiled by then is given up; a compilation that has begun cannot be
            stopped, and goes on until it ends.
        kinds: that are compiled, once `wait` has returned.
        end: when no more steps are begun, likewise.
    """

    scene: Scene
    size: int
    outcomes: Outcomes
    deadline: float
    kinds: tuple[str, ...] = ()
    end: float = math.inf

    def __post_init__(self):
        self.contact = contact_of(self.scene.model)
        self._compiled: dict[str, Future] = {}
        self._judges: dict[tuple[int, ...], Callable] = {}
        self._num_calls, self._seconds, self._compile_seconds = 0, 0.0, 0.0
        pool, longest = ThreadPoolExecutor(_WORKERS), 0.0
        for kind in KINDS:
            started = time.perf_counter()
            # The first trace says how long another one takes, at most.
            if started + longest > self.deadline:
                break
            # Traced here, for a thread does not see what a `with` has set, such as the precision; compiled beside it.
            lowered = jax.jit(jax.vmap(self._advance(kind), in_axes=(None, 0, 0, 0, 0))).lower(*self._shapes())
            longest = max(longest, time.perf_counter() - started)
            self._compiled[kind] = pool.submit(self._compile, kind, lowered)
        pool.shutdown(wait=False)

    def _compile(self, kind: str, lowered: Any) -> Callable | None:
        """Compile a kind; the event gradient only where it will be ready in time, going by the one that was before it."""
        started = time.perf_counter()
        if kind == "event" and started + _EVENT * self._compile_seconds > self.deadline:
            return None
        program = lowered.compile(compiler_options=compiler_options())
        self._compile_seconds = time.perf_counter() - started
        return program

    def wait(self) -> None:
        """Wait until all of them are compiled, or the deadline."""
        wait(self._compiled.values(), timeout=max(0.0, self.deadline - time.perf_counter()))
        self.kinds = tuple(kind for kind, one in self._compiled.items() if one.done() and one.result() is not None)

    @property
    def chunk_seconds(self) -> float:
        """How long `CHUNK` steps of a batch took so far, in the mean."""
        return self._seconds / max(self._num_calls, 1)

    def _advance(self, kind: str) -> Callable:
        asked: dict = {"onset": Onset()} if kind == "onset" else {"gradient": kind}

        def advance(contact: dict, state: State, change: State, controls: Array, control_change: Array) -> tuple:
            def run(state: State, controls: Array) -> tuple:
                scene = with_contact(self.scene, contact)
                trajectory = rollout(scene, state, controls, checkpoint=False, **asked)
                kept = (trajectory.qpos[1:], trajectory.qvel[1:], jnp.asarray(trajectory.act)[1:])
                return (trajectory.final, kept), (trajectory.diverged, trajectory.crowded > 0)

            return jax.jvp(run, (state, controls), (change, control_change), has_aux=True)

        return advance

    def _shapes(self) -> tuple:
        batch = lambda leaf: jax.ShapeDtypeStruct((self.size, *leaf.shape), leaf.dtype)  # noqa: E731
        state = jax.tree.map(batch, initial_state(self.scene))
        controls = batch(jax.ShapeDtypeStruct((CHUNK, self.scene.model.nu), self.scene.data.qpos.dtype))
        return self.contact, state, state, controls, controls

    def move(
        self,
        kind: str,
        states: State,
        controls: Float[np.ndarray, "motions steps nu"],
        direction: Direction,
        lengths: Sequence[int],
        contact: dict[str, Array] | None = None,
    ) -> Moved:
        """Move a batch, with its change along a direction, and judge it after so many steps, which are multiples of `CHUNK`.

        Raises:
            TimeoutError: at the `end`. Some states take a hundred times as long to solve as others, so nobody knows before.
        """
        program = self._compiled[kind].result()
        contact = self.contact if contact is None else contact
        dtype = states.qpos.dtype
        change = jax.tree.map(np.zeros_like, jax.tree.map(np.asarray, states))
        change.qvel[:] = direction.velocities
        if direction.positions.any():
            change.qpos[:] = change_of_poses(self.scene.mj_model, states.qpos, direction.positions)
        controls = np.asarray(controls, dtype)
        control_change = np.broadcast_to(direction.controls, controls.shape).astype(dtype)
        pieces, bad, crowded, start = [], np.zeros(self.size, bool), np.zeros(self.size, bool), states
        start_change = change
        for begin in range(0, lengths[-1], CHUNK):
            if time.perf_counter() > self.end:
                raise TimeoutError
            here, called = slice(begin, begin + CHUNK), time.perf_counter()
            (states, kept), (change, kept_change), (diverged, is_crowded) = program(
                contact, states, change, controls[:, here], control_change[:, here]
            )
            pieces.append(jax.tree.map(np.asarray, (kept, kept_change)))
            bad |= np.asarray(diverged)
            crowded |= np.asarray(is_crowded)
            self._num_calls, self._seconds = self._num_calls + 1, self._seconds + time.perf_counter() - called
        path, path_change = (
            [np.concatenate([first[:, None], *parts], axis=1) for first, *parts in zip(own, *rest, strict=True)]
            for own, rest in (
                (_parts(start), [piece[0] for piece in pieces]),
                (_parts(start_change), [piece[1] for piece in pieces]),
            )
        )
        judge = self._judge(tuple(lengths))
        outcomes, derivatives = judge((*path, controls, bad), (*path_change, control_change))
        size = np.sqrt(sum((part[:, list(lengths)] ** 2).sum(axis=2) for part in path_change[:2]))
        first = np.sqrt(sum((part**2).sum(axis=1) for part in (start_change.qpos, start_change.qvel)))[:, None]
        growth = size / np.where(first > 0, first, 1.0)
        return Moved(np.asarray(outcomes), np.asarray(derivatives), growth, int(crowded.sum()), int(bad.sum()))

    def _judge(self, lengths: tuple[int, ...]) -> Callable:
        """Return a compiled function from a batch of motions and their changes to outcomes and theirs."""
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


def _parts(state: State) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(part) for part in (state.qpos, state.qvel, state.act))


def moved(
    model: mujoco.MjModel,
    qpos: Float[ArrayLike, "motions nq"],
    positions: Float[np.ndarray, " nv"],
    places: Float[np.ndarray, " motions"] | float,
) -> Float[np.ndarray, "motions nq"]:
    """Move poses by so much of a change of positions, quaternions by their own rule."""
    found = np.array(qpos, float)
    for one, place in zip(found, np.broadcast_to(places, len(found)), strict=True):
        mujoco.mj_integratePos(model, one, positions, float(place))
    return found


def change_of_poses(
    model: mujoco.MjModel, qpos: Float[ArrayLike, "motions nq"], positions: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, "motions nq"]:
    """Return the derivative of `moved` by the place, at zero."""
    below, above = (moved(model, qpos, positions, x) for x in (-_TINY, _TINY))
    return (above - below) / (2 * _TINY)


def contact_of(model: mjx.Model) -> dict[str, Array]:
    """Return what of a model `Softness` changes, but for margins."""
    return {name: jnp.asarray(getattr(model, name)) for name in CONTACT_FIELDS}


def with_contact(scene: Scene, contact: dict[str, Array]) -> Scene:
    """Return the scene with other contact parameters."""
    return eqx.tree_at(lambda s: s.model, scene, scene.model.replace(**contact))


def compiler_options() -> dict | None:
    """Return what makes XLA compile in half the time, where it is known to."""
    is_known = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11)
    return _OPTIONS if is_known else None
