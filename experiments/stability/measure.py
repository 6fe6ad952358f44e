"""From settings to numbers: mjxgrad beside C MuJoCo on every point."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
import xarray as xr
from jaxtyping import Float

import mjxgrad as mg
from experiments.parallel import in_threads, processes
from experiments.problems.soundness import soundness
from experiments.stability.classes import (
    UNSOLVED,
    Derivative,
    Motion,
    MotionRecord,
    classify_derivative,
    classify_motion,
)
from experiments.stability.scenes import GRAVITY, Points, StabilityScene, catalogue, effective, points
from experiments.stability.settings import Settings
from experiments.stability.simulators import (
    WIDTHS,
    Course,
    Program,
    Reference,
    Run,
    along,
    direction,
    errors_of_solves,
    simulate,
)
from experiments.workspace import Workspace
from mjxgrad.contact.bounce import Bounce, integrated_restitution

C_MUJOCO = "C MuJoCo"
NOT_ASKED = -1
"""In the place of a value of `Derivative` that was not asked for."""
_JUDGED = ("derivative", "derivative_by_parameters", "slope_derivative")


@dataclass(frozen=True)
class SceneOutcome:
    """One scene."""

    scene: StabilityScene  # of the catalogue
    points: Points  # of its grid
    # By simulator (`C_MUJOCO`, and mjxgrad by its precision) and point: `motion`, of `Motion`; of `Derivative` that of the
    # discrete gradient along a change of the start (`derivative`) and of the model's parameters
    # (`derivative_by_parameters`), and that of the slope at MuJoCo's motion (`slope_derivative`); whether numbers that are
    # not finite left the rollout without a flag (`silent`), whether some step is not solved and `Trajectory.unsolved` is zero
    # (`untold`), whether the gradient is not finite or explodes where `Trajectory.diverged` is false
    # (`gradient_unflagged_by_rollout`), and `soundness` finds nothing wrong either (`missed`); difference of the final
    # positions from those of C MuJoCo over what a body flies (`apart_from_c`), and largest kinetic energy over what there
    # was to draw on (`energy`).
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
        """One row per point, for metrics.csv."""
        return [row for one in self.scenes for row in _rows(one)]


def against_c(found: xr.Dataset, precision: str) -> np.ndarray:
    """Compare mjxgrad's motion with that of C MuJoCo: above 0 where it is of a worse kind, below where of a better one."""
    # All that are fine have one rank.
    ranks = np.maximum(found.motion, Motion.BOUNCES_RIGHT)
    return (ranks.sel(simulator=precision) - ranks.sel(simulator=C_MUJOCO)).values


def _rows(one: SceneOutcome) -> list[dict[str, Any]]:
    columns: dict[str, Any] = {}
    for name in one.found.simulator.values:
        of_one = one.found.sel(simulator=name)
        keys = [key for key in of_one.data_vars if key != "missed"] if name != C_MUJOCO else ["motion", "derivative"]
        prefix = "c" if name == C_MUJOCO else name
        columns |= {f"{prefix}_{key}": _readable(str(key), of_one[key].values) for key in keys}
    planes = ["random" if i < 0 else " × ".join(one.points.planes[i]) for i in one.points.family]
    return [
        {
            "scene": one.scene.name,
            "plane": plane,
            **one.points[i],
            **{key: values[i] for key, values in columns.items()},
        }
        for i, plane in enumerate(planes)
    ]


def _readable(key: str, values: np.ndarray) -> list[Any]:
    if key != "motion" and key not in _JUDGED:
        return values.tolist()
    kind = Derivative if key in _JUDGED else Motion
    return ["" if value == NOT_ASKED else kind(value).label for value in values]


_RELATIVE = ("geom_solref", "jnt_solref", "geom_friction", "timestep")
"""Fields of the model that are changed in proportion, to judge the derivative by them."""
_PARAMETER_WIDTHS = (1e-6, 2e-7)
_TOLERANCE = {"float64": 1e-3, "float32": 5e-2}
_SLOPE_TOLERANCE = 0.1
# What C MuJoCo is not asked for.
_NOTHING = {
    "derivative_by_parameters": NOT_ASKED, "slope_derivative": NOT_ASKED, "silent": False, "untold": False,
    "gradient_unflagged_by_rollout": False, "missed": False, "apart_from_c": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class _Case:
    """A scene with its points, and what C MuJoCo did on them."""

    scene: StabilityScene
    grid: Points
    reference: Reference
    settings: Settings

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
    def push(self) -> dict[str, np.ndarray]:
        """The change of the start along which derivatives are taken."""
        shift, push = direction(self.scene, self.settings.num_steps, self.grid.values["timestep"])
        return {"qpos": shift, "qvel": push}

    @cached_property
    def changes(self) -> dict[str, np.ndarray]:
        """The change of the model's parameters: each number by a share of itself, no two by the same."""
        return {
            name: value * (1 + 0.3 * np.cos(np.arange(value[0].size))).reshape(value[0].shape)
            for name, value in self.reference.fields.items()
            if name in _RELATIVE
        }

    @cached_property
    def restitution(self) -> Float[np.ndarray, " points"]:
        """That of the motion itself, where it is a single bounce from outside."""
        found = np.full(len(self.grid), np.nan)
        for i in range(len(self.grid) if self.scene.bounces else 0):
            point = self.grid[i]
            stiffness, damping = effective(self.scene, point)
            constant, ratio = 2 / damping, damping / (2 * np.sqrt(stiffness))
            impedance = (point["impedance_first"], point["impedance_last"], point["width"])
            if impedance[0] == impedance[1]:
                found[i] = float(Bounce(constant, ratio, point["speed"]).restitution)
            elif impedance[2] > 0:
                with suppress(ValueError):
                    found[i] = integrated_restitution(constant, ratio, impedance, point["speed"])[0]
        return found


@dataclass(frozen=True)
class _Runs:
    """What mjxgrad did on all points of a scene in one precision."""

    discrete: Run  # motion and discrete gradient
    event: Run | None  # the same with the slope at MuJoCo's motion; None where it was not asked for
    differences: np.ndarray | None  # of the outcome (start and parameters, widths, points), in float64


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Run every scene in every precision, and C MuJoCo beside it."""
    size = settings.sizes
    scenes = [scene for scene in catalogue() if size.scenes is None or scene.name in size.scenes]
    cases = []
    with workspace.stage("C MuJoCo", "scenes", len(scenes)) as advance_to, processes() as pool:
        for scene in scenes:
            grid = points(scene, size.resolution, size.num_random, settings.seed)
            in_c = functools.partial(simulate, scene, grid, settings.num_steps, pool)
            cases.append(_Case(scene, grid, workspace.once(f"C {scene.name}", in_c), settings))
            advance_to(len(cases))
    found = [{C_MUJOCO: _of_c(case)} for case in cases]
    truths: list[np.ndarray] = []
    for precision in settings.precisions:
        with _precision(precision):
            runs = _run_all(cases, precision, workspace)
        if precision == "float64":
            truths = [run.differences for run in runs if run.differences is not None]
        else:
            runs = _judge_solves(cases, runs, size.chunk, workspace)
        for one, case, run, truth in zip(found, cases, runs, truths, strict=True):
            one[precision] = _of_mjxgrad(case, run, truth, precision)
    labelled = [SceneOutcome(case.scene, case.grid, _labelled(one)) for case, one in zip(cases, found, strict=True)]
    return Outcome(settings, labelled)


def _labelled(found: dict[str, dict[str, np.ndarray]]) -> xr.Dataset:
    """Label what each simulator did on the points of a scene."""
    ours, count = found["float64"], len(found["float64"]["motion"])
    arrays = {
        key: np.stack([np.broadcast_to(one[key] if key in one else _NOTHING[key], count) for one in found.values()])
        for key in ours
    }
    return xr.Dataset(
        {key: (("simulator", "point"), array) for key, array in arrays.items()}, {"simulator": list(found)}
    )


@contextmanager
def _precision(name: str) -> Iterator[None]:
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", name == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def _run_all(cases: list[_Case], precision: str, workspace: Workspace) -> list[_Runs]:
    """Run the programs of all scenes, some at a time: most of it is compilation."""

    def run(case: _Case) -> _Runs:
        scene, settings, size = case.scene, case.settings, case.settings.sizes
        arrays = (case.reference.fields, case.reference.qpos, case.reference.qvel)
        onset = mg.Onset() if settings.onset else None
        program = Program(scene, settings.num_steps, "discrete", size.chunk, onset)
        has_event = not settings.onset and (size.event is None or scene.name in size.event)
        event = Program(scene, settings.num_steps, "slope", size.chunk).run(*arrays) if has_event else None
        # In float64 alone, whose differences judge the derivatives of both.
        truth = _differences(case, program) if precision == "float64" else None
        return _Runs(program.run(*arrays), event, truth)

    with workspace.stage(f"mjxgrad, {precision}", "scenes", len(cases)) as advance_to:
        return in_threads(
            lambda case: workspace.once(f"{precision} {case.scene.name}", lambda: run(case)), cases, advance_to
        )


def _judge_solves(cases: list[_Case], runs: list[_Runs], chunk: int, workspace: Workspace) -> list[_Runs]:
    """Judge what seems not to be solved in single precision by the forces in double precision."""

    def judge(pair: tuple[_Case, _Runs]) -> _Runs:
        case, run = pair
        course, steps = run.discrete.course, run.discrete.steps
        seems_wrong = np.flatnonzero(~(course.residual <= UNSOLVED))
        if not len(seems_wrong):
            return run
        steps, fields = jax.tree.map(lambda x: x[seems_wrong], (steps, case.reference.fields))
        # The numbers that were given to the solves.
        fields = {name: value.astype(steps.qpos.dtype) for name, value in fields.items()}
        errors = errors_of_solves(case.scene, fields, steps, chunk)
        residual = course.residual.copy()
        residual[seems_wrong] = np.fmin(steps.unbalanced, errors).max(axis=1)
        return replace(run, discrete=replace(run.discrete, course=replace(course, residual=residual)))

    with _precision("float64"), workspace.stage("solves, again in float64", "scenes", len(cases)) as advance_to:
        return in_threads(judge, zip(cases, runs, strict=True), advance_to)


def _differences(case: _Case, program: Program) -> np.ndarray:
    """Give central differences (start and parameters, widths, points) of mjxgrad's own outcome."""
    reference = case.reference

    def from_start(width: float) -> np.ndarray:
        step = (width * case.grid.flown)[:, None]
        moved = {name: getattr(reference, name) + step * push for name, push in case.push.items()}
        return program.values(reference.fields, **moved)

    def by_parameters(width: float) -> np.ndarray:
        fields = {name: value + width * case.changes.get(name, 0.0) for name, value in reference.fields.items()}
        return program.values(fields, reference.qpos, reference.qvel)

    kinds = ((from_start, WIDTHS, case.grid.flown), (by_parameters, _PARAMETER_WIDTHS, case.flown))
    return np.array(
        [[(end(width) - end(-width)) / (2 * width * unit) for width in widths] for end, widths, unit in kinds]
    )


def _record(case: _Case, course: Course) -> MotionRecord:
    scene, grid, start, count = case.scene, case.grid, case.reference.qpos, len(case.grid)
    with np.errstate(all="ignore"):
        stored = np.array([_stored(scene, grid[i]) for i in range(count)])
        budget = course.kinetic[:, 0] + stored + course.potential[:, 0] - course.potential.min(axis=1)
        gain, rest = course.kinetic.max(axis=1) / budget, course.kinetic[:, -1] / budget
        crossed = np.zeros(count, bool)
        for first, second in scene.crossing:
            ahead = course.qpos[:, second] - course.qpos[:, first] + scene.spacing
            crossed |= (ahead < 0) & (start[:, second] - start[:, first] + scene.spacing > 0)
        has_left = np.zeros(count, bool)
        if scene.bounces:
            has_left = (course.qvel[:, 0] > 0) & (course.qpos[:, 0] > grid.values["margin"])
        restitution = np.where(has_left, course.qvel[:, 0] / grid.values["speed"], np.nan)
    is_sound = course.first_bad_step < 0
    return MotionRecord(is_sound, course.residual, gain, rest, crossed, restitution, case.restitution)


def _stored(scene: StabilityScene, point: dict[str, float]) -> float:
    """Bound on the energy of springs compressed at the start, all bodies taken together (J)."""
    if point["depth"] <= 0:
        return 0.0
    stiffness, _ = effective(scene, point)
    mass = sum(scene.masses(point["mass_ratio"]))
    depth = scene.depth_unit * point["depth"] * len(scene.masses(1.0))
    return 0.5 * mass * stiffness / max(point["impedance_last"], 1e-4) * depth**2 + mass * GRAVITY * depth


def _of_c(case: _Case) -> dict[str, np.ndarray]:
    record = _record(case, case.reference.course)
    coarse, fine = case.reference.differences
    bounds = {"largest": case.largest, "tolerance": _TOLERANCE["float64"]}
    derivative = classify_derivative(fine, np.isfinite(fine), record.is_sound, fine, np.abs(fine - coarse), **bounds)
    return {"motion": classify_motion(record), "derivative": derivative, "energy": record.gain}


def _of_mjxgrad(case: _Case, runs: _Runs, truth: np.ndarray, precision: str) -> dict[str, np.ndarray]:
    run, event = runs.discrete, runs.event
    record = _record(case, run.course)
    motion, bound = classify_motion(record), case.largest
    slopes = [along(run, case.push), along(run, case.changes) / case.flown]
    bounds = {"largest": bound, "tolerance": _TOLERANCE[precision]}
    kinds = [
        classify_derivative(slope, run.is_gradient_finite, record.is_sound, fine, np.abs(fine - coarse), **bounds)
        for slope, (coarse, fine) in zip(slopes, truth, strict=True)
    ]
    is_wild = ~run.is_gradient_finite | ~(np.abs(slopes) <= bound).all(axis=0)
    judged = jax.vmap(lambda gradient, diverged: soundness(gradient, diverged, bound=bound).is_sound)(
        (run.gradient[0], *slopes), ~record.is_sound
    )
    with np.errstate(invalid="ignore"):
        apart = np.abs(run.course.qpos - case.reference.course.qpos).max(axis=1) / case.flown
    return {
        "motion": motion,
        "derivative": kinds[0],
        "derivative_by_parameters": kinds[1],
        "slope_derivative": np.array(NOT_ASKED) if event is None else _judge_event(record, event, bound),
        "silent": run.is_silent if event is None else run.is_silent | event.is_silent,
        "untold": (motion == Motion.UNSOLVED) & ~run.is_unsolved,
        "gradient_unflagged_by_rollout": is_wild & record.is_sound,
        "missed": is_wild & record.is_sound & np.asarray(judged),
        "apart_from_c": apart,
        "energy": record.gain,
    }


def _judge_event(record: MotionRecord, run: Run, bound: float) -> np.ndarray:
    """Compare with the restitution after a right bounce; elsewhere only tell what is not finite or explodes."""
    truth = np.where(classify_motion(record) == Motion.BOUNCES_RIGHT, -record.expected, np.nan)
    slope, bounds = run.gradient[1][:, 0], {"largest": bound, "tolerance": _SLOPE_TOLERANCE}
    return classify_derivative(slope, run.is_gradient_finite, record.is_sound, truth, 0 * truth, **bounds)
