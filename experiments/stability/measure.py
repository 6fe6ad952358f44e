"""From settings to numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import jax
import numpy as np
import xarray as xr
from jaxtyping import Float

import mjxgrad as mg
from experiments.parallel import in_threads, processes
from experiments.stability.classes import UNSOLVED, Motion, MotionRecord, classify_derivative, classify_motion
from experiments.stability.grid import Points, points
from experiments.stability.outcome import C_MUJOCO, NOT_ASKED, Outcome, SceneOutcome
from experiments.stability.program import Program, Run, along, errors_of_solves
from experiments.stability.reference import WIDTHS, Course, Reference, direction, simulate
from experiments.stability.scenes import GRAVITY, StabilityScene, catalogue, effective
from experiments.stability.settings import Settings, Sizes
from experiments.workspace import Workspace
from mjxgrad.diagnostics import soundness
from mjxgrad.tasks.textbook import Bounce, integrated_restitution

_RELATIVE = ("geom_solref", "jnt_solref", "geom_friction", "timestep")
"""Fields of the model that are changed in proportion, to judge the derivative by them."""
_PARAMETER_WIDTHS = (1e-6, 2e-7)
_TOLERANCE = {"float64": 1e-3, "float32": 5e-2}
_EVENT_TOLERANCE = 0.1
# What C MuJoCo is not asked for.
_NOTHING = {
    "derivative_by_parameters": NOT_ASKED, "event_derivative": NOT_ASKED, "silent": False, "untold": False,
    "gradient_unflagged_by_rollout": False, "missed": False, "apart_from_c": 0.0,
}  # fmt: skip

_Case = tuple[StabilityScene, Points, Reference, np.ndarray]


@dataclass(frozen=True)
class _Runs:
    """What mjxgrad did on all points of a scene in one precision.

    Attributes:
        discrete: motion and discrete gradient.
        event: the same with the event gradient; None where it was not asked for.
        differences: of the outcome (start and parameters, widths, points), in float64.
    """

    discrete: Run
    event: Run | None
    differences: np.ndarray | None


def largest(num_steps: int) -> float:
    """Bound beyond which a derivative explodes: a hundred times what one jump of a stable contact makes of it.

    A damper that is just stable, h b = 2, changes a velocity by twice itself, which each of the steps that follow adds to the
    position.
    """
    return 100.0 * 2 * num_steps


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Run every scene in every precision, and C MuJoCo beside it."""
    size = settings.sizes
    scenes = [scene for scene in catalogue() if size.scenes is None or scene.name in size.scenes]
    grids = [points(scene, size.resolution, size.num_random, settings.seed) for scene in scenes]
    references = []
    with workspace.stage("C MuJoCo", "scenes", len(scenes)) as advance_to, processes() as pool:
        for scene, grid in zip(scenes, grids, strict=True):
            references.append(simulate(scene, grid, settings.num_steps, pool))
            advance_to(len(references))
    expected = [_expected(scene, grid) for scene, grid in zip(scenes, grids, strict=True)]
    cases = list(zip(scenes, grids, references, expected, strict=True))
    found = [{C_MUJOCO: _of_c(*case, settings)} for case in cases]
    truths: list[np.ndarray] = []
    for precision in settings.precisions:
        with _precision(precision):
            runs = _run_all(cases, precision, size, settings, workspace)
        if precision == "float64":
            truths = [run.differences for run in runs if run.differences is not None]
        else:
            runs = _judge_solves(cases, runs, size.chunk, workspace)
        for i, (case, run) in enumerate(zip(cases, runs, strict=True)):
            found[i][precision] = _of_mjxgrad(*case, run, truths[i], precision, settings)
    datasets = [_labelled(one, len(grid)) for one, grid in zip(found, grids, strict=True)]
    return Outcome(settings, [SceneOutcome(*one) for one in zip(scenes, grids, datasets, strict=True)])


def _labelled(found: dict[str, dict[str, np.ndarray]], count: int) -> xr.Dataset:
    """Label what each simulator did on the points of a scene."""
    keys = list(found["float64"])
    stacks = {
        key: np.stack([np.broadcast_to(one.get(key, _NOTHING.get(key)), count) for one in found.values()])
        for key in keys
    }
    return xr.Dataset(
        {key: (("simulator", "point"), stack) for key, stack in stacks.items()}, {"simulator": list(found)}
    )


@contextmanager
def _precision(name: str) -> Iterator[None]:
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", name == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def _run_all(cases: list[_Case], precision: str, size: Sizes, settings: Settings, workspace: Workspace) -> list[_Runs]:
    """Run the programs of all scenes, some at a time: most of it is compilation."""

    def run(case: _Case) -> _Runs:
        scene, grid, reference, _ = case
        arrays = (reference.fields, reference.qpos, reference.qvel)
        onset = mg.Onset() if settings.onset else None
        program = Program(scene, settings.num_steps, "discrete", size.chunk, onset)
        has_event = not settings.onset and (size.event is None or scene.name in size.event)
        event = Program(scene, settings.num_steps, "event", size.chunk).run(*arrays) if has_event else None
        # In float64 alone, whose differences judge the derivatives of both.
        is_judge = precision == "float64"
        truth = _differences(scene, grid, reference, program, settings.num_steps) if is_judge else None
        return _Runs(program.run(*arrays), event, truth)

    with workspace.stage(f"mjxgrad, {precision}", "scenes", len(cases)) as advance_to:
        return in_threads(run, cases, advance_to)


def _judge_solves(cases: list[_Case], runs: list[_Runs], chunk: int, workspace: Workspace) -> list[_Runs]:
    """Judge what seems not to be solved in single precision by the forces in double precision."""

    def judge(pair: tuple[_Case, _Runs]) -> _Runs:
        (scene, _, reference, _), run = pair
        course, steps = run.discrete.course, run.discrete.steps
        seems_wrong = np.flatnonzero(~(course.residual <= UNSOLVED))
        if not len(seems_wrong):
            return run
        steps, fields = jax.tree.map(lambda x: x[seems_wrong], (steps, reference.fields))
        # The numbers that were given to the solves.
        fields = {name: value.astype(steps.qpos.dtype) for name, value in fields.items()}
        errors = errors_of_solves(scene, fields, steps, chunk)
        residual = course.residual.copy()
        residual[seems_wrong] = np.fmin(steps.unbalanced, errors).max(axis=1)
        return replace(run, discrete=replace(run.discrete, course=replace(course, residual=residual)))

    with _precision("float64"), workspace.stage("solves, again in float64", "scenes", len(cases)) as advance_to:
        return in_threads(judge, zip(cases, runs, strict=True), advance_to)


def _differences(scene: StabilityScene, grid: Points, reference: Reference, program: Program, num_steps: int):
    """Give central differences (start and parameters, widths, points) of mjxgrad's own outcome."""
    shift, push = direction(scene, num_steps, grid.values["timestep"])
    changes = _changes(reference)

    def from_start(width: float) -> np.ndarray:
        step = (width * grid.flown)[:, None]
        return program.values(reference.fields, reference.qpos + step * shift, reference.qvel + step * push)

    def by_parameters(width: float) -> np.ndarray:
        fields = {name: value + width * changes.get(name, 0.0) for name, value in reference.fields.items()}
        return program.values(fields, reference.qpos, reference.qvel)

    kinds = ((from_start, WIDTHS, grid.flown), (by_parameters, _PARAMETER_WIDTHS, grid.flown * num_steps))
    return np.array(
        [[(end(width) - end(-width)) / (2 * width * unit) for width in widths] for end, widths, unit in kinds]
    )


def _changes(reference: Reference) -> dict[str, np.ndarray]:
    """Change each number by a share of itself, no two by the same."""
    return {
        name: value * (1 + 0.3 * np.cos(np.arange(value[0].size))).reshape(value[0].shape)
        for name, value in reference.fields.items()
        if name in _RELATIVE
    }


def _expected(scene: StabilityScene, grid: Points) -> Float[np.ndarray, " points"]:
    """Give the restitution of the motion itself, where it is a single bounce from outside."""
    found = np.full(len(grid), np.nan)
    for i in range(len(grid) if scene.bounces else 0):
        point = grid[i]
        stiffness, damping = effective(scene, point)
        constant, ratio = 2 / damping, damping / (2 * np.sqrt(stiffness))
        impedance = (point["impedance_first"], point["impedance_last"], point["width"])
        if impedance[0] == impedance[1]:
            found[i] = float(Bounce(constant, ratio, point["speed"]).restitution)
        elif impedance[2] > 0:
            try:
                found[i] = integrated_restitution(constant, ratio, impedance, point["speed"])[0]
            except ValueError:
                continue
    return found


def _record(
    scene: StabilityScene, grid: Points, start: np.ndarray, course: Course, expected: Float[np.ndarray, " points"]
) -> MotionRecord:
    count = len(grid)
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
    return MotionRecord(is_sound, course.residual, gain, rest, crossed, restitution, expected)


def _stored(scene: StabilityScene, point: dict[str, float]) -> float:
    """Bound on the energy of springs compressed at the start, all bodies taken together (J)."""
    if point["depth"] <= 0:
        return 0.0
    stiffness, _ = effective(scene, point)
    mass = sum(scene.masses(point["mass_ratio"]))
    depth = scene.depth_unit * point["depth"] * len(scene.masses(1.0))
    return 0.5 * mass * stiffness / max(point["impedance_last"], 1e-4) * depth**2 + mass * GRAVITY * depth


def _of_c(
    scene: StabilityScene, grid: Points, reference: Reference, expected: np.ndarray, settings: Settings
) -> dict[str, np.ndarray]:
    record = _record(scene, grid, reference.qpos, reference.course, expected)
    coarse, fine = reference.differences
    bounds = {"largest": largest(settings.num_steps), "tolerance": _TOLERANCE["float64"]}
    derivative = classify_derivative(fine, np.isfinite(fine), record.is_sound, fine, np.abs(fine - coarse), **bounds)
    return {"motion": classify_motion(record), "derivative": derivative, "energy": record.gain}


def _of_mjxgrad(
    scene: StabilityScene,
    grid: Points,
    reference: Reference,
    expected: np.ndarray,
    runs: _Runs,
    truth: np.ndarray,
    precision: str,
    settings: Settings,
) -> dict[str, np.ndarray]:
    run, event = runs.discrete, runs.event
    record = _record(scene, grid, reference.qpos, run.course, expected)
    motion = classify_motion(record)
    shift, push = direction(scene, settings.num_steps, grid.values["timestep"])
    flown = grid.flown * settings.num_steps
    bound = largest(settings.num_steps)
    slopes = [along(run, {"qpos": shift, "qvel": push}), along(run, _changes(reference)) / flown]
    kinds = [
        classify_derivative(
            slope,
            run.is_gradient_finite,
            record.is_sound,
            fine,
            np.abs(fine - coarse),
            largest=bound,
            tolerance=_TOLERANCE[precision],
        )
        for slope, (coarse, fine) in zip(slopes, truth, strict=True)
    ]
    is_wild = ~run.is_gradient_finite | ~(np.abs(slopes) <= bound).all(axis=0)
    judged = jax.vmap(lambda gradient, diverged: soundness(gradient, diverged, bound=bound).is_sound)(
        (run.gradient[0], *slopes), ~record.is_sound
    )
    with np.errstate(invalid="ignore"):
        apart = np.abs(run.course.qpos - reference.course.qpos).max(axis=1) / flown
    return {
        "motion": motion,
        "derivative": kinds[0],
        "derivative_by_parameters": kinds[1],
        "event_derivative": np.array(NOT_ASKED) if event is None else _judge_event(record, event, bound),
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
    return classify_derivative(
        run.gradient[1][:, 0],
        run.is_gradient_finite,
        record.is_sound,
        truth,
        0 * truth,
        largest=bound,
        tolerance=_EVENT_TOLERANCE,
    )
