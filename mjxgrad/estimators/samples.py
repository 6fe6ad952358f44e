"""Rollouts under noise, in chunks, with memory independent of their number.

A rollout is differentiated by its noise for estimators that compare derivatives with costs, else by the parameters: few of
them allow forward mode.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad._arrays import one_key, whole
from mjxgrad.estimators.moments import Moments, merged
from mjxgrad.objective import Differentiated, Objective
from mjxgrad.objective.base import Scalar, Vector, unchanged, value_and_gradient

# Wide enough to fill a CPU's vector units and to hide loop overhead; narrow enough that a chunk of checkpointed rollouts
# of a small scene takes no more than tens of megabytes.
DEFAULT_CHUNK_SIZE = 512

# All pairs of a group are compared: larger groups cost more per sample, smaller groups use less of the evidence.
GROUP_SIZE = 64


@dataclasses.dataclass(frozen=True)
class Plan:
    """The rollouts that an estimator asks for; a unit is one sample or one pair, independent of all other units."""

    num_samples: int  # rollouts with noise
    chunk_size: int | None = None  # rollouts at a time; None is the default
    antithetic: bool = False  # every noise is used with its mirror image
    with_gradient: bool = False  # the cost is differentiated by the parameters
    with_score: bool = False  # the score by the parameters is wanted
    by_noise: bool = False  # derivative and score are by the noise instead
    with_zero_noise: bool = False  # there is one more rollout without noise
    shares_start: bool = False  # samples come in pairs that share a random start and differ only in their noise
    zero_noise_per_unit: bool = False  # each unit has one more rollout, without noise, from its own random start

    def __post_init__(self):
        pairs = " with antithetic pairs" if self.antithetic else " where pairs share a random start"
        smallest, pairs = (4, pairs) if self.rollouts_per_unit == 2 else (2, "")
        if whole("num_samples", self.num_samples, None) < smallest:
            raise ValueError(f"num_samples must be at least {smallest}{pairs}, got {self.num_samples}")
        if self.num_samples % self.rollouts_per_unit:
            raise ValueError(f"num_samples must be even{pairs}, got {self.num_samples}")
        if self.chunk_size is not None:
            whole("chunk_size", self.chunk_size, self.rollouts_per_unit)

    @property
    def rollouts_per_unit(self) -> int:
        """2 for pairs, else 1."""
        return 2 if self.antithetic or self.shares_start else 1

    @property
    def num_units(self) -> int:
        """Number of independent samples or pairs."""
        return self.num_samples // self.rollouts_per_unit

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts, including those without noise."""
        return self.num_samples + self.with_zero_noise + self.zero_noise_per_unit * self.num_units

    def chunks(self) -> tuple[int, int]:
        """Return the number of chunks and the largest number of units in one, as even as possible."""
        units = self.num_units + self.with_zero_noise
        most = max(1, (self.chunk_size or DEFAULT_CHUNK_SIZE) // self.rollouts_per_unit)
        num_chunks = -(-units // most)
        return num_chunks, -(-units // num_chunks)


def plan_by_noise(objective: Objective, num_samples: int, chunk_size: int | None) -> Plan:
    """Return a plan of rollouts differentiated by their noise; with random starts, in pairs that share a start."""
    if chunk_size is not None and chunk_size < 4:
        raise ValueError(f"chunk_size must be at least 4, got {chunk_size}: samples of a chunk are compared")
    if type(objective).differentiate is Objective.differentiate:
        raise ValueError(
            f"objective must know its noise, got {type(objective).__name__}; override differentiate in it, "
            "or use first_order or zeroth_order"
        )
    return Plan(num_samples, chunk_size, with_gradient=True, by_noise=True, shares_start=objective.has_circumstances)


class Samples(eqx.Module):
    """Rollouts, by unit and by rollout within the unit."""

    rollouts: Differentiated  # derivatives by the noise or by the parameters; zero where not asked for
    is_noisy: Bool[Array, " units"]  # False for units that pad the last chunk and for the unit without noise
    is_noise_free: Bool[Array, " units"]  # True for the unit without noise
    zero_noise_costs: Float[Array, " units"]  # cost of each unit's own rollout without noise; zero if there is none
    has_no_effect: Bool[Array, " units"]  # noise that is not zero changed no cost within the unit; derivatives are zero

    def zeroth_order_mask(self) -> Bool[Array, " units"]:
        """Return which units a zeroth-order estimate can use, whatever their gradients."""
        is_finite = all_finite(self.rollouts.cost) & all_finite(self.rollouts.noise_score)
        return self.is_noisy & is_finite & jnp.isfinite(self.zero_noise_costs)

    def noise_free_cost(self) -> Scalar:
        """Return the cost without noise if it is in this chunk, else zero."""
        return jnp.where(self.is_noise_free, self.rollouts.cost[:, 0], 0).sum()

    def num_felt(self) -> Int[Array, ""]:
        """Return the number of units whose noise made a difference, or cannot tell."""
        return (self.is_noisy & ~self.has_no_effect).sum()


def sample(objective: Objective, params: Vector, key: PRNGKeyArray, plan: Plan, units: Int[Array, " units"]) -> Samples:
    """Roll out some units of a plan under one `jax.vmap`, the unit `plan.num_units` without noise.

    The noise of unit i comes from `fold_in(key, i)`, so it does not depend on the chunk.
    """
    one_key(key)
    is_noise_free = (units == plan.num_units) & plan.with_zero_noise

    def noise_of(unit: Int[Array, ""], is_free: Bool[Array, ""]) -> tuple[list[PyTree], Bool[Array, ""]]:
        noise = objective.sample_noise(jax.random.fold_in(key, unit))
        if plan.with_zero_noise:
            noise = jax.tree.map(lambda free, noisy: jnp.where(is_free, free, noisy), objective.zero_noise(), noise)
        zero_noise = objective.silence(noise)
        images = [noise, objective.mirror(noise)] if plan.antithetic else [noise]
        if plan.shares_start:
            images.append(objective.redraw(noise, jax.random.fold_in(key, plan.num_units + unit)))
        drawn, zeros = (ravel_pytree(eqx.filter(x, eqx.is_inexact_array))[0] for x in (noise, zero_noise))
        # In the same batch, so that the rollout is compiled once.
        return [*images, zero_noise] if plan.zero_noise_per_unit else images, (drawn != zeros).any()

    def in_order(*members: Array) -> Array:
        # Not -1: the state of a scene without activations has an axis of length zero.
        return jnp.stack(members, axis=1).reshape(len(members) * len(members[0]), *members[0].shape[1:])

    images, is_moved = jax.vmap(noise_of)(units, is_noise_free)
    evaluate = objective.differentiate if plan.by_noise else functools.partial(_by_parameters, objective, plan)
    flat = jax.vmap(functools.partial(evaluate, params))(jax.tree.map(in_order, *images))
    found = jax.tree.map(lambda leaf: leaf.reshape(len(units), len(images), *leaf.shape[1:]), flat)
    is_same = (found.cost == found.cost[:, :1]).all(axis=1) & all_finite(found.cost)
    is_flat = (found.gradient_by_noise == 0).all(axis=(1, 2))
    zero_noise_costs = jnp.zeros_like(found.cost[:, 0])
    if plan.zero_noise_per_unit:
        zero_noise_costs = found.cost[:, -1]
        found = jax.tree.map(lambda leaf: leaf[:, :-1], found)
    has_no_effect = is_moved & is_same & is_flat
    return Samples(found, units < plan.num_units, is_noise_free, zero_noise_costs, has_no_effect)


def stream(
    objective: Objective, params: Vector, key: PRNGKeyArray, plan: Plan, summarise: Callable[[Samples], Any]
) -> Any:
    """Roll out a plan chunk by chunk, and return the merged summary; see `moments`."""
    num_chunks, size = plan.chunks()
    total = plan.num_units + plan.with_zero_noise
    fewest, num_larger = divmod(total, num_chunks)
    sampled = functools.partial(sample, objective, params, key, plan)

    # The start of a chunk is in the carry: an array of all starts would grow with the number of samples.
    def step(carry: tuple[Int[Array, ""], Int[Array, ""], Any], _: None) -> tuple[tuple, None]:
        chunk, start, kept = carry
        end = start + fewest + (chunk < num_larger)
        units = start + jnp.arange(size)
        # The padding of a chunk is no unit of the plan, nor the rollout without noise.
        new = summarise(sampled(jnp.where(units < end, units, total)))
        return (chunk + 1, end, merged(kept, new)), None

    start = jnp.zeros((), int)
    shapes = jax.eval_shape(summarise, jax.eval_shape(sampled, start + jnp.arange(size)))
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(step, (start, start, empty), None, length=num_chunks)[0][2]


class Group(eqx.Module):
    """Samples differentiated by noise that are compared with each other.

    Values that are not finite, or pad a chunk, are zero and masked by `has_cost` (and `has_derivative`).
    """

    costs: Float[Array, "*groups samples"]  # costs minus their mean, the `centre`
    derivatives: Float[Array, "*groups samples m"]
    scores: Float[Array, "*groups samples m"]
    has_cost: Bool[Array, "*groups samples"]
    has_derivative: Bool[Array, "*groups samples"]
    stddev: Float[Array, "*groups m"]
    centre: Float[Array, "*groups"]
    rounding: Float[Array, "*groups"]  # largest magnitude of a cost, the scale of its rounding
    per_unit: int = eqx.field(static=True)  # 2 where samples 2i and 2i + 1 share a start, else 1

    @classmethod
    def of(cls, samples: Samples) -> "Group":
        per_unit = samples.rollouts.cost.shape[1]
        # The number of rows is given: a parameter without entries leaves nothing from which to find it.
        flat = jax.tree.map(lambda leaf: leaf.reshape(samples.rollouts.cost.size, *leaf.shape[2:]), samples.rollouts)
        raw, gradients = flat.cost, flat.gradient_by_noise
        has_cost = jnp.repeat(samples.is_noisy, per_unit) & jnp.isfinite(raw)
        has_derivative = has_cost & jnp.isfinite(gradients).all(axis=1)
        # Taken about one of the costs first: a mean of large costs is too inexact to subtract.
        found = Moments.of(raw, has_cost)
        return cls(
            costs=jnp.where(has_cost, (raw - found.origin) - found.offset, 0),
            derivatives=jnp.where(has_derivative[:, None], gradients, 0),
            scores=flat.noise_score,
            has_cost=has_cost,
            has_derivative=has_derivative,
            stddev=flat.noise_stddev[0],
            centre=found.mean,
            rounding=jnp.abs(jnp.where(has_cost, raw, 0)).max(),
            per_unit=per_unit,
        )

    @property
    def noise(self) -> Float[Array, "samples m"]:
        return self.scores * self.stddev**2

    def by_unit(self, values: Float[Array, "samples *shape"]) -> Float[Array, "units *shape"]:
        """Return the mean over each unit."""
        return values.reshape(-1, self.per_unit, *values.shape[1:]).mean(axis=1)

    def complete(self, mask: Bool[Array, " samples"]) -> Bool[Array, " units"]:
        """Return which units have all their samples in a mask."""
        return mask.reshape(-1, self.per_unit).all(axis=1)

    def pull_back(self, samples: Samples, by_noise: Float[Array, "samples m"]) -> Float[Array, "samples dim"]:
        """Return each sample's components of the noise, pulled back to the parameters; zero where there is no sample."""
        pull_backs = jax.tree.map(lambda leaf: leaf.reshape(len(by_noise), *leaf.shape[2:]), samples.rollouts.pull_back)
        by_params = jax.vmap(lambda pull, vector: pull(vector))(pull_backs, by_noise)
        return jnp.where(self.has_cost[:, None], by_params, 0)

    def split(self) -> "Group":
        """Return a chunk split into groups as even as possible, on a first axis; padding has no cost."""
        count, unit = len(self.costs), self.per_unit
        num_groups = -(-count // GROUP_SIZE)
        size = unit * -(-count // (num_groups * unit))

        own = ("costs", "derivatives", "scores", "has_cost", "has_derivative")
        each = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_groups, *leaf.shape)), self)
        return dataclasses.replace(each, **{name: in_groups(getattr(self, name), num_groups, size) for name in own})


def in_groups(rows: Array, num_groups: int, size: int) -> Array:
    """Return rows in groups of a size, on a first axis, padded by zeros."""
    filled = jnp.pad(rows, [(0, num_groups * size - len(rows))] + [(0, 0)] * (rows.ndim - 1))
    return filled.reshape(num_groups, size, *rows.shape[1:])


def _by_parameters(objective: Objective, plan: Plan, params: Vector, noise: PyTree) -> Differentiated:
    """Roll out once for the score and the derivative by the parameters; what the plan does not ask for is zero."""
    nothing = jnp.zeros_like(params)

    def cost_and_score(at: Vector) -> tuple[Scalar, Array]:
        return objective.value_and_score(at, noise) if plan.with_score else (objective.value(at, noise), nothing)

    if plan.with_gradient:
        (cost, score), gradient = value_and_gradient(cost_and_score, params, has_aux=True)
    else:
        (cost, score), gradient = cost_and_score(params), nothing
    return Differentiated(cost, gradient, score, jnp.full_like(params, jnp.nan), Partial(unchanged))


def all_finite(array: Float[Array, "units ..."]) -> Bool[Array, " units"]:
    """Return which units have only finite numbers."""
    return jnp.isfinite(array).all(axis=tuple(range(1, array.ndim)))
