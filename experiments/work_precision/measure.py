"""From settings to numbers: first of all the error of the motion against run time."""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

import mjxgrad as mg
from experiments.parallel import in_threads
from experiments.work_precision import gradient
from experiments.work_precision.cases import CONES, Case, case
from experiments.work_precision.outcome import (
    MG,
    MJX,
    NUM_ITERATIONS,
    SINGLE_TOLERANCE,
    TIGHT_TOLERANCE,
    C,
    Cone,
    Course,
    Integrator,
    Knobs,
    Outcome,
    Point,
    Reference,
    Variant,
)
from experiments.work_precision.programs import Ends, Native, Program, compiled, has_own_implicit, repeated
from experiments.work_precision.settings import Settings
from experiments.workspace import Workspace

# The references' share of the scene's own step, and their rule, the classical one: where nothing switches it is exact to
# rounding, elsewhere all rules are of first order. C MuJoCo affords more steps.
_FINEST, _C_FINEST = 32, 64
# Ends closer than this after the same steps are of the same motion; so are those ten times closer than the reference is known.
_SAME_MOTION = 1e-6
_REFERENCE_TOLERANCE = 1e-12
# Iterations of the solver that are too few, to see what they cost in error.
FEW_ITERATIONS = (1, 3)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every scene, one after the other: first its programs are compiled, then nothing is while it is timed."""
    cases = {name: case(name) for name in settings.scenes or settings.sizes.scenes}
    needed = {name: variants(one, settings, settings.has_asides(name)) for name, one in cases.items()}
    courses = []
    # Compiling is most of the time, so progress is counted in programs; each scene is one more, measured.
    done = itertools.count(1)
    with workspace.stage("scenes", "programs", sum(len(found) + 1 for found in needed.values())) as advance_to:
        for name, one in cases.items():
            workspace.check(mg.load_scene(one.model), name=one.title)
            courses.append(_course(name, one, needed[name], settings, lambda: advance_to(next(done))))
            advance_to(next(done))
    return Outcome(settings, tuple(courses))


def variants(one: Case, settings: Settings, has_asides: bool) -> list[Variant]:
    """Say for what a scene is compiled, without repetition, the longest compilations first.

    A cone makes no difference without friction, and implicitfast none where Euler's implicit damping is all there is. With
    asides one state alone, MJX in double precision and the other cone are taken, too.
    """
    everything = settings.sizes.has_all_variants
    plain = Variant(MG, cone=one.cone, batch=settings.sizes.batch)
    found = [replace(plain, derivative="discrete")]
    model = one.model
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if model.npair or touching.any():
        found = [replace(plain, onset=True, derivative="discrete"), *found, replace(plain, onset=True)]
        found += [replace(plain, derivative="event")] if everything else []
    has_own_rule = has_own_implicit(one)
    for library in (MJX, MG):
        own = replace(plain, library=library)
        found += [own] if library == MG or has_asides else []
        found += [replace(own, precision="float32")]
        found += [replace(own, precision="float32", batch=1)] if has_asides else []
        if library == MG or everything:
            found += [replace(own, integrator="RK4")]
            found += [replace(own, integrator="implicitfast")] if has_own_rule else []
    if has_asides and ((model.geom_condim[touching] > 1).any() or (model.pair_dim > 1).any()):
        found += [replace(plain, cone=name) for name in CONES if name != one.cone]
    if everything:
        found += [replace(plain, integrator="RK4", precision="float32")]
        found += [replace(plain, iterations=count) for count in FEW_ITERATIONS]
    return found


def _course(name: str, one: Case, needed: list[Variant], settings: Settings, on_each: Callable[[], None]) -> Course:
    built = in_threads(functools.partial(compiled, one), needed, lambda _: on_each())
    programs = dict(zip(needed, built, strict=True))
    noise = np.random.default_rng(settings.seed).normal(size=(settings.sizes.batch, len(one.moved)))
    qvel = one.start[1] + one.stddev * noise @ one.directions
    right = _truths(one, programs, qvel)
    points = _measured(one, programs, qvel, right, settings)
    reference, estimates = gradient.measured(one, programs, settings)
    references = {which: truth.found for which, truth in right.items()}
    return Course(name, one.title, one.timestep, one.cone, points, references, estimates, reference)


@dataclass(frozen=True)
class Truth:
    """The final states that motions are compared with, in units of the way gone and of speed, root mean square over states."""

    case: Case
    ends: Ends
    scales: tuple[float, float]
    found: Reference

    def errors(self, ends: Ends) -> tuple[float, float]:
        """Compare a batch of ends, or its first states: root-mean-square distances, relative; NaN if one is not finite."""
        count = len(ends[0])
        return _relative(self.case, (self.ends[0][:count], self.ends[1][:count]), ends, self.scales)


def _truths(
    case: Case, programs: dict[Variant, Program], qvel: Float[np.ndarray, "batch nv"]
) -> dict[tuple[str, Cone], Truth]:
    """Simulate the references of every engine, that of `mg.step`, which is MJX's too, or C MuJoCo's, and every cone.

    MJX makes other contacts than C MuJoCo on some scenes, and then has a reference of its own. Where the same steps of
    both end in the same states, C's serves both, for it is finer.
    """
    found: dict[tuple[str, Cone], Truth] = {}
    same, compiled_for = Knobs(case.timestep, _REFERENCE_TOLERANCE), {variant.cone for variant in programs}
    cones: list[Cone] = [case.cone, *(one for one in CONES if one in compiled_for and one != case.cone)]
    for cone in cones:
        rule = Native(case, Variant(C, "RK4", cone))
        native = _truth(case, qvel, rule, _C_FINEST, found.get((C, case.cone)))
        euler = Variant(MG, cone=cone, batch=len(qvel))
        plain = Native(case, Variant(C, cone=cone)).timed(qvel, same)[0]
        stepped = programs[euler].timed(qvel, same)[0]
        apart = max(_relative(case, plain, stepped, native.scales))
        if apart < max(_SAME_MOTION, native.found.error / 10):
            shared = native
        else:
            finer = programs.get(replace(euler, integrator="RK4"), programs[euler])
            shared = _truth(case, qvel, finer, _FINEST, found.get((MG, case.cone)))
            apart = max(native.errors(shared.ends))
        shared = replace(shared, found=replace(shared.found, distance_to_c=apart))
        found |= {(C, cone): native, (MG, cone): shared}
    return found


def _truth(
    case: Case, qvel: Float[np.ndarray, "batch nv"], program: Program | Native, finest: int, own_cone: Truth | None
) -> Truth:
    """Simulate at a fine step, at two and at four times it."""
    steps = [factor * case.timestep / finest for factor in (1, 2, 4)]
    runs = [program.timed(qvel, Knobs(step, _REFERENCE_TOLERANCE))[0] for step in steps]
    start = np.tile(case.start[0], (len(qvel), 1)), qvel
    way, speed = _rms(differences(case.model, start, runs[0])), np.sqrt((_rms(qvel) ** 2 + _rms(runs[0][1]) ** 2) / 2)
    scales = way, float(speed)
    error, coarser = (max(_relative(case, fine, coarse, scales)) for fine, coarse in itertools.pairwise(runs))
    distance = 0.0 if own_cone is None else max(own_cone.errors(runs[0]))
    return Truth(case, runs[0], scales, Reference(error, coarser, distance))


def _measured(
    case: Case,
    programs: dict[Variant, Program],
    qvel: Float[np.ndarray, "batch nv"],
    right: dict[tuple[str, Cone], Truth],
    settings: Settings,
) -> list[Point]:
    """Simulate in every way."""
    batch = len(qvel)
    cones: list[Cone] = [cone for cone in CONES if (C, cone) in right]
    rules: tuple[Integrator, ...] = ("implicitfast", "RK4", "Euler")
    native = [Variant(C, integrator, cone, batch=batch) for cone in cones for integrator in rules]
    native += [Variant(C, cone=case.cone, batch=batch, iterations=count) for count in FEW_ITERATIONS]
    native += [Variant(C, cone=case.cone)]
    every = [program for variant, program in programs.items() if variant.derivative is None]
    points = []
    for program in [*every, *(Native(case, variant) for variant in native)]:
        variant = program.variant
        truth = right[C if variant.library == C else MG, variant.cone]
        for knobs in _knobs(case, variant, settings):
            ends, seconds = repeated(program, qvel[: variant.batch], knobs, settings.sizes)
            per_second = tuple(taken / (variant.batch * case.duration) for taken in seconds)
            points.append(Point(variant, knobs, *truth.errors(ends), per_second, program.compile_seconds))
    return points


def _knobs(case: Case, variant: Variant, settings: Settings) -> list[Knobs]:
    """Vary the time step, and where nothing else is out of the ordinary the tolerance at the two coarsest ones."""
    sizes = settings.sizes
    tight = SINGLE_TOLERANCE if variant.precision == "float32" else TIGHT_TOLERANCE
    knobs = [Knobs(case.timestep / refinement, tight) for refinement in sizes.refinements]
    has_own_cone = variant.cone == case.cone or variant.library == C
    is_main = variant.integrator == "Euler" and variant.batch > 1 and variant.iterations == NUM_ITERATIONS
    if is_main and has_own_cone and not variant.onset:
        loose = [tolerance for tolerance in sizes.tolerances if tolerance > tight]
        knobs += [Knobs(case.timestep / factor, one) for one in loose for factor in sizes.refinements[:2]]
    return knobs


def differences(model: mujoco.MjModel, start: Ends, end: Ends) -> Float[np.ndarray, "batch nv"]:
    """Give what takes each start to its end, as `mj_differentiatePos` does, in m and rad; NaN where one is not finite."""
    found = np.full((len(end[0]), model.nv), np.nan)
    for row, one, other in zip(found, start[0], end[0], strict=True):
        if np.isfinite(one).all() and np.isfinite(other).all():
            mujoco.mj_differentiatePos(model, row, 1.0, one, other)
    return found


def _relative(case: Case, right: Ends, ends: Ends, scales: tuple[float, float]) -> tuple[float, float]:
    return _rms(differences(case.model, right, ends)) / scales[0], _rms(ends[1] - right[1]) / scales[1]


def _rms(differences: Float[np.ndarray, "batch nv"]) -> float:
    """Give the root mean square over states of the Euclidean norm."""
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))
