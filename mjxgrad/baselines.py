r"""Search without derivatives in the same loop, with rollouts counted alike.

A search draws candidates $\theta_i = \mu + \sigma \epsilon_i$ around the present point $\mu$ and moves it by its own
rule. Candidates are rolled out without the objective's noise, but from random starts where the task has them. The cost in
the history is the mean over the candidates. The best parameters are among the points $\mu$.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Key

from mjxgrad._arrays import whole
from mjxgrad.estimators.moments import Moments
from mjxgrad.loop.descent import Carry, Descent, RunOptions
from mjxgrad.loop.result import Optimisation, Record
from mjxgrad.objective import Objective, OpenLoop, ParameterNoise
from mjxgrad.objective.base import as_objective, positive

__all__ = ["Population", "cross_entropy"]

Move = Callable[[Float[Array, " dim"], Float[Array, " dim"], Array, Array], tuple[Array, Array]]


class Population(Descent):
    """Optimiser by candidates: draw, roll out, move; its state is the width of the search, at the start `stddev`.

    `move` is a function from the point, the width, the candidates and their costs (infinite where not finite) to the next
    point and width. A step is taken if at least `least_finite` candidates are finite; the present point may be the first.
    """

    objective: Objective
    stddev: Float[Array, " dim"]
    move: Move = eqx.field(static=True)
    num_samples: int = eqx.field(static=True)
    least_finite: int = eqx.field(static=True, default=2)
    has_present: bool = eqx.field(static=True, default=False)

    def init_state(self, params: Float[Array, " dim"]) -> Float[Array, " dim"]:
        return self.stddev.astype(params.dtype)

    def step(self, carry: Carry, index: Int[Array, ""]) -> tuple[Carry, Record]:
        params, width = carry.params, carry.state
        search_key, rollout_key = jax.random.split(jax.random.fold_in(carry.key, index))
        objective = self.objective.sized_for(params)
        directions = jax.random.normal(search_key, (self.num_samples, params.size), params.dtype)
        at = params + width * (directions.at[0].set(0) if self.has_present else directions)
        rollout_keys = jax.random.split(rollout_key, self.num_samples)
        noise = jax.vmap(lambda one: objective.silence(objective.sample_noise(one)))(rollout_keys)
        costs = jax.vmap(objective.value)(at, noise)
        is_finite = jnp.isfinite(costs)
        is_taken = is_finite.sum() >= self.least_finite
        new, stddev = self.move(params, width, at, jnp.where(is_finite, costs, jnp.inf))
        new, stddev = jnp.where(is_taken, new, params).astype(params.dtype), jnp.where(is_taken, stddev, width)
        found = Moments.of(costs, is_finite)
        record = dataclasses.replace(
            Record.blank(costs.dtype),
            cost=jnp.where(found.count > 0, found.mean, jnp.nan),
            cost_error=jnp.sqrt(found.squared_error()),
            scale=jnp.ones((), costs.dtype),
            step_norm=jnp.linalg.norm(new - params),
            finite_fraction=is_finite.mean(dtype=costs.dtype),
            num_rollouts=jnp.asarray(costs.size, jnp.int32),
            is_taken=is_taken,
        )
        return self.moved(carry, index, new, stddev, record)


def cross_entropy(
    objective: Objective,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    num_samples: int,
    num_elite: int,
    num_steps: int,
    stddev: ArrayLike | None = None,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost by the cross-entropy method; fields of the result about gradients are NaN.

    Every step draws candidates from $N(\mu, \mathrm{diag}\,\sigma^2)$ and fits $\mu$ and $\sigma$ to the `num_elite`
    best ones, by maximum likelihood (so $\sigma$ has no $n - 1$). A step with fewer finite ones is not taken.

    Args:
        objective: the objective; only its cost is used.
        params: the first $\mu$.
        key: as in `optimise`.
        num_samples: candidates, and so rollouts, per step.
        num_elite: number of the best candidates in the fit. At least 2.
        num_steps: largest number of steps.
        stddev: the first $\sigma$, in the parameters' units; one number, or one per parameter. None takes the
            objective's noise, if it is on the parameters.
        **options: see `RunOptions`.

    Raises:
        ValueError: if a number is out of range or does not fit, or as in `optimise`.

    References:
        De Boer, Kroese, Mannor, Rubinstein. A tutorial on the cross-entropy method. Annals of Operations Research 134,
        2005, section 5 (continuous optimisation).
    """
    width = search_stddev(objective, params, stddev, num_samples)
    if not 2 <= whole("num_elite", num_elite, None) <= num_samples:
        raise ValueError(f"num_elite must be at least 2 and at most num_samples = {num_samples}, got {num_elite}")

    def move(_mean: Array, _stddev: Array, at: Array, costs: Array) -> tuple[Array, Array]:
        elite = at[jnp.argsort(costs)[:num_elite]]
        return elite.mean(axis=0), elite.std(axis=0)

    method = Population(RunOptions.of(num_steps, options), objective, width, move, num_samples, least_finite=num_elite)
    return method.run(params, key)


def search_stddev(
    objective: Objective, params: Float[Array, "..."], stddev: ArrayLike | None, num_samples: int
) -> Float[Array, " dim"]:
    """Return the width of the search for each parameter; refuse invalid ones."""
    as_objective(objective)
    whole("num_samples", num_samples, 2)
    dim = jnp.shape(params)[-1] if jnp.ndim(params) else 1
    if stddev is None and isinstance(objective, OpenLoop | ParameterNoise):
        shape = objective.noise_shape if isinstance(objective, OpenLoop) else (dim,)
        return jnp.ravel(jnp.broadcast_to(objective.stddev, shape))
    if stddev is None:
        raise ValueError(
            f"stddev must be given for {type(objective).__name__}, whose noise is not on the parameters; "
            "it is the width of the search, in the parameters' units"
        )
    width = positive(jnp.asarray(stddev, float))
    if width.shape not in ((), (dim,)):
        raise ValueError(f"stddev must be one number or {dim}, got shape {width.shape}")
    return jnp.broadcast_to(width, (dim,))
