r"""Is a derivative the slope, on average over a little jitter of everything else?

Along one parameter alone an average over an interval is one over the phase of an event only if that event moves through
many time steps there. A later event whose distance hardly depends on the parameter moves through a fraction of one: both
the slope and the mean of derivatives then depend on where in the step it happens to fall, and differ although the
derivative is right. Jitter of the rest of the start moves such events through their time steps too.

With jitter $\xi$ and a parameter $x$ uniform on $(a, b)$,

$$\mathbb{E}\, \frac{f(b, \xi) - f(a, \xi)}{b - a} = \mathbb{E}\, f'(x, \xi)$$

wherever the outcome $f$ is continuous in $x$, whatever the jitter, the number of teeth or the curvature; the two sides
differ by the mean of what jumps. An event derivative stands for the jumps of the time step, so with it they should agree.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.diagnostics.judgement import ROUNDINGS, AgainstSlope

SimulateJittered = Callable[[Float[Array, ""], PyTree, str], Float[Array, "*outcome"]]

# From fewer samples a standard error is itself good for no more than an eighth.
_FEWEST_SAMPLES = 32
_TAIL = 0.01
_HEAVY = 0.5


class JitterComparison(AgainstSlope):
    """Derivatives beside the slope over jittered starts; units are those of the outcome over those of the parameter.

    Where fewer than 32 samples are finite, numbers are NaN.

    Attributes:
        gradients: names of the derivatives, in the order of their axis.
        parameters: at which derivatives were taken, one in each of equal parts of the interval, in random order.
        differences: of the outcome from one end of the interval to the other, over its length, for each jitter.
        derivatives: for the same jitters.
        slope: mean of the differences.
        slope_error: its standard error.
        mean: of each derivative.
        mean_error: its standard error.
        spread: standard deviation of each derivative over the samples.
        paired_error: standard error of mean less slope, from their difference sample by sample, for they share the jitter.
        tail_share: part of a derivative's sum of squared deviations that the largest hundredth of samples carries: about a
            tenth for normal ones. Near one the mean hangs on a few samples, and its error bar is likely too short.
        num_finite: samples whose difference and derivatives are finite; only these count.
        resolution: what rounding of the outcome leaves of a slope; smaller errors are none.
    """

    gradients: tuple[str, ...] = eqx.field(static=True)
    parameters: Float[np.ndarray, " samples"]
    differences: Float[np.ndarray, "samples *outcome"]
    derivatives: Float[np.ndarray, "gradients samples *outcome"]
    slope: Float[np.ndarray, "*outcome"]
    slope_error: Float[np.ndarray, "*outcome"]
    mean: Float[np.ndarray, "gradients *outcome"]
    mean_error: Float[np.ndarray, "gradients *outcome"]
    spread: Float[np.ndarray, "gradients *outcome"]
    paired_error: Float[np.ndarray, "gradients *outcome"]
    tail_share: Float[np.ndarray, "gradients *outcome"]
    num_finite: Int[np.ndarray, "*outcome"]
    resolution: Float[np.ndarray, "*outcome"]

    @property
    def standard_error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Of `error`."""
        return self.paired_error

    @property
    def is_regular(self) -> Bool[np.ndarray, "*outcome"]:
        """Wherever there are numbers: a mean of differences exists however torn the outcome is."""
        return np.isfinite(self.slope)

    @property
    def is_heavy(self) -> Bool[np.ndarray, "gradients *outcome"]:
        """Where a hundredth of the samples carries half of a derivative's variance or more, and more than rounding."""
        return (self.tail_share >= _HEAVY) & (self.mean_error > self.resolution)


def derivative_under_jitter(
    simulate: SimulateJittered,
    interval: tuple[float, float],
    key: PRNGKeyArray,
    *,
    jitter: Callable[[PRNGKeyArray], PyTree],
    num_samples: int = 256,
    gradients: Sequence[str] = ("discrete", "event"),
) -> JitterComparison:
    """Compare derivatives of a simulated outcome with its difference over an interval, both averaged over jitter.

    To be preferred to `derivative_against_slope` where several events follow each other, of which the parameter moves
    some but little. It costs two rollouts a sample beside the derivatives'.

    Args:
        simulate: from a parameter, a jitter and the name of a gradient to the outcome, of any shape. Its value must not
            depend on the name. Compiled once per name and once for values; it is compiled anew for each function object,
            unless it is a pytree (`jax.tree_util.Partial`, `eqx.Module`) whose arrays alone differ.
        interval: of the parameter. Its length is free; the first event is averaged well if it moves through several steps.
        key: consumed here; do not use it again.
        jitter: from a key to one jitter, in whatever form `simulate` takes it. Large enough that events move through their
            time steps: approach speed times time step, as a distance.
        num_samples: jitters. Four rollouts are spent on each, two of them with a derivative, if two gradients are named.
        gradients: names to hand to `simulate`. The first is what errors of the others are measured beside.

    Returns:
        Slope, means and their errors.

    Raises:
        ValueError: if the interval is empty, `num_samples` is below 32 or no gradient is named.
    """
    low, high = interval
    names = tuple(gradients)
    if not names:
        raise ValueError("gradients must name at least one derivative, got none")
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"interval must be two finite numbers, the smaller one first, got {interval}")
    if num_samples < _FEWEST_SAMPLES:
        raise ValueError(f"num_samples must be at least {_FEWEST_SAMPLES}, got {num_samples}: fewer give no error bar")
    jitter_key, place_key, order_key = jax.random.split(key, 3)
    jitters = jax.vmap(jitter)(jax.random.split(jitter_key, num_samples))
    strata = jax.random.permutation(order_key, num_samples)
    parameters = low + (high - low) * (strata + jax.random.uniform(place_key, (num_samples,))) / num_samples
    # Both ends in one batch, with the same jitters.
    ends = jnp.repeat(jnp.asarray([low, high], parameters.dtype), num_samples)
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), jitters)
    outcomes = np.asarray(_values(simulate, ends, twice, names[0]))
    derivatives = [np.asarray(_derivatives(simulate, parameters, jitters, name)) for name in names]
    return _compare(np.asarray(parameters), outcomes, np.array(derivatives), high - low, names)


@eqx.filter_jit
def _values(simulate: SimulateJittered, parameters: Float[Array, " samples"], jitters: PyTree, gradient: str) -> Array:
    return jax.vmap(lambda x, xi: simulate(x, xi, gradient))(parameters, jitters)


@eqx.filter_jit
def _derivatives(
    simulate: SimulateJittered, parameters: Float[Array, " samples"], jitters: PyTree, gradient: str
) -> Array:
    def one(parameter: Float[Array, ""], xi: PyTree) -> Array:
        # Forward mode: one parameter, many outcomes.
        return jax.jvp(lambda x: simulate(x, xi, gradient), (parameter,), (jnp.ones_like(parameter),))[1]

    return jax.vmap(one)(parameters, jitters)


def _compare(
    parameters: np.ndarray, outcomes: np.ndarray, derivatives: np.ndarray, width: float, names: tuple[str, ...]
) -> JitterComparison:
    epsilon = np.finfo(outcomes.dtype).eps
    low, high = np.split(outcomes.astype(float), 2)
    # Of an outcome that is zero throughout: not zero, for errors are divided by it.
    size = np.maximum(np.nanmax(np.abs(outcomes), axis=0, initial=0), np.finfo(float).tiny)
    differences, derivatives = (high - low) / width, derivatives.astype(float)
    is_finite = np.isfinite(differences) & np.isfinite(derivatives).all(axis=0)
    count = is_finite.sum(axis=0)
    has_enough = count >= _FEWEST_SAMPLES

    def mean_and_spread(samples: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
        divisor = np.where(has_enough, count, np.nan)
        mean = np.where(is_finite, samples, 0.0).sum(axis=axis) / divisor
        centred = np.where(is_finite, samples - np.expand_dims(mean, axis), 0.0)
        return np.asarray(mean), np.asarray(np.sqrt((centred**2).sum(axis=axis) / (divisor - 1)))

    slope, slope_spread = mean_and_spread(differences, 0)
    mean, spread = mean_and_spread(derivatives, 1)
    _, error_spread = mean_and_spread(derivatives - differences, 1)
    root = np.sqrt(np.where(has_enough, count, np.nan))
    return JitterComparison(
        gradients=names,
        parameters=parameters,
        differences=differences,
        derivatives=derivatives,
        slope=slope,
        slope_error=np.asarray(slope_spread / root),
        mean=mean,
        mean_error=spread / root,
        spread=spread,
        paired_error=error_spread / root,
        tail_share=_tail_share(np.where(is_finite, derivatives - mean[:, None], 0.0)),
        num_finite=np.asarray(count),
        resolution=np.asarray(ROUNDINGS * epsilon * size / width),
    )


def _tail_share(centred: Float[np.ndarray, "gradients samples *outcome"]) -> Float[np.ndarray, "gradients *outcome"]:
    squares = np.sort(centred**2, axis=1)
    num_largest = max(1, round(_TAIL * squares.shape[1]))
    total = squares.sum(axis=1)
    # Equal derivatives have no tail.
    return squares[:, -num_largest:].sum(axis=1) / np.where(total == 0, 1.0, total)
