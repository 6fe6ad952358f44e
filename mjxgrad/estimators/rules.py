r"""Rules that weigh a first-order estimate against an unbiased one: $\alpha g^1 + (1 - \alpha) g^0$.

A rule is any function from `Evidence` to `Weights`; `mg.learning` maps it over steps and actions. $\delta$ is everywhere
the probability of *failure*.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int
from scipy import stats

from mjxgrad._arrays import is_known
from mjxgrad.estimators.estimate import Reason
from mjxgrad.estimators.moments import Moments
from mjxgrad.objective.base import Scalar


class Evidence(eqx.Module):
    """The input of a rule: norms and variances of one block of coordinates, and facts about all coordinates.

    Attributes:
        count: number of samples behind the means, or of pairs where starts are random.
        dim: number of coordinates in the block.
        first_norm: norm of the mean derivative.
        difference_norm: norm of the difference between the two means.
        first_variance: trace of the covariance of one sample's derivative.
        zeroth_variance: trace of the covariance of one sample's unbiased term.
        difference_variance: trace of the covariance of one sample's difference; both parts share their rollouts.
        inconsistency: share of the squared secants of the cost that derivatives do not explain, from zero.
        relative_bias_bound: bound on the bias of the first order relative to its norm (see `SecantSums`): the standard
            deviation of the cost that derivatives miss, over that of the cost that their mean explains.
        cost_variance: variance of the cost.
        scaled_first_variance: trace of the covariance of derivatives by the noise in its standard deviations.
        scaled_first_norm: norm of the mean of these derivatives.
    """

    count: Int[Array, "*blocks"]
    dim: Float[Array, "*blocks"]
    first_norm: Float[Array, "*blocks"]
    difference_norm: Float[Array, "*blocks"]
    first_variance: Float[Array, "*blocks"]
    zeroth_variance: Float[Array, "*blocks"]
    difference_variance: Float[Array, "*blocks"]
    inconsistency: Float[Array, "*blocks"]
    relative_bias_bound: Float[Array, "*blocks"]
    cost_variance: Float[Array, "*blocks"]
    scaled_first_variance: Float[Array, "*blocks"]
    scaled_first_norm: Float[Array, "*blocks"]

    @classmethod
    def of(cls, first: Moments, zeroth: Moments, difference: Moments, **facts: Float[Array, ""]) -> "Evidence":
        """Return the evidence of one block: moments of both parts and of their difference, and facts, NaN if not given."""
        parts = {"first": first, "zeroth": zeroth, "difference": difference}
        known = {f"{name}_variance": part.variance().sum() for name, part in parts.items()}
        known |= {f"{name}_norm": jnp.linalg.norm(parts[name].mean) for name in ("first", "difference")}
        unknown = dict.fromkeys(cls.__annotations__, jnp.full_like(known["first_norm"], jnp.nan))
        dim = jnp.ones_like(first.offset).sum()
        return cls(**{**unknown, **known, **facts, "count": first.count, "dim": dim})

    @property
    def real_count(self) -> Float[Array, "*blocks"]:
        return self.count.astype(self.first_norm.dtype)

    def least_variance(self, excess: Float[Array, "*blocks"] | float = 0.0) -> Float[Array, "*blocks"]:
        """Return the weight V⁰/(V⁰ + V¹ + excess) of the first order; 1 where all are zero."""
        total = self.zeroth_variance + (self.first_variance + excess)
        return jnp.where(total > 0, self.zeroth_variance / jnp.where(total > 0, total, 1), 1)


class Weights(eqx.Module):
    """The decision of a rule.

    Attributes:
        alpha: weight of the first-order part, from 0 to 1.
        reason: an item of `Reason`.
        bias_bound: upper bound on the norm of the bias, NaN where the rule knows none.
    """

    alpha: Float[Array, "*blocks"]
    reason: Reason
    bias_bound: Float[Array, "*blocks"]


Rule = Callable[[Evidence], Weights]


class FixedAlpha(eqx.Module):
    """A fixed weight, from 0 to 1."""

    alpha: ArrayLike

    def __check_init__(self):
        is_number = isinstance(self.alpha, int | float) or is_known(self.alpha)
        if is_number and not np.all((np.asarray(self.alpha) >= 0) & (np.asarray(self.alpha) <= 1)):
            raise ValueError(f"alpha must be from 0 to 1, got {self.alpha}")

    def __call__(self, evidence: Evidence) -> Weights:
        alpha = jnp.asarray(self.alpha, evidence.first_norm.dtype)
        return Weights(alpha, Reason.fixed, jnp.where(alpha > 0, jnp.nan, 0))


class BiasConstrained(eqx.Module):
    r"""Least variance as far as a bound on the bias allows.

    $B = \|g^1 - g^0\|$ is the bias up to the error of $g^0$. This error exceeds $\varepsilon$ with probability $\delta$ at
    most. Then $\alpha = 0$ if $\varepsilon > \gamma$; inverse variance if $\alpha B \le \gamma - \varepsilon$ holds for
    it; else $\alpha = (\gamma - \varepsilon)/B$.

    Attributes:
        gamma: the allowed norm of the bias.
        bound: $L$, a bound on the norm of one zeroth-order term, for Bernstein's inequality.
        failure_probability: $\delta$, below 1.

    References:
        Suh, Simchowitz, Zhang, Tedrake. ICML 2022, arXiv:2202.00817, section 4; see `first_order`.
    """

    gamma: ArrayLike
    bound: ArrayLike
    failure_probability: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        _check_failure_probability(self.failure_probability, 1.0)

    def __call__(self, evidence: Evidence) -> Weights:
        error = self.zeroth_error(evidence)
        room = jnp.asarray(self.gamma, error.dtype) - error
        best, found = evidence.least_variance(), evidence.difference_norm
        allowed = jnp.maximum(room, 0) / jnp.where(found > 0, found, 1)
        is_free = best * found <= room
        alpha = jnp.where(room < 0, 0, jnp.where(is_free, best, allowed))
        reason = Reason.where(is_free, Reason.inverse_variance, Reason.bias_limit)
        reason = Reason.where(room < 0, Reason.uncertain, reason)
        return Weights(alpha, reason, alpha * (found + error))

    def zeroth_error(self, evidence: Evidence) -> Float[Array, ""]:
        """Return ε; the error of the unbiased part exceeds it with probability δ at most."""
        rate = jnp.log((evidence.dim + 1) / self.failure_probability) / evidence.real_count
        return jnp.sqrt(2 * evidence.zeroth_variance * rate) + 2 / 3 * jnp.asarray(self.bound) * rate


class Consistent(eqx.Module):
    r"""First order where the derivatives explain the costs, weighed by least error; the default.

    The rule asks two questions, the sharper one first:

    - Do the derivatives of the samples explain the differences of their costs (see `SecantSums`)? If a share of more
      than `threshold` remains unexplained, $\alpha = 0$. This finds jumps with few samples and in many dimensions.
    - Does the difference of both parts exceed its own noise, $\|g^1 - g^0\| > \varepsilon$ with failure probability
      $\delta$? The excess $\|g^1 - g^0\|^2 - \varepsilon^2$ is added to the variance of the first order:
      $\alpha = V^0/(V^0 + V^1 + n\,\text{excess})$, the weight of least mean squared error.

    Attributes:
        threshold: share of the squared secants that may remain unexplained. The bias is then at most the root of this
            share times $\mathrm{sd}(f)/\sigma$.
        failure_probability: $\delta$, at most 0.2.

    References:
        Green, Strawderman. A James-Stein type estimator for combining unbiased and possibly biased estimators.
        Journal of the American Statistical Association 86, 1991 (weights from the squared difference).
    """

    threshold: float = eqx.field(static=True, default=0.1)
    failure_probability: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        _check_failure_probability(self.failure_probability, _MOST_FAILURES)

    def __call__(self, evidence: Evidence) -> Weights:
        error = confidence_radius(evidence.difference_variance, evidence.count, self.failure_probability)
        excess = jnp.maximum(evidence.difference_norm**2 - error**2, 0)
        is_consistent = evidence.inconsistency <= self.threshold
        alpha = jnp.where(is_consistent, evidence.least_variance(evidence.real_count * excess), 0)
        reason = Reason.where(excess > 0, Reason.bias_limit, Reason.inverse_variance)
        reason = Reason.where(is_consistent, reason, Reason.inconsistent)
        return Weights(alpha, reason, alpha * evidence.relative_bias_bound * evidence.first_norm)


# Above this, a single coordinate is not the worst case among Gaussian quadratic forms.
_MOST_FAILURES = 0.2
_LONGEST_TABLE = 1000


def confidence_radius(variance: Scalar, count: Int[Array, ""], failure_probability: float) -> Scalar:
    """Return a radius that the norm of a mean's error exceeds with at most the given probability.

    It is Student's quantile times the standard error of the whole vector. For a nearly normal mean it is safe for every
    covariance: among Gaussian quadratic forms of equal mean, that of a single coordinate has the heaviest tail. The variance
    is the trace of the covariance of one sample. Fewer than two samples give infinity.

    References:
        Székely, Bakirov. Extremal probabilities for Gaussian quadratic forms. Probability Theory and Related Fields 126, 2003.
    """
    # JAX has no quantile of Student's t, so it comes from a table; beyond the table it is constant to three digits.
    freedom = np.arange(1, _LONGEST_TABLE)
    quantiles = np.concatenate([[np.inf, np.inf], stats.t.isf(failure_probability / 2, freedom)])
    quantile = jnp.asarray(quantiles, variance.dtype)[jnp.clip(count, 0, _LONGEST_TABLE)]
    spread = jnp.sqrt(variance / jnp.maximum(count, 1).astype(variance.dtype))
    return jnp.where(count >= 2, quantile * spread, jnp.inf)


def _check_failure_probability(value: float, most: float) -> None:
    if not 0 < value <= most or value >= 1:
        raise ValueError(f"failure_probability must be above 0 and at most {most}, got {value}; 0.05 means 95 % sure")
