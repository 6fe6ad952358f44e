"""C MuJoCo on every point of the grid, and the models and starts that mjxgrad takes over from it."""

import math
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np
from jaxtyping import Float

from experiments.parallel import num_cores
from experiments.stability.scenes import FIELDS, Points, StabilityScene, catalogue, configure

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
