"""One step along an estimated gradient, and the same as an optax transformation."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators import GradientEstimate
from mjxgrad.objective import Objective
from mjxgrad.optimiser.smoothing import Smoothing, as_smoothing
from mjxgrad.optimiser.trust_region import TrustRegion, clip

Estimator = Callable[[Objective, Float[Array, " dim"], PRNGKeyArray], GradientEstimate]
SmoothedObjective = Callable[[Float[Array, ""]], Objective]


class StepState(eqx.Module):
    """What a step leaves for the next: the states of the optimiser and of the smoothing."""

    optimiser: PyTree
    smoothing: PyTree


class Proposal(eqx.Module):
    """What a step would do.

    Attributes:
        change: of the parameters; zero if the step is not taken.
        state: for the next step.
        estimate: what it rests on.
        scale: of the smoothing; 1 without any.
        is_taken: whether estimate and change were finite.
    """

    change: Float[Array, " dim"]
    state: StepState
    estimate: GradientEstimate
    scale: Float[Array, ""]
    is_taken: Bool[Array, ""]


class GradientStep(eqx.Module):
    """Everything that turns an estimate into a step; see `optimise`."""

    objective: Objective | SmoothedObjective
    estimator: Estimator
    optimiser: optax.GradientTransformationExtraArgs
    smoothing: Smoothing | None
    trust_region: TrustRegion | None
    clip_norm: float | None

    def init(self, params: Float[Array, " dim"]) -> StepState:
        """Give the state before the first step."""
        smoothing = None if self.smoothing is None else self.smoothing.init(params.dtype)
        return StepState(jax.tree.map(jnp.asarray, self.optimiser.init(params)), smoothing)

    def propose(
        self,
        params: Float[Array, " dim"],
        state: StepState,
        key: PRNGKeyArray,
        step: Int[Array, ""],
        *,
        objective: Objective | SmoothedObjective | None = None,
        other: Float[Array, " dim"] | None = None,
    ) -> Proposal:
        """Estimate, clip, ask the optimiser, limit.

        Args:
            params: the point.
            state: of the step before.
            key: of this step, consumed here.
            step: its number, for schedules.
            objective: in place of the own one.
            other: gradient of what else there is in the cost, without bias.

        Returns:
            The step, which leaves everything as it is if it would not be finite.
        """
        given = self.objective if objective is None else objective
        scale, objective = self._smoothed(given, state, step, params.dtype)
        estimate = self.estimator(objective, params, key)
        gradient = estimate.value if other is None else estimate.value + other
        is_finite = jnp.isfinite(gradient).all()
        # NaN must not reach the optimiser: what it does with one that is thrown away later is not defined.
        gradient = jnp.where(is_finite, gradient, 0).astype(params.dtype)
        # The cost goes along for transformations that watch it, such as optax.contrib.reduce_on_plateau.
        clipped = clip(gradient, self.clip_norm)
        updates, optimiser = self.optimiser.update(clipped, state.optimiser, params, value=estimate.objective_mean)
        change = jnp.asarray(updates)
        if self.trust_region is not None:
            change = self.trust_region.limit(change, gradient, estimate.bias_bound, objective)
        is_taken = is_finite & jnp.isfinite(params + change).all()
        smoothing = state.smoothing
        if self.smoothing is not None:
            smoothing = self.smoothing.update(smoothing, estimate.objective_mean, estimate.objective_standard_error)
        moved = jax.tree.map(lambda new, old: jnp.where(is_taken, new, old), StepState(optimiser, smoothing), state)
        return Proposal(jnp.where(is_taken, change, 0).astype(params.dtype), moved, estimate, scale, is_taken)

    def _smoothed(
        self, objective: Objective | SmoothedObjective, state: StepState, step: Int[Array, ""], dtype: jnp.dtype
    ) -> tuple[Float[Array, ""], Objective]:
        if self.smoothing is None:
            return jnp.ones((), dtype), as_objective(objective)
        scale = self.smoothing.scale(state.smoothing, step)
        return scale, objective if isinstance(objective, Objective) else objective(scale)


def gradient_step(
    objective: Objective | SmoothedObjective,
    estimator: Estimator,
    optimiser: optax.GradientTransformation,
    *,
    smoothing: Smoothing | Callable[[ArrayLike], ArrayLike] | None = None,
    trust_region: TrustRegion | None = None,
    clip_norm: float | None = None,
) -> GradientStep:
    """Put a step together, refusing what does not fit; see `optimise` for the arguments.

    Raises:
        ValueError: if `objective` and `smoothing` do not belong together, or `clip_norm` is not positive.
    """
    smoothing = as_smoothing(smoothing)
    if smoothing is None:
        as_objective(objective)
    elif isinstance(objective, Objective):
        raise ValueError(
            "objective must be a function from a scale to an objective when smoothing is given, got an objective; "
            "write lambda scale: objective.with_stddev(scale * stddev)"
        )
    if clip_norm is not None and not clip_norm > 0:
        raise ValueError(f"clip_norm must be positive, got {clip_norm}")
    optimiser = optax.with_extra_args_support(optimiser)
    return GradientStep(objective, estimator, optimiser, smoothing, trust_region, clip_norm)


def as_objective(objective: Any) -> Objective:
    """Give back an objective, refusing anything else.

    Args:
        objective: as given.

    Returns:
        The same.

    Raises:
        ValueError: if it is none.
    """
    if not isinstance(objective, Objective):
        raise ValueError(
            f"objective must be an Objective, got {type(objective).__name__}; wrap a function by mg.parameter_noise, "
            "or give smoothing= with a function from a scale to an objective"
        )
    return objective


class EstimatedGradientState(eqx.Module):
    """The state of `estimated_gradient`.

    Attributes:
        step: number of updates so far; the noise of each comes from it.
        num_skipped: of those, the ones that were not finite and so were zero.
        scale: of the smoothing at the last update.
        estimate: the last one; all NaN before the first.
        inner: states of the optimiser and of the smoothing.
    """

    step: Int[Array, ""]
    num_skipped: Int[Array, ""]
    scale: Float[Array, ""]
    estimate: GradientEstimate
    inner: StepState


def estimated_gradient(
    objective: Objective | SmoothedObjective,
    estimator: Estimator,
    *,
    key: PRNGKeyArray,
    optimiser: optax.GradientTransformation | None = None,
    smoothing: Smoothing | Callable[[ArrayLike], ArrayLike] | None = None,
    trust_region: TrustRegion | None = None,
    clip_norm: float | None = None,
) -> optax.GradientTransformationExtraArgs:
    """Give the step of `optimise` as an optax transformation, for a loop of your own.

        transformation = mg.estimated_gradient(objective, estimator, key=key, optimiser=optax.adam(1e-2))
        state = transformation.init(params)
        for _ in range(100):
            change, state = transformation.update(None, state, params)
            params = optax.apply_updates(params, change)
        state.estimate  # the last one, with its error bars

    Update number n draws its noise from `fold_in(key, n)`, as `optimise` does, so both give the same trajectory.

    Args:
        objective: as in `optimise`.
        estimator: as in `optimise`.
        key: of all updates.
        optimiser: as in `optimise`. None gives the gradient itself, clipped, to be chained with others; a trust region
            needs an optimiser, for it limits steps.
        smoothing: as in `optimise`.
        trust_region: as in `optimise`.
        clip_norm: as in `optimise`.

    Returns:
        A transformation of flat vectors. What it is given as updates is added to the estimate: the gradient of anything
        else in the cost, or None. Its `update` takes two further arguments, `key` and `objective`, in place of its own
        for that update. Where the estimate is not finite the update is zero, and `num_skipped` counts it.

    Raises:
        ValueError: if `objective` and `smoothing` do not belong together, or a trust region comes without an optimiser.
    """
    if trust_region is not None and optimiser is None:
        raise ValueError("trust_region must come with an optimiser, got None; it limits steps, not gradients")
    rule = gradient_step(
        objective,
        estimator,
        optax.identity() if optimiser is None else optimiser,
        smoothing=smoothing,
        trust_region=trust_region,
        clip_norm=clip_norm,
    )

    def init(params: Float[Array, " dim"]) -> EstimatedGradientState:
        inner = rule.init(params)
        zero = jnp.zeros((), jnp.int32)
        proposal = jax.eval_shape(rule.propose, params, inner, key, zero)
        scale, estimate = jax.tree.map(_nothing, (proposal.scale, proposal.estimate))
        return EstimatedGradientState(zero, zero, scale, estimate, inner)

    def update(
        updates: Float[Array, " dim"] | None,
        state: EstimatedGradientState,
        params: Float[Array, " dim"] | None = None,
        *,
        key: PRNGKeyArray = key,
        objective: Objective | SmoothedObjective | None = None,
        **unused: Any,
    ) -> tuple[Float[Array, " dim"], EstimatedGradientState]:
        del unused  # extra arguments of others in a chain
        if params is None:
            raise ValueError("params must be given to update, got None: the gradient is estimated there")
        own = jax.random.fold_in(key, state.step)
        proposal = rule.propose(params, state.inner, own, state.step, objective=objective, other=updates)
        num_skipped = state.num_skipped + ~proposal.is_taken
        estimate = jax.tree.map(jnp.asarray, proposal.estimate)
        moved = EstimatedGradientState(state.step + 1, num_skipped, proposal.scale, estimate, proposal.state)
        return proposal.change, moved

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _nothing(leaf: jax.ShapeDtypeStruct) -> Array:
    return jnp.full(leaf.shape, jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0, leaf.dtype)
