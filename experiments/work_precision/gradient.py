"""Error of gradient estimates against run time and rollouts.

Rollouts are simulated once for each time step, softness and derivative; the library's own estimators then draw their samples
from these records, so that nothing is simulated, or compiled, anew for another number of samples.
"""

import functools
import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int, PRNGKeyArray

import mjxgrad as mg
from experiments.work_precision.cases import Case
from experiments.work_precision.outcome import MG, TIGHT_TOLERANCE, Estimate, GradientReference, Knobs, Variant
from experiments.work_precision.programs import Program, repeated
from experiments.work_precision.settings import Settings
from mjxgrad.objective import Differentiated, Objective

# Step of the reference, as a share of the scene's own: eight times finer than the finest estimate's by default.
_FINEST, _REFERENCE_TOLERANCE = 8, 1e-10
_SCRAMBLES = 8
_REPEATS = 64
# Half the interval of the difference quotients, in standard deviations: of a Gaussian average it is off by a sixth of its square,
# a per cent, where the third derivative is as large as the first.
_REACH = 0.25

# By name, the library's estimator and the derivative that it uses.
ESTIMATORS: dict[str, tuple[str, str | None]] = {
    "zeroth order": ("zeroth_order", None),
    "first order, discrete": ("first_order", "discrete"),
    "first order, event": ("first_order", "event"),
    "first order, onset": ("first_order", "onset"),
    "α-order, onset": ("alpha_order", "onset"),
}


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


def measured(
    case: Case, programs: dict[Variant, Program], settings: Settings
) -> tuple[GradientReference, list[Estimate]]:
    """Estimate the gradient in every way, and a reference."""
    sizes = settings.sizes
    simulate = programs[Variant(MG, cone=case.cone, batch=sizes.batch)]
    derivatives = {"onset" if v.onset else v.derivative: p for v, p in programs.items() if v.derivative is not None}
    noise = quasi_random(sizes.num_rollouts, len(case.moved), settings.seed) * case.stddev
    reference = _reference(simulate, noise, settings.seed)
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


def _reference(simulate: Program, noise: Float[np.ndarray, "rollouts dim"], seed: int) -> GradientReference:
    case = simulate.case
    fine, coarse = (Knobs(case.timestep * factor / _FINEST, _REFERENCE_TOLERANCE) for factor in (1, 2))
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
