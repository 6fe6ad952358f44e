"""Rollouts under noise, in chunks, with memory independent of their number.

A rollout is differentiated by the parameters or, for estimators that compare derivatives with costs, by its noise. The
second is not the first in general: by few parameters a long rollout is differentiated in forward mode, which by the noise
of all its actions it cannot be.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad._arrays import one_key, whole
from mjxgrad.estimators.moments import Summary
from mjxgrad.objective import Differentiated, Objective
from mjxgrad.objective.base import unchanged, value_and_gradient

# Wide enough to fill a CPU's vector units and hide loop overhead, narrow enough that a chunk of
# checkpointed rollouts of a small scene stays within tens of megabytes.
DEFAULT_CHUNK_SIZE = 512

# All pairs of a group are compared: larger ones cost more for each sample, smaller ones leave out more of what is known.
GROUP_SIZE = 64


@dataclasses.dataclass(frozen=True)
class Plan:
    """Which rollouts an estimator asks for.

    A unit is what is independent of the others: one sample, or a pair of them.

    Attributes:
        num_samples: rollouts with noise.
        chunk_size: rollouts at a time, or None for the default.
        antithetic: whether every noise is used with its mirror image.
        with_gradient: whether the cost is differentiated by the parameters.
        with_score: whether the score by the parameters is wanted.
        by_noise: whether derivative and score are by the noise instead.
        with_zero_noise: whether one more rollout goes without noise.
        shares_start: whether samples come in pairs that differ in their noise alone, not in a random start.
        with_silence: whether each unit has one more rollout, without noise, from its own random start.
    """

    num_samples: int
    chunk_size: int | None = None
    antithetic: bool = False
    with_gradient: bool = False
    with_score: bool = False
    by_noise: bool = False
    with_zero_noise: bool = False
    shares_start: bool = False
    with_silence: bool = False

    def __post_init__(self):
        pairs = " with antithetic pairs" if self.antithetic else " where pairs share a random start"
        smallest, pairs = (4, pairs) if self.rollouts_per_unit == 2 else (2, "")
        whole("num_samples", self.num_samples, least=None)
        if self.num_samples < smallest:
            raise ValueError(f"num_samples must be at least {smallest}{pairs}, got {self.num_samples}")
        if self.num_samples % self.rollouts_per_unit:
            raise ValueError(f"num_samples must be even{pairs}, got {self.num_samples}")
        if self.chunk_size is not None:
            whole("chunk_size", self.chunk_size, self.rollouts_per_unit)

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


def plan_for_baseline(
    objective: Objective, num_samples: int, chunk_size: int | None, antithetic: bool, baseline: str, **wanted: bool
) -> Plan:
    """Plan rollouts with the ones without noise that a baseline needs."""
    check_baseline(baseline)
    is_needed, has_own = baseline == "zero_noise", objective.has_circumstances
    return Plan(
        num_samples,
        chunk_size,
        antithetic,
        with_score=True,
        with_zero_noise=is_needed and not has_own,
        with_silence=is_needed and has_own,
        **wanted,
    )


def check_baseline(baseline: str, choices: tuple[str, ...] = ("leave_one_out", "zero_noise", "none")) -> None:
    """Refuse a baseline that does not exist."""
    if baseline not in choices:
        raise ValueError(f"baseline must be one of {', '.join(map(repr, choices))}, got {baseline!r}")


def plan_by_noise(objective: Objective, num_samples: int, chunk_size: int | None) -> Plan:
    """Plan rollouts that are differentiated by their noise, in pairs that share a start where starts are random."""
    if chunk_size is not None and chunk_size < 4:
        raise ValueError(f"chunk_size must be at least 4, got {chunk_size}: samples of a chunk are compared")
    if type(objective).differentiate is Objective.differentiate:
        raise ValueError(
            f"objective must know its noise, got {type(objective).__name__}; override differentiate in it, "
            "or use first_order or zeroth_order"
        )
    return Plan(num_samples, chunk_size, with_gradient=True, by_noise=True, shares_start=objective.has_circumstances)


class Samples(eqx.Module):
    """Rollouts, by unit and by rollout within the unit.

    Attributes:
        costs: one per rollout.
        gradients: of the cost, by the parameters or by the noise; zero if not asked for.
        scores: of the noise, likewise.
        stddevs: of the noise; NaN where derivatives are by the parameters.
        pull_backs: from components of the noise to parameters.
        is_noisy: False for units that fill up the last chunk and for the one without noise.
        is_noise_free: True for the one without noise.
        silent_costs: of the rollout without noise of each unit; zero if there is none.
        is_quiet: whether the noise of the unit, not being zero, made no difference within it and to no derivative.
    """

    costs: Float[Array, "units rollouts"]
    gradients: Float[Array, "units rollouts m"]
    scores: Float[Array, "units rollouts m"]
    stddevs: Float[Array, "units rollouts m"]
    pull_backs: Partial
    is_noisy: Bool[Array, " units"]
    is_noise_free: Bool[Array, " units"]
    silent_costs: Float[Array, " units"]
    is_quiet: Bool[Array, " units"]

    def first_order_mask(self) -> Bool[Array, " units"]:
        """Pick the units that a first-order estimate can use."""
        return self.is_noisy & _all_finite(self.costs) & _all_finite(self.gradients)

    def zeroth_order_mask(self) -> Bool[Array, " units"]:
        """Pick the units that a zeroth-order estimate can use: gradients do not matter to it."""
        return self.is_noisy & _all_finite(self.costs) & _all_finite(self.scores) & jnp.isfinite(self.silent_costs)

    def noise_free_cost(self) -> Float[Array, ""]:
        """Give the cost without noise if it is among these, else zero."""
        return jnp.where(self.is_noise_free, self.costs[:, 0], 0).sum()

    def num_felt(self) -> Int[Array, ""]:
        """Count the units of the plan that are not quiet."""
        return (self.is_noisy & ~self.is_quiet).sum()


def sample(
    objective: Objective, params: Float[Array, " dim"], key: PRNGKeyArray, plan: Plan, units: Int[Array, " units"]
) -> Samples:
    """Roll out some units of a plan under one `jax.vmap`.

    The noise of unit i comes from `fold_in(key, i)`, so it is the same in whatever chunk. The index `plan.num_units` is
    the rollout without noise, which rides in the batch so that the rollout is compiled only once.
    """
    one_key(key)
    is_noise_free = (units == plan.num_units) & plan.with_zero_noise

    def noise_of(unit: Int[Array, ""], is_free: Bool[Array, ""]) -> tuple[list[PyTree], Bool[Array, ""]]:
        noise = objective.sample_noise(jax.random.fold_in(key, unit))
        if plan.with_zero_noise:
            noise = jax.tree.map(lambda free, noisy: jnp.where(is_free, free, noisy), objective.zero_noise(), noise)
        silence = objective.silence(noise)
        images = [noise, objective.mirror(noise)] if plan.antithetic else [noise]
        if plan.shares_start:
            images.append(objective.redraw(noise, jax.random.fold_in(key, plan.num_units + unit)))
        # Among the others, so that the rollout is compiled once.
        return [*images, silence] if plan.with_silence else images, _differ(noise, silence)

    def in_order(*members: Array) -> Array:
        # Not -1: the state of a scene without activations has an axis of length zero.
        return jnp.stack(members, axis=1).reshape(len(members) * len(members[0]), *members[0].shape[1:])

    images, is_moved = jax.vmap(noise_of)(units, is_noise_free)
    evaluate = objective.differentiate if plan.by_noise else functools.partial(_by_parameters, objective, plan)
    flat = jax.vmap(functools.partial(evaluate, params))(jax.tree.map(in_order, *images))
    found = jax.tree.map(lambda leaf: leaf.reshape(len(units), len(images), *leaf.shape[1:]), flat)
    is_same = (found.cost == found.cost[:, :1]).all(axis=1) & _all_finite(found.cost)
    is_flat = (found.gradient_by_noise == 0).all(axis=(1, 2))
    silent_costs = jnp.zeros_like(found.cost[:, 0])
    if plan.with_silence:
        silent_costs = found.cost[:, -1]
        found = jax.tree.map(lambda leaf: leaf[:, :-1], found)
    return Samples(
        found.cost,
        found.gradient_by_noise,
        found.noise_score,
        found.noise_stddev,
        found.pull_back,
        units < plan.num_units,
        is_noise_free,
        silent_costs,
        is_moved & is_same & is_flat,
    )


def stream(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    plan: Plan,
    summarise: Callable[[Samples], tuple[Summary, ...]],
) -> tuple[Any, ...]:
    """Roll out a plan chunk by chunk, and merge what is kept of each."""
    num_chunks, size = plan.chunks()
    total = plan.num_units + plan.with_zero_noise
    fewest, num_larger = divmod(total, num_chunks)
    sampled = functools.partial(sample, objective, params, key, plan)

    # The start of a chunk is in the carry: an array of all starts would grow with the number of samples.
    def step(carry: tuple[Int[Array, ""], Int[Array, ""], tuple[Summary, ...]], _: None) -> tuple[tuple, None]:
        chunk, start, kept = carry
        end = start + fewest + (chunk < num_larger)
        units = start + jnp.arange(size)
        # What fills up the chunk is no unit of the plan, and not the rollout without noise either.
        new_ones = summarise(sampled(jnp.where(units < end, units, total)))
        return (chunk + 1, end, tuple(old.merge(new) for old, new in zip(kept, new_ones, strict=True))), None

    start = jnp.zeros((), int)
    shapes = jax.eval_shape(summarise, jax.eval_shape(sampled, start + jnp.arange(size)))
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(step, (start, start, empty), None, length=num_chunks)[0][2]


class Group(eqx.Module):
    """Samples by noise that are compared with each other; where starts are random, samples 2i and 2i + 1 begin alike.

    What is not finite, or none of the plan, is zero here, and the masks say so. Costs are about `centre`, their mean;
    `rounding` is the size that they had. `per_unit` is 2 where pairs share a start, else 1.
    """

    costs: Float[Array, "*groups samples"]
    derivatives: Float[Array, "*groups samples m"]
    noise: Float[Array, "*groups samples m"]
    scores: Float[Array, "*groups samples m"]
    has_cost: Bool[Array, "*groups samples"]
    has_derivative: Bool[Array, "*groups samples"]
    stddev: Float[Array, "*groups m"]
    centre: Float[Array, "*groups"]
    rounding: Float[Array, "*groups"]
    per_unit: int = eqx.field(static=True)

    @classmethod
    def of(cls, samples: Samples) -> "Group":
        per_unit = samples.costs.shape[1]
        raw, gradients, scores = (
            leaf.reshape(-1, *leaf.shape[2:]) for leaf in (samples.costs, samples.gradients, samples.scores)
        )
        has_cost = jnp.repeat(samples.is_noisy, per_unit) & jnp.isfinite(raw)
        has_derivative = has_cost & jnp.isfinite(gradients).all(axis=1)
        stddev = samples.stddevs[0, 0]
        costs = jnp.where(has_cost, raw, 0)
        # About one of the costs first: a mean of large costs is not exact enough to take off.
        origin = costs[jnp.argmax(has_cost)]
        offset = jnp.where(has_cost, costs - origin, 0).sum() / jnp.maximum(has_cost.sum(), 1).astype(costs.dtype)
        return cls(
            costs=jnp.where(has_cost, (costs - origin) - offset, 0),
            derivatives=jnp.where(has_derivative[:, None], gradients, 0),
            noise=scores * stddev**2,
            scores=scores,
            has_cost=has_cost,
            has_derivative=has_derivative,
            stddev=stddev,
            centre=origin + offset,
            rounding=jnp.abs(costs).max(),
            per_unit=per_unit,
        )

    def same_start(self) -> Bool[Array, "samples samples"]:
        """Say which samples differ in nothing but their noise."""
        count = len(self.costs)
        if self.per_unit == 1:
            return jnp.ones((count, count), bool)
        unit = jnp.arange(count) // self.per_unit
        return unit[:, None] == unit[None, :]

    def by_unit(self, values: Float[Array, "samples *shape"]) -> Float[Array, "units *shape"]:
        """Give the mean over each unit."""
        return values.reshape(-1, self.per_unit, *values.shape[1:]).mean(axis=1)

    def complete(self, mask: Bool[Array, " samples"]) -> Bool[Array, " units"]:
        """Say which units have all their samples in a mask."""
        return mask.reshape(-1, self.per_unit).all(axis=1)

    def pull_back(self, samples: Samples, by_noise: Float[Array, "samples m"]) -> Float[Array, "samples dim"]:
        """Take each sample's components of the noise to the parameters; zero where there is no sample."""
        pull_backs = jax.tree.map(lambda leaf: leaf.reshape(len(by_noise), *leaf.shape[2:]), samples.pull_backs)
        by_params = jax.vmap(lambda pull, vector: pull(vector))(pull_backs, by_noise)
        return jnp.where(self.has_cost[:, None], by_params, 0)

    def split(self) -> "Group":
        """Split a chunk into groups, as even as they can be, with an axis of groups; samples that fill up have no cost."""
        count, unit = len(self.costs), self.per_unit
        num_groups = -(-count // GROUP_SIZE)
        size = unit * -(-count // (num_groups * unit))

        def split(leaf: Array) -> Array:
            filled = jnp.pad(leaf, [(0, num_groups * size - count)] + [(0, 0)] * (leaf.ndim - 1))
            return filled.reshape(num_groups, size, *leaf.shape[1:])

        own = ("costs", "derivatives", "noise", "scores", "has_cost", "has_derivative")
        shared = ("stddev", "centre", "rounding")
        parts = {name: split(getattr(self, name)) for name in own}
        parts |= {n: jnp.broadcast_to(getattr(self, n), (num_groups, *getattr(self, n).shape)) for n in shared}
        return Group(**parts, per_unit=unit)


def _by_parameters(objective: Objective, plan: Plan, params: Float[Array, " dim"], noise: PyTree) -> Differentiated:
    """Roll out once for all that is wanted of it; what is not is zero."""
    nothing = jnp.zeros_like(params)

    def cost_and_score(at: Float[Array, " dim"]) -> tuple[Float[Array, ""], Array]:
        return objective.value_and_score(at, noise) if plan.with_score else (objective.value(at, noise), nothing)

    if plan.with_gradient:
        (cost, score), gradient = value_and_gradient(cost_and_score, params, has_aux=True)
    else:
        (cost, score), gradient = cost_and_score(params), nothing
    return Differentiated(cost, gradient, score, jnp.full_like(params, jnp.nan), Partial(unchanged))


def _differ(one: PyTree, other: PyTree) -> Bool[Array, ""]:
    """Say whether two draws of noise differ in any real number."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    differences = [(x != y).any() for x, y in pairs if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.zeros((), bool), *differences]).any()


def _all_finite(array: Float[Array, "units ..."]) -> Bool[Array, " units"]:
    return jnp.isfinite(array).all(axis=tuple(range(1, array.ndim)))
