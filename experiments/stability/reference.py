"""C MuJoCo on every point of the grid, and the models and starts that mjxgrad takes over from it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from experiments.parallel import num_cores
from experiments.stability.grid import Points
from experiments.stability.scenes import FIELDS, StabilityScene, configure

VELOCITY_LIMIT = 1e4
"""Beyond it a rollout counts as diverged, as it does for `mg.rollout`."""
WIDTHS = (1e-4, 2e-5)
"""Of finite differences, in units of what a body flies in one step."""


@dataclass(frozen=True)
class Course:
    """What one simulator did on every point.

    Attributes:
        qpos: positions after the last step, or the last good one.
        qvel: velocities, likewise.
        kinetic: energy of motion before each step and at the end, in J.
        potential: energy of height, likewise.
        residual: largest share of the forces left unbalanced by a solve.
        first_bad_step: −1 if there is none.
    """

    qpos: Float[np.ndarray, "points nq"]
    qvel: Float[np.ndarray, "points nv"]
    kinetic: Float[np.ndarray, "points states"]
    potential: Float[np.ndarray, "points states"]
    residual: Float[np.ndarray, " points"]
    first_bad_step: np.ndarray


@dataclass(frozen=True)
class Reference:
    """C MuJoCo on every point.

    Attributes:
        course: what it did.
        fields: of the model, by name, for every point.
        qpos: where each rollout starts.
        qvel: likewise.
        differences: central differences of the outcome along `direction`, by width.
    """

    course: Course
    fields: dict[str, np.ndarray]
    qpos: Float[np.ndarray, "points nq"]
    qvel: Float[np.ndarray, "points nv"]
    differences: Float[np.ndarray, "widths points"]


def direction(scene: StabilityScene, num_steps: int, timestep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the change of the start along which derivatives are taken; quaternions stay.

    Args:
        scene: of the catalogue.
        num_steps: of the rollout.
        timestep: of each point, in s.

    Returns:
        Changes of positions (points, nq) and of velocities (points, nv), which move the outcome alike.
    """
    model = scene.model()
    free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    shift = np.cos(1.0 + np.arange(model.nq))
    for start in free:
        shift[start + 3 : start + 7] = 0.0
    push = np.sin(2.0 + np.arange(model.nv))
    return np.tile(shift, (len(timestep), 1)), push / (num_steps * timestep[:, None])


def scale(points: Points) -> Float[np.ndarray, " points"]:
    """What a body flies in one step (m)."""
    return points.values["speed"] * points.values["timestep"]


def simulate(scene: StabilityScene, points: Points, num_steps: int) -> Reference:
    """Run C MuJoCo on every point.

    Args:
        scene: of the catalogue.
        points: of its grid.
        num_steps: of every rollout.

    Returns:
        What it did.
    """
    # A simulation that goes wrong is what is looked for; C MuJoCo would write a file about it.
    mujoco.set_mju_user_warning(lambda _: None)
    slices = [slice(i, None, num_cores()) for i in range(num_cores())]
    shifts = direction(scene, num_steps, points.values["timestep"])

    def run(which: slice) -> list[tuple]:
        model = scene.model()
        worker = (scene, model, mujoco.MjData(model))
        return [_run_point(worker, points[i], shifts[0][i], shifts[1][i], num_steps) for i in range(len(points))[which]]

    with ThreadPoolExecutor(len(slices)) as pool:
        parts = list(pool.map(run, slices))
    order = np.argsort(np.concatenate([np.arange(len(points))[which] for which in slices]), kind="stable")
    rows = [row for part in parts for row in part]
    columns = [np.array(column)[order] for column in zip(*[row[:-1] for row in rows], strict=True)]
    fields = {name: np.array([row[-1][name] for row in rows])[order] for name in rows[0][-1]}
    return Reference(Course(*columns[:6]), fields, columns[6], columns[7], columns[8].T)


def _run_point(
    worker: tuple[StabilityScene, mujoco.MjModel, mujoco.MjData],
    point: dict[str, float],
    shift: np.ndarray,
    push: np.ndarray,
    num_steps: int,
) -> tuple:
    scene, model, data = worker
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
    """Step, look at every state, and stop at the first bad one."""
    _place(model, data, qpos, qvel)
    good = (qpos, qvel)
    energies, residual, bad, mass = np.zeros((2, num_steps + 1)), 0.0, -1, np.zeros((model.nv, model.nv))
    for i in range(num_steps):
        mujoco.mj_step(model, data)
        energies[:, i] = data.energy[1], data.energy[0]
        mujoco.mj_fullM(model, data, mass)
        forces = (data.qfrc_smooth, data.qfrc_constraint)
        residual = max(residual, float(unbalanced(mass, data.qacc, good[1], *forces, model.opt.timestep)))
        if not (np.isfinite(data.qpos).all() and np.abs(data.qvel).max() < VELOCITY_LIMIT):
            bad = i
            energies[:, i + 1 :] = energies[:, i : i + 1]
            break
        good = (data.qpos.copy(), data.qvel.copy())
    else:
        mujoco.mj_forward(model, data)
        energies[:, -1] = data.energy[1], data.energy[0]
    return (*good, energies[0], energies[1], residual, bad)


def unbalanced(mass, acceleration, velocity, smooth, constraint, timestep):
    """Share of a step's velocity by which a solve is off, in the norm of kinetic energy; of NumPy or JAX arrays.

    Args:
        mass: matrix, of which the diagonal counts.
        acceleration: that the solve has found.
        velocity: before the step.
        smooth: forces but those of constraints.
        constraint: forces of constraints.
        timestep: in s.

    Returns:
        A number; 0 where nothing moves and nothing pulls.
    """
    inertia = mass @ acceleration
    weight = mass.diagonal()

    def norm(force):
        # Scaled, for squares of large forces overflow in float32.
        largest = abs(force).max() + 1e-30
        return largest * ((force / largest) ** 2 / weight).sum() ** 0.5

    moved = norm(weight * velocity) + timestep * (norm(inertia) + norm(smooth) + norm(constraint))
    return timestep * norm(inertia - smooth - constraint) / (moved + 1e-30)
