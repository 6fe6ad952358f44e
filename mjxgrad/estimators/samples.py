"""Rollouts under noise, in chunks, with memory independent of their number.

`sample` gives costs with derivatives and scores by the parameters, `sample_by_noise` differentiates each rollout by its
noise, for estimators that compare derivatives with costs. The second is not the first in general: by few parameters a
long rollout is differentiated in forward mode, which by the noise of all its actions it cannot be.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators.moments import Summary
from mjxgrad.objective import Objective
from mjxgrad.objective.derivative import value_and_gradient

Baseline = Literal["leave_one_out", "zero_noise", "none"]

# Wide enough to fill a CPU's vector units and hide loop overhead, narrow enough that a chunk of
# checkpointed rollouts of a small scene stays within tens of megabytes.
DEFAULT_CHUNK_SIZE = 512

# All pairs of a group are compared: larger ones cost more for each sample, smaller ones leave out more of what is known.
GROUP_SIZE = 64


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
        with_silence: whether each unit has one more rollout, without noise, from its own random start.
        shares_start: whether samples come in pairs that differ in their noise alone, not in a random start.
    """

    num_samples: int
    chunk_size: int | None = None
    antithetic: bool = False
    with_gradient: bool = False
    with_score: bool = False
    with_zero_noise: bool = False
    shares_start: bool = False
    with_silence: bool = False

    def __post_init__(self):
        pairs = " with antithetic pairs" if self.antithetic else " where pairs share a random start"
        smallest, pairs = (4, pairs) if self.rollouts_per_unit == 2 else (2, "")
        if self.num_samples < smallest:
            raise ValueError(f"num_samples must be at least {smallest}{pairs}, got {self.num_samples}")
        if self.num_samples % self.rollouts_per_unit:
            raise ValueError(f"num_samples must be even{pairs}, got {self.num_samples}")
        if self.chunk_size is not None and self.chunk_size < self.rollouts_per_unit:
            raise ValueError(f"chunk_size must be at least {self.rollouts_per_unit}, got {self.chunk_size}")

    @property
    def rollouts_per_unit(self) -> int:
        """Give 2 for pairs, else 1."""
        return 2 if self.antithetic or self.shares_start else 1

    @property
    def num_units(self) -> int:
        """Give the number of independent samples or pairs."""
        return self.num_samples // self.rollouts_per_unit

    @property
    def num_rollouts(self) -> int:
        """Give the number of rollouts, those without noise included."""
        return self.num_samples + self.with_zero_noise + self.with_silence * self.num_units

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
        silent_costs: of the rollout without noise of each unit; zero if there is none.
    """

    costs: Float[Array, "units rollouts"]
    gradients: Float[Array, "units rollouts gradient_dim"]
    scores: Float[Array, "units rollouts score_dim"]
    is_noisy: Bool[Array, " units"]
    is_noise_free: Bool[Array, " units"]
    silent_costs: Float[Array, " units"]

    def first_order_mask(self) -> Bool[Array, " units"]:
        """Pick the units that a first-order estimate can use."""
        return self.is_noisy & _all_finite(self.costs) & _all_finite(self.gradients)

    def zeroth_order_mask(self) -> Bool[Array, " units"]:
        """Pick the units that a zeroth-order estimate can use: gradients do not matter to it."""
        return self.is_noisy & _all_finite(self.costs) & _all_finite(self.scores) & jnp.isfinite(self.silent_costs)

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
        # Among the others, so that the rollout is compiled once.
        images += [objective.silence(noise)] if plan.with_silence else []
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *images)

    noises = jax.vmap(noise_of)(units, is_noise_free)
    evaluate = jax.vmap(jax.vmap(lambda noise: _evaluate(objective, params, noise, plan)))
    costs, gradients, scores = evaluate(noises)
    silent_costs = jnp.zeros_like(costs[:, 0])
    if plan.with_silence:
        silent_costs = costs[:, -1]
        costs, gradients, scores = costs[:, :-1], gradients[:, :-1], scores[:, :-1]
    return Samples(costs, gradients, scores, units < plan.num_units, is_noise_free, silent_costs)


class Group(eqx.Module):
    """Samples that are compared with each other; where starts are random, samples 2i and 2i + 1 begin alike.

    What is not finite is zero here, and the masks say so.

    Attributes:
        costs: about some constant; no estimator here minds which.
        derivatives: of the cost by each component of the noise.
        noise: in its own units.
        stddev: of the noise.
        scores: noise over variance.
        has_cost: whether the sample is one of the plan and its cost is finite.
        has_derivative: whether its derivative is finite, too.
        rounding: size of the costs before the constant was taken off.
        per_unit: 2 where pairs share a start, else 1.
    """

    costs: Float[Array, "*groups samples"]
    derivatives: Float[Array, "*groups samples m"]
    noise: Float[Array, "*groups samples m"]
    stddev: Float[Array, "*groups m"]
    scores: Float[Array, "*groups samples m"]
    has_cost: Bool[Array, "*groups samples"]
    has_derivative: Bool[Array, "*groups samples"]
    rounding: Float[Array, "*groups"]
    per_unit: int = eqx.field(static=True)

    def same_start(self) -> Bool[Array, "samples samples"]:
        """Say which samples differ in nothing but their noise."""
        count = len(self.costs)
        if self.per_unit == 1:
            return jnp.ones((count, count), bool)
        unit = jnp.arange(count) // self.per_unit
        return unit[:, None] == unit[None, :]


class SamplesByNoise(eqx.Module):
    """Rollouts of a chunk.

    Attributes:
        group: all of them.
        mean_cost: what was taken off the costs.
        pull_backs: from components of the noise to parameters, one for each sample.
    """

    group: Group
    mean_cost: Float[Array, ""]
    pull_backs: Partial

    def pull_back(self, by_noise: Float[Array, "samples m"]) -> Float[Array, "samples dim"]:
        """Take each sample's components of the noise to the parameters; zero where there is no sample."""
        by_params = jax.vmap(lambda pull, vector: pull(vector))(self.pull_backs, by_noise)
        return jnp.where(self.group.has_cost[:, None], by_params, 0)

    def by_unit(self, values: Float[Array, "samples *shape"]) -> Float[Array, "units *shape"]:
        """Give the mean over each unit."""
        return values.reshape(-1, self.group.per_unit, *values.shape[1:]).mean(axis=1)

    def complete(self, mask: Bool[Array, " samples"]) -> Bool[Array, " units"]:
        """Say which units have all their samples in a mask."""
        return mask.reshape(-1, self.group.per_unit).all(axis=1)

    def groups(self) -> Group:
        """Split the chunk into groups, as even as they can be, with an axis of groups; samples that fill up have no cost."""
        count, unit = len(self.group.costs), self.group.per_unit
        num_groups = -(-count // GROUP_SIZE)
        size = unit * -(-count // (num_groups * unit))

        def split(leaf: Array) -> Array:
            filled = jnp.pad(leaf, [(0, num_groups * size - count)] + [(0, 0)] * (leaf.ndim - 1))
            return filled.reshape(num_groups, size, *leaf.shape[1:])

        group = self.group
        return Group(
            costs=split(group.costs),
            derivatives=split(group.derivatives),
            noise=split(group.noise),
            stddev=jnp.broadcast_to(group.stddev, (num_groups, *group.stddev.shape)),
            scores=split(group.scores),
            has_cost=split(group.has_cost),
            has_derivative=split(group.has_derivative),
            rounding=jnp.broadcast_to(group.rounding, num_groups),
            per_unit=unit,
        )


def plan_by_noise(objective: Objective, num_samples: int, chunk_size: int | None) -> Plan:
    """Plan rollouts for `sample_by_noise`.

    Args:
        objective: whether its start is random decides whether samples come in pairs.
        num_samples: rollouts to spend.
        chunk_size: rollouts at a time.

    Returns:
        The plan.

    Raises:
        ValueError: if `num_samples` is below 2, or odd or below 4 where starts are random; if `chunk_size` is below 4;
            or if the objective does not say what its noise is.
    """
    if chunk_size is not None and chunk_size < 4:
        raise ValueError(f"chunk_size must be at least 4, got {chunk_size}: samples of a chunk are compared")
    if type(objective).differentiate is Objective.differentiate:
        raise ValueError(
            f"objective must know its noise, got {type(objective).__name__}; override differentiate in it, "
            "or use first_order or zeroth_order"
        )
    return Plan(num_samples, chunk_size, with_gradient=True, shares_start=objective.has_circumstances)


def sample_by_noise(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    units: Int[Array, " units"],
    plan: Plan,
) -> SamplesByNoise:
    """Roll out some units of a plan, each rollout differentiated once, by its noise.

    Args:
        objective: see `plan_by_noise`.
        params: the point.
        key: the same for all units of an estimate; the noise of unit i comes from `fold_in(key, i)`.
        units: which ones; those from `plan.num_units` on only fill up.
        plan: from `plan_by_noise`.

    Returns:
        The rollouts.
    """

    def noise_of(unit: Int[Array, ""]) -> list:
        noise = objective.sample_noise(jax.random.fold_in(key, unit))
        if plan.rollouts_per_unit == 1:
            return [noise]
        return [noise, objective.redraw(noise, jax.random.fold_in(key, plan.num_units + unit))]

    def in_order(*members: Array) -> Array:
        # Not -1: the state of a scene without activations has an axis of length zero.
        return jnp.stack(members, axis=1).reshape(len(members) * len(members[0]), *members[0].shape[1:])

    noises = jax.tree.map(in_order, *jax.vmap(noise_of)(units))
    result = jax.vmap(lambda noise: objective.differentiate(params, noise))(noises)
    is_asked_for = jnp.repeat(units < plan.num_units, plan.rollouts_per_unit)
    has_cost = is_asked_for & jnp.isfinite(result.cost)
    has_derivative = has_cost & jnp.isfinite(result.gradient_by_noise).all(axis=1)
    stddev = result.noise_stddev[0]
    costs = jnp.where(has_cost, result.cost, 0)
    # About one of the costs first: a mean of large costs is not exact enough to take off.
    origin = costs[jnp.argmax(has_cost)]
    offset = jnp.where(has_cost, costs - origin, 0).sum() / jnp.maximum(has_cost.sum(), 1).astype(costs.dtype)
    group = Group(
        costs=jnp.where(has_cost, (costs - origin) - offset, 0),
        derivatives=jnp.where(has_derivative[:, None], result.gradient_by_noise, 0),
        noise=result.noise_score * stddev**2,
        stddev=stddev,
        scores=result.noise_score,
        has_cost=has_cost,
        has_derivative=has_derivative,
        rounding=jnp.abs(costs).max(),
        per_unit=plan.rollouts_per_unit,
    )
    return SamplesByNoise(group, origin + offset, result.pull_back)


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
    return accumulate(plan, lambda units: summarise(sample(objective, params, key, units, plan)))


def accumulate(plan: Plan, one_chunk: Callable[[Int[Array, " units"]], tuple[Summary, ...]]) -> tuple[Any, ...]:
    """Go through the units of a plan chunk by chunk, merging what is kept of each.

    Args:
        plan: what is asked for.
        one_chunk: from the numbers of some units to what is kept of them; those beyond `plan.num_units` fill up.

    Returns:
        The merged summaries.
    """
    num_chunks, size = plan.chunks()
    total = plan.num_units + plan.with_zero_noise
    fewest, num_larger = divmod(total, num_chunks)

    # The start of a chunk is in the carry: an array of all starts would grow with the number of samples.
    def step(carry: tuple[Int[Array, ""], Int[Array, ""], tuple[Summary, ...]], _: None) -> tuple[tuple, None]:
        chunk, start, kept = carry
        end = start + fewest + (chunk < num_larger)
        units = start + jnp.arange(size)
        # What fills up the chunk is no unit of the plan, and not the rollout without noise either.
        new_ones = one_chunk(jnp.where(units < end, units, total))
        merged = tuple(old.merge(new) for old, new in zip(kept, new_ones, strict=True))
        return (chunk + 1, end, merged), None

    start = jnp.zeros((), int)
    shapes = jax.eval_shape(one_chunk, start + jnp.arange(size))
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(step, (start, start, empty), None, length=num_chunks)[0][2]


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
    cost, score, gradient = value_and_gradient(cost_and_score, params)
    return cost, gradient, score


def _all_finite(array: Float[Array, "units ..."]) -> Bool[Array, " units"]:
    return jnp.isfinite(array).all(axis=tuple(range(1, array.ndim)))
