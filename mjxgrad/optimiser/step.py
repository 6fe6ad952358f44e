"""One step along an estimated gradient, how far it may go, and the same as an optax transformation."""

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
from mjxgrad.objective import Objective, OpenLoop, ParameterNoise, flattened, of_vector
from mjxgrad.objective.base import as_objective
from mjxgrad.optimiser.annealing import Annealing, as_annealing
from mjxgrad.optimiser.result import Record

AnnealedObjective = Callable[[Float[Array, ""]], Objective]


class Method(eqx.Module):
    """A way to improve parameters step by step; `run` gives it budgets, a history and many seeds."""

    @abstractmethod
    def init(self, params: Float[Array, " dim"]) -> PyTree:
        """Return what the method carries from step to step besides the parameters."""

    @abstractmethod
    def advance(
        self, params: Float[Array, " dim"], state: PyTree, key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], PyTree, Record]:
        """Take one step; where it cannot, return what came in, with `is_taken` False."""


class TrustRegion(eqx.Module):
    r"""Limit a step to where the estimate of the gradient can be believed.

    An estimate $g$ with bias at most $B$ describes the smoothed cost $F$ about as far as its noise reached, and less
    far the more of it may be bias. The step $s$, in units of the noise's standard deviation, is shortened to

    $$\lVert s \rVert \le \mathrm{radius} \cdot \max(0, 1 - B / \lVert g \rVert).$$

    What this guarantees. With $g = \nabla F + b$, $\lVert b \rVert \le B$,

    $$\langle g, \nabla F \rangle \ge \lVert g \rVert (\lVert g \rVert - B) > 0
      \quad\text{if } B < \lVert g \rVert,$$

    and no better bound exists: $b = B g / \lVert g \rVert$ meets it. So $-g$ is a descent direction as long as a step
    is allowed at all, and none is allowed when the bias may have turned it round. If $\nabla F$ has Lipschitz constant
    $L$, a step of length $t$ along $-g$ changes $F$ by at most
    $-t(\lVert g \rVert - B) + L t^2 / 2$, which is negative for $t < 2(\lVert g \rVert - B)/L$. With
    $t = r\,(1 - B/\lVert g \rVert)$ that is $r < 2\lVert g \rVert / L$, whatever $B$ is: a radius that is safe
    without bias stays safe with it. An optimiser that turns the step away from $-g$ keeps the limit, not the guarantee.
    Sampling error is not part of it: it averages out over steps, which bias does not.

    The length is the Euclidean one, not per root of dimension: in any one direction the noise reaches about one
    standard deviation however many others there are. Where nothing is known of the bias ($B$ is NaN) the radius alone
    limits.

    Attributes:
        radius: in standard deviations of the noise; positive.
        step_scale: the unit of length for each parameter, in the parameter's units. Needed where the noise is not on
            the parameters, as with a policy; None takes the noise's standard deviation.
    """

    radius: float = eqx.field(static=True)
    step_scale: Float[Array, "..."] | float | None = None

    def __check_init__(self):
        if not self.radius > 0:
            raise ValueError(f"radius must be positive, got {self.radius}")

    def limit(
        self,
        step: Float[Array, " dim"],
        gradient: Float[Array, " dim"],
        bias_bound: Float[Array, ""],
        objective: Objective,
    ) -> Float[Array, " dim"]:
        """Shorten a step along an estimate, not clipped, where it is too long."""
        unit = self.step_scale
        if unit is None:
            unit = parameter_stddev(objective, step.size)
        if unit is None:
            raise ValueError(
                f"step_scale must be given to TrustRegion for {type(objective).__name__}, whose noise is not on the "
                "parameters; write TrustRegion(radius, step_scale=...) in the parameters' units"
            )
        norm = jnp.linalg.norm(gradient)
        bound = jnp.nan_to_num(bias_bound, nan=0.0, posinf=jnp.inf)
        trusted = jnp.where(bound < norm, 1 - bound / jnp.where(norm > 0, norm, 1), 0)
        length = jnp.linalg.norm(step / unit)
        return step * jnp.minimum(1, self.radius * trusted / jnp.where(length > 0, length, 1)).astype(step.dtype)


class StepState(eqx.Module):
    """What a step leaves for the next: the states of the optimiser and of the annealing."""

    optimiser: PyTree
    annealing: PyTree


class GradientStep(Method):
    """Everything that turns an estimate into a step; see `optimise`."""

    objective: Objective | AnnealedObjective
    estimator: Estimator
    optimiser: optax.GradientTransformationExtraArgs
    annealing: Annealing | None
    trust_region: TrustRegion | None

    def __init__(
        self,
        objective: Objective | AnnealedObjective,
        estimator: Estimator,
        optimiser: optax.GradientTransformation,
        annealing: Annealing | Callable[[ArrayLike], ArrayLike] | None,
        trust_region: TrustRegion | None,
        clip_norm: float | None,
    ):
        if annealing is None:
            as_objective(objective)
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
        self.annealing, self.trust_region = as_annealing(annealing), trust_region

    def init(self, params: Float[Array, " dim"]) -> StepState:
        annealing = None if self.annealing is None else self.annealing.init(params.dtype)
        return StepState(jax.tree.map(jnp.asarray, self.optimiser.init(params)), annealing)

    def advance(
        self, params: Float[Array, " dim"], state: StepState, key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], StepState, Record]:
        scale, objective = self.annealed(self.objective, params, state, step)
        estimate = self.estimator(objective, params, key)
        change, state, is_taken = self.change(params, state, objective, estimate, estimate.value)
        step_norm = jnp.linalg.norm(change)
        return params + change, state, Record.of_estimate(estimate, scale=scale, step_norm=step_norm, is_taken=is_taken)

    def annealed(
        self,
        objective: Objective | AnnealedObjective,
        params: Float[Array, " dim"],
        state: StepState,
        step: Int[Array, ""],
    ) -> tuple[Float[Array, ""], Objective]:
        """Return the scale of a step, 1 without annealing, and the objective at it."""
        if self.annealing is None:
            return jnp.ones((), params.dtype), as_objective(objective)
        scale = self.annealing.scale(state.annealing, step)
        return scale, objective if isinstance(objective, Objective) else objective(scale)

    def change(
        self,
        params: Float[Array, " dim"],
        state: StepState,
        objective: Objective,
        estimate: GradientEstimate,
        gradient: Float[Array, " dim"],
    ) -> tuple[Float[Array, " dim"], StepState, Bool[Array, ""]]:
        """Ask the optimiser for the change of the parameters, and limit it.

        The gradient is that of the estimate and of anything else in the cost. A step that would not be finite is not
        taken: the change is zero and the state stays as it was.
        """
        is_finite = jnp.isfinite(gradient).all()
        # NaN must not reach the optimiser: what it does with one that is thrown away later is not defined.
        gradient = jnp.where(is_finite, gradient, 0).astype(params.dtype)
        updates, optimiser = self.optimiser.update(gradient, state.optimiser, params, value=estimate.objective_mean)
        change = jnp.asarray(updates)
        if self.trust_region is not None:
            change = self.trust_region.limit(change, gradient, estimate.bias_bound, objective)
        is_taken = is_finite & jnp.isfinite(params + change).all()
        annealing = state.annealing
        if self.annealing is not None:
            annealing = self.annealing.update(annealing, estimate.objective_mean, estimate.objective_standard_error)
        moved = jax.tree.map(lambda new, old: jnp.where(is_taken, new, old), StepState(optimiser, annealing), state)
        return jnp.where(is_taken, change, 0).astype(params.dtype), moved, is_taken


class EstimatedGradientState(eqx.Module):
    """The state of `estimated_gradient`.

    Attributes:
        step: number of updates so far; the noise of each comes from it.
        num_skipped: of those, the ones that were not finite and so were zero.
        scale: of the annealing at the last update.
        estimate: the last one, of the vector; all NaN before the first.
        inner: states of the optimiser and of the annealing.
    """

    step: Int[Array, ""]
    num_skipped: Int[Array, ""]
    scale: Float[Array, ""]
    estimate: GradientEstimate
    inner: StepState


def estimated_gradient(
    objective: Objective | AnnealedObjective,
    key: PRNGKeyArray,
    *,
    estimator: Estimator,
    optimiser: optax.GradientTransformation | None = None,
    annealing: Annealing | Callable[[ArrayLike], ArrayLike] | None = None,
    trust_region: TrustRegion | None = None,
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
    with others; a trust region needs an optimiser, for it limits steps.

    Returns:
        A transformation of a vector, or of a pytree as in `optimise`. What it is given as updates is added to the
        estimate: the gradient of anything else in the cost, or None. Its `update` takes two further arguments, `key` and
        `objective`, in place of its own for that update. Where the estimate is not finite the update is zero, and
        `num_skipped` counts it.

    Raises:
        ValueError: if `objective` and `annealing` do not belong together, or a trust region comes without an optimiser.
    """
    if trust_region is not None and optimiser is None:
        raise ValueError("trust_region must come with an optimiser, got None; it limits steps, not gradients")
    rule = GradientStep(objective, estimator, optimiser or optax.identity(), annealing, trust_region, clip_norm)

    def init(params: PyTree) -> EstimatedGradientState:
        vector, restore = flattened(params)

        def first(
            vector: Float[Array, " dim"], inner: StepState, key: PRNGKeyArray, step: Int[Array, ""]
        ) -> tuple[Float[Array, ""], GradientEstimate]:
            scale, annealed = rule.annealed(of_vector(objective, restore), vector, inner, step)
            return scale, estimator(annealed, vector, key)

        inner, zero = rule.init(vector), jnp.zeros((), jnp.int32)
        scale, estimate = jax.tree.map(_nothing, jax.eval_shape(first, vector, inner, key, zero))
        return EstimatedGradientState(zero, zero, scale, estimate, inner)

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
        scale, annealed = rule.annealed(of_vector(objective, restore), vector, state.inner, state.step)
        estimate = jax.tree.map(jnp.asarray, estimator(annealed, vector, jax.random.fold_in(key, state.step)))
        gradient = estimate.value if updates is None else estimate.value + flattened(updates)[0]
        change, inner, is_taken = rule.change(vector, state.inner, annealed, estimate, gradient)
        moved = EstimatedGradientState(state.step + 1, state.num_skipped + ~is_taken, scale, estimate, inner)
        return change if restore is None else eqx.filter(restore(change), eqx.is_inexact_array), moved

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _nothing(leaf: jax.ShapeDtypeStruct) -> Array:
    return jnp.full(leaf.shape, jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0, leaf.dtype)


def parameter_stddev(objective: Objective, dim: int) -> Float[Array, " dim"] | None:
    """Return the standard deviation of the noise on each parameter, or None if the noise is elsewhere."""
    if isinstance(objective, OpenLoop):
        return jnp.ravel(jnp.broadcast_to(objective.stddev, objective.noise_shape))
    if isinstance(objective, ParameterNoise):
        return jnp.broadcast_to(objective.stddev, (dim,))
    return None
