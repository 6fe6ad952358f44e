"""One step along an estimated gradient, and the same as an optax transformation."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.estimators.estimate import Estimator, GradientEstimate
from mjxgrad.objective import Objective, flattened, of_vector
from mjxgrad.objective.base import as_objective
from mjxgrad.optimiser.result import Record

AnnealedObjective = Callable[[Float[Array, ""]], Objective]
Annealing = Callable[[ArrayLike], ArrayLike]
"""From the number of a step to a scale in (0, 1]."""


class Method(eqx.Module):
    """A way to improve parameters step by step; `run` gives it a history and many seeds."""

    @abstractmethod
    def init(self, params: Float[Array, " dim"]) -> PyTree:
        """Return what the method carries from step to step besides the parameters."""

    @abstractmethod
    def advance(
        self, params: Float[Array, " dim"], state: PyTree, key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], PyTree, Record]:
        """Take one step; where it cannot, return what came in, with `is_taken` False."""


class GradientStep(Method):
    """Everything that turns an estimate into a step; see `optimise`."""

    objective: Objective | AnnealedObjective
    estimator: Estimator
    optimiser: optax.GradientTransformationExtraArgs
    annealing: Annealing | None

    def __init__(
        self,
        objective: Objective | AnnealedObjective,
        estimator: Estimator,
        optimiser: optax.GradientTransformation,
        annealing: Annealing | None,
        clip_norm: float | None,
    ):
        if annealing is None:
            as_objective(objective)
        elif not callable(annealing):
            raise ValueError(
                f"annealing must be a schedule from step to scale, got {annealing!r}; "
                "for a fixed scale give the objective that scale"
            )
        elif isinstance(objective, Objective):
            raise ValueError(
                "objective must be a function from a scale to an objective when annealing is given, got an objective; "
                "write lambda scale: objective.with_stddev(scale * stddev)"
            )
        if not callable(estimator):
            named = "functools.partial(mg.estimators.alpha_order, num_samples=64)"
            raise ValueError(f"estimator must be a function such as {named}, got {estimator!r}")
        if not isinstance(optimiser, optax.GradientTransformation):
            raise ValueError(
                f"optimiser must be of optax, with its settings, such as optax.adam(1e-2), got {optimiser!r}"
            )
        if clip_norm is not None:
            if not clip_norm > 0:
                raise ValueError(f"clip_norm must be positive, got {clip_norm}")
            optimiser = optax.chain(optax.clip_by_global_norm(clip_norm), optimiser)
        self.objective, self.estimator = objective, estimator
        # The cost goes along for transformations that watch it, such as optax.contrib.reduce_on_plateau.
        self.optimiser = optax.with_extra_args_support(optimiser)
        self.annealing = annealing

    def init(self, params: Float[Array, " dim"]) -> PyTree:
        return jax.tree.map(jnp.asarray, self.optimiser.init(params))

    def advance(
        self, params: Float[Array, " dim"], state: PyTree, key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], PyTree, Record]:
        scale, objective = self.annealed(self.objective, params, step)
        estimate = self.estimator(objective, params, key)
        change, state, is_taken = self.change(params, state, estimate, estimate.value)
        step_norm = jnp.linalg.norm(change)
        return params + change, state, Record.of_estimate(estimate, scale=scale, step_norm=step_norm, is_taken=is_taken)

    def annealed(
        self, objective: Objective | AnnealedObjective, params: Float[Array, " dim"], step: Int[Array, ""]
    ) -> tuple[Float[Array, ""], Objective]:
        """Return the scale of a step, 1 without annealing, and the objective at it."""
        if self.annealing is None:
            return jnp.ones((), params.dtype), as_objective(objective)
        scale = jnp.asarray(self.annealing(step), params.dtype)
        return scale, objective if isinstance(objective, Objective) else objective(scale)

    def change(
        self,
        params: Float[Array, " dim"],
        state: PyTree,
        estimate: GradientEstimate,
        gradient: Float[Array, " dim"],
    ) -> tuple[Float[Array, " dim"], PyTree, Bool[Array, ""]]:
        """Ask the optimiser for the change of the parameters.

        The gradient is that of the estimate and of anything else in the cost. A step that would not be finite is not
        taken: the change is zero and the state stays as it was.
        """
        is_finite = jnp.isfinite(gradient).all()
        # NaN must not reach the optimiser: what it does with one that is thrown away later is not defined.
        gradient = jnp.where(is_finite, gradient, 0).astype(params.dtype)
        updates, moved = self.optimiser.update(gradient, state, params, value=estimate.objective_mean)
        change = jnp.asarray(updates)
        is_taken = is_finite & jnp.isfinite(params + change).all()
        moved = jax.tree.map(lambda new, old: jnp.where(is_taken, new, old), moved, state)
        return jnp.where(is_taken, change, 0).astype(params.dtype), moved, is_taken


class EstimatedGradientState(eqx.Module):
    """The state of `estimated_gradient`.

    Attributes:
        step: number of updates so far; the noise of each comes from it.
        num_skipped: of those, the ones that were not finite and so were zero.
        scale: of the annealing at the last update.
        estimate: the last one, of the vector; all NaN before the first.
        inner: state of the optimiser.
    """

    step: Int[Array, ""]
    num_skipped: Int[Array, ""]
    scale: Float[Array, ""]
    estimate: GradientEstimate
    inner: PyTree


def estimated_gradient(
    objective: Objective | AnnealedObjective,
    key: PRNGKeyArray,
    *,
    estimator: Estimator,
    optimiser: optax.GradientTransformation | None = None,
    annealing: Annealing | None = None,
    clip_norm: float | None = None,
) -> optax.GradientTransformationExtraArgs:
    """Return the step of `optimise` as an optax transformation, for a loop of your own.

        transformation = mg.estimated_gradient(objective, key, estimator=estimator, optimiser=optax.adam(1e-2))
        state = transformation.init(params)
        for _ in range(100):
            change, state = transformation.update(None, state, params)
            params = optax.apply_updates(params, change)
        state.estimate  # the last one, with its error bars

    Update number n draws its noise from `fold_in(key, n)`, as `optimise` does, so both give the same trajectory. The
    arguments are those of `optimise`, but `optimiser` may be None, which gives the gradient itself, clipped, to be chained
    with others.

    Returns:
        A transformation of a vector, or of a pytree as in `optimise`. What it is given as updates is added to the
        estimate: the gradient of anything else in the cost, or None. Its `update` takes two further arguments, `key` and
        `objective`, in place of its own for that update. Where the estimate is not finite the update is zero, and
        `num_skipped` counts it.

    Raises:
        ValueError: if `objective` and `annealing` do not belong together.
    """
    rule = GradientStep(objective, estimator, optimiser or optax.identity(), annealing, clip_norm)

    def init(params: PyTree) -> EstimatedGradientState:
        vector, restore = flattened(params)

        def first(
            vector: Float[Array, " dim"], key: PRNGKeyArray, step: Int[Array, ""]
        ) -> tuple[Float[Array, ""], GradientEstimate]:
            scale, annealed = rule.annealed(of_vector(objective, restore), vector, step)
            return scale, estimator(annealed, vector, key)

        zero = jnp.zeros((), jnp.int32)
        scale, estimate = jax.tree.map(_nothing, jax.eval_shape(first, vector, key, zero))
        return EstimatedGradientState(zero, zero, scale, estimate, rule.init(vector))

    def update(
        updates: PyTree,
        state: EstimatedGradientState,
        params: PyTree = None,
        *,
        key: PRNGKeyArray = key,
        objective: Objective | AnnealedObjective = objective,
        **unused: Any,
    ) -> tuple[PyTree, EstimatedGradientState]:
        del unused  # extra arguments of others in a chain
        if params is None:
            raise ValueError("params must be given to update, got None: the gradient is estimated there")
        vector, restore = flattened(params)
        scale, annealed = rule.annealed(of_vector(objective, restore), vector, state.step)
        estimate = jax.tree.map(jnp.asarray, estimator(annealed, vector, jax.random.fold_in(key, state.step)))
        gradient = estimate.value if updates is None else estimate.value + flattened(updates)[0]
        change, inner, is_taken = rule.change(vector, state.inner, estimate, gradient)
        moved = EstimatedGradientState(state.step + 1, state.num_skipped + ~is_taken, scale, estimate, inner)
        return change if restore is None else eqx.filter(restore(change), eqx.is_inexact_array), moved

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _nothing(leaf: jax.ShapeDtypeStruct) -> Array:
    return jnp.full(leaf.shape, jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0, leaf.dtype)
