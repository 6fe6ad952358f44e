r"""Empirical bias: a jump so rare, or so steep, that the samples of a gradient miss it.

A first-order estimate of a stiff cost is unbiased on paper. But if what the stiffness does sits in a few samples of
chance β, a number of samples that all miss it agree among each other on a wrong answer: biased for all anyone can see,
until one of them hits and the estimate leaps. The pair (β, Δ) says how likely, and how wrong.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from scipy import stats

from mjxgrad.diagnostics.statistics import checked
from mjxgrad.objective import Objective, as_vector

# Cutting a normal sample at its mean explains 2/π of its variance, an exponential one at the best place 0.65, a uniform
# one 3/4. More than that takes two groups, or a tail that carries the mean.
_LEAST_SHARE = 0.75

# For the share that a cut explains by chance: more draws and samples change its third digit.
_NULL_DRAWS, _NULL_SAMPLES = 400, 1000


class EmpiricalBias(eqx.Module):
    r"""What `empirical_bias` found: an event E, and the triple (β, Δ, S) of its definition.

    E is that a sample lies within S of the mean over E. It holds with chance $1 - \beta$; given E the mean is off by
    $\Delta = \|\mathbb{E}[z \mid E] - \mathbb{E}[z]\|$. S has no error bar: it defines the event, and by the law of
    order statistics the interval of β is right for it whatever the distribution.

    Attributes:
        num_samples: finite ones, which everything is taken from.
        num_not_finite: left out.
        num_outlying: samples outside of E; zero if no group was seen that stands apart.
        share: of the variance of all samples that the difference between E and its complement explains.
        mean: over E.
        probability: β, the share of samples outside of E.
        probability_interval: Clopper-Pearson.
        probability_bound: one-sided upper; about 3/n at 95 % if no sample was outside.
        distance: Δ; without a reference and without outlying samples zero.
        distance_interval: covers Δ; from zero to infinity where a single outlying sample is all there is to tell it.
        spread: S.
        variance: of one sample, as seen: the trace of the covariance.
        implied_variance: $\Delta^2(1 - \beta)/\beta$, the variance that the jump alone makes; with no sample outside
            of E it is at the bound of β, and so the least that an unseen jump implies.
        implied_variance_bound: the same at the ends of the intervals that make it least: a lower bound.
        confidence: of every interval and bound; the last rests on two of them.
    """

    num_samples: int = eqx.field(static=True)
    num_not_finite: int = eqx.field(static=True)
    num_outlying: int = eqx.field(static=True)
    share: float
    mean: Float[np.ndarray, " dim"]
    probability: float
    probability_interval: Float[np.ndarray, " 2"]
    probability_bound: float
    distance: float
    distance_interval: Float[np.ndarray, " 2"]
    spread: float
    variance: float
    implied_variance: float
    implied_variance_bound: float
    confidence: float = eqx.field(static=True)

    def miss_probability(self, num_samples: ArrayLike) -> Float[np.ndarray, "*shape"]:
        r"""Give the chance $(1 - \beta)^N$ that N samples all lie in E, so that none of them shows the jump."""
        return _all_inside(self.probability, num_samples)

    def miss_probability_interval(self, num_samples: ArrayLike) -> Float[np.ndarray, "2 *shape"]:
        """Give the interval of `miss_probability`, which is that of β carried over."""
        low, high = self.probability_interval
        return np.stack([_all_inside(high, num_samples), _all_inside(low, num_samples)])


def empirical_bias(
    gradients: ArrayLike, *, reference: tuple[ArrayLike, ArrayLike] | ArrayLike | None = None, confidence: float = 0.95
) -> EmpiricalBias:
    r"""Find the event, its chance, and what missing it does, from samples of first-order gradients.

    For each k the samples are cut into the k that are farthest from their median and the rest. The cut that explains
    the largest share of the variance is taken, and is believed if that share is larger than 0.75 and than what chance
    makes of as many normal samples at the given confidence; otherwise no sample counts as outlying. At most half can.

    With $b$ the chance of the complement and $\mu_E, \mu_o$ the means, $\Delta = b\,\|\mu_o - \mu_E\|$, so

    $$\mathrm{Var}[z] = (1 - b) V_E + b V_o + b(1 - b)\|\mu_o - \mu_E\|^2
      \;\ge\; \Delta^2 (1 - b)/b \;\ge\; \Delta^2 (1 - \beta)/\beta,$$

    with equality if the gradient is constant on both sides. This is the bound of order $\Delta^2/\beta$ of the paper,
    exact. A discrepancy Δ between a zeroth-order estimate and n first-order samples that show no outlier thus implies
    a variance of about $\Delta^2 n/3$, however small the variance of the samples is.

    Args:
        gradients: of shape (n, dim) or (n,), independent; those that are not finite are left out and counted.
        reference: an unbiased estimate of E[z], such as a zeroth-order one: its value and standard error, or the value
            alone if it is exact. Without it E[z] is the mean of all samples, which knows only what they met.
        confidence: of the intervals.

    Returns:
        The triple, and what follows from it.

    Raises:
        ValueError: if fewer than two samples are finite, shapes do not fit, or `confidence` is not between 0 and 1.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
        arXiv:2202.00817, section 3 (empirical bias). Otsu. A threshold selection method from gray-level histograms.
        IEEE Transactions on Systems, Man, and Cybernetics 9, 1979 (the cut). Wilks. Determination of sample sizes for
        setting tolerance limits. Annals of Mathematical Statistics 12, 1941 (why S needs no interval).
    """
    checked(confidence)
    samples, num_not_finite = _finite(gradients)
    samples, shares = _cuts(samples)
    num_outlying = int(np.argmax(shares))
    if shares[num_outlying] < max(_LEAST_SHARE, _share_by_chance(len(samples), confidence)):
        num_outlying = 0
    inside, outside = samples[: len(samples) - num_outlying], samples[len(samples) - num_outlying :]
    interval = binomial_interval(num_outlying, len(samples), confidence)
    bound = binomial_bound(num_outlying, len(samples), confidence)
    probability = num_outlying / len(samples)
    if reference is None:
        distance, ends = _distance_by_groups(inside, outside, confidence)
    else:
        distance, ends = _distance_to(reference, inside, confidence)
    return EmpiricalBias(
        num_samples=len(samples),
        num_not_finite=num_not_finite,
        num_outlying=num_outlying,
        share=float(shares[num_outlying]),
        mean=inside.mean(axis=0),
        probability=probability,
        probability_interval=interval,
        probability_bound=bound,
        distance=distance,
        distance_interval=ends,
        spread=float(np.linalg.norm(inside - inside.mean(axis=0), axis=1).max()),
        variance=float(samples.var(axis=0, ddof=1).sum()),
        implied_variance=_implied(distance, probability or bound),
        implied_variance_bound=_implied(float(ends[0]), bound),
        confidence=confidence,
    )


def first_order_samples(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int
) -> Float[Array, "samples dim"]:
    """Give single samples of the first-order gradient, one per row, not finite where a rollout or its derivative is not.

    Parameters are a vector or a pytree, as for `mjxgrad.estimators.first_order`. Memory grows with the number of samples.

    Raises:
        ValueError: if `num_samples` is below 1, or `params` is not a vector of the objective's dimension.
    """
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, got {num_samples}")
    objective, vector, _ = as_vector(objective, params)

    def one(key: PRNGKeyArray) -> Float[Array, " dim"]:
        cost, gradient = jax.value_and_grad(objective.value)(vector, objective.sample_noise(key))
        # The derivative of a diverged rollout may be a number all the same.
        return jnp.where(jnp.isfinite(cost), gradient, jnp.nan)

    return jax.vmap(one)(jax.random.split(key, num_samples))


def binomial_interval(count: int, total: int, confidence: float = 0.95) -> Float[np.ndarray, " 2"]:
    """Give the Clopper-Pearson interval of a probability, which covers at least as often as it says.

    References:
        Clopper, Pearson. The use of confidence or fiducial limits illustrated in the case of the binomial. Biometrika
        26, 1934.
    """
    return np.array(stats.binomtest(count, total).proportion_ci(checked(confidence)))


def binomial_bound(count: int, total: int, confidence: float = 0.95) -> float:
    """Give the one-sided upper Clopper-Pearson bound of a probability; for a count of zero about 3/total at 95 %."""
    return float(stats.binomtest(count, total, alternative="less").proportion_ci(checked(confidence)).high)


def _finite(gradients: ArrayLike) -> tuple[Float[np.ndarray, "samples dim"], int]:
    samples = np.asarray(gradients, float)
    samples = samples[:, None] if samples.ndim == 1 else samples
    if samples.ndim != 2:
        raise ValueError(f"gradients must have shape (n, dim) or (n,), got {samples.shape}")
    is_finite = np.isfinite(samples).all(axis=1)
    if is_finite.sum() < 2:
        raise ValueError(f"gradients must have at least 2 finite samples, got {is_finite.sum()} of {len(samples)}")
    return samples[is_finite], int((~is_finite).sum())


def _cuts(samples: Float[np.ndarray, "*batch n dim"]) -> tuple[np.ndarray, Float[np.ndarray, "*batch cuts"]]:
    """Sort samples by distance from their median; give the share of variance that cutting off the last k explains."""
    distances = np.linalg.norm(samples - np.median(samples, axis=-2, keepdims=True), axis=-1)
    order = np.argsort(distances, axis=-1, kind="stable")
    samples = np.take_along_axis(samples, order[..., None], axis=-2)
    centred = samples - samples.mean(axis=-2, keepdims=True)
    total = (centred**2).sum(axis=(-1, -2))
    count = samples.shape[-2]
    k = np.arange(count // 2 + 1)
    # About the mean of all, k outliers of sum s explain s²/k + s²/(n − k) of the sum of squares.
    sums = np.cumsum(centred[..., ::-1, :], axis=-2)[..., : count // 2, :]
    explained = (sums**2).sum(axis=-1) * (1 / np.maximum(k[1:], 1) + 1 / (count - k[1:]))
    shares = np.where(total[..., None] > 0, explained / np.where(total > 0, total, 1)[..., None], 0)
    return samples, np.concatenate([np.zeros((*shares.shape[:-1], 1)), shares], axis=-1)


def _share_by_chance(count: int, confidence: float) -> float:
    """Give the share that the best cut of normal samples does not exceed with some confidence."""
    # One coordinate is the worst case: in several, chance does not make outliers point the same way.
    normal = np.random.default_rng(0).normal(size=(_NULL_DRAWS, min(count, _NULL_SAMPLES), 1))
    return float(np.quantile(_cuts(normal)[1].max(axis=-1), confidence))


def _distance_by_groups(
    inside: Float[np.ndarray, "n dim"], outside: Float[np.ndarray, "k dim"], confidence: float
) -> tuple[float, Float[np.ndarray, " 2"]]:
    """Give Δ = b ‖μ_o − μ_E‖; its interval is the product of theirs, each of half the risk."""
    count, total = len(outside), len(inside) + len(outside)
    if count == 0:
        return 0.0, np.zeros(2)
    jump = outside.mean(axis=0) - inside.mean(axis=0)
    half_risk = (1 + confidence) / 2
    ends = binomial_interval(count, total, half_risk) * _norm_interval(jump, [inside, outside], half_risk)
    return count / total * float(np.linalg.norm(jump)), ends


def _distance_to(
    reference: tuple[ArrayLike, ArrayLike] | ArrayLike, inside: Float[np.ndarray, "n dim"], confidence: float
) -> tuple[float, Float[np.ndarray, " 2"]]:
    value, error = reference if isinstance(reference, tuple) else (reference, 0.0)
    dim = inside.shape[1]
    value, error = np.atleast_1d(np.asarray(value, float)), np.broadcast_to(np.asarray(error, float), (dim,))
    if value.shape != (dim,):
        raise ValueError(f"reference must have the shape ({dim},) of a gradient, got {value.shape}")
    gap = value - inside.mean(axis=0)
    return float(np.linalg.norm(gap)), _norm_interval(gap, [inside], confidence, (error**2).sum())


def _norm_interval(
    vector: Float[np.ndarray, " dim"], groups: list[np.ndarray], confidence: float, extra_variance: float = 0.0
) -> Float[np.ndarray, " 2"]:
    """Give the interval of a norm by the triangle inequality, so that it covers at least as often as it says."""
    norm = np.linalg.norm(vector)
    if any(len(group) < 2 for group in groups):
        return np.array([0.0, np.inf])
    variances = [group.var(axis=0, ddof=1).sum() / len(group) for group in groups]
    # All of the variance in one direction is the worst case.
    quantile = stats.t.ppf((1 + confidence) / 2, min(len(group) for group in groups) - 1)
    reach = quantile * np.sqrt(sum(variances) + extra_variance)
    return np.array([max(0.0, norm - reach), norm + reach])


def _implied(distance: float, probability: float) -> float:
    return distance**2 * (1 - probability) / probability


def _all_inside(probability: float, num_samples: ArrayLike) -> Float[np.ndarray, "*shape"]:
    """Give (1 − β)^N, exact for the smallest β."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(np.asarray(num_samples, float) * np.log1p(-probability)))
