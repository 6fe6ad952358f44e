"""From settings to numbers."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import mjxgrad as mg
from experiments.work_precision import gradient, simulation
from experiments.work_precision.cases import CONES, Case, case
from experiments.work_precision.outcome import MG, MJX, Course, Outcome, Variant
from experiments.work_precision.programs import compiled, has_own_implicit
from experiments.work_precision.settings import Settings
from experiments.workspace import Workspace


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every scene, one after the other: first its programs are compiled, then nothing is while it is timed."""
    cases = {name: case(name) for name in settings.scene_names}
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
        found += [replace(plain, iterations=count) for count in simulation.FEW_ITERATIONS]
    return found


def _course(name: str, one: Case, needed: list[Variant], settings: Settings, on_each: Callable[[], None]) -> Course:
    programs = compiled(one, needed, on_each)
    qvel = simulation.starts(one, settings.sizes.batch, settings.seed)
    right = simulation.truths(one, programs, qvel)
    points = simulation.measured(one, programs, qvel, right, settings)
    reference, estimates = gradient.measured(one, programs, settings)
    return Course(
        name=name,
        title=one.title,
        timestep=one.timestep,
        cone=one.cone,
        points=tuple(points),
        references={which: truth.found for which, truth in right.items()},
        estimates=tuple(estimates),
        gradient_reference=reference,
    )
