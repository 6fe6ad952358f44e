"""Error of the motion against run time."""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from experiments.work_precision.cases import Case
from experiments.work_precision.native import differences, simulate
from experiments.work_precision.outcome import MG, MJX, NUM_ITERATIONS, ONSET, C, Point, Reference, relative_errors, rms
from experiments.work_precision.programs import (
    CONES,
    FEW_ITERATIONS,
    Cone,
    Ends,
    Integrator,
    Knobs,
    Program,
    Variant,
    own_cone,
    timed,
)  # fmt: skip
from experiments.work_precision.settings import Settings

# The classical rule for references: where nothing switches it is exact to rounding, elsewhere all rules are of first order.
# C MuJoCo affords more steps.
_FINEST = {(C, "RK4"): 64, (MG, "RK4"): 32, (MG, "Euler"): 32}
# Ends closer than this after the same steps are of the same motion; so are those ten times closer than the reference is known.
_SAME_MOTION = 1e-6
_REFERENCE_TOLERANCE = 1e-12
_SINGLE_TOLERANCE = 1e-6
_NAMES = {"mg": MG, "mjx": MJX}
_REPEATS_OF_C = 3


@dataclass(frozen=True)
class Truth:
    """The state that motions are compared with, and in what units.

    Attributes:
        ends: final positions and velocities.
        scales: way gone and speed, root mean square over the states.
        found: what is known about it.
    """

    ends: Ends
    scales: tuple[float, float]
    found: Reference

    def errors(self, case: Case, ends: Ends) -> tuple[float, float]:
        """Compare a batch of ends, or its first states."""
        count = len(ends[0])
        right = self.ends[0][:count], self.ends[1][:count]
        return relative_errors(differences(case.model, right, ends), ends[1] - right[1], self.scales)


def starts(case: Case, batch: int, seed: int) -> Float[np.ndarray, "batch nv"]:
    """Draw start velocities."""
    noise = np.random.default_rng(seed).normal(size=(batch, len(case.moved)))
    return case.start[1] + case.stddev * noise @ case.directions


def truths(
    case: Case, programs: dict[Variant, Program], qvel: Float[np.ndarray, "batch nv"], threads: int
) -> dict[tuple[str, Cone], Truth]:
    """Simulate the references of every engine and cone.

    MJX makes other contacts than C MuJoCo on some scenes, and then has a reference of its own. Where the same steps of
    both end in the same states, C's serves both, for it is finer.

    Args:
        case: the scene.
        programs: of the scene.
        qvel: start velocities.
        threads: of C MuJoCo.

    Returns:
        By engine (that of `mg.step`, which is MJX's too, or C MuJoCo's) and cone.
    """
    found: dict[tuple[str, Cone], Truth] = {}
    own, same = own_cone(case), Knobs(case.model.opt.timestep, _REFERENCE_TOLERANCE)
    compiled_for = {variant.cone for variant in programs}
    cones: list[Cone] = [own, *(one for one in CONES if one in compiled_for and one != own)]
    for cone in cones:
        native_run = functools.partial(simulate, case, qvel, cone=cone, threads=threads)
        native = _truth(case, qvel, lambda at, run=native_run: run(at, integrator="RK4")[0], (C, cone, "RK4"), found)
        euler = Variant("mg", cone=cone, batch=len(qvel))
        apart = max(_between(case, native_run(same)[0], programs[euler].run(qvel, same), native.scales))
        if apart < max(_SAME_MOTION, native.found.error / 10):
            shared = replace(native, found=replace(native.found, engine=MG, distance_to_c=apart))
        else:
            has_finer = replace(euler, integrator="RK4") in programs
            finer = replace(euler, integrator="RK4") if has_finer else euler
            run = functools.partial(programs[finer].run, qvel)
            shared = _truth(case, qvel, run, (MG, cone, finer.integrator), found)
            far = max(_between(case, native.ends, shared.ends, native.scales))
            shared = replace(shared, found=replace(shared.found, distance_to_c=far))
        found |= {(C, cone): native, (MG, cone): shared}
    return found


def _truth(
    case: Case,
    qvel: Float[np.ndarray, "batch nv"],
    run: Callable[[Knobs], Ends],
    names: tuple[str, Cone, Integrator],
    found: dict[tuple[str, Cone], Truth],
) -> Truth:
    """Simulate at a fine step, at two and at four times it."""
    engine, cone, integrator = names
    finest = case.model.opt.timestep / _FINEST[engine, integrator]
    runs = [run(Knobs(factor * finest, _REFERENCE_TOLERANCE)) for factor in (1, 2, 4)]
    scales = _scales(case, qvel, runs[0])
    error, coarser = (max(_between(case, fine, coarse, scales)) for fine, coarse in itertools.pairwise(runs))
    first = found.get((engine, own_cone(case)))
    distance = 0.0 if first is None else max(_between(case, first.ends, runs[0], first.scales))
    return Truth(runs[0], scales, Reference(engine, cone, integrator, finest, error, coarser, distance))


def measured(
    case: Case,
    programs: dict[Variant, Program],
    qvel: Float[np.ndarray, "batch nv"],
    right: dict[tuple[str, Cone], Truth],
    settings: Settings,
) -> list[Point]:
    """Simulate in every way.

    Args:
        case: the scene.
        programs: of the scene.
        qvel: start velocities.
        right: references.
        settings: of the run.

    Returns:
        The points.
    """
    points = []
    for variant, program in programs.items():
        if variant.derivative is None:
            points += _of_program(program, qvel[: variant.batch], right[MG, variant.cone], settings)
    return points + _of_c(case, qvel, right, settings)


def _of_program(program: Program, qvel: Float[np.ndarray, "batch nv"], truth: Truth, settings: Settings) -> list[Point]:
    case, variant, sizes = program.case, program.variant, settings.sizes
    is_own = variant.integrator == "Euler" and variant.cone == own_cone(case)
    is_main = is_own and not variant.onset and variant.batch > 1 and variant.iterations == NUM_ITERATIONS
    points = []
    for knobs in _knobs(case, settings, with_tolerances=is_main, is_single=variant.precision == "float32"):
        ends, seconds = timed(lambda at=knobs: program.run(qvel, at), repeats=sizes.repeats, seconds=sizes.seconds)
        errors = truth.errors(case, ends)
        points.append(
            Point(
                library=ONSET if variant.onset else _NAMES[variant.library],
                integrator=variant.integrator,
                cone=variant.cone,
                precision=variant.precision,
                timestep=knobs.timestep,
                tolerance=knobs.tolerance,
                iterations=variant.iterations,
                batch=variant.batch,
                position_error=errors[0],
                velocity_error=errors[1],
                seconds=tuple(taken / (variant.batch * case.duration) for taken in seconds),
                compile_seconds=program.trace_seconds + program.compile_seconds,
            )
        )
    return points


def _of_c(
    case: Case,
    qvel: Float[np.ndarray, "batch nv"],
    right: dict[tuple[str, Cone], Truth],
    settings: Settings,
) -> list[Point]:
    plain, varied = (_knobs(case, settings, with_tolerances=flag, is_single=False) for flag in (False, True))
    cones: list[Cone] = [name for name in CONES if (C, name) in right]
    points = []
    for cone in cones:
        find = functools.partial(_c_points, case, qvel, right[C, cone], settings, cone=cone)
        points += [*find(plain, integrator="implicitfast"), *find(plain, integrator="RK4"), *find(varied)]
        if cone == own_cone(case):
            points += [point for count in FEW_ITERATIONS for point in find(plain, iterations=count)]
            points += _c_points(case, qvel[:1], right[C, cone], settings, plain, cone=cone)
    return points


def _c_points(
    case: Case,
    qvel: Float[np.ndarray, "batch nv"],
    truth: Truth,
    settings: Settings,
    every: Sequence[Knobs],
    *,
    cone: Cone,
    integrator: Integrator = "Euler",
    iterations: int = NUM_ITERATIONS,
) -> list[Point]:
    threads, simulated = (settings.num_threads if len(qvel) > 1 else 1), len(qvel) * case.duration
    points = []
    for knobs in every:
        runs = [
            simulate(case, qvel, knobs, integrator=integrator, cone=cone, iterations=iterations, threads=threads)
            for _ in range(_REPEATS_OF_C)
        ]
        errors = truth.errors(case, runs[0][0])
        points.append(
            Point(
                library=C,
                integrator=integrator,
                cone=cone,
                precision="float64",
                timestep=knobs.timestep,
                tolerance=knobs.tolerance,
                iterations=iterations,
                batch=len(qvel),
                position_error=errors[0],
                velocity_error=errors[1],
                seconds=tuple(taken / simulated for _, taken in runs),
            )
        )
    return points


def _knobs(case: Case, settings: Settings, *, with_tolerances: bool, is_single: bool) -> list[Knobs]:
    tight = max(settings.tight_tolerance, _SINGLE_TOLERANCE) if is_single else settings.tight_tolerance
    own = case.model.opt.timestep
    knobs = [Knobs(own / refinement, tight) for refinement in settings.sizes.refinements]
    if with_tolerances:
        knobs += [
            Knobs(own / refinement, tolerance)
            for tolerance in settings.sizes.tolerances
            if tolerance > tight
            for refinement in settings.sizes.refinements[:2]
        ]
    return knobs


def _scales(case: Case, qvel: Float[np.ndarray, "batch nv"], ends: Ends) -> tuple[float, float]:
    start = np.tile(case.start[0], (len(qvel), 1)), qvel
    way = rms(differences(case.model, start, ends))
    return way, float(np.sqrt((rms(qvel) ** 2 + rms(ends[1]) ** 2) / 2))


def _between(case: Case, fine: Ends, coarse: Ends, scales: tuple[float, float]) -> tuple[float, float]:
    return relative_errors(differences(case.model, fine, coarse), coarse[1] - fine[1], scales)
