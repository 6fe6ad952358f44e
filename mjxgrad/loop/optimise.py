"""Descent along estimated gradients with any optimiser of optax, and one step of it as an optax transformation."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int, Key, PRNGKeyArray, PyTree

from mjxgrad._arrays import function, instance, known, one_key, real, takes
from mjxgrad.estimators.estimate import Estimator, GradientEstimate
from mjxgrad.loop.descent import Carry, Descent, RunOptions
from mjxgrad.loop.result import Optimisation, Record
from mjxgrad.objective import Objective, flattened, of_vector
from mjxgrad.objective.base import Restored, Scalar, Vector, as_objective

AnnealedObjective = Callable[[Scalar], Objective]
Annealing = Callable[[ArrayLike], ArrayLike]
"""A schedule from the number of a step to a scale in (0, 1]."""


def optimise(
    objective: Objective | AnnealedObjective,
    params: PyTree,
    key: Key[Array, "..."],
    *,
    estimator: Estimator,
    optimiser: optax.GradientTransformation,
    num_steps: int,
    annealing: Annealing | None = None,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost under noise by descent along estimated gradients.

    There is one compilation for all steps and seeds: `jax.random.split(jax.random.key(0), 5)` in place of the key runs
    five seeds in one program. Step number n of a run draws its noise from `fold_in(key, n)`.

    A step whose estimate is not finite is not taken: parameters and optimiser stay unchanged, `num_skipped` counts the
    step, and the next one draws other noise. The run stops where nothing is felt, see `Stopped`.

    With annealing, smoothing decreases as the run converges: `objective` is then a function of a traced scale in
    (0, 1], and `annealing` is the schedule of the scale.

        # Contact from soft to stiff; likewise objective.with_stddev(0.3 * scale) for less and less noise.
        mg.optimise(
            lambda scale: task.objective(softness=mg.Softness(stiffness=1e3 / scale, damping_ratio=1.0)), params, key,
            annealing=optax.exponential_decay(1.0, 10, 0.5, end_value=0.01), ...
        )

    Args:
        objective: the objective to minimise, or with `annealing` a function from a scale to an objective.
        params: the start: a vector, with many seeds also one per seed; or a pytree with floating-point arrays, such as a
            dict, an equinox module or a matrix of controls. The function of `parameter_noise` and `evaluate` then take a
            pytree of the same form, and the result has this form. Estimators see all its arrays as one vector.
        key: key of all noise; with a leading axis, one per seed.
        estimator: function called as `estimator(objective, params, key)`: your own, or one of `mg.estimators` with its
            settings bound by `functools.partial`. One that takes `memory`, as `alpha_order` does, is given the `memory` of
            the estimate before.
        optimiser: an optimiser of optax; it also gets the mean cost under noise, as `value`.
        num_steps: largest number of steps.
        annealing: a schedule from step to scale, such as one of optax.
        **options: `evaluate`, a cost without noise, by which the best parameters are chosen, every `evaluate_every` steps (1);
            `patience`, `log`, `checkpoint` and `progress`; see `mjxgrad.loop.descent.RunOptions`.

    Returns:
        The result; after Ctrl-C that of the steps done, `stopped` being `Stopped.interrupted`.

    Raises:
        KeyboardInterrupt: if Ctrl-C came before the end of the first step.
        ValueError: if `objective` and `annealing` do not belong together, a number is out of range, shapes do not fit,
            or a checkpoint is damaged or from another run.
    """
    vector, restore = flattened(params, 1 + jnp.ndim(key))
    chosen = RunOptions.of(num_steps, options)
    if chosen.evaluate is not None:
        chosen = dataclasses.replace(chosen, evaluate=Restored(chosen.evaluate, restore))
    method = GradientStep(chosen, of_vector(objective, restore), estimator, optimiser, annealing)
    result = method.run(vector, key)
    return dataclasses.replace(result, params=restore(result.params), best_params=restore(result.best_params))


_CHECKED = 100_000  # steps whose scales are looked at before the first


class GradientStep(Descent):
    """The method of `optimise`: an estimate, and a step of the optimiser along it."""

    objective: Objective | AnnealedObjective
    estimator: Estimator
    optimiser: optax.GradientTransformation
    annealing: Annealing | None

    def __check_init__(self):
        schedule = self.annealing
        function("annealing", schedule, "step")
        if schedule is None:
            as_objective(self.objective)
        elif isinstance(self.objective, Objective):
            raise ValueError(
                "objective must be a function from a scale to an objective when annealing is given, got an objective; "
                "write lambda scale: objective.with_stddev(scale * stddev)"
            )
        else:
            real("the scale of annealing", schedule(0))
            steps = jnp.arange(min(self.options.num_steps, _CHECKED))
            scales = known(jax.vmap(lambda step: jnp.asarray(schedule(step), float))(steps))
            if scales is not None and not np.isfinite(scales).all():
                step = int(np.argmin(np.isfinite(scales)))
                raise ValueError(f"the scale of annealing must be finite, got {scales[step]} in step {step}")
        function("estimator", self.estimator, "objective", "params", "key", is_needed=True)
        instance(
            "optimiser", self.optimiser, optax.GradientTransformation, "of optax with its settings, as optax.adam(1e-2)"
        )

    def init_state(self, params: Vector) -> tuple[PyTree, PyTree]:
        """Return the optimiser's first state, and an empty memory for an estimator that takes one, else None."""
        state = jax.tree.map(jnp.asarray, self.optimiser.init(params))
        if not takes(self.estimator, "memory"):
            return state, None
        zero = jnp.zeros((), jnp.int32)
        shapes = jax.eval_shape(lambda at: self.estimated(at, jax.random.key(0), zero)[1].memory, params)
        return state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def step(self, carry: Carry, index: Int[Array, ""]) -> tuple[Carry, Record]:
        scale, estimate = self.estimated(carry.params, carry.key, index, carry.state[1])
        change, state, is_taken = self.change(carry.params, carry.state, estimate, estimate.value)
        dtype = carry.params.dtype
        record = Record(
            cost=estimate.objective_mean.astype(dtype),
            cost_error=estimate.objective_standard_error.astype(dtype),
            gradient_norm=jnp.linalg.norm(estimate.value),
            alpha=estimate.alpha.astype(dtype),
            reason=estimate.reason,
            scale=scale,
            step_norm=jnp.linalg.norm(change),
            finite_fraction=jnp.asarray(estimate.finite_fraction, dtype),
            num_rollouts=estimate.num_rollouts.astype(jnp.int32),
            num_gradient_rollouts=estimate.num_gradient_rollouts.astype(jnp.int32),
            is_taken=is_taken,
            noise_free_cost=jnp.full((), jnp.nan, dtype),
        )
        return self.moved(carry, index, carry.params + change, state, record)

    def estimated(
        self, params: Vector, key: PRNGKeyArray, step: Int[Array, ""], memory: PyTree = None
    ) -> tuple[Scalar, GradientEstimate]:
        """Return the scale of a step, 1 without annealing, and the estimate at this scale."""
        objective: Any = self.objective
        scale = jnp.ones((), params.dtype)
        if self.annealing is not None:
            scale = jnp.asarray(self.annealing(step), params.dtype)
            objective = objective(scale)
        known = {} if memory is None else {"memory": memory}
        estimate = self.estimator(objective, params, jax.random.fold_in(key, step), **known)
        if not isinstance(estimate, GradientEstimate):
            raise ValueError(f"estimator must return a GradientEstimate, got {type(estimate).__name__}")
        return scale, jax.tree.map(jnp.asarray, estimate)

    def change(
        self, params: Vector, state: tuple[PyTree, PyTree], estimate: GradientEstimate, gradient: Vector
    ) -> tuple[Vector, tuple[PyTree, PyTree], Bool[Array, ""]]:
        """Return the optimiser's change of the parameters, the state after it, and whether the step is taken.

        The gradient is the sum of the estimate and of the gradient of anything else in the cost.
        """
        inner, memory = state
        is_finite = jnp.isfinite(gradient).all()
        # NaN must not reach the optimiser: its behaviour is then undefined, even if the result is discarded.
        gradient = jnp.where(is_finite, gradient, 0).astype(params.dtype)
        # `reduce_on_plateau` needs the cost.
        update = optax.with_extra_args_support(self.optimiser).update
        try:
            updates, moved = update(gradient, inner, params, value=estimate.objective_mean)
        except TypeError as error:
            wanted = "optimiser must have numbers as its settings, as optax.adam(1e-2)"
            raise ValueError(f"{wanted}; its update raised TypeError: {error}") from error
        change = jnp.asarray(updates)
        is_taken = is_finite & jnp.isfinite(params + change).all()
        moved = jax.tree.map(lambda new, old: jnp.where(is_taken, new, old), moved, inner)
        kept = moved, None if memory is None else estimate.memory
        return jnp.where(is_taken, change, 0).astype(params.dtype), kept, is_taken


class EstimatedGradientState(eqx.Module):
    """The state of `estimated_gradient`: counts of updates and of those that were not finite, and the optimiser's state.

    Attributes:
        scale: scale of the annealing at the last update.
        estimate: last estimate, as a vector; all NaN before the first update.
    """

    step: Int[Array, ""]
    num_skipped: Int[Array, ""]
    scale: Scalar
    estimate: GradientEstimate
    inner: tuple[PyTree, PyTree]


def estimated_gradient(
    objective: Objective | AnnealedObjective,
    key: PRNGKeyArray,
    *,
    estimator: Estimator,
    optimiser: optax.GradientTransformation | None = None,
    annealing: Annealing | None = None,
) -> optax.GradientTransformationExtraArgs:
    """Return the step of `optimise` as an optax transformation, for a loop of your own.

        transformation = mg.estimated_gradient(objective, key, estimator=estimator, optimiser=optax.adam(1e-2))
        state = transformation.init(params)
        for _ in range(100):
            change, state = transformation.update(None, state, params)
            params = optax.apply_updates(params, change)
        state.estimate  # the last one, with its error bars

    Arguments and noise are those of `optimise`, so both give the same trajectory. With `optimiser` None the update is the
    gradient itself, to be chained with other transformations.

    Returns:
        A transformation of a vector, or of a pytree as in `optimise`. The updates that it is given are added to the
        estimate: the gradient of anything else in the cost, or None. Where the estimate is not finite the update is zero,
        and `num_skipped` counts it.

    Raises:
        ValueError: if `objective` and `annealing` do not belong together.
    """
    one_key(key)
    rule = GradientStep(RunOptions(1), objective, estimator, optimiser or optax.identity(), annealing)

    def of_form(params: PyTree) -> tuple[GradientStep, Vector, Any]:
        vector, restore = flattened(params)
        return dataclasses.replace(rule, objective=of_vector(objective, restore)), vector, restore

    def init(params: PyTree) -> EstimatedGradientState:
        zero, (own, vector, _) = jnp.zeros((), jnp.int32), of_form(params)
        shapes = jax.eval_shape(lambda step: own.estimated(vector, key, step), zero)
        nothing = lambda x: jnp.full(x.shape, jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else 0, x.dtype)  # noqa: E731
        scale, estimate = jax.tree.map(nothing, shapes)
        return EstimatedGradientState(zero, zero, scale, estimate, own.init_state(vector))

    def update(
        updates: PyTree, state: EstimatedGradientState, params: PyTree = None, **_: Any
    ) -> tuple[PyTree, EstimatedGradientState]:
        if params is None:
            raise ValueError("params must be given to update, got None: the gradient is estimated there")
        own, vector, restore = of_form(params)
        scale, estimate = own.estimated(vector, key, state.step, state.inner[1])
        gradient = estimate.value if updates is None else estimate.value + flattened(updates)[0]
        change, inner, is_taken = own.change(vector, state.inner, estimate, gradient)
        moved = EstimatedGradientState(state.step + 1, state.num_skipped + ~is_taken, scale, estimate, inner)
        return eqx.filter(restore(change), eqx.is_inexact_array), moved

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]
