"""From settings to numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

import mjxgrad as mg
from experiments.parallel import in_threads, processes
from experiments.stability.classes import UNSOLVED, Motion, MotionRecord, classify_derivative, classify_motion
from experiments.stability.grid import Points, points
from experiments.stability.outcome import C_MUJOCO, Behaviour, Outcome, SceneOutcome
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

    Args:
        num_steps: of the rollout. A damper that is just stable, h b = 2, changes a velocity by twice itself, which each of
            the steps that follow adds to the position.
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
    behaviours = [{C_MUJOCO: _of_c(*case, settings)} for case in cases]
    apart: list[dict[str, np.ndarray]] = [{} for _ in cases]
    truths: list[np.ndarray] = []
    for precision in settings.precisions:
        with _precision(precision):
            runs = _run_all(cases, precision, size, settings, workspace)
        if precision == "float64":
            truths = [run.differences for run in runs if run.differences is not None]
        else:
            runs = _judge_solves(cases, runs, size.chunk, workspace)
        for i, (case, run) in enumerate(zip(cases, runs, strict=True)):
            behaviours[i][precision] = _of_mjxgrad(*case, run, truths[i], precision, settings)
            apart[i][precision] = _apart(case[1], run.discrete.course, case[2].course, settings.num_steps)
    found = zip(scenes, grids, behaviours, apart, strict=True)
    return Outcome(settings, [SceneOutcome(*one) for one in found])


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
    flown = _flown_in_step(grid)
    shift, push = direction(scene, num_steps, grid.values["timestep"])
    changes = _changes(reference)
    quotients = []
    for width in WIDTHS:
        ends = []
        for side in (1, -1):
            step = (side * width * flown)[:, None]
            start = (reference.qpos + step * shift, reference.qvel + step * push)
            ends.append(program.values(reference.fields, *start))
        quotients.append((ends[0] - ends[1]) / (2 * width * flown))
    for width in _PARAMETER_WIDTHS:
        ends = []
        for side in (1, -1):
            fields = {
                name: value + side * width * changes.get(name, np.zeros_like(value))
                for name, value in reference.fields.items()
            }
            ends.append(program.values(fields, reference.qpos, reference.qvel))
        quotients.append((ends[0] - ends[1]) / (2 * width * flown * num_steps))
    return np.array(quotients).reshape(2, 2, -1)


def _changes(reference: Reference) -> dict[str, np.ndarray]:
    """Change each number by a share of itself, no two by the same."""
    return {
        name: value * (1 + 0.3 * np.cos(np.arange(value[0].size))).reshape(value[0].shape)
        for name, value in reference.fields.items()
        if name in _RELATIVE
    }


def _flown_in_step(grid: Points) -> Float[np.ndarray, " points"]:
    return grid.values["speed"] * grid.values["timestep"]


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


def _of_c(scene: StabilityScene, grid: Points, reference: Reference, expected, settings: Settings) -> Behaviour:
    record = _record(scene, grid, reference.qpos, reference.course, expected)
    coarse, fine = reference.differences
    is_finite = np.isfinite(fine)
    derivative = classify_derivative(
        fine,
        is_finite,
        record.is_sound,
        fine,
        np.abs(fine - coarse),
        largest=largest(settings.num_steps),
        tolerance=_TOLERANCE["float64"],
    )
    none = np.zeros(len(grid), bool)
    return Behaviour(classify_motion(record), derivative, None, None, none, none, none, none, record.gain)


def _of_mjxgrad(
    scene: StabilityScene,
    grid: Points,
    reference: Reference,
    expected: np.ndarray,
    runs: _Runs,
    truth: np.ndarray,
    precision: str,
    settings: Settings,
) -> Behaviour:
    run, event = runs.discrete, runs.event
    record = _record(scene, grid, reference.qpos, run.course, expected)
    shift, push = direction(scene, settings.num_steps, grid.values["timestep"])
    flown = _flown_in_step(grid) * settings.num_steps
    bound, tolerance = largest(settings.num_steps), _TOLERANCE[precision]
    along_start = along(run, {"qpos": shift, "qvel": push})
    along_parameters = along(run, _changes(reference)) / flown
    kinds = [
        classify_derivative(
            value,
            run.is_gradient_finite,
            record.is_sound,
            fine,
            np.abs(fine - coarse),
            largest=bound,
            tolerance=tolerance,
        )
        for value, (coarse, fine) in zip((along_start, along_parameters), truth, strict=True)
    ]
    is_wild = ~run.is_gradient_finite | ~(np.abs(along_start) <= bound) | ~(np.abs(along_parameters) <= bound)
    is_sound = np.asarray(
        jax.vmap(lambda gradient, diverged: soundness(gradient, diverged, bound=bound).is_sound)(
            (run.gradient[0], along_start, along_parameters),
            ~record.is_sound,
        )
    )
    return Behaviour(
        classify_motion(record),
        kinds[0],
        kinds[1],
        None if event is None else _judge_event(record, event, bound),
        run.is_silent | (False if event is None else event.is_silent),
        (classify_motion(record) == Motion.UNSOLVED) & ~run.is_unsolved,
        is_wild & record.is_sound,
        is_wild & record.is_sound & is_sound,
        record.gain,
    )


def _judge_event(record: MotionRecord, run: Run, bound: float) -> np.ndarray:
    """Compare with the restitution after a right bounce; elsewhere only tell what is not finite or explodes."""
    derivative = run.gradient[1][:, 0]
    truth = np.where(classify_motion(record) == Motion.BOUNCES_RIGHT, -record.expected, np.nan)
    return classify_derivative(
        derivative, run.is_gradient_finite, record.is_sound, truth, 0 * truth, largest=bound, tolerance=_EVENT_TOLERANCE
    )


def _apart(grid: Points, ours: Course, theirs: Course, num_steps: int) -> Float[np.ndarray, " points"]:
    with np.errstate(invalid="ignore"):
        return np.abs(ours.qpos - theirs.qpos).max(axis=1) / (_flown_in_step(grid) * num_steps)
