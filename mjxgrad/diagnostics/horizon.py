r"""Effect of the horizon on gradients: growth of derivatives, and the horizon beyond which zeroth order is as good as first.

The derivative of a state with respect to an earlier one is the product of the step Jacobians between them. Its largest
singular value $s_t$ bounds every derivative of an outcome at $t$. Where motions diverge exponentially it grows as
$e^{\lambda t}$, and the variance of a first-order estimate as $e^{2 \lambda t}$. The cost bounds the variance of a
zeroth-order estimate.

References:
    Metz, Freeman, Schoenholz, Kachman. Gradients are Not All You Need. arXiv:2111.05803.
    Benettin, Galgani, Giorgilli, Strelcyn. Lyapunov characteristic exponents for smooth dynamical systems and for Hamiltonian
    systems; a method for computing all of them. Meccanica 15, 1980 (by repeated orthogonalisation).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.diagnostics.statistics import checked


class Growth(eqx.Module):
    """The growth of a product of Jacobians with the number of factors.

    Attributes:
        log_largest: logarithm of the product's largest singular value, after each factor.
        log_stretches: logarithms of the stretches along orthogonal directions, in the limit of many factors the largest
            first. Divided by time they tend to the Lyapunov exponents. Their sum is the logarithm of the determinant.
    """

    log_largest: Float[Array, "*batch horizon"]
    log_stretches: Float[Array, "*batch horizon n"]

    def exponents(self, times: Float[Array, " horizon"]) -> Float[Array, "*batch horizon n"]:
        """Return the finite-time Lyapunov exponents (1/s) from the times after each factor (s)."""
        return self.log_stretches / times[:, None]


def growth(jacobians: Float[Array, "*batch horizon n n"]) -> Growth:
    """Multiply Jacobians of consecutive steps, the first one first; any number of factors without overflow."""
    if jacobians.ndim > 3:
        return jax.vmap(growth)(jacobians)
    identity = jnp.eye(jacobians.shape[-1], dtype=jacobians.dtype)

    def multiply(carry: tuple[Array, Array, Array, Array], factor: Array):
        product, log_size, frame, log_stretch = carry
        product = factor @ product
        size = jnp.linalg.norm(product)
        # A vanishing product has no direction; its logarithm stays minus infinity.
        product, log_size = product / jnp.where(size > 0, size, 1.0), log_size + jnp.log(size)
        frame, triangle = jnp.linalg.qr(factor @ frame)
        log_stretch = log_stretch + jnp.log(jnp.abs(jnp.diagonal(triangle)))
        largest = jnp.linalg.norm(product, ord=2)
        return (product, log_size, frame, log_stretch), (log_size + jnp.log(largest), log_stretch)

    zero = jnp.zeros((), jacobians.dtype)
    start = (identity, zero, identity, jnp.zeros(jacobians.shape[-1], jacobians.dtype))
    _, (log_largest, log_stretches) = jax.lax.scan(multiply, start, jacobians)
    return Growth(log_largest, log_stretches)


class Crossover(eqx.Module):
    """The horizon from which the second estimator is at least as good as the first.

    Attributes:
        horizon: interpolated horizon; infinite if there is no crossing, the first horizon if it is so from the beginning.
        low: lower end of its interval.
        high: upper end, infinite if resamples do not reach it.
        log_ratio: logarithm of the first estimator's mean squared error over the second's.
    """

    horizon: float
    low: float
    high: float
    log_ratio: Float[np.ndarray, " horizons"]


def crossover(
    horizons: Float[np.ndarray, " horizons"],
    first: Float[np.ndarray, "repeats horizons"],
    second: Float[np.ndarray, "repeats horizons"],
    *,
    confidence: float = 0.95,
    num_resamples: int = 1000,
) -> Crossover:
    """Find the last crossing of two estimators' mean squared errors, with a bootstrap interval over repeats.

    The crossing follows the last horizon at which the first estimator is better, so brief draws before it do not count. The
    logarithm of the error ratio is interpolated between horizons.

    Args:
        horizons: the horizons, increasing, in any unit.
        first: squared errors of repeated estimates by the first estimator.
        second: squared errors by the second estimator, as many; repeats of both are resampled together, since they may share
            rollouts.
        confidence: coverage of the interval.
        num_resamples: number of bootstrap resamples.

    Returns:
        The horizon and its interval.

    Raises:
        ValueError: if shapes differ, horizons do not increase, there are fewer than two repeats, or `confidence` is not
            between 0 and 1.
    """
    tail = (1 - checked(confidence)) / 2
    if first.shape != second.shape or first.shape[1:] != horizons.shape or len(first) < 2:
        raise ValueError(
            "first and second must hold at least two repeats of one number per horizon, got shapes "
            f"{first.shape} and {second.shape} for {len(horizons)} horizons"
        )
    if not (np.diff(horizons) > 0).all():
        raise ValueError(f"horizons must increase, got {horizons.tolist()}")
    log_ratio = _log_ratio(first.mean(axis=0), second.mean(axis=0))
    draws = np.random.default_rng(0).integers(len(first), size=(num_resamples, len(first)))
    found = [_last_crossing(horizons, _log_ratio(first[one].mean(axis=0), second[one].mean(axis=0))) for one in draws]
    # Without interpolation, since infinity minus infinity is NaN.
    low, high = np.quantile(found, [tail, 1 - tail], method="nearest")
    return Crossover(_last_crossing(horizons, log_ratio), float(low), float(high), log_ratio)


def _log_ratio(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    # Two errors of zero are equal.
    tiny = np.finfo(float).tiny
    return np.log(np.maximum(first, tiny)) - np.log(np.maximum(second, tiny))


def _last_crossing(horizons: np.ndarray, log_ratio: np.ndarray) -> float:
    is_better = log_ratio < 0
    if not is_better.any():
        return float(horizons[0])
    last = int(np.flatnonzero(is_better)[-1])
    if last == len(horizons) - 1:
        return np.inf
    below, above = log_ratio[last], log_ratio[last + 1]
    return float(horizons[last] - below / (above - below) * (horizons[last + 1] - horizons[last]))
