"""Error of the motion against run time, then of gradient estimates.

For these rollouts are simulated once for each time step, softness and derivative; the library's own estimators then draw their
samples from the records, so that nothing is simulated, or compiled, anew for another number of samples.
"""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.stats
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int, PRNGKeyArray

import mjxgrad as mg
from experiments.parallel import in_threads
from experiments.work_precision.cases import CONES, Case, case, own_case
from experiments.work_precision.outcome import (
    MG,
    MJX,
    NUM_ITERATIONS,
    SINGLE_TOLERANCE,
    TIGHT_TOLERANCE,
    C,
    Cone,
    Course,
    Estimate,
    GradientReference,
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
from mjxgrad.objective import Differentiated, Objective

# The references' share of the scene's own step, and their rule, the classical one: where nothing switches it is exact to
# rounding, elsewhere all rules are of first order. C MuJoCo affords more steps.
_FINEST, _C_FINEST = 32, 64
# Ends closer than this after the same steps are of the same motion; so are those ten times closer than the reference is known.
_SAME_MOTION = 1e-6
_REFERENCE_TOLERANCE = 1e-12
# Iterations of the solver that are too few, to see what they cost in error.
FEW_ITERATIONS = (1, 3)
# Step of the reference gradient, as a share of the scene's own: eight times finer than the finest estimate's by default.
_GRADIENT_FINEST, _GRADIENT_TOLERANCE = 8, 1e-10
_SCRAMBLES = 8
_REPEATS = 64
# Half the interval of the difference quotients, in standard deviations: of a Gaussian average it is off by a sixth of its square,
# a per cent, where the third derivative is as large as the first.
_REACH = 0.25

# By name, the library's estimator and the derivative that it uses.
ESTIMATORS: dict[str, tuple[str, str | None]] = {
    "zeroth order": ("zeroth_order", None),
    "first order, discrete": ("first_order", "discrete"),
    "first order, slope": ("first_order", "slope"),
    "first order, onset": ("first_order", "onset"),
    "α-order, onset": ("alpha_order", "onset"),
}


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every scene, one after the other: first its programs are compiled, then nothing is while it is timed."""
    cases = {name: case(name) for name in settings.scenes or settings.sizes.scenes}
    if settings.scene is not None:
        own = own_case(settings)
        cases = {own.title: own}
    needed = {name: variants(one, settings, settings.has_asides(name)) for name, one in cases.items()}
    courses = []
    # Compiling is most of the time, so progress is counted in programs; each scene is one more, measured.
    done = itertools.count(1)
    with workspace.stage("scenes", "programs", sum(len(found) + 1 for found in needed.values())) as advance_to:
        for name, one in cases.items():
            workspace.check(mg.load_scene(one.model), name=one.title)
            course = functools.partial(_course, name, one, needed[name], settings, lambda: advance_to(next(done)))
            courses.append(workspace.once(name, course))
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
        found += [replace(plain, derivative="slope")] if everything else []
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
    reference, estimates = _gradients(one, programs, settings)
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


class Recorded(Objective):
    """Rollouts that were made before, as an objective: its noise is the number of a rollout, drawn with replacement."""

    costs: Float[Array, " rollouts"]
    gradients: Float[Array, "rollouts dim"]
    noise: Float[Array, "rollouts dim"]
    stddev: Float[Array, " dim"]
    dim: int | None = eqx.field(static=True)

    def sample_noise(self, key: PRNGKeyArray) -> Int[Array, ""]:
        """Draw a rollout."""
        return jax.random.randint(key, (), 0, len(self.costs))

    def value(self, params: Float[Array, " dim"], noise: Int[Array, ""]) -> Float[Array, ""]:
        """Give its cost, whose derivative by the parameters is the recorded one."""
        return self.costs[noise] + self.gradients[noise] @ (params - jax.lax.stop_gradient(params))

    def score(self, params: Float[Array, " dim"], noise: Int[Array, ""]) -> Float[Array, " dim"]:
        """Give that of its noise."""
        return self.noise[noise] / self.stddev**2

    def differentiate(self, params: Float[Array, " dim"], noise: Int[Array, ""]) -> Differentiated:
        """Give cost, derivative and score as they were recorded."""
        unchanged = Partial(lambda vector: vector)
        return Differentiated(
            self.costs[noise], self.gradients[noise], self.score(params, noise), self.stddev, unchanged
        )


def _gradients(
    case: Case, programs: dict[Variant, Program], settings: Settings
) -> tuple[GradientReference, list[Estimate]]:
    """Estimate the gradient in every way, and a reference."""
    sizes = settings.sizes
    simulate = programs[Variant(MG, cone=case.cone, batch=sizes.batch)]
    derivatives = {"onset" if v.onset else v.derivative: p for v, p in programs.items() if v.derivative is not None}
    noise = quasi_random(sizes.num_rollouts, len(case.moved), settings.seed) * case.stddev
    reference = _reference_gradient(simulate, noise, settings.seed)
    ways = [(case.timestep / refinement, 1.0) for refinement in sizes.gradient_refinements]
    if "onset" in derivatives:  # there is a contact to soften
        ways += [(case.timestep, softening) for softening in sizes.softenings]
    estimates = []
    for timestep, softening in ways:
        knobs = Knobs(timestep, TIGHT_TOLERANCE, softening)
        every = {
            name: (one, *_record(one, noise, knobs, settings)) for name, one in {None: simulate, **derivatives}.items()
        }
        used = [(name, function, *every[one]) for name, (function, one) in ESTIMATORS.items() if one in every]
        for (name, function, program, record, taken), count in itertools.product(used, sizes.num_samples):
            errors = _estimate(function, count, record, np.array(reference.value), settings.seed)
            seconds = tuple(count * one for one in taken)
            about = name, count, timestep, softening
            estimates.append(Estimate(*about, *errors, seconds, program.compile_seconds))
    return reference, estimates


def quasi_random(count: int, dim: int, seed: int) -> Float[np.ndarray, "count dim"]:
    """Draw standard normal points more evenly than chance does: eight scrambles of Sobol's sequence, one after the other.

    The count is a multiple of 8; consecutive eighths are independent.
    """
    seeds = np.random.SeedSequence(seed).spawn(_SCRAMBLES)
    parts = [scipy.stats.qmc.Sobol(dim, rng=np.random.default_rng(one)).random(count // _SCRAMBLES) for one in seeds]
    return scipy.stats.norm.ppf(np.concatenate(parts))


def smoothed_gradient(
    costs: Float[np.ndarray, " rollouts"], noise: Float[np.ndarray, "rollouts dim"], stddev: float
) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
    r"""Give the gradient of the average of a cost over Gaussian noise, without differentiating it.

    $\nabla F = \mathbb{E}[f w]/\sigma^2$, where the part of $f$ that is linear in $w$ is put back exactly. The noise is
    `quasi_random`; its scrambles give the standard error, which goes with the gradient.
    """
    columns = np.column_stack([np.ones(len(noise)), noise])
    linear = np.linalg.lstsq(columns, costs, rcond=None)[0]
    rest = costs - columns @ linear
    mean, error = _over_scrambles(rest[:, None] * noise / stddev**2)
    return linear[1:] + mean, error


def _over_scrambles(samples: Float[np.ndarray, "rollouts dim"]) -> tuple[np.ndarray, np.ndarray]:
    """Give the mean and its standard error."""
    parts = samples.reshape(_SCRAMBLES, -1, samples.shape[1]).mean(axis=1)
    return parts.mean(axis=0), parts.std(axis=0, ddof=1) / np.sqrt(_SCRAMBLES)


def _reference_gradient(simulate: Program, noise: Float[np.ndarray, "rollouts dim"], seed: int) -> GradientReference:
    case = simulate.case
    fine, coarse = (Knobs(case.timestep * factor / _GRADIENT_FINEST, _GRADIENT_TOLERANCE) for factor in (1, 2))
    value, error = smoothed_gradient(_costs(simulate, noise, fine), noise, case.stddev)
    halved, _ = smoothed_gradient(_costs(simulate, noise, coarse), noise, case.stddev)
    # The same by the slope of the smoothed outcome along each parameter, on samples of its own.
    others = quasi_random(len(noise) // 2, len(case.moved), seed + 1) * case.stddev
    reach = _REACH * case.stddev
    ends = [
        [_costs(simulate, others + sign * reach * axis, fine) for axis in np.eye(len(case.moved))] for sign in (1, -1)
    ]
    other, other_error = _over_scrambles((np.array(ends[0]) - np.array(ends[1])).T / (2 * reach))
    size = np.linalg.norm(value)
    offsets = (error, halved - value, other - value, np.hypot(error, other_error))
    return GradientReference(tuple(value.tolist()), *(float(np.linalg.norm(one) / size) for one in offsets))


def _costs(simulate: Program, noise: np.ndarray, knobs: Knobs) -> Float[np.ndarray, " rollouts"]:
    weights = simulate.case.weights
    return _in_chunks(simulate, lambda qvel: simulate.timed(qvel, knobs)[0][0] @ weights, noise)


def _in_chunks(program: Program, run: Callable, noise: np.ndarray) -> np.ndarray:
    """Run all, a batch at a time; what fills up the last one is cut off."""
    case, batch = program.case, program.variant.batch
    filled = np.concatenate([noise, np.zeros((-len(noise) % batch, noise.shape[1]))])
    starts = (case.start[1] + filled @ case.directions).reshape(-1, batch, case.model.nv)
    return np.concatenate([run(qvel) for qvel in starts])[: len(noise)]


def _record(program: Program, noise: np.ndarray, knobs: Knobs, settings: Settings) -> tuple[Recorded, list[float]]:
    """Simulate at one time step and softness; gradients are zero without a derivative. The times of one rollout go with it."""
    case, batch = program.case, program.variant.batch
    first = case.start[1] + np.resize(noise, (batch, noise.shape[1])) @ case.directions
    _, taken = repeated(program, first, knobs, settings.sizes)
    if program.variant.derivative is None:
        costs, gradients = _costs(program, noise, knobs), np.zeros_like(noise)
    else:
        both = _in_chunks(program, lambda qvel: np.column_stack(program.timed(qvel, knobs)[0]), noise)
        costs, gradients = both[:, 0], both[:, 1:]
    dim = noise.shape[1]
    arrays = {"costs": costs, "gradients": gradients, "noise": noise, "stddev": np.full(dim, case.stddev)}
    record = Recorded(**{name: jnp.asarray(each) for name, each in arrays.items()}, dim=dim)
    return record, [one / batch for one in taken]


def _estimate(
    function: str, num_samples: int, record: Recorded, right: np.ndarray, seed: int
) -> tuple[float, tuple[float, float], float, float, float]:
    """Give an estimator's error, spread, bias with its error, and variance, over the size of the right gradient."""
    size, keys = float(np.linalg.norm(right)), jax.random.split(jax.random.key(seed), _REPEATS)
    values = np.asarray(_repeated(record, keys, function, num_samples))
    # What it has in the mean, and the error of that, from all rollouts where it is linear in them.
    if function == "zeroth_order":
        centre, chance = smoothed_gradient(np.asarray(record.costs), np.asarray(record.noise), float(record.stddev[0]))
    elif function == "first_order":
        centre, chance = _over_scrambles(np.asarray(record.gradients))
    else:
        centre, chance = values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))
    offset, chance = (float(np.linalg.norm(each) / size) for each in (centre - right, chance))
    variance = float(values.var(axis=0, ddof=1).sum() / size**2)
    is_finite = np.isfinite([offset, chance, variance]).all()
    bias = float(np.sqrt(max(0.0, offset**2 - chance**2))) if is_finite else np.inf
    low, high = np.quantile(np.linalg.norm(values - right, axis=1) / size, (0.25, 0.75)).tolist()
    error = float(np.hypot(bias, np.sqrt(variance))) if is_finite else np.inf
    return error, (low, high), bias, chance, variance


@functools.partial(jax.jit, static_argnums=(2, 3))
def _repeated(objective: Recorded, keys: Array, function: str, num_samples: int) -> Float[Array, "repeats dim"]:
    estimator = getattr(mg.estimators, function)
    params = jnp.zeros_like(objective.stddev)
    return jax.vmap(lambda key: estimator(objective, params, key, num_samples=num_samples).value)(keys)
