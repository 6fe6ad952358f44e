"""Both simulators on every point of the grid: C MuJoCo, and mjxgrad in one program per scene, precision and gradient."""

import math
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.parallel import num_cores
from experiments.stability.scenes import FIELDS, Points, StabilityScene, catalogue, configure
from mjxgrad._mjx import mjx
from mjxgrad.rollouts import Observe, Trajectory
from mjxgrad.stepping import Contact

VELOCITY_LIMIT = 1e4
"""Beyond it a rollout counts as diverged, as it does for `mg.rollout`."""
WIDTHS = (1e-4, 2e-5)
"""Of finite differences, in units of what a body flies in one step."""
_Worker = tuple[StabilityScene, mujoco.MjModel, mujoco.MjData]
_SHARES = 4
"""Pieces of work for each process: some points take longer than others."""


@dataclass(frozen=True)
class Course:
    """What one simulator did on every point."""

    qpos: Float[np.ndarray, "points nq"]  # positions after the last step, or the last good one
    qvel: Float[np.ndarray, "points nv"]  # velocities, likewise
    kinetic: Float[np.ndarray, "points states"]  # energy of motion before each step and at the end, in J
    potential: Float[np.ndarray, "points states"]  # energy of height, likewise
    # Largest share of a step's velocity by which a solve is off, or that its forces leave unbalanced.
    residual: Float[np.ndarray, " points"]
    first_bad_step: np.ndarray  # −1 if there is none


@dataclass(frozen=True)
class Reference:
    """C MuJoCo on every point."""

    course: Course  # what it did
    fields: dict[str, np.ndarray]  # of the model, by name, for every point
    qpos: Float[np.ndarray, "points nq"]  # where each rollout starts
    qvel: Float[np.ndarray, "points nv"]  # likewise
    differences: Float[np.ndarray, "widths points"]  # central differences of the outcome along `direction`, by width


def direction(scene: StabilityScene, num_steps: int, timestep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the change of the start along which derivatives are taken; quaternions stay.

    Positions (points, nq) and velocities (points, nv) move the outcome alike.
    """
    model = scene.model()
    free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    shift = np.cos(1.0 + np.arange(model.nq))
    for start in free:
        shift[start + 3 : start + 7] = 0.0
    push = np.sin(2.0 + np.arange(model.nv))
    return np.tile(shift, (len(timestep), 1)), push / (num_steps * timestep[:, None])


def simulate(scene: StabilityScene, points: Points, num_steps: int, pool: Executor) -> Reference:
    """Run C MuJoCo on every point, in processes: most of the time goes into Python, a step at a time."""
    shifts = np.concatenate(direction(scene, num_steps, points.values["timestep"]), axis=1)
    cases = list(zip((points[i] for i in range(len(points))), shifts, strict=True))
    share = math.ceil(len(cases) / (_SHARES * num_cores()))
    parts = [cases[start : start + share] for start in range(0, len(cases), share)]
    rows = [row for part in pool.map(partial(_run_points, scene.name, num_steps), parts) for row in part]
    columns = [np.array(column) for column in zip(*[row[:-1] for row in rows], strict=True)]
    fields = {name: np.array([row[-1][name] for row in rows]) for name in rows[0][-1]}
    return Reference(Course(*columns[:6]), fields, columns[6], columns[7], columns[8].T)


def _run_points(name: str, num_steps: int, cases: list[tuple[dict[str, float], np.ndarray]]) -> list[tuple]:
    # A simulation that goes wrong is what is looked for; C MuJoCo would write a file about it.
    mujoco.set_mju_user_warning(lambda _: None)
    scene = next(scene for scene in catalogue() if scene.name == name)
    model = scene.model()
    worker = (scene, model, mujoco.MjData(model))
    return [_run_point(worker, point, change, num_steps) for point, change in cases]


def _run_point(worker: _Worker, point: dict[str, float], change: np.ndarray, num_steps: int) -> tuple:
    (scene, model, data), (shift, push) = worker, np.split(change, [worker[1].nq])
    configure(scene, model, data, point)
    fields = {name: np.array(getattr(model, name)) for name in FIELDS}
    fields["timestep"] = np.array(model.opt.timestep)
    qpos, qvel = scene.start(point)
    course = _follow(model, data, qpos, qvel, num_steps)
    weights = np.array(scene.outcome)
    flown = point["speed"] * point["timestep"]

    def end(step: float) -> float:
        _place(model, data, qpos + step * shift, qvel + step * push)
        mujoco.mj_step(model, data, num_steps)
        return float(weights @ data.qpos)

    differences = [(end(width * flown) - end(-width * flown)) / (2 * width * flown) for width in WIDTHS]
    return (*course, qpos, qvel, differences, fields)


def _place(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, qvel: np.ndarray) -> None:
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = qpos, qvel


def _follow(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, qvel: np.ndarray, num_steps: int) -> tuple:
    """Step, then look at every state up to the first bad one."""
    _place(model, data, qpos, qvel)
    positions, velocities = np.zeros((num_steps + 1, model.nq)), np.zeros((num_steps + 1, model.nv))
    positions[0], velocities[0] = qpos, qvel
    energies = np.zeros((num_steps + 1, 2))
    masses = np.zeros((num_steps, model.nv, model.nv))
    accelerations, smooth, constraint = np.zeros((3, num_steps, model.nv))
    for i in range(num_steps):
        mujoco.mj_step(model, data)
        energies[i] = data.energy
        mujoco.mj_fullM(model, data, masses[i])
        accelerations[i], smooth[i], constraint[i] = data.qacc, data.qfrc_smooth, data.qfrc_constraint
        positions[i + 1], velocities[i + 1] = data.qpos, data.qvel
    mujoco.mj_forward(model, data)
    energies[-1] = data.energy
    is_good = np.isfinite(positions[1:]).all(axis=1) & (np.abs(velocities[1:]).max(axis=1) < VELOCITY_LIMIT)
    bad, last = -1, num_steps
    if not is_good.all():
        bad = last = int(np.argmin(is_good))
        energies[bad + 1 :] = energies[bad]
    seen = slice(0, last + 1)
    solves = (masses, accelerations, velocities[:num_steps], smooth, constraint)
    residual = unbalanced(*(x[seen] for x in solves), timestep=model.opt.timestep)
    return positions[last], velocities[last], energies[:, 1], energies[:, 0], float(residual.max()), bad


def unbalanced(mass, acceleration, velocity, smooth, constraint, timestep):
    """Share of a step's velocity by which a solve is off, in the norm of kinetic energy; of NumPy or JAX arrays.

    The norm takes the diagonal of the mass matrix (..., nv, nv); all others are (..., nv). It is 0 where nothing moves and
    nothing pulls.
    """
    inertia = (mass @ acceleration[..., None])[..., 0]
    weight = mass.diagonal(axis1=-2, axis2=-1)

    def norm(force):
        # Scaled, for squares of large forces overflow in float32.
        largest = abs(force).max(axis=-1) + 1e-30
        return largest * ((force / largest[..., None]) ** 2 / weight).sum(axis=-1) ** 0.5

    moved = norm(weight * velocity) + timestep * (norm(inertia) + norm(smooth) + norm(constraint))
    return timestep * norm(inertia - smooth - constraint) / (moved + 1e-30)


class Steps(eqx.Module):
    """What the solves of a rollout were given and found."""

    qpos: Float[np.ndarray, "points steps nq"]  # positions before each step
    qvel: Float[np.ndarray, "points steps nv"]  # velocities, likewise
    qacc: Float[np.ndarray, "points steps nv"]  # the acceleration found
    unbalanced: Float[np.ndarray, "points steps"]  # share of the forces that it leaves; 0 from the first bad step on


@dataclass(frozen=True)
class Run:
    """What mjxgrad did on every point."""

    course: Course  # the motion
    value: Float[np.ndarray, " points"]  # the outcome at the end
    # Of the outcome with respect to the model's fields, positions and velocities.
    gradient: tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]
    is_silent: np.ndarray  # whether a rollout returned a number that is not finite without a flag
    is_gradient_finite: np.ndarray  # whether all numbers of the gradient are
    is_unsolved: np.ndarray  # whether the rollout says that some step's forces are not in balance
    steps: Steps  # state and solution at each step, for a closer look at those that seem wrong


def _observe(model: mjx.Model, data: mjx.Data) -> tuple[Array, Array, Array, Array]:
    mass, forces = mjx.full_m(model, data), (data.qfrc_smooth, data.qfrc_constraint)
    kinetic = 0.5 * data.qvel @ mass @ data.qvel
    potential = -model.body_mass @ (data.xipos @ model.opt.gravity)
    return kinetic, potential, unbalanced(mass, data.qacc, data.qvel, *forces, model.opt.timestep), data.qacc


class Program:
    """A scene's rollout with its gradient, vectorised over points, a chunk at once."""

    def __init__(self, scene: StabilityScene, num_steps: int, contact: Contact, chunk: int):
        self._scene = mg.load_scene(scene.model())
        self._weights = jnp.array(scene.outcome)
        self._contact = contact
        self._num_steps, self._chunk = num_steps, chunk
        both = jax.value_and_grad(self._outcome, argnums=(0, 1, 2), has_aux=True)
        self._both = jax.jit(jax.vmap(both))
        # Finite differences need no gradient, which takes four times as long as its value.
        self._value = jax.jit(jax.vmap(lambda *start: self._outcome(*start, observe=None)[0]))

    def values(self, fields: dict[str, np.ndarray], qpos: np.ndarray, qvel: np.ndarray) -> Float[np.ndarray, " points"]:
        """Give the outcome alone, from the model's fields and the start of every point."""
        return np.concatenate(
            [np.asarray(self._value(*arrays))[:count] for count, arrays in self._chunks((fields, qpos, qvel))]
        )

    def run(self, fields: dict[str, np.ndarray], qpos: np.ndarray, qvel: np.ndarray) -> Run:
        """Simulate and differentiate, likewise."""
        parts = []
        for count, arrays in self._chunks((fields, qpos, qvel)):
            (value, trajectory), gradient = self._both(*arrays)
            parts.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], (value, trajectory, gradient)))
        value, trajectory, gradient = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        kinetic, potential, residual, qacc = trajectory.observations
        # From the first bad step on the solver is asked what has no answer.
        first_bad, step = trajectory.first_bad_step, np.arange(residual.shape[1])
        residual = np.where((first_bad[:, None] >= 0) & (step >= first_bad[:, None]), 0.0, residual)
        is_silent = ~trajectory.diverged & ~_all_finite((trajectory, value))
        ends = trajectory.qpos[:, -1], trajectory.qvel[:, -1]
        course = Course(*ends, kinetic, potential, residual.max(axis=1), first_bad)
        last = self._num_steps
        steps = Steps(trajectory.qpos[:, :last], trajectory.qvel[:, :last], qacc[:, :last], residual[:, :last])
        return Run(course, value, gradient, is_silent, _all_finite(gradient), trajectory.unsolved > 0, steps)

    def _outcome(
        self, fields: dict[str, Array], qpos: Array, qvel: Array, observe: Observe | None = _observe
    ) -> tuple[Array, Trajectory]:
        scene = _with_fields(self._scene, fields)
        state = mg.initial_state(scene, qpos, qvel)
        trajectory = mg.rollout(scene, state, horizon=self._num_steps, observe=observe, contact=self._contact)
        return trajectory.qpos[-1] @ self._weights, trajectory

    def _chunks(self, arrays) -> Iterator[tuple[int, Any]]:
        return _chunks(arrays, self._chunk, self._scene.data.qpos.dtype)


def errors_of_solves(
    scene: StabilityScene, fields: dict[str, np.ndarray], steps: Steps, chunk: int
) -> Float[np.ndarray, "points steps"]:
    """Ask the forces of a solve of the same states, in the present precision, whether they balance accelerations found.

    Forces out of balance bound the error of an acceleration, but in single precision those of stiff rows may be out of balance
    by rounding alone, with hardly an error. The answer is the share of a step's velocity by which each is off.
    """
    loaded = mg.load_scene(scene.model())

    def error(fields: dict[str, Array], qpos: Array, qvel: Array, qacc: Array) -> Array:
        model = _with_fields(loaded, fields).model
        data = mg.forward(model, loaded.data.replace(qpos=qpos, qvel=qvel))
        forces = (data.qfrc_smooth, data.qfrc_constraint)
        return unbalanced(mjx.full_m(model, data), qacc, qvel, *forces, model.opt.timestep)

    run = jax.jit(jax.vmap(jax.vmap(error, in_axes=(None, 0, 0, 0))))
    at_once = max(1, chunk // steps.qpos.shape[1])
    pieces = _chunks((fields, steps.qpos, steps.qvel, steps.qacc), at_once, loaded.data.qpos.dtype)
    return np.concatenate([np.asarray(run(*arrays))[:count] for count, arrays in pieces])


def _with_fields(scene: mg.Scene, fields: dict[str, Array]) -> mg.Scene:
    others = {name: value for name, value in fields.items() if name != "timestep"}
    model = scene.model.replace(**others).tree_replace({"opt.timestep": fields["timestep"]})
    return eqx.tree_at(lambda scene: scene.model, scene, model)


def _chunks(arrays: Any, size: int, dtype: Any) -> Iterator[tuple[int, Any]]:
    """Cut into pieces of one length, the last filled up with its last point."""
    total = len(arrays[1])
    for start in range(0, total, size):
        index = np.minimum(np.arange(start, start + size), total - 1)
        yield min(size, total - start), jax.tree.map(lambda x, i=index: x[i].astype(dtype), arrays)


def along(run: Run, changes: dict[str, np.ndarray]) -> Float[np.ndarray, " points"]:
    """Take a gradient along a change of fields, and of the start, "qpos" and "qvel"."""
    fields, qpos, qvel = run.gradient
    parts = {**fields, "qpos": qpos, "qvel": qvel}
    with np.errstate(all="ignore"):
        terms = [(parts[name] * change).reshape(len(qpos), -1).sum(axis=1) for name, change in changes.items()]
    return np.sum(terms, axis=0)


def _all_finite(tree: Any) -> np.ndarray:
    leaves = [x for x in jax.tree.leaves(tree) if np.issubdtype(np.asarray(x).dtype, np.floating)]
    return np.all([np.isfinite(x).reshape(len(x), -1).all(axis=1) for x in leaves], axis=0)
