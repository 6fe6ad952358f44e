"""Model-predictive path integral control, and predictive sampling: weigh candidates by cost, or take the best."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Key, PRNGKeyArray

from mjxgrad.baselines.population import Candidates, Population, search_stddev
from mjxgrad.objective import Objective
from mjxgrad.optimiser.result import Optimisation
from mjxgrad.optimiser.run import RunOptions, run


class PathIntegral(Population):
    """See `mppi`."""

    objective: Objective
    stddev: Float[Array, " dim"]
    num_samples: int = eqx.field(static=True)
    temperature: float = eqx.field(static=True)
    is_relative: bool = eqx.field(static=True)

    def moved(
        self, params: Float[Array, " dim"], stddev: Float[Array, " dim"], candidates: Candidates
    ) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Give the mean of the candidates under the weights."""
        costs = candidates.costs
        is_finite = jnp.isfinite(costs)
        temperature = jnp.asarray(self.temperature, costs.dtype)
        if self.is_relative:
            spread = jnp.std(costs, where=is_finite)
            # All costs alike: any temperature gives equal weights, but zero would give 0/0.
            temperature *= jnp.where(spread > 0, spread, 1)
        weights = jax.nn.softmax(jnp.where(is_finite, -costs / temperature, -jnp.inf))
        # Weighting the offsets, not the candidates: equal to rounding, and exact where a weight of one is left.
        return params + weights @ (candidates.params - params), stddev


class PredictiveSampling(Population):
    """See `predictive_sampling`."""

    objective: Objective
    stddev: Float[Array, " dim"]
    num_samples: int = eqx.field(static=True)

    @property
    def least_finite(self) -> int:
        """Ask for one that is finite: the best needs no other."""
        return 1

    def noises(self, key: PRNGKeyArray, dim: int, dtype: Any) -> Float[Array, "num_samples dim"]:
        """Draw directions; the first candidate is the present point itself."""
        return super().noises(key, dim, dtype).at[0].set(0)

    def moved(
        self, params: Float[Array, " dim"], stddev: Float[Array, " dim"], candidates: Candidates
    ) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Give the best candidate."""
        return candidates.params[jnp.argmin(candidates.costs)], stddev


def mppi(
    objective: Objective,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    num_samples: int,
    num_steps: int,
    temperature: float = 0.1,
    is_relative: bool = True,
    stddev: ArrayLike | None = None,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost by the update of model-predictive path integral control.

    $$\mu \leftarrow \mu + \sum_i \frac{\exp(-f_i/\lambda)}{\sum_j \exp(-f_j/\lambda)}\, \sigma\epsilon_i,
      \qquad f_i = f(\mu + \sigma\epsilon_i).$$

    The whole horizon is planned anew in each step; nothing is shifted or executed in between, and the cost is the
    objective's alone, without the cited method's extra charge $\lambda\mu^\top\Sigma^{-1}\epsilon$ for control.
    A candidate that is not finite has weight zero; a step with fewer than two finite ones is not taken.

    Args:
        objective: what to minimise; only its cost is used.
        params: the first $\mu$, such as controls raveled.
        key: as in `optimise`.
        num_samples: candidates, and so rollouts, per step.
        num_steps: at most.
        temperature: $\lambda$; low follows the best candidate, high averages over all.
        is_relative: whether the temperature is in units of the standard deviation of the step's costs, so that the
            cost's unit has no effect; otherwise in units of the cost.
        stddev: $\sigma$, in the parameters' units; one number, or one per parameter. None takes the objective's noise,
            if that is on the parameters.
        **options: see `RunOptions`.

    Returns:
        As `optimise`; what belongs to gradients is NaN.

    Raises:
        ValueError: if a number is out of range or does not fit, or as in `optimise`.

    References:
        Williams, Wagener, Goldfain, Drews, Rehg, Boots, Theodorou. Information theoretic MPC for model-based
        reinforcement learning. ICRA 2017, algorithm 2. Theodorou, Buchli, Schaal. A generalized path integral control
        approach to reinforcement learning. JMLR 11, 2010, section 3.3 (there with the costs' range as their unit).
    """
    width = search_stddev(objective, params, stddev, num_samples)
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, got {temperature}; predictive_sampling takes the best alone")
    method = PathIntegral(objective, width, num_samples, temperature, is_relative)
    return run(method, params, key, RunOptions(num_steps, **options))


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
    r"""Minimise a cost by going to the best candidate, the present point among them.

    The cost without noise never rises, unless the task's start is random.

    Args:
        objective: what to minimise; only its cost is used.
        params: the first point.
        key: as in `optimise`.
        num_samples: candidates, and so rollouts, per step; the first is the present point.
        num_steps: at most.
        stddev: width of the search, in the parameters' units; one number, or one per parameter. None takes the
            objective's noise, if that is on the parameters.
        **options: see `RunOptions`.

    Returns:
        As `optimise`; what belongs to gradients is NaN.

    Raises:
        ValueError: if a number is out of range or does not fit, or as in `optimise`.

    References:
        Howell, Gileadi, Tunyasuvunakool, Zakka, Erez, Tassa. Predictive sampling: real-time behaviour synthesis with
        MuJoCo. 2022, arXiv:2212.00541, algorithm 1.
    """
    width = search_stddev(objective, params, stddev, num_samples)
    method = PredictiveSampling(objective, width, num_samples)
    return run(method, params, key, RunOptions(num_steps, **options))
