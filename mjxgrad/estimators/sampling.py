"""Rollouts under noise, in chunks, with memory independent of their number."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators.moments import Summary
from mjxgrad.objective import Objective

Baseline = Literal["leave_one_out", "zero_noise", "none"]

# Wide enough to fill a CPU's vector units and hide loop overhead, narrow enough that a chunk of
# checkpointed rollouts of a small scene stays within tens of megabytes.
DEFAULT_CHUNK_SIZE = 512

# Up to here forward mode wins: on the rollout of tasks/ball_wall (one parameter, 512 samples, 2 cores) it took 0.53 s
# and 7 s of compilation, reverse mode 1.7 s and 13 s. Each further parameter costs about one more forward pass.
MOST_FORWARD_DIMENSIONS = 3


@dataclasses.dataclass(frozen=True)
class Plan:
    """Which rollouts an estimator asks for.

    A unit is what is independent of the others: one sample, or an antithetic pair.

    Attributes:
        num_samples: rollouts with noise.
        chunk_size: rollouts at a time, or None for the default.
        antithetic: whether every noise is used with its mirror image.
        with_gradient: whether the cost is differentiated.
        with_score: whether the score is wanted.
        with_zero_noise: whether one more rollout goes without noise.
    """

    num_samples: int
    chunk_size: int | None = None
    antithetic: bool = False
    with_gradient: bool = False
    with_score: bool = False
    with_zero_noise: bool = False

    def __post_init__(self):
        smallest = 4 if self.antithetic else 2
        if self.num_samples < smallest:
            pairs = " with antithetic pairs" if self.antithetic else ""
            raise ValueError(f"num_samples must be at least {smallest}{pairs}, got {self.num_samples}")
        if self.antithetic and self.num_samples % 2:
            raise ValueError(f"num_samples must be even with antithetic pairs, got {self.num_samples}")
        if self.chunk_size is not None and self.chunk_size < self.rollouts_per_unit:
            raise ValueError(f"chunk_size must be at least {self.rollouts_per_unit}, got {self.chunk_size}")

    @property
    def rollouts_per_unit(self) -> int:
        """Give 2 for pairs, else 1."""
        return 2 if self.antithetic else 1

    @property
    def num_units(self) -> int:
        """Give the number of independent samples or pairs."""
        return self.num_samples // self.rollouts_per_unit

    @property
    def num_rollouts(self) -> int:
        """Give the number of rollouts, that without noise included."""
        return self.num_samples + self.with_zero_noise

    def chunks(self) -> tuple[int, int]:
        """Give the number of chunks and the units in each, as even as they can be."""
        units = self.num_units + self.with_zero_noise
        most = max(1, (self.chunk_size or DEFAULT_CHUNK_SIZE) // self.rollouts_per_unit)
        num_chunks = -(-units // most)
        return num_chunks, -(-units // num_chunks)


class Samples(eqx.Module):
    """Rollouts, by unit and by rollout within the unit.

    Attributes:
        costs: one per rollout.
        gradients: of the cost; of length zero if not asked for.
        scores: of the noise; likewise.
        is_noisy: False for units that fill up the last chunk and for the one without noise.
        is_noise_free: True for the one without noise.
    """

    costs: Float[Array, "units rollouts"]
    gradients: Float[Array, "units rollouts gradient_dim"]
    scores: Float[Array, "units rollouts score_dim"]
    is_noisy: Bool[Array, " units"]
    is_noise_free: Bool[Array, " units"]

    def first_order_mask(self) -> Bool[Array, " units"]:
        """Pick the units that a first-order estimate can use."""
        return self.is_noisy & _all_finite(self.costs) & _all_finite(self.gradients)

    def zeroth_order_mask(self) -> Bool[Array, " units"]:
        """Pick the units that a zeroth-order estimate can use: gradients do not matter to it."""
        return self.is_noisy & _all_finite(self.costs) & _all_finite(self.scores)

    def noise_free_cost(self) -> Float[Array, ""]:
        """Give the cost without noise if it is among these, else zero."""
        return jnp.where(self.is_noise_free, self.costs[:, 0], 0).sum()


def sample(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    units: Int[Array, " units"],
    plan: Plan,
) -> Samples:
    """Roll out some units of a plan.

    The noise of unit i comes from `fold_in(key, i)`, so it is the same in whatever chunk.

    Args:
        objective: evaluated under two `jax.vmap`.
        params: the point.
        key: the same for all units of an estimate.
        units: which ones. The index `plan.num_units` is the rollout without noise, which rides
            in the batch so that the rollout is compiled only once.
        plan: what is asked for.

    Returns:
        The rollouts.
    """
    is_noise_free = (units == plan.num_units) & plan.with_zero_noise

    def noise_of(unit: Int[Array, ""], is_free: Bool[Array, ""]) -> PyTree:
        noise = objective.sample_noise(jax.random.fold_in(key, unit))
        if plan.with_zero_noise:
            noise = jax.tree.map(lambda free, noisy: jnp.where(is_free, free, noisy), objective.zero_noise(), noise)
        images = [noise, objective.mirror(noise)] if plan.antithetic else [noise]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *images)

    noises = jax.vmap(noise_of)(units, is_noise_free)
    evaluate = jax.vmap(jax.vmap(lambda noise: _evaluate(objective, params, noise, plan)))
    costs, gradients, scores = evaluate(noises)
    return Samples(costs, gradients, scores, units < plan.num_units, is_noise_free)


def stream(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    plan: Plan,
    summarise: Callable[[Samples], tuple[Summary, ...]],
) -> tuple[Any, ...]:
    """Roll out a plan chunk by chunk, keeping only summaries.

    Args:
        objective: see `sample`.
        params: the point.
        key: consumed here.
        plan: what is asked for.
        summarise: what to keep of a chunk.

    Returns:
        The merged summaries.
    """
    num_chunks, size = plan.chunks()

    def one_chunk(start: Int[Array, ""]) -> tuple[Summary, ...]:
        return summarise(sample(objective, params, key, start + jnp.arange(size), plan))

    # The start of a chunk is in the carry: an array of all starts would grow with the number of samples.
    def step(carry: tuple[Int[Array, ""], tuple[Summary, ...]], _: None) -> tuple[tuple, None]:
        start, kept = carry
        merged = tuple(old.merge(new) for old, new in zip(kept, one_chunk(start), strict=True))
        return (start + size, merged), None

    start = jnp.zeros((), int)
    shapes = jax.eval_shape(one_chunk, start)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(step, (start, empty), None, length=num_chunks)[0][1]


def check_baseline(baseline: str) -> None:
    """Refuse a baseline that does not exist.

    Args:
        baseline: the name given.

    Raises:
        ValueError: if it is none of the choices; the message lists them.
    """
    choices = get_args(Baseline)
    if baseline not in choices:
        listed = ", ".join(repr(choice) for choice in choices)
        raise ValueError(f"baseline must be one of {listed}, got {baseline!r}")


def _evaluate(
    objective: Objective, params: Float[Array, " dim"], noise: PyTree, plan: Plan
) -> tuple[Float[Array, ""], Float[Array, " gradient_dim"], Float[Array, " score_dim"]]:
    """Roll out once for all that is wanted of it."""
    nothing = jnp.zeros(0, params.dtype)

    def cost_and_score(at: Float[Array, " dim"]) -> tuple[Float[Array, ""], Array]:
        if plan.with_score:
            return objective.value_and_score(at, noise)
        return objective.value(at, noise), nothing

    if not plan.with_gradient:
        cost, score = cost_and_score(params)
        return cost, nothing, score
    if params.size <= MOST_FORWARD_DIMENSIONS:
        try:
            return _forward(cost_and_score, params)
        except TypeError:  # a rule of jax.custom_vjp has no forward mode; any other mistake comes again below
            pass
    (cost, score), gradient = jax.value_and_grad(cost_and_score, has_aux=True)(params)
    return cost, gradient, score


def _forward(
    cost_and_score: Callable[[Array], tuple[Array, Array]], params: Float[Array, " dim"]
) -> tuple[Float[Array, ""], Float[Array, " dim"], Float[Array, " score_dim"]]:
    """Differentiate in forward mode, one tangent per parameter."""

    def along(tangent: Float[Array, " dim"]) -> tuple[Array, Array, Array]:
        return jax.jvp(cost_and_score, (params,), (tangent,), has_aux=True)

    tangents = jnp.eye(params.size, dtype=params.dtype)
    return jax.vmap(along, out_axes=(None, 0, None))(tangents)


def _all_finite(array: Float[Array, "units ..."]) -> Bool[Array, " units"]:
    return jnp.isfinite(array).all(axis=tuple(range(1, array.ndim)))
