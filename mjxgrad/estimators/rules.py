r"""Rules that weigh a first-order estimate against an unbiased one: $\alpha g^1 + (1 - \alpha) g^0$.

A rule is any function from `Evidence` to `Weights`. $\delta$ is everywhere the probability of *failure*.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy import stats

from mjxgrad._arrays import is_known
from mjxgrad.estimators.estimate import Reason
from mjxgrad.estimators.evidence import Evidence


class Weights(eqx.Module):
    """The decision of a rule.

    Attributes:
        alpha: weight of the first-order part, from 0 to 1.
        reason: an item of `Reason`.
        bias_bound: upper bound on the norm of the bias, NaN where the rule knows none.
    """

    alpha: Float[Array, "*batch"]
    reason: Reason
    bias_bound: Float[Array, "*batch"]


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


class InverseVariance(eqx.Module):
    r"""$\alpha = V^0/(V^0 + V^1)$: least variance if both parts are independent, blind to bias."""

    def __call__(self, evidence: Evidence) -> Weights:
        alpha = evidence.least_variance()
        return Weights(alpha, Reason.inverse_variance, jnp.where(alpha > 0, jnp.nan, 0))


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
        rate = jnp.log((evidence.dim + 1) / self.failure_probability) / evidence.count
        return jnp.sqrt(2 * evidence.zeroth_variance * rate) + 2 / 3 * jnp.asarray(self.bound) * rate


class TrustRegion(eqx.Module):
    r"""First order as far as it lies within the error of zeroth order, by the empirical bias alone.

    The estimate is the point nearest to $g^1$ in a ball about $g^0$: $\alpha = \min(1, r/\|g^1 - g^0\|)$. The truth lies in
    the ball with the probability $1 - \delta$, so that the error is at most twice the radius $r$, however wrong derivatives
    are. Unlike `BiasConstrained` it has no constants of the task.

    Attributes:
        failure_probability: $\delta$, at most 0.2.

    References:
        Tedrake. Do Differentiable Simulators Give Better Policy Gradients? Talk at the RSS workshop on differentiable
        simulation, 2022 (the empirical bias as a trust region).
    """

    failure_probability: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        _check_failure_probability(self.failure_probability, _MOST_FAILURES)

    def __call__(self, evidence: Evidence) -> Weights:
        radius = confidence_radius(evidence.zeroth_variance, evidence.count, self.failure_probability)
        found = evidence.difference_norm
        is_inside = found <= radius
        alpha = jnp.where(is_inside, 1, radius / jnp.where(is_inside, 1, found))
        reason = Reason.where(is_inside, Reason.inside, Reason.bias_limit)
        return Weights(alpha, reason, radius + alpha * found)


class Concavity(eqx.Module):
    r"""Inverse variance if $V^1 \ge 2(1 - c)\mathrm{Var}f/\sigma^2 - 2\|g^1\|^2$, else $\alpha = 0$ (DDCG).

    A smooth cost satisfies this on average with $c = 0$, a Poincaré inequality one order higher. A cost with jumps has
    too much variance for its derivatives.

    Attributes:
        slack: $c$.

    References:
        Onoda et al., arXiv:2604.18161 (DDCG), here with the noise of each coordinate in its own standard deviations.
    """

    slack: float = eqx.field(static=True, default=0.3)

    def __call__(self, evidence: Evidence) -> Weights:
        needed = 2 * (1 - self.slack) * evidence.cost_variance - 2 * evidence.scaled_first_norm**2
        is_smooth = evidence.scaled_first_variance >= needed
        alpha = jnp.where(is_smooth, evidence.least_variance(), 0)
        reason = Reason.where(is_smooth, Reason.inverse_variance, Reason.inconsistent)
        return Weights(alpha, reason, jnp.where(alpha > 0, jnp.nan, 0))


class LeastRisk(eqx.Module):
    r"""The weight of least mean squared error, for bias as far as it is seen; the default.

    Let $V^1$ and $V^0$ be the noise of both means that they do not share, and $b$ the bias of the first order. The squared
    error of the mixture, but for what both share, is $\alpha^2(V^1 + b^2) + (1 - \alpha)^2 V^0$. It is least at

    $$\alpha = \frac{V^0}{V^0 + V^1 + b^2}.$$

    Two sources tell $b^2$, and the smaller counts:

    - $D = \|g^1 - g^0\|^2$ less its noise is unbiased for it. What noise alone exceeds with the probability $2 v^{1/2}$, or
      $4.5 v^{2/3}$ where that is less, is taken off, $v$ being $V^1/V^0$ as a rule. A bias that is seen where there is none
      costs $V^0$, and one that is not seen as much as is taken off. By this balance the largest ratio to the better part's
      error, over all biases, is near the least that any rule of both means can have. This is near 1 where noise is worth 16
      coordinates or more, but in a single one it is 1.9 where $v$ is a tenth, 3.4 at a hundredth, 7.4 at $10^{-4}$: there
      nobody can promise more.
    - $U$, by what derivatives leave unexplained in the costs, bounds it from above (see `SecantSums`). It is zero for a
      quadratic. Where samples are fewer than dimensions, it lies below $V^0$: no bias does more harm there than the noise of
      zeroth order.

    Derivatives that scatter about the right mean leave much unexplained, but no more than they scatter; derivatives that miss
    jumps do. With $J$ the part of $U$ that scatter does not explain, $pJ/n$ is the part of $V^0$ that is due to jumps. $v V^0$ is
    at least that, and so jumps show at once; and $v$ at least $10^{-4}$, for no derivative is trusted without limit.

    In a descent (see `Memory`) $D$ is that of the mean over its last steps, and $b^2$ counts as many times as there are steps
    over which noise averages.

    References:
        Green, Strawderman. A James-Stein type estimator for combining unbiased and possibly biased estimators. Journal of the
        American Statistical Association 86, 1991 (weights from the squared difference). Chen, Qin. A two-sample test for
        high-dimensional data with applications to gene-set testing. Annals of Statistics 38, 2010 (D and its noise).
        Laurent, Massart. Adaptive estimation of a quadratic functional by model selection. Annals of Statistics 28, 2000 (how
        far noise goes).
    """

    def __call__(self, evidence: Evidence) -> Weights:
        seen = evidence.squared_bias - _taken_off(evidence) * evidence.squared_bias_error
        # Where the error overflows, as fourth powers of derivatives do in single precision, nothing is seen.
        seen = jnp.where(jnp.isfinite(evidence.squared_bias_error), seen, 0)
        bias = jnp.clip(seen, 0, evidence.squared_bias_bound)
        risk = evidence.zeroth_noise + (evidence.first_noise + evidence.num_estimates * bias)
        alpha = jnp.where(risk > 0, evidence.zeroth_noise / jnp.where(risk > 0, risk, 1), 1)
        reason = Reason.where(bias > 0, Reason.bias_limit, Reason.inverse_variance)
        return Weights(alpha, reason, alpha * jnp.sqrt(evidence.squared_bias_bound))


def _taken_off(evidence: Evidence) -> Float[Array, "*batch"]:
    """Return how many of its standard errors the squared difference must exceed its noise by, to count as bias."""
    zeroth = evidence.zeroth_noise
    jumps = evidence.noise_dim * evidence.squared_jump_bound / jnp.maximum(evidence.count, 1)
    first = jnp.maximum(jnp.maximum(evidence.first_noise, jumps), _LEAST_NOISE * zeroth)
    # Noise worth p coordinates exceeds so many errors with the probability exp(-rate) at most.
    ratio = jnp.log(zeroth / jnp.where(first > 0, first, 1))
    rate = jnp.maximum(jnp.maximum((ratio - jnp.log(4.0)) / 2, 2 / 3 * ratio - 1.5), 0)
    far = jnp.sqrt(2.0) * (jnp.sqrt(rate) + rate / jnp.sqrt(evidence.noise_dim))
    # At least one in many coordinates, where it costs nothing: else noise counts as bias half of the time.
    return jnp.maximum(1 - 1 / evidence.noise_dim, far)


_LEAST_NOISE = (
    1e-4  # of that of zeroth order; with 1e-2 first order's errors would grow a hundredfold where it is far ahead
)
# Above this, a single coordinate is not the worst case among Gaussian quadratic forms.
_MOST_FAILURES = 0.2
_LONGEST_TABLE = 1000


def confidence_radius(
    variance: Float[Array, "*batch"], count: Float[Array, "*batch"], failure_probability: float
) -> Float[Array, "*batch"]:
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
    quantile = jnp.asarray(quantiles, variance.dtype)[jnp.clip(jnp.round(count), 0, _LONGEST_TABLE).astype(int)]
    spread = jnp.sqrt(variance / jnp.maximum(count, 1))
    return jnp.where(count >= 2, quantile * spread, jnp.inf)


def _check_failure_probability(value: float, most: float) -> None:
    if not 0 < value <= most or value >= 1:
        raise ValueError(f"failure_probability must be above 0 and at most {most}, got {value}; 0.05 means 95 % sure")
