"""Searches without derivatives that optimisation experiments compare with, beside the library's cross-entropy method."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Key

from mjxgrad.baselines import Population, cross_entropy, search_stddev
from mjxgrad.loop import Optimisation
from mjxgrad.loop.descent import RunOptions
from mjxgrad.objective import Objective

__all__ = ["cross_entropy", "mppi", "predictive_sampling"]


def mppi(
    objective: Objective,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    num_samples: int,
    num_steps: int,
    temperature: float = 0.1,
    stddev: ArrayLike | None = None,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost by the update of model-predictive path integral control.

    $$\mu \leftarrow \mu + \sum_i \frac{\exp(-f_i/\lambda)}{\sum_j \exp(-f_j/\lambda)}\, \sigma\epsilon_i,
      \qquad f_i = f(\mu + \sigma\epsilon_i).$$

    Each step plans the whole horizon anew; nothing is shifted or executed in between. The cost is the objective's alone,
    without the cited method's extra charge $\lambda\mu^\top\Sigma^{-1}\epsilon$ for control.
    A candidate that is not finite has weight zero; a step with fewer than two finite ones is not taken.

    A low temperature $\lambda$ follows the best candidate, a high one averages over all. Its unit is the standard
    deviation of the step's costs, so that the cost's unit has no effect. All other arguments, the result and the errors
    are those of `cross_entropy`.

    References:
        Williams, Wagener, Goldfain, Drews, Rehg, Boots, Theodorou. Information theoretic MPC for model-based
        reinforcement learning. ICRA 2017, algorithm 2. Theodorou, Buchli, Schaal. A generalized path integral control
        approach to reinforcement learning. JMLR 11, 2010, section 3.3 (there with the costs' range as their unit).
    """
    width = search_stddev(objective, params, stddev, num_samples)
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, got {temperature}; predictive_sampling takes the best alone")

    def move(mean: Array, stddev: Array, at: Array, costs: Array) -> tuple[Array, Array]:
        spread = jnp.std(costs, where=jnp.isfinite(costs))
        # For equal costs any temperature gives equal weights, but zero would give 0/0.
        scale = temperature * jnp.where(spread > 0, spread, 1)
        # Weighted offsets, not candidates: equal to rounding, and exact for a single weight of one.
        return mean + jax.nn.softmax(-costs / scale) @ (at - mean), stddev

    method = Population(RunOptions(num_steps, **options), objective, width, move, num_samples)
    return method.run(params, key)


def predictive_sampling(
    objective: Objective,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    num_samples: int,
    num_steps: int,
    stddev: ArrayLike | None = None,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost by moving to the best candidate, including the present point.

    The cost without noise never rises, unless the task's start is random. Arguments, result and errors are as in
    `cross_entropy`.

    References:
        Howell, Gileadi, Tunyasuvunakool, Zakka, Erez, Tassa. Predictive sampling: real-time behaviour synthesis with
        MuJoCo. 2022, arXiv:2212.00541, algorithm 1.
    """
    width = search_stddev(objective, params, stddev, num_samples)

    def move(mean: Array, stddev: Array, at: Array, costs: Array) -> tuple[Array, Array]:
        return at[jnp.argmin(costs)], stddev

    method = Population(
        RunOptions(num_steps, **options), objective, width, move, num_samples, least_finite=1, has_present=True
    )
    return method.run(params, key)
