"""Error of the motion against run time, then of gradient estimates.

Few programs are compiled, for each takes long: time step, number of steps and solver tolerance are arguments. For gradients
rollouts are simulated once for each time step and derivative; the library's own estimators then draw their samples from the
records.
"""

import copy
import functools
import itertools
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import numpy.typing as npt
import scipy.stats
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

import mjxgrad as mg
from experiments.motion import advance
from experiments.problems.comparison import over_keys
from experiments.work_precision.cases import Case, case, own_case
from experiments.work_precision.settings import Settings, Sizes
from experiments.workspace import Workspace, in_threads, num_cores
from mjxgrad._mjx import mjx
from mjxgrad._warnings import collected
from mjxgrad.objective import Differentiated, Objective

C, MG, MJX, ONSET = "C MuJoCo", "mg.step", "mjx.step", "mg.step, onset"
Speeds = Float[np.ndarray, "batch nv"]
Ends = tuple[Float[np.ndarray, "batch nq"], Float[np.ndarray, "batch nv"]]
Integrator = Literal["Euler", "implicitfast", "RK4"]
# jax 0.11.2 ended the process where threads that loaded at once traced the same function.
_LOADING = threading.Lock()
_INTEGRATORS: dict[Integrator, mujoco.mjtIntegrator] = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
# Of the solver: what each precision resolves, and for references.
_TOLERANCE = {"float32": 1e-6, "float64": 1e-8}
_REFERENCE_TOLERANCE = 1e-12
# The references' share of the scene's own step, and their rule, the classical one: where nothing switches it is exact to
# rounding, elsewhere all rules are of first order. C MuJoCo affords more steps.
_FINEST, _C_FINEST = 32, 64
# Ends closer than this after the same steps are of the same motion; so are those ten times closer than the reference is known.
_SAME_MOTION = 1e-6
# Step of the reference gradient, as a share of the scene's own: eight times finer than the finest estimate's by default.
_GRADIENT_FINEST, _GRADIENT_TOLERANCE = 8, 1e-10
# C MuJoCo's rollouts keep every state on the way: this many at once stay within some hundred megabytes.
_AT_A_TIME = 128
_SCRAMBLES = 8
_REPEATS = 64

# By name, the library's estimator and the derivative that it uses.
ESTIMATORS: dict[str, tuple[str, str | None]] = {
    "zeroth order": ("zeroth_order", None),
    "first order, discrete": ("first_order", "discrete"),
    "first order, onset": ("first_order", "onset"),
    "α-order, onset": ("alpha_order", "onset"),
}


@dataclass(frozen=True)
class Variant:
    """What a program is compiled for, beside the scene, or how C MuJoCo is run."""

    library: str  # `MG`, `MJX` or `C`; `ONSET` is `MG` with contacts that begin within the step
    integrator: Integrator = "Euler"
    precision: Literal["float32", "float64"] = "float64"
    has_gradient: bool = False  # whether the discrete gradient by the uncertain velocities comes with the outcome


class _Timed:
    """Something that took some seconds, in each of several repetitions."""

    seconds: tuple[float, ...]

    @property
    def cost(self) -> float:
        """Median of the times (s)."""
        return float(np.median(self.seconds))


@dataclass(frozen=True)
class Point(_Timed):
    """One way of simulating a scene."""

    variant: Variant
    timestep: float  # s
    # Root mean square over the states, the larger of the distance in m and rad over that of the way gone and of velocities
    # over their size; infinite if some state is not finite.
    error: float
    seconds: tuple[float, ...]  # wall time per simulated second of one state, of each repetition


@dataclass(frozen=True)
class Reference:
    """How well the motion is known that an engine's points are compared with, in the units of their errors."""

    error: float  # between the finest run and the one at twice its step
    coarser_error: float  # likewise between the runs at two and four times the step

    @property
    def converges(self) -> bool:
        """Whether halving the step still brought it nearer, or there is nothing left but rounding."""
        return self.error < 0.75 * self.coarser_error or self.error < 1e-9


@dataclass(frozen=True)
class Estimate(_Timed):
    """One way of estimating a gradient; errors are over the norm of the reference."""

    estimator: str  # its name, with the derivative that it uses
    num_samples: int
    timestep: float  # s
    error: float  # root of squared bias and variance
    bias: float  # of it what chance does not explain
    bias_error: float  # what chance would make of no bias
    variance: float  # of one estimate, the trace
    seconds: tuple[float, ...]  # wall time of its rollouts, of each repetition


@dataclass(frozen=True)
class Course:
    """All that was measured on one scene: ways to simulate it, and to estimate the gradient."""

    name: str
    title: str
    timestep: float  # the scene's own (s)
    points: Sequence[Point]
    references: dict[str, Reference]  # of the motion, by engine: that of `MG`, which is MJX's too, or `C`
    estimates: Sequence[Estimate]
    gradient_error: float  # of the reference gradient: its standard error and its change when the step is halved
    compile_seconds: dict[str, float]  # by library, to trace and compile its Euler step in float32

    def floor(self, library: str) -> float:
        """Return the error below which a library's errors are not known."""
        return self.references[C if library == C else MG].error


@dataclass(frozen=True)
class Outcome:
    """All numbers: one course per scene."""

    settings: Settings
    courses: tuple[Course, ...]

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of metrics.csv: points of the motion first, then estimates of the gradient."""
        rows = []
        for course in self.courses:
            for kind, measured in (("motion", course.points), ("gradient", course.estimates)):
                on_front = pareto_front([one.cost for one in measured], [one.error for one in measured])
                for one, is_best in zip(measured, on_front, strict=True):
                    values = asdict(one)
                    flat = values.pop("variant", {}) | values | {"seconds": one.cost, "num_repeats": len(one.seconds)}
                    rows.append({"scene": course.name, "of": kind, **flat, "on_front": bool(is_best)})
        return rows


def pareto_front(costs: npt.ArrayLike, errors: npt.ArrayLike) -> Bool[np.ndarray, " points"]:
    """Return which points no other beats in cost and error at once; of equal ones all, of those that are not finite none."""
    cost, error = np.asarray(costs, float), np.asarray(errors, float)
    no_worse = (cost <= cost[:, None]) & (error <= error[:, None])
    better = (cost < cost[:, None]) | (error < error[:, None])
    return ~(no_worse & better).any(axis=1) & np.isfinite(error) & np.isfinite(cost)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every scene, one after the other: first its programs are compiled, then nothing is while it is timed."""
    cases = {name: case(name) for name in settings.scenes or settings.sizes.scenes}
    if settings.scene is not None:
        own = own_case(settings)
        cases = {own.title: own}
    courses = []
    # Compiling is most of the time, so progress is counted in programs; each scene is one more, measured.
    done = itertools.count(1)
    total = sum(len(variants(one)) + 1 for one in cases.values())
    with workspace.stage("scenes", "programs", total) as advance_to:
        for name, one in cases.items():
            workspace.check(mg.load_scene(one.model), name=one.title)
            course = functools.partial(_course, name, one, settings, lambda: advance_to(next(done)))
            courses.append(workspace.once(name, course))
            advance_to(next(done))
    return Outcome(settings, tuple(courses))


def variants(one: Case) -> list[Variant]:
    """Return for what a scene is compiled, the longest compilations first; an onset needs a contact."""
    model = one.model
    has_contact = bool(model.npair or ((model.geom_contype != 0) | (model.geom_conaffinity != 0)).any())
    onset = [Variant(ONSET, has_gradient=True), Variant(ONSET)] if has_contact else []
    own = [Variant(MG), Variant(MG, "RK4"), Variant(MG, precision="float32"), Variant(MJX, precision="float32")]
    return [*onset, Variant(MG, has_gradient=True), *own]


def _course(name: str, one: Case, settings: Settings, on_each: Callable[[], None]) -> Course:
    needed = variants(one)
    built = in_threads(lambda variant: Program(one, variant, settings.sizes.batch), needed, lambda _: on_each())
    programs = dict(zip(needed, built, strict=True))
    noise = np.random.default_rng(settings.seed).normal(size=(settings.sizes.batch, len(one.moved)))
    qvel = one.start[1] + one.stddev * noise @ one.directions
    right = _truths(one, programs, qvel)
    native = [Native(one, Variant(C, integrator)) for integrator in _INTEGRATORS]
    points = []
    for program in [*(each for each in programs.values() if not each.variant.has_gradient), *native]:
        variant = program.variant
        for timestep in (one.timestep / refinement for refinement in settings.sizes.refinements):
            ends, seconds = repeated(program, qvel, timestep, settings.sizes)
            error = right[C if variant.library == C else MG].error(ends)
            per_second = tuple(taken / (len(qvel) * one.duration) for taken in seconds)
            points.append(Point(variant, timestep, error, per_second))
    known, estimates = _gradients(one, programs, settings)
    references = {engine: truth.found for engine, truth in right.items()}
    compiling = {library: programs[Variant(library, precision="float32")].compile_seconds for library in (MG, MJX)}
    return Course(name, one.title, one.timestep, points, references, estimates, known, compiling)


class Program:
    """A compiled simulation of one scene."""

    def __init__(self, case: Case, variant: Variant, batch: int):
        self.case, self.variant, self.batch = case, variant, batch
        begun, dtype = time.perf_counter(), np.dtype(variant.precision)
        with jax.enable_x64(variant.precision == "float64"):
            with _LOADING:
                scene = mg.load_scene(_c_model(case, variant))
            start = scene.data.replace(
                qpos=jnp.asarray(case.start[0], dtype),
                ctrl=jnp.asarray(case.controls, dtype),
                time=jnp.zeros((), dtype),
            )
            simulate = functools.partial(_simulate, variant, start)
            if variant.has_gradient:
                simulate = functools.partial(_differentiate, simulate, case)
            batched = jax.jit(jax.vmap(simulate, in_axes=(None, 0, None)))
            self._model = scene.model
            self._call = batched.lower(scene.model, np.zeros((batch, case.model.nv), dtype), np.int32(1)).compile()
        self.compile_seconds = time.perf_counter() - begun

    def timed(self, qvel: Speeds, timestep: float, tolerance: float | None = None) -> tuple[Any, float]:
        """Return final positions and velocities, or outcomes and their slopes, and the wall time (s)."""
        begun, dtype = time.perf_counter(), np.dtype(self.variant.precision)
        options = {"opt.timestep": timestep, "opt.tolerance": tolerance or _TOLERANCE[self.variant.precision]}
        model = self._model.tree_replace({key: jnp.asarray(np.asarray(each, dtype)) for key, each in options.items()})
        num_steps = np.int32(round(self.case.duration / timestep))
        found = jax.tree.map(np.asarray, self._call(model, np.asarray(qvel, dtype), num_steps))
        return found, time.perf_counter() - begun


class Native:
    """C MuJoCo on the same starts, a batch on every core; the same call as a program's."""

    def __init__(self, case: Case, variant: Variant):
        self.case, self.variant = case, variant

    def timed(self, qvel: Speeds, timestep: float, tolerance: float | None = None) -> tuple[Ends, float]:
        """Return final positions and velocities, and the wall time (s)."""
        case, model = self.case, _c_model(self.case, self.variant)
        model.opt.timestep, model.opt.tolerance = timestep, tolerance or _TOLERANCE["float64"]
        # What diverges shall end as no number, not at a new start.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        num_steps, batch = round(case.duration / timestep), len(qvel)
        initial = np.zeros((batch, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        velocities = slice(1 + model.nq, 1 + model.nq + model.nv)
        initial[:, 1 : 1 + model.nq], initial[:, velocities] = case.start[0], qvel
        workers, seconds, finals = [mujoco.MjData(model) for _ in range(num_cores())], 0.0, []
        with collected(), mujoco.rollout.Rollout(nthread=len(workers) if len(workers) > 1 else 0) as pool:
            for part in np.array_split(initial, -(-batch // _AT_A_TIME)):
                control = np.tile(case.controls, (len(part), num_steps, 1)) if model.nu else None
                begun = time.perf_counter()
                states, _ = pool.rollout([model] * len(part), workers, part, control, nstep=num_steps)
                seconds += time.perf_counter() - begun
                finals.append(np.asarray(states)[:, -1])
        final = np.concatenate(finals)
        return (final[:, 1 : 1 + model.nq], final[:, velocities]), seconds


def _c_model(case: Case, variant: Variant) -> mujoco.MjModel:
    model = copy.deepcopy(case.model)
    model.opt.integrator, model.opt.solver = _INTEGRATORS[variant.integrator], mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations = 100  # enough to converge
    return model


def repeated(program: Program | Native, qvel: Speeds, timestep: float, sizes: Sizes) -> tuple[Any, tuple[float, ...]]:
    """Simulate at least twice, and again while it takes little time; a short first time only warms up."""
    result, first = program.timed(qvel, timestep)
    taken = [first] if first > sizes.seconds else []
    while len(taken) < 2 or (len(taken) < sizes.repeats and sum(taken) < sizes.seconds):
        result, seconds = program.timed(qvel, timestep)
        taken.append(seconds)
    return result, tuple(taken)


def _simulate(
    variant: Variant, start: mjx.Data, model: mjx.Model, qvel: Float[Array, " nv"], num_steps: Array
) -> tuple[Array, Array]:
    contact = mg.Onset() if variant.library == ONSET else mg.Discrete()

    def step(data: mjx.Data) -> mjx.Data:
        if variant.library == MJX:
            return mjx.step(model, data)
        return mg.step(model, data, contact=contact)

    final = advance(step, start.replace(qvel=qvel), num_steps)
    return final.qpos, final.qvel


def _differentiate(
    simulate: Callable, case: Case, model: mjx.Model, qvel: Float[Array, " nv"], num_steps: Array
) -> tuple[Array, Array]:
    """Take forward mode, which the library takes for so few parameters too, and which a loop of any length has."""
    weights = jnp.asarray(case.weights, qvel.dtype)

    def along(direction: Array) -> tuple[Array, Array]:
        return jax.jvp(lambda at: weights @ simulate(model, at, num_steps)[0], (qvel,), (direction,))

    return jax.vmap(along, out_axes=(None, 0))(jnp.asarray(case.directions, qvel.dtype))


@dataclass(frozen=True)
class Truth:
    """The final states that motions are compared with, and what their errors are over: the way gone and the speed."""

    case: Case
    ends: Ends
    scales: tuple[float, float]
    found: Reference

    def error(self, ends: Ends) -> float:
        """Return the larger relative error of positions and velocities; infinite if one is not finite."""
        return _relative(self.case, self.ends, ends, self.scales)


def _truths(case: Case, programs: dict[Variant, Program], qvel: Speeds) -> dict[str, Truth]:
    """Simulate the references of both engines.

    MJX makes other contacts than C MuJoCo on some scenes, and then has a reference of its own. Where the same steps of
    both end in the same states, C's serves both, for it is finer.
    """
    native = _truth(case, qvel, Native(case, Variant(C, "RK4")), _C_FINEST)
    same_step = case.timestep, _REFERENCE_TOLERANCE
    in_c, in_mjx = (one.timed(qvel, *same_step)[0] for one in (Native(case, Variant(C)), programs[Variant(MG)]))
    is_same = _relative(case, in_c, in_mjx, native.scales) < max(_SAME_MOTION, native.found.error / 10)
    return {C: native, MG: native if is_same else _truth(case, qvel, programs[Variant(MG, "RK4")], _FINEST)}


def _truth(case: Case, qvel: Speeds, program: Program | Native, finest: int) -> Truth:
    """Simulate at a fine step, at two and at four times it."""
    steps = [factor * case.timestep / finest for factor in (1, 2, 4)]
    runs = [program.timed(qvel, step, _REFERENCE_TOLERANCE)[0] for step in steps]
    start = np.tile(case.start[0], (len(qvel), 1)), qvel
    way, speed = _rms(differences(case.model, start, runs[0])), np.sqrt((_rms(qvel) ** 2 + _rms(runs[0][1]) ** 2) / 2)
    scales = way, float(speed)
    error, coarser = (_relative(case, fine, coarse, scales) for fine, coarse in itertools.pairwise(runs))
    return Truth(case, runs[0], scales, Reference(error, coarser))


def differences(model: mujoco.MjModel, start: Ends, end: Ends) -> Float[np.ndarray, "batch nv"]:
    """Return what takes each start to its end, as `mj_differentiatePos` does, in m and rad; NaN where one is not finite."""
    found = np.full((len(end[0]), model.nv), np.nan)
    for row, one, other in zip(found, start[0], end[0], strict=True):
        if np.isfinite(one).all() and np.isfinite(other).all():
            mujoco.mj_differentiatePos(model, row, 1.0, one, other)
    return found


def _relative(case: Case, right: Ends, ends: Ends, scales: tuple[float, float]) -> float:
    both = _rms(differences(case.model, right, ends)) / scales[0], _rms(ends[1] - right[1]) / scales[1]
    return max(both) if np.isfinite(both).all() else np.inf


def _rms(differences: Float[np.ndarray, "batch nv"]) -> float:
    """Return the root mean square over states of the Euclidean norm."""
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))


class Recorded(Objective):
    """Rollouts that were made before, as an objective: its noise is the number of a rollout, drawn with replacement.

    The derivative of a cost by the parameters is the recorded one.
    """

    costs: Float[Array, " rollouts"]
    gradients: Float[Array, "rollouts dim"]
    noise: Float[Array, "rollouts dim"]
    stddev: Float[Array, " dim"]
    dim: int | None = eqx.field(static=True)

    def sample_noise(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return jax.random.randint(key, (), 0, len(self.costs))

    def value(self, params: Float[Array, " dim"], noise: Int[Array, ""]) -> Float[Array, ""]:
        return self.costs[noise] + self.gradients[noise] @ (params - jax.lax.stop_gradient(params))

    def score(self, params: Float[Array, " dim"], noise: Int[Array, ""]) -> Float[Array, " dim"]:
        return self.noise[noise] / self.stddev**2

    def differentiate(self, params: Float[Array, " dim"], noise: Int[Array, ""]) -> Differentiated:
        unchanged = Partial(lambda vector: vector)
        return Differentiated(
            self.costs[noise], self.gradients[noise], self.score(params, noise), self.stddev, unchanged
        )


def _gradients(case: Case, programs: dict[Variant, Program], settings: Settings) -> tuple[float, list[Estimate]]:
    """Estimate the gradient in every way; how well the reference is known comes first."""
    sizes, names = settings.sizes, {MG: "discrete", ONSET: "onset"}
    simulate = programs[Variant(MG)]
    derivatives = {names[v.library]: one for v, one in programs.items() if v.has_gradient}
    noise = quasi_random(sizes.num_rollouts, len(case.moved), settings.seed) * case.stddev
    steps = [factor * case.timestep / _GRADIENT_FINEST for factor in (1, 2)]
    costs = [_rollouts(simulate, noise, step, _GRADIENT_TOLERANCE)[:, 0] for step in steps]
    fine, coarse = (smoothed_gradient(each, noise, case.stddev) for each in costs)
    right, size = fine[0], np.linalg.norm(fine[0])
    known = float(np.hypot(np.linalg.norm(fine[1]), np.linalg.norm(coarse[0] - right)) / size)
    estimates = []
    for timestep in (case.timestep / refinement for refinement in sizes.gradient_refinements):
        every = {name: _record(one, noise, timestep, settings) for name, one in {None: simulate, **derivatives}.items()}
        used = [(name, function, *every[one]) for name, (function, one) in ESTIMATORS.items() if one in every]
        for (name, function, record, taken), count in itertools.product(used, sizes.num_samples):
            errors = _estimate(function, count, record, right, settings.seed)
            estimates.append(Estimate(name, count, timestep, *errors, tuple(count * one for one in taken)))
    return known, estimates


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
    r"""Return the gradient of the average of a cost over Gaussian noise, without differentiating it.

    $\nabla F = \mathbb{E}[f w]/\sigma^2$, where the part of $f$ that is linear in $w$ is put back exactly. The noise is
    `quasi_random`; its scrambles give the standard error, which goes with the gradient.
    """
    columns = np.column_stack([np.ones(len(noise)), noise])
    linear = np.linalg.lstsq(columns, costs, rcond=None)[0]
    rest = costs - columns @ linear
    mean, error = _over_scrambles(rest[:, None] * noise / stddev**2)
    return linear[1:] + mean, error


def _over_scrambles(samples: Float[np.ndarray, "rollouts dim"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and its standard error."""
    parts = samples.reshape(_SCRAMBLES, -1, samples.shape[1]).mean(axis=1)
    return parts.mean(axis=0), parts.std(axis=0, ddof=1) / np.sqrt(_SCRAMBLES)


def _rollouts(
    program: Program, noise: np.ndarray, timestep: float, tolerance: float | None = None
) -> Float[np.ndarray, "rollouts columns"]:
    """Simulate all, a batch at a time: the cost of each, and its gradient, zero without a derivative."""
    case, batch = program.case, program.batch
    # What fills up the last batch is cut off.
    filled = np.concatenate([noise, np.zeros((-len(noise) % batch, noise.shape[1]))])
    starts = (case.start[1] + filled @ case.directions).reshape(-1, batch, case.model.nv)
    ends = [program.timed(qvel, timestep, tolerance)[0] for qvel in starts]
    if not program.variant.has_gradient:
        ends = [(qpos @ case.weights, np.zeros((batch, noise.shape[1]))) for qpos, _ in ends]
    return np.concatenate([np.column_stack(one) for one in ends])[: len(noise)]


def _record(program: Program, noise: np.ndarray, timestep: float, settings: Settings) -> tuple[Recorded, list[float]]:
    """Simulate at one time step. The times of one rollout go with it."""
    case, batch, dim = program.case, program.batch, noise.shape[1]
    first = case.start[1] + np.resize(noise, (batch, dim)) @ case.directions
    _, taken = repeated(program, first, timestep, settings.sizes)
    found = _rollouts(program, noise, timestep)
    arrays = {"costs": found[:, 0], "gradients": found[:, 1:], "noise": noise, "stddev": np.full(dim, case.stddev)}
    record = Recorded(**{name: jnp.asarray(each) for name, each in arrays.items()}, dim=dim)
    return record, [one / batch for one in taken]


def _estimate(
    function: str, num_samples: int, record: Recorded, right: np.ndarray, seed: int
) -> tuple[float, float, float, float]:
    """Return an estimator's error, bias with its error, and variance, over the size of the right gradient."""
    size, keys = float(np.linalg.norm(right)), jax.random.split(jax.random.key(seed), _REPEATS)
    at = jnp.zeros_like(record.stddev)
    values = np.asarray(
        over_keys(getattr(mg.estimators, function), record, at, keys, num_samples, at_a_time=_REPEATS).value
    )
    # What it has in the mean, and the error of that, from all rollouts where it is linear in them.
    if function == "zeroth_order":
        centre, chance = smoothed_gradient(np.asarray(record.costs), np.asarray(record.noise), float(record.stddev[0]))
    elif function == "first_order":
        centre, chance = _over_scrambles(np.asarray(record.gradients))
    else:
        centre, chance = values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))
    offset, chance = (float(np.linalg.norm(each) / size) for each in (centre - right, chance))
    variance = float(values.var(axis=0, ddof=1).sum() / size**2)
    if not np.isfinite([offset, chance, variance]).all():
        return np.inf, np.inf, chance, variance
    bias = float(np.sqrt(max(0.0, offset**2 - chance**2)))
    return float(np.hypot(bias, np.sqrt(variance))), bias, chance, variance
