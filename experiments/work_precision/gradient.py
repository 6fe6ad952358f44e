"""Error of gradient estimates against run time and rollouts.

Rollouts are simulated once for each time step, softness and derivative; the library's own estimators then draw their samples
from these records, so that nothing is simulated, or compiled, anew for another number of samples.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int, PRNGKeyArray

import mjxgrad as mg
from experiments.work_precision.cases import Case
from experiments.work_precision.outcome import Estimate, GradientReference
from experiments.work_precision.programs import Knobs, Program, Variant, timed
from experiments.work_precision.settings import Settings
from mjxgrad.objective import Differentiated, Objective

# Step of the reference, as a share of the scene's own: eight times finer than the finest estimate's by default.
_FINEST = 8
_SCRAMBLES = 8
_REPEATS = 64
# Half the interval of the difference quotients, in standard deviations: of a Gaussian average it is off by a sixth of its square,
# a per cent, where the third derivative is as large as the first.
_REACH = 0.25

ESTIMATORS: dict[str, tuple[str, str | None]] = {
    "zeroth order": ("zeroth_order", None),
    "first order, discrete": ("first_order", "discrete"),
    "first order, event": ("first_order", "event"),
    "first order, onset": ("first_order", "onset"),
    "α-order, onset": ("alpha_order", "onset"),
}


class Recorded(Objective):
    """Rollouts that were made before, as an objective: its noise is the number of a rollout, drawn with replacement.

    Attributes:
        costs: of the rollouts.
        gradients: of these, by the parameters.
        noise: on the parameters.
        stddev: of the noise.
        dim: number of parameters.
    """

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


@dataclass(frozen=True)
class Records:
    """Rollouts at one time step and softness.

    Attributes:
        noise: on the parameters, in their units.
        costs: of the rollouts, by the name of the derivative or None.
        gradients: by the name of the derivative.
        seconds: of one rollout, of each repetition, by the name of the derivative or None.
        compile_seconds: likewise.
    """

    noise: Float[np.ndarray, "rollouts dim"]
    costs: dict[str | None, Float[np.ndarray, " rollouts"]]
    gradients: dict[str, Float[np.ndarray, "rollouts dim"]]
    seconds: dict[str | None, tuple[float, ...]]
    compile_seconds: dict[str | None, float]


def measured(
    case: Case, programs: dict[Variant, Program], settings: Settings
) -> tuple[GradientReference, list[Estimate]]:
    """Estimate the gradient in every way.

    Args:
        case: the scene.
        programs: of the scene.
        settings: of the run.

    Returns:
        The reference, and the estimates.
    """
    sizes, own = settings.sizes, case.model.opt.timestep
    simulate = next(p for v, p in programs.items() if v == Variant("mg", cone=p.variant.cone, batch=sizes.batch))
    noise = quasi_random(sizes.num_rollouts, len(case.moved), settings.seed) * case.stddev
    reference = _reference(case, simulate, noise, settings)
    ways = [(own / refinement, 1.0) for refinement in sizes.gradient_refinements]
    if any(variant.onset for variant in programs):  # there is a contact to soften
        ways += [(own, softening) for softening in sizes.softenings]
    estimates = []
    for timestep, softening in ways:
        knobs = Knobs(timestep, settings.tight_tolerance, softening)
        estimates += _estimates(
            case, _record(case, programs, simulate, noise, knobs, settings), knobs, reference, settings
        )
    return reference, estimates


def quasi_random(count: int, dim: int, seed: int) -> Float[np.ndarray, "count dim"]:
    """Draw standard normal points more evenly than chance does: eight scrambles of Sobol's sequence, one after the other.

    Args:
        count: of points, a multiple of 8.
        dim: of each.
        seed: of the scrambles.

    Returns:
        The points; consecutive eighths are independent.
    """
    seeds = np.random.SeedSequence(seed).spawn(_SCRAMBLES)
    parts = [scipy.stats.qmc.Sobol(dim, rng=np.random.default_rng(one)).random(count // _SCRAMBLES) for one in seeds]
    return scipy.stats.norm.ppf(np.concatenate(parts))


def smoothed_gradient(
    costs: Float[np.ndarray, " rollouts"], noise: Float[np.ndarray, "rollouts dim"], stddev: float
) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
    r"""Give the gradient of the average of a cost over Gaussian noise, without differentiating it.

    $\nabla F = \mathbb{E}[f w]/\sigma^2$, where the part of $f$ that is linear in $w$ is put back exactly.

    Args:
        costs: at the noise.
        noise: from `quasi_random`.
        stddev: of the noise.

    Returns:
        The gradient, and its standard error from the scrambles.
    """
    columns = np.column_stack([np.ones(len(noise)), noise])
    linear = np.linalg.lstsq(columns, costs, rcond=None)[0]
    rest = costs - columns @ linear
    parts = (rest[:, None] * noise / stddev**2).reshape(_SCRAMBLES, -1, noise.shape[1]).mean(axis=1)
    return linear[1:] + parts.mean(axis=0), parts.std(axis=0, ddof=1) / np.sqrt(_SCRAMBLES)


def _reference(
    case: Case, simulate: Program, noise: Float[np.ndarray, "rollouts dim"], settings: Settings
) -> GradientReference:
    own = case.model.opt.timestep
    fine, coarse = (Knobs(own * factor / _FINEST, 1e-10) for factor in (1, 2))
    value, error = smoothed_gradient(_costs(case, simulate, noise, fine), noise, case.stddev)
    halved, _ = smoothed_gradient(_costs(case, simulate, noise, coarse), noise, case.stddev)
    size = np.linalg.norm(value)
    other, other_error = _differences(case, simulate, len(noise), fine, settings)
    return GradientReference(
        tuple(value.tolist()),
        float(np.linalg.norm(error) / size),
        float(np.linalg.norm(halved - value) / size),
        float(np.linalg.norm(other - value) / size),
        float(np.linalg.norm(np.hypot(error, other_error)) / size),
        fine.timestep,
    )


def _differences(
    case: Case, simulate: Program, num_rollouts: int, knobs: Knobs, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """Give the slope of the smoothed outcome along each parameter, on samples of its own."""
    dim = len(case.moved)
    noise = quasi_random(num_rollouts // 2, dim, settings.seed + 1) * case.stddev
    reach = _REACH * case.stddev
    slopes, errors = [], []
    for axis in np.eye(dim):
        ends = [_costs(case, simulate, noise + sign * reach * axis, knobs) for sign in (1, -1)]
        parts = ((ends[0] - ends[1]) / (2 * reach)).reshape(_SCRAMBLES, -1).mean(axis=1)
        slopes.append(parts.mean())
        errors.append(parts.std(ddof=1) / np.sqrt(_SCRAMBLES))
    return np.array(slopes), np.array(errors)


def _costs(case: Case, simulate: Program, noise: np.ndarray, knobs: Knobs) -> Float[np.ndarray, " rollouts"]:
    run = functools.partial(simulate.run, knobs=knobs)
    return _in_chunks(case, lambda qvel: run(qvel)[0] @ case.weights, noise, simulate.variant.batch)


def _in_chunks(case: Case, run: Callable, noise: np.ndarray, batch: int) -> np.ndarray:
    """Run all, a batch at a time; what fills up the last one is cut off."""
    filled = np.concatenate([noise, np.zeros((-len(noise) % batch, noise.shape[1]))])
    starts = (case.start[1] + filled @ case.directions).reshape(-1, batch, case.model.nv)
    return np.concatenate([run(qvel) for qvel in starts])[: len(noise)]


def _record(
    case: Case,
    programs: dict[Variant, Program],
    simulate: Program,
    noise: np.ndarray,
    knobs: Knobs,
    settings: Settings,
) -> Records:
    sizes = settings.sizes
    batch = simulate.variant.batch
    first = case.start[1] + np.resize(noise, (batch, noise.shape[1])) @ case.directions
    derivatives = {"onset" if v.onset else v.derivative: p for v, p in programs.items() if v.derivative is not None}
    seconds, gradients, costs = {}, {}, {}
    for name, program in {None: simulate, **derivatives}.items():
        _, taken = timed(lambda p=program: p.run(first, knobs), repeats=sizes.repeats, seconds=sizes.seconds)
        seconds[name] = tuple(one / batch for one in taken)
        if name is None:
            costs[name] = _costs(case, simulate, noise, knobs)
            continue
        both = _in_chunks(case, lambda qvel, p=program: np.column_stack(p.run(qvel, knobs)), noise, batch)
        costs[name], gradients[name] = both[:, 0], both[:, 1:]
    compiling = {name: p.trace_seconds + p.compile_seconds for name, p in {None: simulate, **derivatives}.items()}
    return Records(noise, costs, gradients, seconds, compiling)


def _estimates(
    case: Case, records: Records, knobs: Knobs, reference: GradientReference, settings: Settings
) -> list[Estimate]:
    right = np.array(reference.value)
    size = float(np.linalg.norm(right))
    keys = jax.random.split(jax.random.key(settings.seed), _REPEATS)
    found = []
    for name, (function, derivative) in ESTIMATORS.items():
        if derivative is not None and derivative not in records.gradients:
            continue
        gradients = np.zeros_like(records.noise) if derivative is None else records.gradients[derivative]
        dim = records.noise.shape[1]
        objective = Recorded(
            costs=jnp.asarray(records.costs[derivative]),
            gradients=jnp.asarray(gradients),
            noise=jnp.asarray(records.noise),
            stddev=jnp.full(dim, case.stddev),
            dim=dim,
        )
        for num_samples in settings.sizes.num_samples:
            values = np.asarray(_repeated(objective, keys, function, num_samples))
            centre, chance = _expectation(function, records, gradients, values, case.stddev)
            offset = float(np.linalg.norm(centre - right) / size)
            chance = float(np.linalg.norm(chance) / size)
            variance = float(values.var(axis=0, ddof=1).sum() / size**2)
            is_finite = np.isfinite([offset, chance, variance]).all()
            bias = float(np.sqrt(max(0.0, offset**2 - chance**2))) if is_finite else np.inf
            low, high = np.quantile(np.linalg.norm(values - right, axis=1) / size, (0.25, 0.75)).tolist()
            found.append(
                Estimate(
                    estimator=name,
                    num_samples=num_samples,
                    timestep=knobs.timestep,
                    softening=knobs.softening,
                    error=float(np.hypot(bias, np.sqrt(variance))) if is_finite else np.inf,
                    spread=(low, high),
                    bias=bias,
                    bias_error=chance,
                    variance=variance,
                    seconds=tuple(num_samples * one for one in records.seconds[derivative]),
                    compile_seconds=records.compile_seconds[derivative],
                )
            )
    return found


def _expectation(
    function: str, records: Records, gradients: np.ndarray, values: Float[np.ndarray, "repeats dim"], stddev: float
) -> tuple[np.ndarray, np.ndarray]:
    """Give what an estimator has in the mean, and the standard error of that, from all rollouts where it is linear in them."""
    if function == "zeroth_order":
        return smoothed_gradient(records.costs[None], records.noise, stddev)
    if function == "first_order":
        parts = gradients.reshape(_SCRAMBLES, -1, gradients.shape[1]).mean(axis=1)
        return parts.mean(axis=0), parts.std(axis=0, ddof=1) / np.sqrt(_SCRAMBLES)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


@functools.partial(jax.jit, static_argnums=(2, 3))
def _repeated(objective: Recorded, keys: Array, function: str, num_samples: int) -> Float[Array, "repeats dim"]:
    estimator = getattr(mg.estimators, function)
    params = jnp.zeros_like(objective.stddev)
    return jax.vmap(lambda key: estimator(objective, params, key, num_samples=num_samples).value)(keys)
