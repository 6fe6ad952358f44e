"""Motions of a scene in C MuJoCo, which needs no compilation: random ones, and batches with derivatives along a direction.

Random motions come first because they take a second and locate the expensive measurements: just before a first touch.
"""

import dataclasses
import functools
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.interpolate
from jaxtyping import Array, ArrayLike, Bool, Float, Int
from numpy.random import Generator

from mjxgrad.batched import device
from mjxgrad.contact import Softness
from mjxgrad.contact.parameters import geom_name
from mjxgrad.engines.jacobians import with_pairs
from mjxgrad.engines.pool import pool_of
from mjxgrad.engines.rule import to_coordinates
from mjxgrad.engines.state import VELOCITY_LIMIT
from mjxgrad.objective.task import finite_cost
from mjxgrad.rollouts import State, Trajectory
from mjxgrad.rollouts.start import pose_warnings
from mjxgrad.scene import Scene
from mjxgrad.scene.refusals import element_name
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Gradient

_NUM_MOTIONS = 4
_SECONDS, _MOST_STEPS, _FEWEST_STEPS = 2.0, 1000, 50
_KNOTS_PER_SECOND = 4.0  # slow enough for bodies to follow
_REACH = 0.8  # share of half the range, so that small changes are not clipped
_REPLAYED = 100  # steps before and after the first touch, within which effects show
_SMALLEST_EFFECT = 1e-9  # m, rad: above the rounding in double precision over these steps
_TIMED, _SOON = 40, 0.5  # steps of which the price is taken, and s after which it is taken twice alone
_ROUNDING = 1e-6  # m, of gaps in single precision
_CLEARANCE = 0.01  # m, beyond the margin: a nearer pair may touch in similar motions
_MOST_TREES = 3  # whose final states are outcomes
Kind = Literal["slope", "discrete", "plain", "fine"]
KINDS: tuple[Kind, ...] = ("slope", "discrete")
"""Kinds of derivatives of MuJoCo's motion; it has none as "plain", nor as "fine", at a `REFINED` times shorter time step."""
REFINED = 4
CONTACT_FIELDS = ("geom_solref", "geom_solimp", "pair_solref", "pair_solimp")
_States = dict[str, Any]  # qpos, qvel and act, with leading axes
Outcomes = Callable[[Trajectory], Float[Array, " outcomes"]]


@dataclass(frozen=True)
class Touch:
    """Two geoms that begin to touch: their names, the first time (s), and the largest speed of approach (m/s)."""

    pair: str
    time: float
    speed: float


@dataclass(frozen=True)
class Motions:
    """Random motions from the poses of a scene, by C MuJoCo; states are those before each step and after the last."""

    poses: tuple[str, ...]  # names of the initial poses
    qpos: Float[np.ndarray, "motions states nq"]
    qvel: Float[np.ndarray, "motions states nv"]
    act: Float[np.ndarray, "motions states na"]
    controls: Float[np.ndarray, "motions steps nu"]
    timestep: float  # time step of the scene, in s
    bad_steps: Int[np.ndarray, " motions"]  # first step that is not finite or too fast, −1 if there is none
    onsets: Int[np.ndarray, " motions"]  # step of the first new touch, −1 if there is none
    reached: Float[np.ndarray, "motions geoms"]  # step at which a geom first touches another, infinite if it never does
    touches: tuple[Touch, ...]  # pairs that begin to touch, in order of time
    touching: tuple[str, ...]  # pairs in contact from the first step on
    idle: tuple[str, ...]  # actuators whose control has no effect
    exact: tuple[str, ...] = ()  # pairs that touch to rounding in the first pose

    @property
    def touch_speed(self) -> float:
        """The largest speed of approach at any first touch, in m/s; zero without one."""
        return max((touch.speed for touch in self.touches), default=0.0)

    def state(self, motion: int, step: int) -> State:
        """Return the state of a motion after a number of steps."""
        qpos, qvel, act = (jnp.asarray(x[motion, step], float) for x in (self.qpos, self.qvel, self.act))
        return State(qpos, qvel, act, time=jnp.asarray(step * self.timestep), warmstart=jnp.zeros_like(qvel))


def heaviest(model: mujoco.MjModel) -> dict[int, str]:
    """Return the heaviest bodies that move, each with all that hangs on it, and their names."""
    trees = np.unique(model.body_rootid[model.jnt_bodyid])
    roots = sorted(trees.tolist(), key=lambda root: -model.body_subtreemass[root])[:_MOST_TREES]
    return {root: mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, root) or f"body {root}" for root in roots}


def half_range(scene: Scene) -> Float[np.ndarray, " nu"]:
    """Return half the width of each actuator's range of controls, in its units; 1 where there is none."""
    low, high = scene.mj_model.actuator_ctrlrange.T
    return np.where(scene.mj_model.actuator_ctrllimited & (high > low), (high - low) / 2, 1.0)


def smooth(rng: Generator, num_steps: int, num_columns: int, timestep: float) -> Float[np.ndarray, "steps nu"]:
    """Draw numbers between −1 and 1 that are piecewise linear in time between a few random knots."""
    knots = rng.uniform(-1, 1, (max(2, round(_KNOTS_PER_SECOND * num_steps * timestep) + 1), num_columns))
    return scipy.interpolate.make_interp_spline(np.linspace(0, 1, len(knots)), knots, k=1)(np.linspace(0, 1, num_steps))


def random_motions(scene: Scene, rng: Generator, key: int | None = None) -> Motions:
    """Simulate a scene under smooth random controls, from its key frames and reference pose, or from one about its controls."""
    model, timestep = scene.to_mujoco(), float(scene.model.opt.timestep)
    num_steps = int(np.clip(round(_SECONDS / timestep), _FEWEST_STEPS, _MOST_STEPS))
    low, high = np.asarray(scene.ctrlrange, float).T
    middle, half = np.where(np.isfinite(low + high), (low + high) / 2, 0.0), half_range(scene)
    starts = list(_starts(scene, model, key))
    chosen = [starts[i % len(starts)] for i in range(_NUM_MOTIONS)]
    wiggles = [smooth(rng, num_steps, model.nu, timestep) for _ in chosen]
    middle = middle if key is None else model.key_ctrl[key]
    controls = np.array([np.clip(middle + _REACH * half * one, low, high) for one in wiggles])
    names, *parts = zip(*chosen, strict=True)
    start: _States = dict(zip(("qpos", "qvel", "act"), map(np.array, parts), strict=True))
    path, bad_steps = held(run(scene, start, controls))
    qpos, qvel, act = path.values()
    touches, touching, onsets, reached = _touches(model, qpos, qvel)
    begin = max(0, int(onsets[0]) - _REPLAYED)
    window = controls[0, begin : begin + 2 * _REPLAYED]
    idle = _idle(scene, {name: x[:1, begin] for name, x in path.items()}, window, half)
    exact = touching_exactly(scene, qpos[0, 0])
    course = qpos, qvel, act, controls, timestep
    return Motions(names, *course, bad_steps, onsets, reached, touches, touching, idle, exact)


def _starts(
    scene: Scene, model: mujoco.MjModel, key: int | None
) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield name and state of one key frame, or of all, and of the reference pose if it is valid or the only one."""
    for i in range(min(model.nkey, _NUM_MOTIONS - 1)) if key is None else [key]:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) or str(i)
        yield f"key frame {name}", model.key_qpos[i], model.key_qvel[i], model.key_act[i]
    if key is None and (not model.nkey or not any(pose_warnings(scene.model, model, model.qpos0))):
        yield "the reference pose", model.qpos0, np.zeros(model.nv), np.zeros(model.na)


def start_of(state: State) -> _States:
    """Return the parts of one or more states from which C MuJoCo starts."""
    return {name: np.asarray(getattr(state, name), float) for name in ("qpos", "qvel", "act")}


def run(
    scene: Scene,
    start: _States,
    controls: Float[np.ndarray, "motions steps nu"],
    *,
    softness: Softness | None = None,
    refined: int = 1,
    follow: tuple[Gradient, tuple[np.ndarray, np.ndarray]] | None = None,
) -> _States:
    """Return the states of motions by C MuJoCo at all steps and after the last, at a time step divided by `refined`.

    With `follow`, a kind of derivative and changes of start and controls, "change" is what becomes of these after each step.
    """
    if softness is not None:
        scene = dataclasses.replace(scene, model=softness.apply(scene.model))
    numbers = changed_numbers(scene) | {"opt.timestep": scene.model.opt.timestep / refined}
    numbers = {name: np.asarray(value)[None] for name, value in numbers.items()}
    given = numbers, {"time": np.zeros((len(controls), 1)), **start}, {"ctrl": np.repeat(controls, refined, axis=1)}
    pool = pool_of(scene.mj_model)
    found = pool.run(*given) if follow is None else pool.follow(follow[0], *given, follow[1])
    path = {name: np.concatenate([start[name][:, None], found[name]], axis=1) for name in start}
    return path if follow is None else path | {"change": found["change"]}


def seconds_of(scene: Scene, key: int | None = None) -> dict[str, float]:
    """Return how long a step of a "motion" and of its gradients takes, by kind: in a batch by C MuJoCo, from the start."""
    model, pool = scene.mj_model, pool_of(scene.mj_model)
    num = 2 * pool.num_threads
    _, *start = next(_starts(scene, scene.to_mujoco(), key))
    numbers = {name: np.asarray(value)[None] for name, value in changed_numbers(scene).items()}
    given = {name: np.tile(x, (num, 1)) for name, x in zip(("qpos", "qvel", "act"), start, strict=True)}
    given["time"] = np.zeros((num, 1))
    # About those of the key frame, by default the first, or zero, within the actuators' ranges.
    home = np.clip(
        model.key_ctrl[key or 0] if model.nkey else np.zeros(model.nu), *np.asarray(scene.ctrlrange, float).T
    )
    controls = home + 0.1 * half_range(scene) * np.random.default_rng(0).normal(size=(num, _TIMED, model.nu))
    wanted = {"discrete": ("ctrl",), "slope": (*with_pairs(("ctrl",)), "flight")}

    def take(kind: str, steps: int) -> None:
        """Do what a rollout and its gradient do beside what is compiled."""
        inputs = {"ctrl": controls[:, :steps]}
        after = pool.run(numbers, given, inputs)
        if kind in wanted:
            before = {k: np.concatenate([x[:, None], after[k][:, :-1]], axis=1) for k, x in given.items() if k in after}
            before["time"] = np.zeros((num, steps, 1))
            pool.maps(numbers, before, inputs, pool.no_flight((num,)), gradient=kind, wanted=wanted[kind])

    found = {}
    for kind in ("motion", *KINDS):
        take(kind, 2)  # begins with threads and memory
        spent = []
        # Other programs take the processor for a while.
        while len(spent) < 2 or (sum(spent) < _SOON and len(spent) < 4):
            began = time.perf_counter()
            take(kind, _TIMED)
            spent.append(time.perf_counter() - began)
        found[kind] = min(spent) / num / _TIMED
    return found


def held(path: _States) -> tuple[_States, Int[np.ndarray, " motions"]]:
    """Return motions, held from their first bad step on, and these steps."""
    is_good: Any = np.isfinite(path["qpos"]).all(axis=2) & (np.abs(path["qvel"]) < VELOCITY_LIMIT).all(axis=2)
    first_bad = np.where(is_good[:, 1:].all(axis=1), -1, is_good[:, 1:].argmin(axis=1))
    steps = np.arange(is_good.shape[1])
    kept = np.where(first_bad[:, None] < 0, steps, np.minimum(steps, first_bad[:, None]))
    return {name: np.take_along_axis(x, kept[..., None], axis=1) for name, x in path.items()}, first_bad


def _touches(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray
) -> tuple[tuple[Touch, ...], tuple[str, ...], Int[np.ndarray, " motions"], Float[np.ndarray, "motions geoms"]]:
    """Return the pairs that begin to touch in any motion, the initially touching ones, each motion's first touch and geoms'."""
    data, found, always, onsets = mujoco.MjData(model), {}, {}, np.full(len(qpos), -1)
    reached = np.full((len(qpos), model.ngeom), np.inf)
    before = set()
    for motion, step in np.ndindex(qpos.shape[:2]):
        data.qpos[:], data.qvel[:] = qpos[motion, step], qvel[motion, step]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        now = {tuple(map(int, contact.geom)): contact for contact in data.contact if contact.efc_address >= 0}
        for geom in itertools.chain.from_iterable(now):
            reached[motion, geom] = min(reached[motion, geom], step)
        # Bodies that rest on each other press from the first step on.
        if step <= 1:
            always, before = always | now, set(now)
        for pair in now.keys() - before:
            onsets[motion] = step if onsets[motion] < 0 else onsets[motion]
            time, speed = found.get(pair, (np.inf, 0.0))
            found[pair] = (min(time, step * model.opt.timestep), max(speed, _approach(model, data, now[pair])))
        before = set(now)
    named = [Touch(_pair(model, pair), *when) for pair, when in found.items()]
    ordered = sorted(named, key=lambda touch: touch.time)
    return tuple(ordered), tuple(_pair(model, pair) for pair in always), onsets, reached


def most_contacts(scene: Scene, qpos: Float[np.ndarray, "motions states nq"]) -> int:
    """Return the largest number of near contacts of one friction dimension in any pose; at least 1."""
    model = scene.to_mujoco()
    model.geom_margin[:] += _CLEARANCE / 2  # the margins of both geoms add up
    model.body_margin[:] += _CLEARANCE / 2
    data, most = mujoco.MjData(model), 1
    for pose in qpos.reshape(-1, model.nq):
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        most = max(most, *np.bincount(data.contact.dim, minlength=1).tolist())
    return most


def touching_exactly(scene: Scene, qpos: Float[np.ndarray, " nq"]) -> tuple[str, ...]:
    """Return the pairs that single precision may tell from touching, or not, otherwise than double precision does."""
    model = scene.to_mujoco()
    margin = np.array(model.geom_margin)
    model.geom_margin[:] += _ROUNDING
    (data := mujoco.MjData(model)).qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    near = {tuple(map(int, one.geom)): one.dist - margin[one.geom].sum() for one in data.contact}
    return tuple(_pair(model, pair) for pair, gap in near.items() if abs(gap) < _ROUNDING)


def _pair(model: mujoco.MjModel, geoms: tuple[int, ...]) -> str:
    return " – ".join(geom_name(model, geom) for geom in geoms)


def _approach(model: mujoco.MjModel, data: mujoco.MjData, contact) -> float:
    """Return the speed of approach along the normal, the mean over the edges of a pyramid."""
    is_pyramid = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and contact.dim > 1
    num_rows = 2 * (contact.dim - 1) if is_pyramid else 1
    return max(0.0, -float(data.efc_vel[contact.efc_address : contact.efc_address + num_rows].mean()))


def pairs_at(scene: Scene, state: State, controls: Float[np.ndarray, "steps nu"], refined: int = 1) -> frozenset[str]:
    """Return the pairs that touch at any time of a motion by C MuJoCo, at a time step divided by `refined`."""
    start = {name: x[None] for name, x in start_of(state).items()}
    path, _ = held(run(scene, start, controls[None], refined=refined))
    touches, touching, *_ = _touches(scene.to_mujoco(), path["qpos"], path["qvel"])
    return frozenset([touch.pair for touch in touches]) | frozenset(touching)


def _idle(scene: Scene, start: _States, controls: Float[np.ndarray, "steps nu"], half: np.ndarray) -> tuple[str, ...]:
    """Return the names of the actuators whose control changes nothing in a motion."""
    changes = (1 - _REACH) * np.diag(np.append(0.0, half))[:, None, 1:]  # none at first
    starts = {name: np.repeat(x, len(changes), axis=0) for name, x in start.items()}
    path, _ = held(run(scene, starts, controls + changes))
    effects = [np.abs(path[name][1:] - path[name][:1]).max(axis=(1, 2)) for name in ("qpos", "qvel")]
    idle = np.flatnonzero(np.maximum(*effects) < _SMALLEST_EFFECT).tolist()
    return tuple(element_name(scene.mj_model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in idle)


@dataclass(frozen=True)
class Direction:
    """A change of a motion: of its initial positions (m, rad) and velocities (m/s, rad/s), and of its controls."""

    positions: Float[np.ndarray, " nv"]
    velocities: Float[np.ndarray, " nv"]
    controls: Float[np.ndarray, "steps nu"]


@dataclass(frozen=True)
class Moved:
    """Outcomes of a batch of motions at several times, and their derivatives along a direction; NaN for those that diverged."""

    outcomes: Float[np.ndarray, "motions times outcomes"]
    derivatives: Float[np.ndarray, "motions times outcomes"]
    growth: Float[np.ndarray, "motions times"]  # of the tangent of the state, relative to the start
    num_diverged: int

    def where(self, is_felt: Bool[np.ndarray, "times outcomes"]) -> "Moved":
        """Return the same with insensitive outcomes as constants: rounding has jumps and slopes of its own."""
        mean = np.nansum(self.outcomes, axis=0) / np.maximum(np.isfinite(self.outcomes).sum(axis=0), 1)
        kept = is_felt | np.isnan(self.outcomes)
        return dataclasses.replace(self, outcomes=np.where(kept, self.outcomes, mean))


@dataclass
class Mover:
    """Simulator of batches of `size` motions in a scene; none but what is needed ends after `end`, by `perf_counter`."""

    scene: Scene
    size: int
    outcomes: Outcomes
    end: float = math.inf
    is_needed: bool = False

    def __post_init__(self):
        self._judge, self._spent = functools.cache(self._judge_at), {}

    def seconds(self, kind: Kind, num_steps: int) -> float:
        """Return how long steps of motions, all added up, will take with a kind of derivative, by the batches so far."""
        steps, seconds = self._spent.get(kind, (0, 0.0))
        return num_steps * seconds / max(steps, 1)

    def move(
        self,
        kind: Kind,
        states: State,
        controls: Float[np.ndarray, "motions steps nu"],
        direction: Direction,
        lengths: Sequence[int],
        softness: Softness | None = None,
    ) -> Moved:
        """Simulate at most `size` motions with their tangents along a direction, and return the outcomes after the given steps.

        Raises:
            TimeoutError: if it would end after `end`, by the batches so far.
        """
        if not self.is_needed and time.perf_counter() + self.seconds(kind, len(controls) * lengths[-1]) > self.end:
            raise TimeoutError
        start = start_of(states)
        num, steps = len(controls), lengths[-1]
        controls = np.asarray(controls, float)[:, :steps]
        pushes = np.broadcast_to(direction.controls[:steps], controls.shape)
        change = np.concatenate([direction.positions, direction.velocities, np.zeros(start["act"].shape[1])])
        follow = (kind, (np.tile(change, (num, 1)), pushes)) if kind in ("slope", "discrete") else None
        refined = REFINED if kind == "fine" else 1
        started = time.perf_counter()
        found = run(self.scene, start, controls, softness=softness, refined=refined, follow=follow)
        before = self._spent.get(kind)  # none of the first, which begins with threads and memory, and is not timed
        spent = num * steps, time.perf_counter() - started
        self._spent[kind] = (before[0] + spent[0], before[1] + spent[1]) if before else (0, 0.0)
        course = found.pop("change", np.full((num, steps, len(change)), np.nan))
        path, bad_steps = held({name: x[:, ::refined] for name, x in found.items()})
        bad = bad_steps >= 0
        course = np.concatenate([np.tile(change, (num, 1, 1)), np.where(bad[:, None, None], 0.0, course)], axis=1)
        batch = bad, (*path.values(), controls), course, pushes
        # So that one program judges all.
        filled = jax.tree.map(lambda x: np.resize(x, (self.size, *x.shape[1:])), batch)
        outcomes, derivatives = (np.asarray(x)[:num] for x in self._judge(tuple(lengths))(*filled))
        growth = np.linalg.norm(course[:, list(lengths)], axis=2) / (np.linalg.norm(change) or 1.0)
        return Moved(outcomes, derivatives, growth, int(bad.sum()))

    def _judge_at(self, lengths: tuple[int, ...]) -> Callable:
        """Return a compiled function from a batch of motions and tangents to outcomes and their derivatives."""
        nv = self.scene.model.nv

        def at(length: int, bad: Array, qpos: Array, qvel: Array, act: Array, controls: Array) -> Array:
            final = State(qpos[length], qvel[length], act[length], jnp.zeros(()), jnp.zeros_like(qvel[0]))
            qpos, qvel, act = (x[: length + 1] for x in (qpos, qvel, act))
            trajectory = Trajectory(qpos, qvel, controls[:length], None, final, bad, jnp.where(bad, 0, -1), act=act)
            return jax.vmap(lambda one: finite_cost(one, trajectory))(self.outcomes(trajectory))

        def one(bad: Array, motion: tuple[Array, ...], course: Array, pushes: Array) -> tuple[Array, Array]:
            parts = jnp.split(course, (nv, 2 * nv), axis=1)
            parts[0] = jax.vmap(functools.partial(to_coordinates, self.scene))(motion[0], parts[0])
            outcomes = lambda *motion: jnp.stack([at(length, bad, *motion) for length in lengths])  # noqa: E731
            return jax.jvp(outcomes, motion, (*parts, pushes))

        return jax.jit(jax.vmap(one))


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
    """Return options that halve XLA's compile time, where known and unless XLA_FLAGS chooses a level."""
    is_chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    if is_chosen or not device.is_cpu() or jax.__version_info__ >= (0, 11):
        return None
    # XLA's optimisation level 1 halves the time to compile (hopper, jax 0.10.2: 12 s in place of 24); the code is as fast.
    return {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
