"""Rollouts differentiated by their noise, for estimators that compare derivatives with costs."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mjxgrad.estimators.sampling import Plan
from mjxgrad.objective import Objective

# All pairs of a group are compared: larger ones cost more for each sample, smaller ones leave out more of what is known.
GROUP_SIZE = 64


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
