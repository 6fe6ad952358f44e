"""From settings to numbers."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import mjxgrad as mg
from experiments.work_precision import gradient, simulation
from experiments.work_precision.cases import Case, case
from experiments.work_precision.native import has_own_implicit
from experiments.work_precision.outcome import Course, Outcome
from experiments.work_precision.programs import CONES, FEW_ITERATIONS, Cone, Library, Variant, compiled, own_cone
from experiments.work_precision.settings import Settings
from experiments.workspace import Workspace


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every scene, one after the other: first its programs are compiled, then nothing is while it is timed."""
    cases = {name: case(name) for name in settings.scene_names}
    courses = []
    # Compiling is most of the time, so progress is counted in programs; each scene is one more, measured.
    total = sum(len(variants(one, settings, settings.has_asides(name))) + 1 for name, one in cases.items())
    done = itertools.count(1)
    with workspace.stage("scenes", "programs", total) as advance_to:
        for name, one in cases.items():
            workspace.check(mg.load_scene(one.model), name=one.title)
            courses.append(_course(name, one, settings, lambda: advance_to(next(done))))
            advance_to(next(done))
    return Outcome(settings, tuple(courses))


def variants(one: Case, settings: Settings, has_asides: bool) -> list[Variant]:
    """Say for what a scene is compiled, the longest compilations first.

    A cone makes no difference without friction, and implicitfast none where Euler's implicit damping is all there is.

    Args:
        one: the scene.
        settings: of the run.
        has_asides: whether to take one state alone, MJX in double precision and the other cone, too.

    Returns:
        The variants, without repetition.
    """
    batch, everything = settings.sizes.batch, settings.sizes.has_all_variants
    own = own_cone(one)
    found = [Variant("mg", cone=own, batch=batch, derivative="discrete")]
    if has_contacts(one):
        onset = Variant("mg", cone=own, batch=batch, onset=True)
        found = [replace(onset, derivative="discrete"), *found, onset]
        found += [Variant("mg", cone=own, batch=batch, derivative="event")] if everything else []
    libraries: tuple[Library, ...] = ("mjx", "mg")
    for library in libraries:
        found += [Variant(library, cone=own, batch=batch)] if library == "mg" or has_asides else []
        found += [Variant(library, cone=own, precision="float32", batch=batch)]
        found += [Variant(library, cone=own, precision="float32")] if has_asides else []
        if library == "mg" or everything:
            found += [Variant(library, "RK4", own, batch=batch)]
            found += [Variant(library, "implicitfast", own, batch=batch)] if has_own_implicit(one) else []
    cones: list[Cone] = [name for name in CONES if name != own and has_friction(one) and has_asides]
    found += [Variant("mg", cone=name, batch=batch) for name in cones]
    if everything:
        found += [Variant("mg", "RK4", own, "float32", batch)]
        found += [Variant("mg", cone=own, batch=batch, iterations=count) for count in FEW_ITERATIONS]
    return found


def has_contacts(one: Case) -> bool:
    """Say whether anything can touch."""
    return bool(one.model.npair) or bool(((one.model.geom_contype != 0) | (one.model.geom_conaffinity != 0)).any())


def has_friction(one: Case) -> bool:
    """Say whether a contact has friction."""
    model = one.model
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return bool((model.geom_condim[touching] > 1).any()) or bool((model.pair_dim > 1).any())


def _course(name: str, one: Case, settings: Settings, on_each: Callable[[], None]) -> Course:
    programs = compiled(one, variants(one, settings, settings.has_asides(name)), on_each)
    qvel = simulation.starts(one, settings.sizes.batch, settings.seed)
    right = simulation.truths(one, programs, qvel, settings.num_threads)
    points = simulation.measured(one, programs, qvel, right, settings)
    gradient_reference, estimates = gradient.measured(one, programs, settings)
    return Course(
        name=name,
        title=one.title,
        timestep=one.model.opt.timestep,
        cone=own_cone(one),
        points=tuple(points),
        references=tuple(truth.found for truth in right.values()),
        estimates=tuple(estimates),
        gradient_reference=gradient_reference,
    )
