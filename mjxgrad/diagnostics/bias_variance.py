r"""Bias and variance of both kinds of gradient, against contact softness.

The bias is against the gradient of the smoothed objective, found without either estimator that is on trial.
For noise on a single parameter it is an integral over a line,

$$F'(\theta) = \int (f(x) - f(\theta)) \frac{x - \theta}{\sigma^2}
   \varphi\!\left(\frac{x - \theta}{\sigma}\right) \frac{dx}{\sigma},$$

so one sweep of $f$ serves every $\theta$. The line is cut into equal cells and $f$ evaluated at a random place in each:
unbiased for any $f$, jumps and the fine saw teeth of simulated impacts included, with an error that falls as 1/cells
at a jump and faster elsewhere. A quadrature on regular points would need a smooth $f$ to know its own error.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import compile_once, whole
from mjxgrad.diagnostics.statistics import bootstrap_variance_interval, mean_interval
from mjxgrad.estimators.estimate import GradientEstimate
from mjxgrad.estimators.first_and_zeroth import both_results, both_summary, zeroth_order
from mjxgrad.estimators.samples import DEFAULT_CHUNK_SIZE, Plan, Samples, check_baseline, sample
from mjxgrad.objective import Objective, ParameterNoise, flattened, of_vector
from mjxgrad.objective.base import unchanged

# The Gaussian weight beyond six standard deviations is below 1e-7 of its peak.
REACH = 6.0
# XLA keeps 1.3 of two cores busy with one such program.
_WORKERS = 2


class Landscape(eqx.Module):
    """A cost along one parameter, at one random place, ascending, in each of many cells of one length."""

    points: Float[Array, " cells"]
    costs: Float[Array, "*batch cells"]
    cell: Float[Array, ""]

    def smoothed_gradient(
        self, params: Float[Array, ""], stddev: Float[Array, ""], centre: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Give the gradient of the smoothed cost, at least `REACH` standard deviations inside the landscape.

        With it a standard error that is rather too large than too small; both NaN if a cost that carries weight is not
        finite. The centre is a cost to compare with, such as that at `params` itself, not taken from these costs.
        """
        offset = (self.points - params) / stddev
        weight = offset / stddev * jax.scipy.stats.norm.pdf(offset) / stddev
        # Outside the reach a cost may be anything, also not finite.
        terms = jnp.where(jnp.abs(offset) <= REACH, (self.costs - centre) * weight, 0) * self.cell
        # Neighbouring cells differ by the variance within them and by their means, so this is on the safe side. Two
        # points per cell would give an unbiased one that mostly misses the only cell that matters: that of the jump.
        variance = (jnp.diff(terms) ** 2).sum(axis=-1) / 2
        return terms.sum(axis=-1), jnp.sqrt(variance)


def cell_points(
    key: PRNGKeyArray, low: Float[Array, ""], high: Float[Array, ""], num_cells: int
) -> tuple[Float[Array, " cells"], Float[Array, ""]]:
    """Draw one point in each of the equal cells of a line, ascending, and give the length of a cell."""
    cell = (high - low) / num_cells
    return low + cell * (jnp.arange(num_cells) + jax.random.uniform(key, (num_cells,), cell.dtype)), cell


def map_in_chunks(function: Callable, points: PyTree, chunk_size: int) -> PyTree:
    """Apply a function under `jax.vmap` to points with a leading axis, some at a time.

    `jax.lax.map` with a batch size would compile the function a second time for what remains over.
    """
    count = jax.tree.leaves(points)[0].shape[0]
    num_chunks = -(-count // chunk_size)
    size = -(-count // num_chunks)
    # The last chunk is filled up with points that there are already.
    indices = jnp.minimum(jnp.arange(num_chunks * size), count - 1)

    def one_chunk(indices: Array) -> PyTree:
        return jax.vmap(function)(jax.tree.map(lambda leaf: leaf[indices], points))

    results = jax.lax.map(one_chunk, indices.reshape(num_chunks, size))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], results)


class BiasVariance(eqx.Module):
    """What `bias_variance` measured; `softness` × `points` are the leading axes.

    An interval has its lower and upper ends on the very first axis and covers with chance `confidence`: Student's t for
    means and biases, percentile bootstrap for variances.

    Attributes:
        softness: what was swept, stacked.
        params: the points.
        first: the first-order estimates.
        zeroth: the zeroth-order estimates, of the same rollouts.
        cost: without noise.
        reference: the gradient of the smoothed cost, from rollouts of its own.
        reference_error: its standard error.
        reference_method: "landscape" (see `Landscape`) or "zeroth_order" (a long run).
        bias: first order less reference.
        bias_error: its standard error, from both.
        first_interval: of the mean of the first-order estimate; the other intervals likewise of what they are named for.
        first_variance_interval: of the variance of one first-order sample.
        zeroth_variance_interval: of the variance of one zeroth-order sample.
        landscape: the cost along the parameter at every softness, if there is only one parameter, with noise on it.
        confidence: of every interval.
    """

    softness: PyTree
    params: Float[Array, "points dim"]
    first: GradientEstimate
    zeroth: GradientEstimate
    cost: Float[Array, "softness points"]
    reference: Float[Array, "softness points dim"]
    reference_error: Float[Array, "softness points dim"]
    bias: Float[Array, "softness points dim"]
    bias_error: Float[Array, "softness points dim"]
    first_interval: Float[np.ndarray, "2 softness points dim"]
    zeroth_interval: Float[np.ndarray, "2 softness points dim"]
    reference_interval: Float[np.ndarray, "2 softness points dim"]
    bias_interval: Float[np.ndarray, "2 softness points dim"]
    first_variance_interval: Float[np.ndarray, "2 softness points"]
    zeroth_variance_interval: Float[np.ndarray, "2 softness points"]
    landscape: Landscape | None
    reference_method: Literal["landscape", "zeroth_order"] = eqx.field(static=True)
    confidence: float = eqx.field(static=True)


def bias_variance(
    objective_of_softness: Callable[[PyTree], Objective],
    params: PyTree,
    key: PRNGKeyArray,
    *,
    softness: PyTree | Sequence[PyTree],
    num_samples: int = 256,
    num_reference: int = 2048,
    baseline: str = "leave_one_out",
    confidence: float = 0.95,
    num_resamples: int = 1000,
    chunk_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BiasVariance:
    r"""Measure both estimates of the gradient of a smoothed cost, at every softness and point.

    The noise is the same at every softness, so that differences between them are not luck. Everything is compiled
    once, in the first softness; the loop over the others is on the host, where progress can be shown. Samples are kept
    for the bootstrap: memory grows with points × `num_samples` × dim.

    Args:
        objective_of_softness: gives the objective at one softness; traceable.
        params: points to measure at, one per row, in the parameters' units; or a pytree whose floating-point arrays have
            an axis of points first. The result has them as vectors.
        key: consumed here.
        softness: any pytree whose leaves have a leading axis (`Softness.sweep`), or a sequence of pytrees.
        num_samples: differentiated rollouts per softness and point. At least 2.
        num_reference: rollouts for the reference, per softness if the cost is of one parameter with noise on it (one
            landscape serves all points), otherwise per softness and point.
        baseline: of the zeroth-order estimate.
        confidence: of the intervals.
        num_resamples: of the bootstrap.
        chunk_size: rollouts at a time.
        progress: called after every softness with how many are done and how many there are.

    Returns:
        The measurement.

    Raises:
        ValueError: if `params` is not a matrix, `softness` has no or unequal leading axes, or a number is out of range.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
        arXiv:2202.00817, section 3 (bias) and figure 4 (variance against stiffness).
    """
    check_baseline(baseline)
    params, restore = _points(params)
    whole("num_reference", num_reference, 4)
    stacked, count = _stacked(softness)
    has_zero_noise = baseline == "zero_noise"
    plan = Plan(num_samples, chunk_size, with_gradient=True, with_score=True, with_zero_noise=has_zero_noise)

    @jax.jit
    def measure(
        softness: PyTree, params: Float[Array, "points dim"], key: PRNGKeyArray
    ) -> tuple[dict[str, Any], Samples]:
        objective = of_vector(objective_of_softness(softness), restore).sized_for(params[0])
        samples_key, reference_key = jax.random.split(key)
        samples = _sampled(objective, params, samples_key, plan)
        first, zeroth = jax.vmap(lambda s: both_results(both_summary(s), plan, baseline, unchanged))(samples)
        is_line = isinstance(objective, ParameterNoise) and objective.dim == 1
        find = _by_landscape if is_line else _by_long_run
        reference = find(objective, params, reference_key, num_reference, max(2, chunk_size or DEFAULT_CHUNK_SIZE))
        return {"first": first, "zeroth": zeroth, **reference}, samples

    each = [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(count)]
    # Compiled here, for a thread does not see what a `with` has set, such as the precision.
    compiled = compile_once(measure.lower(each[0], params, key))

    def row(one: PyTree) -> tuple[dict[str, Any], np.ndarray]:
        measured, samples = jax.block_until_ready(compiled(one, params, key))
        return measured, _variance_intervals(samples, baseline, confidence, num_resamples)

    rows = []
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done in pool.map(row, each):
            rows.append(done)
            if progress is not None:
                progress(len(rows), count)
    found = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[row[0] for row in rows])
    variances = np.stack([row[1] for row in rows], axis=2)
    first, zeroth, reference, error = (found[name] for name in ("first", "zeroth", "reference", "reference_error"))
    # Independent: the reference has rollouts of its own.
    bias, bias_error = first.value - reference, jnp.hypot(first.standard_error, error)
    count_first, count_zeroth = first.num_finite[..., None], zeroth.num_finite[..., None]
    return BiasVariance(
        **found,
        softness=stacked,
        params=params,
        bias=bias,
        bias_error=bias_error,
        first_interval=mean_interval(first.value, first.standard_error, count_first, confidence),
        zeroth_interval=mean_interval(zeroth.value, zeroth.standard_error, count_zeroth, confidence),
        # The reference averages over so many cells, or samples, that its t is a normal distribution.
        reference_interval=mean_interval(reference, error, 10**6, confidence),
        bias_interval=mean_interval(bias, bias_error, count_first, confidence),
        first_variance_interval=variances[0],
        zeroth_variance_interval=variances[1],
        reference_method="zeroth_order" if found["landscape"] is None else "landscape",
        confidence=confidence,
    )


def _sampled(objective: Objective, params: Float[Array, "points dim"], key: PRNGKeyArray, plan: Plan) -> Samples:
    """Roll out for both estimates, all points through one compiled body."""
    num_chunks, size = plan.chunks()
    points, chunks = jnp.divmod(jnp.arange(len(params) * num_chunks), num_chunks)

    def one_chunk(point_and_chunk: tuple[Array, Array]) -> Samples:
        point, chunk = point_and_chunk
        return sample(objective, params[point], jax.random.fold_in(key, point), plan, size * chunk + jnp.arange(size))

    samples = jax.lax.map(one_chunk, (points, chunks))
    return jax.tree.map(lambda leaf: leaf.reshape(len(params), num_chunks * size, *leaf.shape[2:]), samples)


def _by_landscape(
    objective: ParameterNoise,
    params: Float[Array, "points dim"],
    key: PRNGKeyArray,
    num_reference: int,
    chunk_size: int,
) -> dict[str, Any]:
    """Take the cost and the reference from one landscape."""
    stddev = jnp.ravel(objective.stddev)[0].astype(params.dtype)
    low, high = params.min() - REACH * stddev, params.max() + REACH * stddev
    points, cell = cell_points(key, low, high, num_reference)
    everywhere = jnp.concatenate([points, params[:, 0]])
    # One body for the landscape and for the points themselves: compiling it takes longer than running it.
    costs = map_in_chunks(lambda x: objective.function(x[None]), everywhere, chunk_size)
    landscape, cost = Landscape(points, costs[:num_reference], cell), costs[num_reference:]
    gradient, error = jax.vmap(landscape.smoothed_gradient, in_axes=(0, None, 0))(params[:, 0], stddev, cost)
    return {"cost": cost, "reference": gradient[:, None], "reference_error": error[:, None], "landscape": landscape}


def _by_long_run(
    objective: Objective, params: Float[Array, "points dim"], key: PRNGKeyArray, num_reference: int, chunk_size: int
) -> dict[str, Any]:
    """Take the reference from many more samples, in pairs, of the estimate that is unbiased."""
    settings = {"num_samples": 2 * (num_reference // 2), "antithetic": True, "chunk_size": chunk_size}

    def one_point(index_and_point: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        index, point = index_and_point
        estimate = zeroth_order(objective, point, jax.random.fold_in(key, index), **settings)
        return objective.value(point, objective.zero_noise()), estimate.value, estimate.standard_error

    cost, gradient, error = jax.lax.map(one_point, (jnp.arange(len(params)), params))
    return {"cost": cost, "reference": gradient, "reference_error": error, "landscape": None}


def _variance_intervals(
    samples: Samples, baseline: str, confidence: float, num_resamples: int
) -> Float[np.ndarray, "2 2 points"]:
    """Bootstrap both variances at each point: estimate, end of interval, point."""
    points = range(len(samples.costs))
    per_point = [jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i], float), samples) for i in points]
    intervals = [
        [bootstrap_variance_interval(terms, confidence, num_resamples=num_resamples) for terms in _terms(s, baseline)]
        for s in per_point
    ]
    return np.moveaxis(np.array(intervals), 0, -1)


def _terms(samples: Samples, baseline: str) -> tuple[np.ndarray, np.ndarray]:
    """Give the samples of both estimates at one point; the leave-one-out baseline as the mean that it is up to 1/N."""
    is_noisy = samples.is_noisy > 0
    costs, scores = samples.costs[is_noisy, 0], samples.scores[is_noisy, 0]
    finite = costs[np.isfinite(costs)]
    centre = {
        "leave_one_out": finite.mean() if len(finite) else np.nan,
        "zero_noise": samples.costs[samples.is_noise_free > 0, 0].sum(),
        "none": 0.0,
    }[baseline]
    gradients = np.where(np.isfinite(costs)[:, None], samples.gradients[is_noisy, 0], np.nan)
    return gradients, (costs - centre)[:, None] * scores


def _points(params: PyTree) -> tuple[Float[Array, "points dim"], Callable | None]:
    """Give the points as rows, and the way from a row to their form; None if they are rows."""
    if eqx.is_array_like(params):
        if jnp.ndim(params) != 2:
            raise ValueError(
                f"params must have shape (points, dim), got {jnp.shape(params)}; for one parameter write params[:, None]"
            )
        return jnp.asarray(params), None
    arrays, others = eqx.partition(params, eqx.is_inexact_array)
    first = eqx.combine(jax.tree.map(lambda leaf: leaf[0], arrays), others)
    return jax.vmap(lambda one: flattened(one)[0])(arrays), flattened(first)[1]


def _stacked(softness: PyTree | Sequence[PyTree]) -> tuple[PyTree, int]:
    """Give one pytree with a leading axis, and its length."""
    if isinstance(softness, list | tuple):
        if not softness:
            raise ValueError("softness must have at least one value, got none")
        structures = {jax.tree.structure(one) for one in softness}
        if len(structures) > 1:
            raise ValueError(
                "softness must have the same parts set in every value, got "
                f"{len(structures)} different sets; give each of them every part that any of them has"
            )
        softness = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *softness)
    softness = jax.tree.map(jnp.asarray, softness)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(softness)}
    if len(lengths) != 1 or () in lengths or (0,) in lengths:
        raise ValueError(
            f"softness must have the same leading axis in every leaf, got lengths {sorted(lengths)}; see Softness.sweep"
        )
    return softness, lengths.pop()[0]
