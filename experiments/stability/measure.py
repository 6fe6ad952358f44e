"""From settings to numbers: mjxgrad beside C MuJoCo on every point, and what each rollout and derivative turned out to be."""

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import xarray as xr
from jaxtyping import Array, Bool, Float, Int

import mjxgrad as mg
from experiments.stability.scenes import FIELDS, GRAVITY, Points, StabilityScene, catalogue, points
from experiments.stability.settings import Settings
from experiments.workspace import Workspace, in_threads
from mjxgrad._mjx import mjx
from mjxgrad._warnings import collected

C_MUJOCO = "C MuJoCo"
NOT_ASKED = -1  # in the place of a value of `Derivative` that was not asked for
_VELOCITY_LIMIT = 1e4  # beyond it a rollout counts as diverged, as it does for `mg.rollout`
_WIDTHS = (1e-4, 2e-5)  # of finite differences by the start, in units of what a body flies in one step
_PARAMETER_WIDTHS = (1e-6, 2e-7)
_RELATIVE = ("geom_solref", "jnt_solref", "geom_friction", "timestep")
"""Fields of the model that are changed in proportion, to judge the derivative by them."""
_TOLERANCE = {"float64": 1e-3, "float32": 5e-2}

# The thresholds are coarse on purpose: a class is a kind of behaviour, not an accuracy.
UNSOLVED = 1e-3  # share of a step's velocity by which a solve may be off
GAIN = 0.05  # share by which kinetic energy may exceed what there was to draw on
AT_REST = 1e-3  # share of that energy below which a body has settled


class _Kind(enum.IntEnum):
    @property
    def label(self) -> str:
        """The kind in words."""
        return self.name.lower().replace("_", " ")


class Motion(_Kind):
    """What a rollout did; the larger, the worse. Those from `GAINS_ENERGY` on are failures."""

    SETTLES = 0
    MOVES_ON = 1
    GAINS_ENERGY = 2
    TUNNELS = 3
    NOT_SOLVED = 4
    DIVERGES = 5


class Derivative(_Kind):
    """What a derivative turned out to be.

    `UNJUDGED` where the truth is not known well enough, `NONE` where the rollout diverged and has no derivative.
    """

    RIGHT = 0
    UNJUDGED = 1
    WRONG = 2
    EXPLODES = 3
    NOT_FINITE = 4
    NONE = 5


@dataclass(frozen=True)
class Course:
    """What one simulator did on every point."""

    qpos: Float[np.ndarray, "points nq"]  # positions after the last step, or the last good one
    kinetic: Float[np.ndarray, "points states"]  # energy of motion before each step and at the end (J)
    potential: Float[np.ndarray, "points states"]  # energy of height, likewise
    residual: Float[np.ndarray, " points"]  # largest share of a step's velocity by which a solve is off
    is_sound: Bool[np.ndarray, " points"]  # whether all states were finite and below the velocity limit


@dataclass(frozen=True)
class SceneOutcome:
    """One scene."""

    scene: StabilityScene  # of the catalogue
    points: Points  # of its grid
    # By simulator (`C_MUJOCO`, and mjxgrad by its precision) and point: `motion`, of `Motion`; of `Derivative` that along a
    # change of the start (`derivative`) and of the model's parameters (`derivative_by_parameters`); whether numbers that are
    # not finite left the rollout without a flag (`silent`); whether some step is not solved and `Trajectory.unsolved` is zero
    # (`untold`); difference of the final positions from those of C MuJoCo over what a body flies (`apart_from_c`).
    found: xr.Dataset


@dataclass(frozen=True)
class Outcome:
    """All that was measured, the scenes in the order of the catalogue."""

    settings: Settings
    scenes: list[SceneOutcome]

    @cached_property
    def found(self) -> xr.Dataset:
        """The points of all scenes, one after another."""
        return xr.concat([one.found for one in self.scenes], "point")

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per point, for metrics.csv."""
        return [row for one in self.scenes for row in _rows(one)]


def against_c(found: xr.Dataset, precision: str) -> np.ndarray:
    """Compare mjxgrad's motion with that of C MuJoCo: above 0 where it is of a worse kind, below where of a better one."""
    # All that are fine have one rank.
    ranks = np.maximum(found.motion, Motion.MOVES_ON)
    return (ranks.sel(simulator=precision) - ranks.sel(simulator=C_MUJOCO)).values


def _rows(one: SceneOutcome) -> list[dict[str, Any]]:
    kinds = {"motion": Motion, "derivative": Derivative, "derivative_by_parameters": Derivative}
    columns = {}
    for name in one.found.simulator.values:
        for key, values in one.found.sel(simulator=name).data_vars.items():
            if name != C_MUJOCO or key == "motion":
                told = [kinds[str(key)](v).label for v in values.values] if key in kinds else values.values
                columns[f"{'c' if name == C_MUJOCO else name}_{key}"] = told
    planes = ["random" if i < 0 else " × ".join(one.points.planes[i]) for i in one.points.family]
    return [
        {"scene": one.scene.name, "plane": plane, **one.points[i], **{key: told[i] for key, told in columns.items()}}
        for i, plane in enumerate(planes)
    ]


def classify_motion(
    course: Course, gain: np.ndarray, rest: np.ndarray, has_crossed: np.ndarray
) -> Int[np.ndarray, " points"]:
    """Return what each rollout did, by values of `Motion`; of several failures the worst.

    Largest and final kinetic energy are over what there was to draw on: start, gravity and compressed springs. Bodies that
    ended on the wrong side of each other have crossed.
    """
    # A comparison with NaN is false, so each question is asked in the form that NaN fails.
    answers = (
        (~course.is_sound, Motion.DIVERGES),
        (~(course.residual <= UNSOLVED), Motion.NOT_SOLVED),
        (has_crossed, Motion.TUNNELS),
        (~(gain <= 1 + GAIN), Motion.GAINS_ENERGY),
        (rest <= AT_REST, Motion.SETTLES),
    )
    return np.select([is_so for is_so, _ in answers], [int(kind) for _, kind in answers], int(Motion.MOVES_ON))


def classify_derivative(
    derivative: Float[np.ndarray, " points"],
    is_finite: Bool[np.ndarray, " points"],
    is_sound: Bool[np.ndarray, " points"],
    truth: Float[np.ndarray, "2 points"],
    *,
    largest: float,
    tolerance: float,
) -> Int[np.ndarray, " points"]:
    """Return whether each derivative of one number by one direction is right, by values of `Derivative`.

    The whole gradient that it was taken from is finite, and its rollout sound, or not. The truth comes by differences of two
    widths, the finer last. Where they disagree by more than the tolerance, a share of the larger of the truth and one, nothing
    is judged; beyond `largest` a derivative explodes.
    """
    with np.errstate(invalid="ignore"):
        fine, error = truth[1], np.abs(truth[1] - truth[0])
        scale = tolerance * np.maximum(np.abs(fine), 1.0)
        answers = (
            (~is_sound, Derivative.NONE),
            (~is_finite | ~np.isfinite(derivative), Derivative.NOT_FINITE),
            (np.abs(derivative) > largest, Derivative.EXPLODES),
            (~(error <= scale), Derivative.UNJUDGED),
            (np.abs(derivative - fine) <= scale + error, Derivative.RIGHT),
        )
    return np.select([is_so for is_so, _ in answers], [int(kind) for _, kind in answers], int(Derivative.WRONG))


@dataclass(frozen=True)
class _Case:
    """A scene with its points: starts, the model's fields for every point, and the directions of derivatives."""

    scene: StabilityScene
    grid: Points
    settings: Settings

    @cached_property
    def starts(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Fields of the model, positions and velocities of every point."""
        model = self.scene.model()
        data, rows = mujoco.MjData(model), []
        for i in range(len(self.grid)):
            self.scene.configure(model, data, self.grid[i])
            fields = {name: np.array(getattr(model, name)) for name in FIELDS}
            rows.append((fields | {"timestep": np.array(model.opt.timestep)}, *self.scene.start(self.grid[i])))
        return jax.tree.map(lambda *x: np.stack(x), *rows)

    @property
    def flown(self) -> Float[np.ndarray, " points"]:
        """What a body flies in the rollout (m)."""
        return self.grid.flown * self.settings.num_steps

    @property
    def largest(self) -> float:
        """Bound beyond which a derivative explodes: a hundred times what one jump of a stable contact makes of it.

        A damper that is just stable, h b = 2, changes a velocity by twice itself, which each of the steps that follow adds to
        the position.
        """
        return 100.0 * 2 * self.settings.num_steps

    @cached_property
    def pushes(self) -> tuple[np.ndarray, np.ndarray]:
        """Change of positions and velocities along which derivatives are taken, both moving the outcome alike.

        Quaternions stay.
        """
        model = self.scene.model()
        shift = np.cos(1.0 + np.arange(model.nq))
        for start in model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]:
            shift[start + 3 : start + 7] = 0.0
        push = np.sin(2.0 + np.arange(model.nv))
        seconds = self.settings.num_steps * self.grid.values["timestep"]
        return np.tile(shift, (len(self.grid), 1)), push / seconds[:, None]

    @cached_property
    def changes(self) -> dict[str, np.ndarray]:
        """Change of the model's parameters: each number by a share of itself, no two by the same."""
        fields = self.starts[0]
        return {
            name: fields[name] * (1 + 0.3 * np.cos(np.arange(fields[name][0].size))).reshape(fields[name][0].shape)
            for name in _RELATIVE
        }

    def motion(self, course: Course) -> Int[np.ndarray, " points"]:
        """Return what the rollouts did, by values of `Motion`."""
        scene, grid, start = self.scene, self.grid, self.starts[1]
        with np.errstate(all="ignore"):
            stored = np.array([_stored(scene, grid[i]) for i in range(len(grid))])
            budget = course.kinetic[:, 0] + stored + course.potential[:, 0] - course.potential.min(axis=1)
            gain, rest = course.kinetic.max(axis=1) / budget, course.kinetic[:, -1] / budget
            crossed = np.zeros(len(grid), bool)
            for first, second in scene.crossing:
                before, after = (x[:, second] - x[:, first] + scene.spacing for x in (start, course.qpos))
                crossed |= (after < 0) & (before > 0)
        return classify_motion(course, gain, rest, crossed)


def _stored(scene: StabilityScene, point: dict[str, float]) -> float:
    """Return a bound on the energy of springs compressed at the start, all bodies taken together (J)."""
    if point["depth"] <= 0:
        return 0.0
    stiffness, _ = scene.effective(point)
    mass = sum(scene.masses(point["mass_ratio"]))
    depth = scene.depth_unit * point["depth"] * len(scene.masses(1.0))
    return 0.5 * mass * stiffness / max(point["impedance_last"], 1e-4) * depth**2 + mass * GRAVITY * depth


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Run every scene in every precision, and C MuJoCo beside it, some scenes at a time: most of it is compilation."""
    size = settings.sizes
    scenes = [scene for scene in catalogue() if size.scenes is None or scene.name in size.scenes]

    def run(scene: StabilityScene) -> SceneOutcome:
        case = _Case(scene, points(scene, size.resolution, size.num_random, settings.seed), settings)
        return SceneOutcome(scene, case.grid, workspace.once(scene.name, lambda: _found(case)))

    # A simulation that goes wrong is what is looked for; C MuJoCo would write a file about it.
    with collected(), workspace.stage("simulating", "scenes", len(scenes)) as advance_to:
        return Outcome(settings, in_threads(run, scenes, advance_to))


def _found(case: _Case) -> xr.Dataset:
    """Return what every simulator did on the points of a scene."""
    in_c = in_c_mujoco(case.scene, case.grid, case.settings.num_steps)
    found, truth = {C_MUJOCO: {"motion": case.motion(in_c)}}, np.zeros(0)
    for precision in case.settings.precisions:
        with jax.enable_x64(precision == "float64"):
            program = Program(case.scene, case.settings)
            # Differences in float64 judge the derivatives of both precisions.
            truth = _differences(case, program) if precision == "float64" else truth
            run = program.run(case.starts)
        if precision != "float64":
            run = _judged_again(case, run)
        found[precision] = _of_mjxgrad(case, run, truth, in_c, _TOLERANCE[precision])
    nothing = {
        key: np.full_like(values, NOT_ASKED if "derivative" in key else 0) for key, values in found["float64"].items()
    }
    found[C_MUJOCO] = nothing | found[C_MUJOCO]
    arrays = {key: (("simulator", "point"), np.stack([one[key] for one in found.values()])) for key in nothing}
    return xr.Dataset(arrays, {"simulator": list(found)})


def in_c_mujoco(scene: StabilityScene, grid: Points, num_steps: int) -> Course:
    """Run C MuJoCo on every point, and look at every state up to the first bad one."""
    model = scene.model()
    data, rows = mujoco.MjData(model), []
    for i in range(len(grid)):
        scene.configure(model, data, grid[i])
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = scene.start(grid[i])
        rows.append(_follow(model, data, num_steps))
    return Course(*(np.array(column) for column in zip(*rows, strict=True)))


def _follow(model: mujoco.MjModel, data: mujoco.MjData, num_steps: int) -> tuple[np.ndarray, ...]:
    mass, residual, energies, is_sound = np.zeros((model.nv, model.nv)), 0.0, np.zeros((num_steps + 1, 2)), True
    for i in range(num_steps):
        qpos, qvel = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(model, data)
        energies[i:] = data.energy
        mujoco.mj_fullM(model, data, mass)
        forces = data.qfrc_smooth, data.qfrc_constraint
        residual = max(residual, float(unbalanced(mass, data.qacc, qvel, *forces, model.opt.timestep)))
        is_sound = bool(np.isfinite(data.qpos).all() and np.abs(data.qvel).max() < _VELOCITY_LIMIT)
        if not is_sound:
            return qpos, energies[:, 1], energies[:, 0], np.array(residual), np.array(False)
    mujoco.mj_forward(model, data)
    energies[-1] = data.energy
    return data.qpos.copy(), energies[:, 1], energies[:, 0], np.array(residual), np.array(True)


def unbalanced(mass, acceleration, velocity, smooth, constraint, timestep):
    """Return the share of a step's velocity by which a solve is off, in the norm of kinetic energy; of NumPy or JAX arrays.

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

    course: Course
    gradient: tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]  # by the model's fields, positions and velocities
    is_silent: np.ndarray  # whether a rollout returned a number that is not finite without a flag
    is_unsolved: np.ndarray  # whether the rollout says that some step's forces are not in balance
    steps: Steps  # state and solution at each step, for a closer look at those that seem wrong


def _observe(model: mjx.Model, data: mjx.Data) -> tuple[Array, ...]:
    mass, forces = mjx.full_m(model, data), (data.qfrc_smooth, data.qfrc_constraint)
    kinetic = 0.5 * data.qvel @ mass @ data.qvel
    potential = -model.body_mass @ (data.xipos @ model.opt.gravity)
    return kinetic, potential, unbalanced(mass, data.qacc, data.qvel, *forces, model.opt.timestep), data.qacc


class Program:
    """A scene's rollout with its gradient, vectorised over points, a chunk at once."""

    def __init__(self, scene: StabilityScene, settings: Settings):
        self._scene, self._settings = mg.load_scene(scene.model()), settings
        self._weights = jnp.array(scene.outcome)
        self._both = jax.jit(jax.vmap(jax.value_and_grad(self._outcome, argnums=(0, 1, 2), has_aux=True)))
        # Finite differences need no gradient, which takes four times as long as its value.
        self._value = jax.jit(jax.vmap(lambda *start: self._outcome(*start, observe=None)[0]))

    def values(self, starts: tuple) -> Float[np.ndarray, " points"]:
        """Return the outcome alone, from the model's fields and the start of every point."""
        return _in_chunks(self._value, starts, self._settings.sizes.chunk)

    def run(self, starts: tuple) -> Run:
        """Simulate and differentiate, likewise."""
        (value, trajectory), gradient = _in_chunks(self._both, starts, self._settings.sizes.chunk)
        kinetic, potential, residual, qacc = trajectory.observations
        # From the first bad step on the solver is asked what has no answer.
        first_bad, step = trajectory.first_bad_step[:, None], np.arange(residual.shape[1])
        residual = np.where((first_bad >= 0) & (step >= first_bad), 0.0, residual)
        course = Course(trajectory.qpos[:, -1], kinetic, potential, residual.max(axis=1), first_bad[:, 0] < 0)
        is_silent = ~trajectory.diverged & ~_all_finite((trajectory, value))
        last = self._settings.num_steps
        steps = Steps(trajectory.qpos[:, :last], trajectory.qvel[:, :last], qacc[:, :last], residual[:, :last])
        return Run(course, gradient, is_silent, trajectory.unsolved > 0, steps)

    def _outcome(
        self, fields: dict[str, Array], qpos: Array, qvel: Array, observe: Any = _observe
    ) -> tuple[Array, Any]:
        scene = _with_fields(self._scene, fields)
        trajectory = mg.rollout(
            scene,
            mg.initial_state(scene, qpos, qvel),
            horizon=self._settings.num_steps,
            observe=observe,
            contact=mg.Discrete(),
        )
        return trajectory.qpos[-1] @ self._weights, trajectory


def errors_of_solves(
    scene: StabilityScene, fields: dict[str, np.ndarray], steps: Steps, chunk: int
) -> Float[np.ndarray, "points steps"]:
    """Return the share of a step's velocity by which each solve is off, by the forces of its state in the present precision.

    Forces out of balance bound the error of an acceleration, but in single precision those of stiff rows may be out of balance
    by rounding alone, with hardly an error.
    """
    loaded = mg.load_scene(scene.model())

    def error(fields: dict[str, Array], qpos: Array, qvel: Array, qacc: Array) -> Array:
        model = _with_fields(loaded, fields).model
        data = mg.forward(model, loaded.data.replace(qpos=qpos, qvel=qvel))
        forces = (data.qfrc_smooth, data.qfrc_constraint)
        return unbalanced(mjx.full_m(model, data), qacc, qvel, *forces, model.opt.timestep)

    run = jax.jit(jax.vmap(jax.vmap(error, in_axes=(None, 0, 0, 0))))
    return _in_chunks(run, (fields, steps.qpos, steps.qvel, steps.qacc), max(1, chunk // steps.qpos.shape[1]))


def _judged_again(case: _Case, run: Run) -> Run:
    """Judge what seems not to be solved in single precision by the forces in double precision."""
    seems_wrong = np.flatnonzero(~(run.course.residual <= UNSOLVED))
    if not len(seems_wrong):
        return run
    steps, fields = jax.tree.map(lambda x: x[seems_wrong], (run.steps, case.starts[0]))
    # The numbers that were given to the solves.
    fields = {name: value.astype(steps.qpos.dtype) for name, value in fields.items()}
    with jax.enable_x64(True):
        errors = errors_of_solves(case.scene, fields, steps, case.settings.sizes.chunk)
    residual = run.course.residual.copy()
    residual[seems_wrong] = np.fmin(steps.unbalanced, errors).max(axis=1)
    return replace(run, course=replace(run.course, residual=residual))


def _with_fields(scene: mg.Scene, fields: dict[str, Array]) -> mg.Scene:
    others = {name: value for name, value in fields.items() if name != "timestep"}
    model = scene.model.replace(**others).tree_replace({"opt.timestep": fields["timestep"]})
    return eqx.tree_at(lambda scene: scene.model, scene, model)


def _in_chunks(run: Callable, arrays: tuple, size: int) -> Any:
    """Run pieces of one length, the last filled up with its last point, in the present precision."""
    total, dtype, parts = len(arrays[1]), jnp.zeros(()).dtype, []
    for start in range(0, total, size):
        index = np.minimum(np.arange(start, start + size), total - 1)
        found = run(*jax.tree.map(lambda x, i=index: x[i].astype(dtype), arrays))
        parts.append(jax.tree.map(lambda x, count=total - start: np.asarray(x)[:count], found))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _differences(case: _Case, program: Program) -> Float[np.ndarray, "2 widths points"]:
    """Return central differences of mjxgrad's own outcome, by the start and by parameters."""
    (fields, qpos, qvel), (shift, push) = case.starts, case.pushes

    def by_start(width: float) -> np.ndarray:
        step = (width * case.grid.flown)[:, None]
        return program.values((fields, qpos + step * shift, qvel + step * push))

    def by_parameters(width: float) -> np.ndarray:
        changed = {name: value + width * case.changes.get(name, 0.0) for name, value in fields.items()}
        return program.values((changed, qpos, qvel))

    kinds = ((by_start, _WIDTHS, case.grid.flown), (by_parameters, _PARAMETER_WIDTHS, case.flown))
    return np.array(
        [[(end(width) - end(-width)) / (2 * width * unit) for width in widths] for end, widths, unit in kinds]
    )


def _of_mjxgrad(case: _Case, run: Run, truth: np.ndarray, in_c: Course, tolerance: float) -> dict[str, np.ndarray]:
    motion, (fields, qpos, qvel) = case.motion(run.course), run.gradient
    shift, push = case.pushes
    with np.errstate(all="ignore"):
        by_start = (qpos * shift).sum(axis=1) + (qvel * push).sum(axis=1)
        terms = [(fields[name] * change).reshape(len(qpos), -1).sum(axis=1) for name, change in case.changes.items()]
        slopes = [by_start, np.sum(terms, axis=0) / case.flown]
        apart = np.abs(run.course.qpos - in_c.qpos).max(axis=1) / case.flown
    known, how = (_all_finite(run.gradient), run.course.is_sound), {"largest": case.largest, "tolerance": tolerance}
    kinds = [classify_derivative(slope, *known, one, **how) for slope, one in zip(slopes, truth, strict=True)]
    return {
        "motion": motion,
        "derivative": kinds[0],
        "derivative_by_parameters": kinds[1],
        "silent": run.is_silent,
        "untold": (motion == Motion.NOT_SOLVED) & ~run.is_unsolved,
        "apart_from_c": apart,
    }


def _all_finite(tree: Any) -> np.ndarray:
    leaves = [x for x in jax.tree.leaves(tree) if np.issubdtype(np.asarray(x).dtype, np.floating)]
    return np.all([np.isfinite(x).reshape(len(x), -1).all(axis=1) for x in leaves], axis=0)
