"""Windows: the derivative forgets where it came from, with and without a value function for what comes after."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.long_horizon.estimates import reference_gradient, zeroth
from experiments.long_horizon.outcome import BEYOND_CHANCE, Windows
from experiments.long_horizon.problems import Problem
from experiments.long_horizon.settings import Settings, Sizes
from mjxgrad.diagnostics import root_mean_square_interval

# Of the features' own squares. Noisy parameters are few, so the states lie close to a surface, and across it a fit knows no
# slope; without a ridge its slopes there are arbitrary.
_RIDGE = 1e-2


def cut(settings: Settings, sizes: Sizes, one: Problem, again: Callable[[int], np.ndarray], many, own) -> Windows:
    """Estimate the gradient of the mean cost over the whole horizon from windows of every length.

    A window charges the costs in it, and at its end the fitted value of the costs to come; the next one starts from the same
    state without its derivative, as in SHAC (Xu et al., arXiv:2204.07137).

    Args:
        settings: of the run.
        sizes: how many rollouts make an estimate.
        one: the problem.
        again: from a window's length to the tangents of the same rollouts.
        many: rollouts on which the value function is fitted, and from which the reference is taken.
        own: the rollouts that `again` repeats.

    Returns:
        Errors and biases by length.
    """
    whole = sizes.num_times
    costs = jax.jit(jax.vmap(jax.vmap(one.cost)))
    own_costs, many_costs = (np.asarray(costs(jnp.asarray(each.states))) for each in (own, many))
    half = len(many_costs) // 8
    total = many_costs.mean(axis=1, keepdims=True)
    reference, reference_error = reference_gradient(
        one.stddev, (many.noise[:half], total[:half]), (many.noise[half:], total[half:])
    )
    slopes = np.asarray(jax.jit(jax.vmap(jax.vmap(jax.grad(one.cost))))(jnp.asarray(own.states)))
    value_slopes, fit = _value_slopes(one, many.states, many_costs, own.states)
    lengths = (*(length for length in (1, 2, 4, 8, 16, 32) if length < whole), whole)
    samples = []
    for length in lengths:
        tangents = again(length)
        charged = np.einsum("stn,stnd->sd", slopes, tangents) / whole
        ends = np.arange(length - 1, whole - 1, length)
        later = np.einsum("stn,stnd->sd", value_slopes[:, ends], tangents[:, ends]) / whole
        samples += [charged, charged + later]
    samples.append(zeroth(one.stddev, own.noise, own_costs.mean(axis=1, keepdims=True), sizes)[:, 0])
    errors = [_error(settings, sizes, each, reference[0], reference_error[0]) for each in samples]
    plain, valued, last = errors[:-1:2], errors[1:-1:2], errors[-1]
    pairs = [np.array([[each[i] for each in kind] for kind in (plain, valued)]) for i in range(5)]
    return Windows(
        lengths=lengths,
        error=pairs[0],
        interval=np.stack([pairs[1], pairs[2]], axis=1),
        bias=pairs[3],
        bias_noise=pairs[4],
        zeroth=np.array(last[:3]),
        fit=fit,
    )


def _error(
    settings: Settings,
    sizes: Sizes,
    samples: np.ndarray,
    reference: np.ndarray,
    reference_error: np.ndarray,
) -> tuple[float, float, float, float, float]:
    """Return error, both ends of its interval, bias and what chance makes of it, over the reference's size."""
    scale = np.linalg.norm(reference)
    off = (samples.reshape(sizes.num_repeats, sizes.num_samples, -1).mean(axis=1) - reference) / scale
    known = (reference_error / scale) ** 2
    mean = off.mean(axis=0)
    error, interval = root_mean_square_interval(
        (off**2).sum(axis=-1),
        settings.confidence,
        reference_variance=known.sum(),
        cross_variance=(4 * mean**2 * known + 2 * known**2).sum(),
    )
    noise = BEYOND_CHANCE * np.sqrt((off.var(axis=0, ddof=1) / sizes.num_repeats + known).sum())
    return float(error), float(interval[0]), float(interval[1]), float(np.linalg.norm(mean)), float(noise)


def _value_slopes(
    one: Problem, states: np.ndarray, costs: np.ndarray, at: np.ndarray
) -> tuple[Float[np.ndarray, "samples times n"], float]:
    """Fit the sum of the costs to come by a quadratic in what is observed, time by time, and differentiate it elsewhere."""

    def features(x: Float[Array, " n"], centre: Array, size: Array) -> Float[Array, " features"]:
        z = (one.observe(x) - centre) / size
        rows, columns = np.triu_indices(z.shape[0])
        return jnp.concatenate([jnp.ones(1), z, z[rows] * z[columns]])

    every = jax.jit(jax.vmap(features, in_axes=(0, None, None)))
    slopes = jax.jit(
        jax.vmap(jax.grad(lambda x, centre, size, w: features(x, centre, size) @ w), in_axes=(0, None, None, None))
    )
    later = costs[:, ::-1].cumsum(axis=1)[:, ::-1] - costs
    # Less its mean, which a ridge would pull towards zero with the rest, and which has no slope.
    later = later - later.mean(axis=0)
    found, fits = np.zeros_like(at), []
    for time in range(states.shape[1] - 1):
        seen = np.asarray(jax.vmap(one.observe)(jnp.asarray(states[:, time])))
        centre, size = seen.mean(axis=0), np.maximum(seen.std(axis=0), 1e-9)
        basis = np.asarray(every(jnp.asarray(states[:, time]), centre, size))
        gram = basis.T @ basis
        weights = np.linalg.solve(
            gram + _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram)), basis.T @ later[:, time]
        )
        rest = later[:, time] - basis @ weights
        fits.append(1 - rest.var() / max(later[:, time].var(), np.finfo(float).tiny))
        found[:, time] = slopes(jnp.asarray(at[:, time]), centre, size, jnp.asarray(weights))
    return found, float(np.median(fits))
