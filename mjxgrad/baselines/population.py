r"""Methods that look at many candidates per step and at their costs alone.

Each draws candidates $\theta_i = \mu + \sigma \epsilon_i$ about the present point $\mu$ and moves it by a rule of its
own. The search noise takes the place of the objective's: candidates are rolled out without that, or, where a task's
start is random, with a start of their own. The cost in the history is the mean over the candidates, and the best
parameters are among the points $\mu$, whose noise-free cost `evaluate` measures.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators import Reason
from mjxgrad.objective import ActionNoise, Objective
from mjxgrad.optimiser.result import Record
from mjxgrad.optimiser.step import Method, as_objective, parameter_stddev


class Candidates(eqx.Module):
    """What one step has looked at; a cost that is not finite is infinite here.

    Attributes:
        params: one candidate per row.
        costs: of them.
    """

    params: Float[Array, "num_samples dim"]
    costs: Float[Array, " num_samples"]


class Population(Method):
    """Draw candidates, roll them out, move.

    A subclass gives `moved`. One that adapts the width of the search gives `init` too; the state is that width.

    Attributes:
        objective: what to minimise.
        stddev: of the search at the start; one number, or one per parameter.
        num_samples: candidates, and so rollouts, per step.
    """

    objective: eqx.AbstractVar[Objective]
    stddev: eqx.AbstractVar[Float[Array, "..."]]
    num_samples: eqx.AbstractVar[int]

    @abstractmethod
    def moved(
        self, params: Float[Array, " dim"], stddev: Float[Array, " dim"], candidates: Candidates
    ) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Give the next point and the next width of the search."""

    @property
    def least_finite(self) -> int:
        """Give how many candidates must be finite for a step to be taken."""
        return 2

    def noises(self, key: PRNGKeyArray, dim: int, dtype: Any) -> Float[Array, "num_samples dim"]:
        """Draw the directions of the candidates, standard normal."""
        return jax.random.normal(key, (self.num_samples, dim), dtype)

    def init(self, params: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Give the width of the search."""
        return jnp.broadcast_to(self.stddev, params.shape).astype(params.dtype)

    def advance(
        self, params: Float[Array, " dim"], state: Float[Array, " dim"], key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], Float[Array, " dim"], Record]:
        """Take one step; it is not taken if too few candidates were finite."""
        search_key, rollout_key = jax.random.split(key)
        objective = self.objective.sized_for(params)
        at = params + state * self.noises(search_key, params.size, params.dtype)
        noises = jax.vmap(lambda one: without_action_noise(objective, one))(
            jax.random.split(rollout_key, self.num_samples)
        )
        costs = jax.vmap(objective.value)(at, noises)
        is_finite = jnp.isfinite(costs)
        is_taken = is_finite.sum() >= self.least_finite
        new, stddev = self.moved(params, state, Candidates(at, jnp.where(is_finite, costs, jnp.inf)))
        new, stddev = jnp.where(is_taken, new, params), jnp.where(is_taken, stddev, state)
        return new, stddev, _record(costs, is_finite, jnp.linalg.norm(new - params), is_taken)


def without_action_noise(objective: Objective, key: PRNGKeyArray) -> PyTree:
    """Give the noise of a rollout with no noise on actions or parameters, but a random start where the task has one."""
    if isinstance(objective, ActionNoise):
        _, start = objective.split(objective.sample_noise(key))
        if start is not None:
            return jnp.zeros(objective.noise_shape, objective.stddev.dtype), start
    return objective.zero_noise()


def search_stddev(
    objective: Objective, params: Float[Array, "..."], stddev: ArrayLike | None, num_samples: int
) -> Float[Array, " dim"]:
    """Settle the width of the search, refusing what makes no sense.

    Args:
        objective: whose noise is the default, if it is on the parameters.
        params: the start.
        stddev: as given.
        num_samples: candidates per step.

    Returns:
        One width per parameter.

    Raises:
        ValueError: if `stddev` is needed and not given, not positive, or does not fit; if there are fewer than two
            candidates.
    """
    as_objective(objective)
    if num_samples < 2:
        raise ValueError(f"num_samples must be at least 2, got {num_samples}")
    dim = jnp.shape(params)[-1] if jnp.ndim(params) else 1
    if stddev is None:
        stddev = parameter_stddev(objective, dim)
    if stddev is None:
        raise ValueError(
            f"stddev must be given for {type(objective).__name__}, whose noise is not on the parameters; "
            "it is the width of the search, in the parameters' units"
        )
    width = jnp.asarray(stddev, float)
    if width.shape not in ((), (dim,)):
        raise ValueError(f"stddev must be one number or {dim}, got shape {width.shape}")
    if not bool((width > 0).all()):
        raise ValueError(f"stddev must be positive, got {stddev}")
    return jnp.broadcast_to(width, (dim,))


def _record(
    costs: Float[Array, " num_samples"],
    is_finite: Bool[Array, " num_samples"],
    step_norm: Float[Array, ""],
    is_taken: Bool[Array, ""],
) -> Record:
    count = is_finite.sum()
    mean = jnp.where(count > 0, jnp.mean(costs, where=is_finite), jnp.nan)
    variance = jnp.sum(jnp.where(is_finite, costs - mean, 0) ** 2) / jnp.maximum(count - 1, 1)
    nan = jnp.full((), jnp.nan, costs.dtype)
    return Record(
        cost=mean,
        cost_error=jnp.where(count > 1, jnp.sqrt(variance / jnp.maximum(count, 1)), nan).astype(costs.dtype),
        gradient_norm=nan,
        gradient_error=nan,
        alpha=nan,
        reason=jax.tree.map(jnp.asarray, Reason.fixed),
        bias_bound=nan,
        scale=jnp.ones_like(nan),
        step_norm=step_norm,
        finite_fraction=is_finite.mean(dtype=costs.dtype),
        num_rollouts=jnp.asarray(costs.size, jnp.int32),
        num_gradient_rollouts=jnp.zeros((), jnp.int32),
        is_taken=is_taken,
    )
