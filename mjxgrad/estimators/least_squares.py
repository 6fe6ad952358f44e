"""The slope of a linear fit to samples: zeroth order bundled, as smoothed contact models are estimated."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._programs import compiled
from mjxgrad.estimators.estimate import GradientEstimate, assemble
from mjxgrad.estimators.moments import Moments
from mjxgrad.estimators.samples import Plan, sample
from mjxgrad.objective import Objective, OpenLoop, ParameterNoise, as_vector


@compiled
def least_squares(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int, chunk_size: int | None = None
) -> GradientEstimate:
    r"""Estimate the gradient of a smoothed objective by a linear fit to its samples, without derivatives.

    The estimate is the slope of the regression of $f$ on $w$, with an intercept. For Gaussian noise it converges to
    $\nabla F$ for every $f$ (Stein's lemma). For a linear $f$ it is exact from $\mathrm{dim} + 1$ samples on, where
    zeroth order has the full noise. With few more samples than dimensions it is noisier than zeroth order.

    The standard error is the sandwich with each residual divided by one minus its leverage (HC3), because at a jump the
    residual depends on the noise. It is a little too large rather than too small.

    Args:
        objective: an objective with Gaussian noise on the parameters, or open loop from a fixed start.
        params: the point $\theta$, a vector or a pytree as in `first_order`.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. More than dim + 1.
        chunk_size: rollouts at a time. Noise and costs of all samples are kept: memory grows with num_samples * dim.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if the noise is not on the parameters alone, or there are not enough samples for the dimension.

    References:
        Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic
        Contact Models. IEEE T-RO 2023, arXiv:2206.10787, section III (fits to samples). MacKinnon, White. Some
        heteroskedasticity-consistent covariance matrix estimators. Journal of Econometrics 29, 1985 (HC3).
    """
    objective, vector, restore = as_vector(objective, params)
    if not isinstance(objective, ParameterNoise | OpenLoop) or objective.has_circumstances:
        raise ValueError(
            "objective must have its noise on the parameters and nothing else at random, got "
            f"{type(objective).__name__}{' with random starts' if objective.has_circumstances else ''}; "
            "use zeroth_order or control_variate"
        )
    plan = Plan(num_samples, chunk_size, with_score=True)
    if num_samples <= vector.size + 1:
        raise ValueError(
            f"num_samples must be more than dim + 1 = {vector.size + 1}, got {num_samples}; "
            "zeroth_order needs no more than 2"
        )
    num_chunks, size = plan.chunks()
    units = jnp.arange(num_chunks * size).reshape(num_chunks, size)
    samples = jax.lax.map(lambda some: sample(objective, vector, key, plan, some), units)
    samples = jax.tree.map(lambda leaf: leaf.reshape(num_chunks * size, *leaf.shape[2:]), samples)
    mask = samples.zeroth_order_mask()
    costs = Moments.of(samples.rollouts.cost[:, 0], mask)
    # Scores times the standard deviation: comparable size in all coordinates, whatever their units.
    stddev = jnp.ravel(jnp.broadcast_to(objective.stddev, objective.noise_shape)).astype(vector.dtype)
    noise = jnp.where(mask[:, None], samples.rollouts.noise_score[:, 0] * stddev, 0)
    slope, squared_error = _fit(noise, jnp.where(mask, samples.rollouts.cost[:, 0] - costs.mean, 0), mask)
    return assemble(
        slope / stddev,
        squared_error / stddev**2,
        costs,
        plan,
        # A fit that leaves no residual degree of freedom is no estimate.
        count=jnp.where(costs.count > vector.size + 1, costs.count, 0),
        num_felt=samples.num_felt(),
        restore=restore,
    )


def _fit(
    noise: Float[Array, "samples dim"], costs: Float[Array, " samples"], mask: Array
) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Return the slope of the regression, by QR, with its squared error."""
    design = jnp.concatenate([mask[:, None].astype(noise.dtype), noise], axis=1)
    basis, triangle = jnp.linalg.qr(design)
    to_slope = jax.scipy.linalg.solve_triangular(triangle, basis.T)
    fitted = to_slope @ costs
    leverage = (basis**2).sum(axis=1)
    residual = (costs - design @ fitted) / jnp.maximum(1 - leverage, jnp.finfo(noise.dtype).eps)
    squared_error = (to_slope**2 * jnp.where(mask, residual, 0) ** 2).sum(axis=1)
    return fitted[1:], squared_error[1:]
