"""What the loop runs: something that takes a step, and the record of one."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators import GradientEstimate, Reason


class Record(eqx.Module):
    """What one step of one run did; NaN where a method has no such thing.

    Attributes:
        cost: mean cost under noise at the parameters before the step.
        cost_error: its standard error.
        gradient_norm: norm of the estimate.
        gradient_error: norm of its standard error.
        alpha: weight of the first-order part, the mean over blocks.
        reason: why, for the block with the least weight.
        bias_bound: on the norm of the bias of the estimate.
        scale: of the smoothing; 1 without any.
        step_norm: norm of the change of the parameters.
        finite_fraction: share of the samples that were finite.
        num_rollouts: spent.
        num_gradient_rollouts: of those, the ones differentiated.
        is_taken: False if the estimate was not finite, so that nothing was changed.
    """

    cost: Float[Array, ""]
    cost_error: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    gradient_error: Float[Array, ""]
    alpha: Float[Array, ""]
    reason: Reason
    bias_bound: Float[Array, ""]
    scale: Float[Array, ""]
    step_norm: Float[Array, ""]
    finite_fraction: Float[Array, ""]
    num_rollouts: Int[Array, ""]
    num_gradient_rollouts: Int[Array, ""]
    is_taken: Bool[Array, ""]

    @classmethod
    def blank(cls, dtype: jnp.dtype) -> "Record":
        """Give the record of a step that did not happen."""
        nan, none = jnp.full((), jnp.nan, dtype), jnp.zeros((), jnp.int32)
        # A reason that is an array, as those of steps are.
        reason = jax.tree.map(jnp.asarray, Reason.fixed)
        return cls(nan, nan, nan, nan, nan, reason, nan, nan, nan, nan, none, none, jnp.zeros((), bool))

    @classmethod
    def of_estimate(
        cls, estimate: GradientEstimate, *, scale: ArrayLike, step_norm: ArrayLike, is_taken: ArrayLike
    ) -> "Record":
        """Summarise a step along an estimated gradient."""
        dtype = estimate.value.dtype
        alpha = jnp.ravel(estimate.alpha)
        reason = jax.tree.map(
            lambda item: jnp.ravel(jnp.broadcast_to(item, estimate.alpha.shape))[jnp.argmin(alpha)], estimate.reason
        )
        return cls(
            cost=estimate.objective_mean.astype(dtype),
            cost_error=estimate.objective_standard_error.astype(dtype),
            gradient_norm=jnp.linalg.norm(estimate.value),
            gradient_error=jnp.linalg.norm(estimate.standard_error),
            alpha=alpha.mean().astype(dtype),
            reason=reason,
            bias_bound=estimate.bias_bound.astype(dtype),
            scale=jnp.asarray(scale, dtype),
            step_norm=jnp.asarray(step_norm, dtype),
            finite_fraction=jnp.asarray(estimate.finite_fraction, dtype),
            num_rollouts=estimate.num_rollouts.astype(jnp.int32),
            num_gradient_rollouts=estimate.num_gradient_rollouts.astype(jnp.int32),
            is_taken=jnp.asarray(is_taken),
        )


class Method(eqx.Module):
    """A way to improve parameters step by step; `run` gives it budgets, a history and many seeds."""

    @abstractmethod
    def init(self, params: Float[Array, " dim"]) -> PyTree:
        """Give what the method carries from step to step besides the parameters."""

    @abstractmethod
    def advance(
        self, params: Float[Array, " dim"], state: PyTree, key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], PyTree, Record]:
        """Take one step; where it cannot, give back what came in, with `is_taken` False."""
